"""What a learnt plate is worth: the same network trained behind it and behind a plain lens, on the same scenes.

    make train-demo                     about an hour on two cores
    python examples/train_demo.py --images DIR --test DIR [--steps N] [--seeds 0 1 2] [--out runs/train_demo]

For each occlusion model that is asked for, two trainings with the same pictures, scenes, steps and seed: the plate of
`examples/automotive_cpu.toml`, learnt together with its network, and a conventional camera, which is the same one with
a flat plate. Both are judged on the same dirty scenes, made from pictures that neither was trained on. The table gives
means and, because scenes are the same, the interval of the mean difference scene by scene (and seed by seed, where
there are several); beside it stand the rows of the paper's Table 1 that need no training. Written to OUT:

    design/, MODEL_CAMERA_SEED/     the design to begin with, and a training for each
    table.json, table.md            what came out
    pictures/                       links to the pictures that were used

Whatever the numbers say is what the product says. Work that was stopped goes on with the same command.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.cli import exit_code
from doedesign.commands.optimize import optimize
from doedesign.commands.train import Request, train
from doedesign.images import PICTURE_FILES
from doedesign.recon.scores import mean_and_interval, paired_difference
from fab.files import canonical_json, write_atomic

SPEC = Path(__file__).parent / "automotive_cpu.toml"
# Where the checkout has a folder of data beside it. Trained on: pictures whose licences allow it (Unsplash, CC0, free
# use, MIT), so that what is learnt may be given away. Judged by: others, for which that is not needed.
DATA = Path(__file__).parents[2] / "shared" / "data"
TRAINED_ON = ("backgrounds_clic2025_2k/*", "backgrounds_gb82/*", "backgrounds_kodak/*", "driving_720p/udacity_*")
LICENCES = "Unsplash License (CLIC 2025), CC0 1.0 (GB82), unrestricted (Kodak PCD0992), MIT (Udacity)"
JUDGED_BY = ("backgrounds_bsds500/val/*", "driving_camvid480/*", "driving_720p/bdd_*", "driving_720p/tusimple_*")
MOST_JUDGED = 48

CAMERAS = ("doe", "conventional")
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


def linked(folder: Path, patterns: Sequence[str], most: int | None = None) -> Path | None:
    """A folder of links to pictures of DATA, evenly chosen; None where there are none."""
    found = [path for pattern in patterns for path in sorted(DATA.glob(pattern)) if path.suffix in PICTURE_FILES]
    if not found:
        return None
    if most is not None and len(found) > most:
        found = [found[k] for k in np.linspace(0, len(found) - 1, most).round().astype(int)]
    folder.mkdir(parents=True, exist_ok=True)
    for path in found:
        link = folder / path.name
        if not link.exists():
            link.symlink_to(path.resolve())
    return folder


def trained(plan: Plan, design: Path, model: str, camera: str, seed: int) -> dict[str, Any]:
    """Train one network, and return how it is judged."""
    images = plan.images or linked(plan.out / "pictures" / "trained_on", TRAINED_ON)
    test = plan.test or (linked(plan.out / "pictures" / "judged_by", JUDGED_BY, MOST_JUDGED) if images else None)
    settings = [f'train.camera="{camera}"', f"train.seed={seed}", *plan.overrides]
    if test is not None:
        settings.insert(0, f"train.validation={sum(p.suffix.lower() in PICTURE_FILES for p in test.iterdir())}")
    licence = LICENCES if plan.images is None and images is not None else None
    request = Request(images, test, settings, licence=licence, occlusion=model)
    folder = train(design, plan.out / f"{model}_{camera}_{seed}", request, say)
    return json.loads((folder / "metrics.json").read_text())


def scores_of(found: Sequence[dict[str, Any]], row: str, region: str, score: str) -> np.ndarray:
    """`[seed, scene]` a score; NaN where nothing is occluded."""
    return np.array([[each[row][region][score] for each in one["scenes"]] for one in found], np.float64)


def compared(judged: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Means, and differences scene by scene with their 95 % intervals."""
    table: dict[str, Any] = {"scenes": len(judged["doe"][0]["scenes"]), "seeds": len(judged["doe"])}
    for region in ("occluded", "full"):
        rows = {
            f"{camera}: {label}": {
                s: mean_and_interval(scores_of(judged[camera], row, region, s)).mean for s in ("psnr", "ssim")
            }
            for camera in CAMERAS
            for row, label in ROWS.items()
        }
        psnr = {c: scores_of(judged[c], "reconstruction", region, "psnr") for c in CAMERAS}
        others = {
            "network behind the plate over its capture": scores_of(judged["doe"], "capture", region, "psnr"),
            "network behind the plate over the one behind a plain lens": psnr["conventional"],
        }
        differences = {
            name: paired_difference(psnr["doe"], other)._asdict()
            | {"by_seed": np.nanmean(psnr["doe"] - other, axis=1).tolist()}
            for name, other in others.items()
        }
        table[region] = {"rows": rows, "psnr_differences": differences}
    return table


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
        draws = "scenes and seeds" if table["seeds"] > 1 else "scenes"
        lines += ["", f"PSNR differences, dB, with 95 % intervals of the mean over {draws}:", ""]
        for region in ("occluded", "full"):
            for name, d in table[region]["psnr_differences"].items():
                by_seed = ", ".join(f"{value:+.2f}" for value in d["by_seed"])
                told = f"; by seed {by_seed}" if table["seeds"] > 1 else ""
                lines.append(f"- {region}: {name}: {d['mean']:+.2f} ({d['low']:+.2f} to {d['high']:+.2f}){told}")
        lines.append("")
    return "\n".join(lines)


def run(plan: Plan) -> dict[str, Any]:
    """Train everything and write the table."""
    design = optimize(plan.spec, plan.out / "design", (), say).folder
    found = {}
    for model in plan.models:
        judged = {camera: [trained(plan, design, model, camera, seed) for seed in plan.seeds] for camera in CAMERAS}
        found[model] = compared(judged)
        write_atomic(plan.out / "table.json", canonical_json(found))
        write_atomic(plan.out / "table.md", written(found).encode())
        say(written({model: found[model]}))
    return found


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--images", type=Path, help="pictures to train on")
    parser.add_argument("--test", type=Path, help="pictures to judge by")
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
