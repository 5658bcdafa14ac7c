"""What a learnt plate is worth: the same network trained behind it and behind a plain lens, on the same scenes.

    make train-demo                     about 65 minutes on two cores
    python examples/train_demo.py --images DIR --test DIR [--steps N] [--seeds 0 1 2] [--out runs/train_demo]

For each occlusion model that is asked for, two trainings with the same pictures, scenes, steps and seed: the plate of
`examples/automotive_cpu.toml`, learnt together with its network, and a conventional camera, which is the same one with
a flat plate. Both are judged on the same dirty scenes, made from pictures that neither was trained on. The table gives
means and, because scenes are the same, the interval of the mean difference picture by picture (and seed by seed, where
there are several, each of which puts the pictures behind other dirt); beside it stand the rows of the paper's Table 1
that need no training. Trainings let a scene go on beyond its edges as its mirror image, and filters know that: the last
lines tell what is left of the differences where it goes on as the picture does. Written to OUT:

    design/, MODEL_CAMERA_SEED/     the design to begin with, and a training for each
    table.json, table.md            what came out
    pictures/                       links to the pictures that were used

Whatever the numbers say is what the product says. Work that was stopped goes on with the same command.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import see_through

from doedesign.capture.images import PICTURE_FILES, Pictures, picture_files, sample_files
from doedesign.capture.scenes import NamedScene, SceneData
from doedesign.capture.simulate import inner, photograph
from doedesign.cli import exit_code
from doedesign.optimization import optimize
from doedesign.recon.model import Model
from doedesign.runs.folder import TRAINING_TABLES
from doedesign.runs.level_maps import open_design
from doedesign.runtime.progress import meter
from doedesign.spec import load_spec
from doedesign.training.scores import mean_and_interval, paired_difference, scores
from doedesign.training.train import train
from doedesign.training.validation import SCENE_SEED
from fab.errors import InputError
from fab.files import canonical_json, write_atomic
from sim.light import srgb_from_linear
from sim.obstruction import CameraView

SPEC = Path(__file__).parent / "automotive_cpu.toml"
# Where the checkout has a folder of data beside it. Trained on: pictures whose licences allow it (Unsplash, CC0, free
# use, MIT), so that what is learnt may be given away. Judged by: others, for which that is not needed.
DATA = Path(__file__).parents[2] / "shared" / "data"
TRAINED_ON = ("backgrounds_clic2025_2k/*", "backgrounds_gb82/*", "backgrounds_kodak/*", "driving_720p/udacity_*")
LICENCES = "Unsplash License (CLIC 2025), CC0 1.0 (GB82), unrestricted (Kodak PCD0992), MIT (Udacity)"
JUDGED_BY = ("backgrounds_bsds500/val/*", "driving_camvid480/*", "driving_720p/bdd_*", "driving_720p/tusimple_*")
MOST_JUDGED = 48

CAMERAS = ("doe", "conventional")
BORDERS = ("own", "reflect")
# Where differences are taken.
PARTS = {
    "occluded": "occluded",
    "full": "full",
    "own": "occluded, scenes that go on as the picture does",
    "reflect": "occluded, the same scenes mirrored",
}
ROWS = {
    "reconstruction": "network",
    "wiener_far": "Wiener (far)",
    "wiener_near": "Wiener (near)",
    "richardson_lucy_far": "Richardson-Lucy (far)",
    "capture": "capture",
}


@dataclass(frozen=True)
class Plan:
    """What to train.

    Attributes:
        out: folder of everything.
        images: pictures to train on; those of DATA, or scikit-image's, if None.
        test: pictures to judge by; the same.
        models: occlusion models.
        seeds: seeds of the trainings.
        spec: what is trained.
        overrides: changes to the spec.
    """

    out: Path
    images: Path | None = None
    test: Path | None = None
    models: Sequence[str] = ("paper", "radiometric")
    seeds: Sequence[int] = (0,)
    spec: Path = SPEC
    overrides: Sequence[str] = field(default_factory=tuple)


def say(text: str) -> None:
    """Tell what is going on."""
    print(text, file=sys.stderr, flush=True)


def link(folder: Path, files: Sequence[Path], most: int | None = None) -> None:
    """Make a folder of links to pictures, evenly chosen where there are too many."""
    if most is not None and len(files) > most:
        files = [files[k] for k in np.linspace(0, len(files) - 1, most).round().astype(int)]
    folder.mkdir(parents=True, exist_ok=True)
    for path in files:
        name = folder / path.name
        if not name.exists():
            name.unlink(missing_ok=True)  # a link to where the pictures were before
            name.symlink_to(path.resolve())


class Source(NamedTuple):
    """Where pictures come from.

    Attributes:
        images: folder of those to train on.
        test: folder of those to judge by.
        licence: that of the first, where it is known.
    """

    images: Path
    test: Path
    licence: str | None


def source_of(plan: Plan) -> Source:
    """The user's pictures; or links to those of DATA, or to scikit-image's where there are none."""
    if plan.images is not None and plan.test is not None:
        return Source(plan.images, plan.test, None)
    if plan.images is not None or plan.test is not None:
        given = "--images" if plan.test is None else "--test"
        raise InputError("--images, --test", "must be given together", f"{given} alone", "Give both, or neither.")
    folders = plan.out / "pictures" / "trained_on", plan.out / "pictures" / "judged_by"
    sets = [[p for pattern in given for p in sorted(DATA.glob(pattern))] for given in (TRAINED_ON, JUDGED_BY)]
    known = all(sets)
    if not known:
        samples = sample_files()
        sets = [[path for k, path in enumerate(samples) if k % 3], samples[::3]]
    for folder, files, most in zip(folders, sets, (None, MOST_JUDGED), strict=True):
        link(folder, [path for path in files if path.suffix.lower() in PICTURE_FILES], most)
    return Source(*folders, LICENCES if known else None)


def trained(plan: Plan, design: Path, model: str, camera: str, seed: int) -> dict[str, Any]:
    """Train one network, and return how it is judged."""
    images, test, licence = source_of(plan)
    settings = [f"train.validation={len(picture_files(test))}", f'train.camera="{camera}"', f"train.seed={seed}"]
    how: Any = {"validation": test, "licence": licence, "occlusion": model}
    out = plan.out / f"{model}_{camera}_{seed}"
    changes = (*settings, *plan.overrides)
    begun = open_design(design, False, overrides=changes, free=TRAINING_TABLES)
    train(begun, images, out, overrides=changes, **how)
    return json.loads((out / "metrics.json").read_text())


def surroundings(plan: Plan, model: str, seed: int) -> dict[str, dict[str, list[float]]]:
    """PSNR in the occluded region of every scene, by what lies beyond its edges ("own", "reflect") and by picture.

    Both show the same scenes. They bring their surroundings along, so they are larger than those that the trainings
    were judged by, other ones, and small pictures are enlarged for them.
    """
    models = {camera: Model.open(plan.out / f"{model}_{camera}_{seed}") for camera in CAMERAS}
    own, kind, far = see_through.capture_model_of(models["doe"])
    psfs = {camera: see_through.psfs_of(models[camera]) for camera in CAMERAS}
    side = load_spec(plan.out / f"{model}_doe_{seed}" / "spec.toml").train.size + own.margin_px
    view = CameraView((side, side), own.camera.pixel_m, own.camera.sensor_distance_m)
    files = picture_files(source_of(plan).test)
    data = SceneData(Pictures(files, most_px=2 * side), kind, view, far, SCENE_SEED, mirrored=False)
    found: dict[str, dict[str, list[float]]] = {border: {} for border in BORDERS}
    with meter(f"surroundings, {model}, seed {seed}", len(files)) as progress:
        for number in range(len(files)):
            (name, scene), key = data.item(number), jax.random.key(number)
            turns = {"own": (scene, own), "reflect": (inner(scene, own.margin_px), replace(own, border="reflect"))}
            for border, (seen, by) in turns.items():
                shot = photograph(NamedScene(name, seen), by, psfs["doe"], psfs["conventional"], key)
                for camera, light in zip(CAMERAS, (shot.doe, shot.conventional), strict=True):
                    known = map(psfs[camera], (shot.depth_far_m, shot.depth_near_m))
                    network = see_through.restored(models[camera], light, *known)
                    for what, image in (("capture", srgb_from_linear(light)), ("network", network)):
                        judged = scores(image[None], srgb_from_linear(shot.clean)[None], shot.mask[None])
                        found[border].setdefault(f"{camera}: {what}", []).append(float(judged.occluded.psnr[0]))
            progress.advance(number + 1)
    return found


def scores_of(found: Sequence[dict[str, Any]], row: str, region: str, score: str) -> np.ndarray:
    """`[seed, picture]` a score, in the order of the pictures' names; NaN where nothing is occluded."""
    ordered = [sorted(one["scenes"], key=lambda scene: scene["name"]) for one in found]
    return np.array([[each[row][region][score] for each in scenes] for scenes in ordered], np.float64)


def compared(judged: dict[str, list[dict[str, Any]]], beyond: Sequence[dict[str, dict[str, list[float]]]]) -> Any:
    """Means, and differences picture by picture with their 95 % intervals.

    Args:
        judged: by camera, the metrics of every seed's training.
        beyond: `surroundings` of every seed.
    """
    table: dict[str, Any] = {"scenes": len(judged["doe"][0]["scenes"]), "seeds": len(judged["doe"])}
    for region in ("occluded", "full"):
        table[region] = {
            "rows": {
                f"{camera}: {label}": {
                    s: mean_and_interval(scores_of(judged[camera], row, region, s)).mean for s in ("psnr", "ssim")
                }
                for camera in CAMERAS
                for row, label in ROWS.items()
            },
            "psnr_differences": differences(
                scores_of(judged["doe"], "reconstruction", region, "psnr"),
                scores_of(judged["doe"], "capture", region, "psnr"),
                scores_of(judged["conventional"], "reconstruction", region, "psnr"),
            ),
        }
    for border in BORDERS:
        kinds = ("doe: network", "doe: capture", "conventional: network")
        psnr = [np.array([one[border][kind] for one in beyond]) for kind in kinds]
        table[border] = {"psnr_differences": differences(*psnr)}
    return table


def differences(network: np.ndarray, capture: np.ndarray, plain: np.ndarray) -> dict[str, Any]:
    """What the network behind the plate wins, in dB; all `[seed, picture]`."""
    return {
        name: paired_difference(network, other)._asdict() | {"by_seed": np.nanmean(network - other, axis=1).tolist()}
        for name, other in (
            ("network behind the plate over its capture", capture),
            ("network behind the plate over the one behind a plain lens", plain),
        )
    }


def written(found: dict[str, Any]) -> str:
    """The tables as Markdown."""
    lines = []
    for model, table in found.items():
        seeds = f"{table['seeds']} seed{'s' if table['seeds'] > 1 else ''}"
        lines += [f"## Occlusion model `{model}`, {table['scenes']} scenes, {seeds}", ""]
        lines += ["| occluded region (full picture) | PSNR, dB | SSIM |", "| --- | --- | --- |"]
        for name, hidden in table["occluded"]["rows"].items():
            full = table["full"]["rows"][name]
            psnr, ssim = (f"{hidden[s]:.{n}f} ({full[s]:.{n}f})" for s, n in (("psnr", 2), ("ssim", 3)))
            lines.append(f"| {name} | {psnr} | {ssim} |")
        draws = "pictures and seeds" if table["seeds"] > 1 else "pictures"
        lines += ["", f"PSNR differences, dB, with 95 % intervals of the mean over {draws}:", ""]
        for part, where in PARTS.items():
            for name, d in table[part]["psnr_differences"].items():
                by_seed = ", ".join(f"{value:+.2f}" for value in d["by_seed"])
                told = f"; by seed {by_seed}" if table["seeds"] > 1 else ""
                lines.append(f"- {where}: {name}: {d['mean']:+.2f} ({d['low']:+.2f} to {d['high']:+.2f}){told}")
        lines.append("")
    return "\n".join(lines)


def run(plan: Plan) -> dict[str, Any]:
    """Train everything and write the table."""
    design = plan.out / "design"
    optimize(plan.spec, design)
    found = {}
    for model in plan.models:
        judged = {camera: [trained(plan, design, model, camera, seed) for seed in plan.seeds] for camera in CAMERAS}
        found[model] = compared(judged, [surroundings(plan, model, seed) for seed in plan.seeds])
        write_atomic(plan.out / "table.json", canonical_json(found))
        write_atomic(plan.out / "table.md", written(found).encode())
        say(written({model: found[model]}))
    return found


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--images", type=Path, help="pictures to train on; with --test")
    parser.add_argument("--test", type=Path, help="pictures to judge by; with --images")
    parser.add_argument("--models", nargs="+", default=["paper", "radiometric"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, help="steps of every training")
    parser.add_argument("--out", type=Path, default=Path("runs") / "train_demo")
    given = parser.parse_args()
    overrides = [] if given.steps is None else [f"train.steps={given.steps}"]
    plan = Plan(given.out, given.images, given.test, given.models, given.seeds, overrides=overrides)

    def work() -> None:
        run(plan)
        print(plan.out / "table.md")

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
