"""A larger aperture whose depth of field the plate buys back: what it is worth behind dirt, measured with its rivals.

    python examples/wide_aperture.py [--images DIR ...] [--judged DIR ...] [--behind bars] [--steps 0]
        [--classic] [--out runs/wide_aperture]

Four cameras of 16 mm look at scenes from 2 m to infinity through dirt 4 to 6 mm wide, at 5 to 12 cm: stopped down
to 4.44 mm, at f/2, at f/1.4, and at f/1.4 with the plate of `wide_aperture.toml`. All expose as long, so that the stop
gets 0.15 of the light. The dirt is known as one knows it in practice, with errors (`DirtErrors`): its light is taken
off, what it keeps back is made up for, and a network gets the result and the share of light that passed. Everyone has
the same network and training, on scenes of random depth that it is not told (it has the PSF of the middle depth),
judged by PSNR of the covered part at 2 m, 4 m and infinity; the plate as drawn and as fabricated. Beside it stands one
linear filter for all depths, without training; `--steps 0` has it alone. `--behind bars` has straight bars of 4 mm at
8 cm, 12 to 16 mm apart, in place of dirt. `--classic` adds cameras with a quartic, a cubic and a logarithmic asphere,
each at its best strength (`wide_plates.py`). Written to OUT:

    design/             the run of the plate
    classic/            those of classic plates
    CAMERA/             PSFs by parts of the aperture, light of the training scenes, network
    scores.csv          PSNR of every picture, camera, depth and light
    summary.json        means, differences picture by picture with their intervals
    wide_aperture.png   pictures

Light goes through the aperture part by part (`sim.imaging.parts`), for a shadow on a wide aperture changes its PSF.
`doedesign train` is not used, for its scenes are mirrored at their edges and these shadows are wider than the pictures;
network, loss and Adam's step are its own. Work that was stopped goes on with the same command; some 17 minutes of one
core for a camera. `examples/results` has what it left: trained on 120 photographs of BSDS500's training set, judged on
32 of its validation set.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import wide_cameras as cameras
import wide_plates
from dirty_scenes import DirtyScene, dirty_scenes, light_of

from doedesign.build import camera_from_spec
from doedesign.capture.from_spec import obstruction_from_spec
from doedesign.capture.images import Pictures, picture_files, sample_files
from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.optimization import optimize
from doedesign.recon.network import Network, NetworkShape
from doedesign.recon.weights import camera_facts, read_network, write_network
from doedesign.runs.journal import study_folder
from doedesign.runs.level_maps import open_design
from doedesign.runtime.progress import meter
from doedesign.spec import load_spec, spec_digest
from doedesign.spec.training import TrainSpec
from doedesign.training.loss import adam_step, losses
from doedesign.training.scores import mean_and_interval, paired_difference, psnr
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.figure import SMALL, panels, save
from fab.files import canonical_json, csv_table, write_atomic
from sim.light import srgb_from_linear
from sim.optic import CellOptic, HeightOptic

DRAWS = 3  # plates as fabricated

# Words that put something else before the cameras than the dirt of the spec.
BEHIND: Mapping[str, Sequence[str]] = {
    "dirt": (),
    "bars": (
        'obstruction.kind="fence"',
        'obstruction.options={ patterns = ["bars"], depth = "8 cm", wire = "4 mm", mesh = ["12 mm", "16 mm"] }',
    ),
}


@dataclass(frozen=True)
class Plan:
    """How much is computed.

    Attributes:
        size: pixels per side of a picture, a multiple of 8, at least 40.
        scenes: scenes to train on.
        judged: scenes to judge by.
        steps: training steps; 0 for no network.
        batch: scenes per step.
        width: features of the network's finest scale.
        seed: of everything random.
        behind: what all scenes are behind, a key of `BEHIND`.
        classic: whether classic plates are judged, too.
    """

    size: int = 128
    scenes: int = 320
    judged: int = 32
    steps: int = 3500
    batch: int = 2
    width: int = 16
    seed: int = 1
    behind: str = "dirt"
    classic: bool = False

    def __post_init__(self) -> None:
        """Refuse what no picture or training comes of."""
        if self.size < 40 or self.size % 8:
            raise InputError("size", "must be a multiple of 8, at least 40", self.size, "For example 128.")
        least = {"judged": 1, "batch": 1, "width": 1, "steps": 0, "scenes": 1 if self.steps else 0}
        for name, smallest in least.items():
            if getattr(self, name) < smallest:
                raise InputError(name, f"must be at least {smallest}", getattr(self, name), "Give more.")


def scenes_of(pictures: Pictures, plan: Plan, count: int, stream: int) -> list[DirtyScene]:
    """Scenes behind dirt or bars; streams are apart."""
    spec = load_spec(cameras.SPEC, BEHIND[plan.behind])
    kind = obstruction_from_spec(spec, str(cameras.SPEC))
    return list(dirty_scenes(pictures, camera_from_spec(spec), kind, plan.size, count, (plan.seed, stream)))


def noise_key(plan: Plan, stream: int, number: int) -> Any:
    """Of the noise of a training step or a judged scene."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(plan.seed), stream), number)


def training_light(
    bench: cameras.Bench, scenes: Sequence[DirtyScene], plan: Plan, folder: Path
) -> tuple[np.ndarray, list[float]]:
    """Light of all scenes to train on, `[scene, c, y, x]`, and the depth of each; kept in a file."""
    choose = np.random.default_rng((plan.seed, 9))
    all_depths = cameras.depths_of(bench.spec)
    depths = [all_depths[k] for k in choose.integers(len(all_depths), size=len(scenes))]
    path = folder / "light.npz"
    if path.is_file():
        return read_archive(path, "light of scenes", cameras.AGAIN)[1]["light"], depths
    found = []
    with meter(f"light, {bench.kind.name}", len(scenes), 0) as progress:
        for number, (scene, depth) in enumerate(zip(scenes, depths, strict=True)):
            found.append(light_of(scene, *bench.at(depth), plan.size))
            progress.advance(number + 1, "")
    light = np.stack(found)
    write_archive(path, {"format": "light of scenes 1"}, {"light": light})
    return light, depths


@eqx.filter_jit
def _slopes(network: Any, seen: Any, far: Any, wanted: Any, covered: Any, options: TrainSpec) -> Any:
    moving, still = eqx.partition(network, eqx.is_inexact_array)

    def loss(part: Any) -> Any:
        picture = eqx.combine(part, still)(seen, far, far)[:, :3]
        return losses(picture, wanted, covered, options)

    return jax.value_and_grad(loss, has_aux=True)(moving)


def trained(bench: cameras.Bench, scenes: Sequence[DirtyScene], plan: Plan, folder: Path) -> Network:
    """The network of a camera, trained or read."""
    path = folder / "network.npz"
    if path.is_file():
        return read_network(path)[0]
    light, depths = training_light(bench, scenes, plan, folder)
    shape = NetworkShape(4, plan.width, 3, near_estimate=False)
    network = Network.make(shape, plan.seed)
    options = TrainSpec(l1=1.0, perceptual=0.0, masked=2.0)
    moments = optax.scale_by_adam().init(eqx.filter(network, eqx.is_inexact_array))
    far = np.repeat(bench.told()[None], plan.batch, axis=0)
    rng = np.random.default_rng((plan.seed, 7))
    sensor, edge = bench.sensor(), (bench.camera.window - 1) // 2
    history = []
    with meter(f"training, {bench.kind.name}", plan.steps, 0) as progress:
        for step in range(plan.steps):
            chosen = rng.integers(len(scenes), size=plan.batch)
            keys = jax.random.split(noise_key(plan, 0, step), plan.batch)
            seen, wanted, covered = [], [], []
            for k, key in zip(chosen, keys, strict=True):
                scene = scenes[k]
                flip = int(rng.integers(2))  # every PSF here is even, but for errors of plates
                images = (
                    bench.corrected(cameras.taken(light[k], sensor, key), scene, depths[k]),
                    srgb_from_linear(scene.background[:, edge:-edge, edge:-edge]),
                    scene.covered,
                )
                for kept, image in zip((seen, wanted, covered), images, strict=True):
                    kept.append(image[..., ::-1] if flip else image)
            inputs = [np.stack(each).astype(np.float32) for each in (seen, wanted, covered)]
            (value, _), slope = _slopes(network, inputs[0], far, inputs[1], inputs[2], options)
            rate = 2e-3 * (0.05 + 0.95 * 0.5 * (1 + np.cos(np.pi * step / plan.steps))) * min(1, (step + 1) / 20)
            moving, still = eqx.partition(network, eqx.is_inexact_array)
            moving, moments = adam_step(moving, slope, moments, jnp.float32(rate))
            network = eqx.combine(moving, still)
            history.append(float(value))
            progress.advance(step + 1, f"loss {np.mean(history[-50:]):.4f}")
    colours = [colour.name for colour in bench.camera.colours]
    about = camera_facts(bench.camera, (0.05, 0.12)) | {"colours": [*colours, "passed"], "history": history}
    about["wavelengths_m"] = [*about["wavelengths_m"], 550e-9]
    write_network(path, network, about)
    return network


@eqx.filter_jit
def _look(network: Network, seen: Any, far: Any) -> Any:
    return network(seen, far, far)[:, :3]


class Judged(NamedTuple):
    """Score of a picture."""

    camera: str
    plate: str
    way: str
    light: float
    depth_m: float
    scene: int
    picture: str
    psnr: float


def judge(
    bench: cameras.Bench,
    network: Network | None,
    scenes: Sequence[DirtyScene],
    plan: Plan,
    plate: str,
    lights: Sequence[float],
    at: cameras.Bench,
) -> tuple[list[Judged], dict[Any, np.ndarray]]:
    """Judge a camera, its network and one filter; `at` has the PSFs that take the pictures, `bench` those one knows of.

    Returns the scores, and capture and reconstruction of every scene and depth in the first of `lights`.
    """
    rows, pictures = [], {}
    edge, far = (bench.camera.window - 1) // 2, bench.told()[None]
    with meter(f"judging, {bench.kind.name} {plate}", len(scenes), 0) as progress:
        for number, scene in enumerate(scenes):
            wanted = srgb_from_linear(scene.background[:, edge:-edge, edge:-edge])[None]
            for depth in cameras.JUDGED_M:
                light = light_of(scene, *at.at(depth), plan.size)
                for brightness in lights:
                    raw = cameras.taken(light, bench.sensor(brightness), noise_key(plan, 1, number))
                    seen = bench.corrected(raw, scene, depth)
                    found = {} if network is None else {"network": np.asarray(_look(network, seen[None], far))[0]}
                    found["filter"] = cameras.filtered(seen, bench)
                    for way, picture in found.items():
                        value = float(psnr(picture[None], wanted, scene.covered[None])[0])
                        where = depth, number, scene.picture
                        rows.append(Judged(bench.kind.name, plate, way, brightness, *where, value))
                    if brightness == lights[0]:
                        shots = np.clip(srgb_from_linear(raw), 0, 1), np.clip(next(iter(found.values())), 0, 1)
                        pictures[number, depth] = np.stack(shots)
            progress.advance(number + 1, "")
    return rows, pictures


def summary_of(rows: Sequence[Judged]) -> dict[str, Any]:
    """Means by camera, plate, way, light and depth; worst depths; differences of the plate over every rival.

    What is "as fabricated" is the mean over the plates that are, picture by picture.
    """
    by: dict[tuple[str, str, str, float], dict[float, dict[int, float]]] = {}
    several: dict[Any, list[float]] = {}
    for row in rows:
        by.setdefault(row[:4], {}).setdefault(row.depth_m, {})[row.scene] = row.psnr
        if row.plate.startswith("fabricated"):
            several.setdefault((row.camera, row.way, row.light, row.depth_m, row.scene), []).append(row.psnr)
    for (camera, way, light, depth, scene), psnrs in several.items():
        by.setdefault((camera, "as fabricated", way, light), {}).setdefault(depth, {})[scene] = float(np.mean(psnrs))
    table: dict[str, Any] = {}
    worst: dict[Any, list[float]] = {}  # scores of every picture at the depth that is worst
    average: dict[Any, list[float]] = {}  # over the depths
    for key, depths in by.items():
        scores = {depth: [of[k] for k in sorted(of)] for depth, of in depths.items()}
        means = {depth: float(np.nanmean(of)) for depth, of in scores.items()}
        last = min(means, key=means.__getitem__)
        worst[key], average[key] = scores[last], np.mean([*scores.values()], axis=0).tolist()
        table[" / ".join(map(str, key))] = {f"{depth:g}": value for depth, value in means.items()} | {
            "mean": float(np.mean([*means.values()])),
            "worst": means[last],
            "interval": list(mean_and_interval(scores[last])),
        }
    pairs = [
        (key, rival) for key in by for rival in by if key[0] == "plate" and rival[0] != "plate" and rival[2:] == key[2:]
    ]

    def over(scores: Mapping[Any, list[float]]) -> dict[str, list[float]]:
        return {
            f"{' / '.join(map(str, key))} over {rival[0]}": list(paired_difference(scores[key], scores[rival]))
            for key, rival in pairs
        }

    return {
        "scores": table,
        "worst depth, plate over rival": over(worst),
        "mean of the depths, plate over rival": over(average),
    }


def draw(
    path: Path, scenes: Sequence[DirtyScene], shown: Mapping[str, Mapping[Any, np.ndarray]], edge: int, plan: Plan
) -> None:
    """Draw some scenes and what they are behind, and every camera's capture and reconstruction, at infinity."""
    chosen = range(min(3, len(scenes)))
    found = "its network" if plan.steps else "one filter"
    note = f"Scene at infinity, {plan.behind} before it; for each camera the capture, and what {found} makes of it."
    title = f"A wide aperture behind {plan.behind}"
    with panels(None, (1.5 * (2 + len(shown)), 3.1 * len(chosen)), title, note) as figure:
        grid = figure.subplots(2 * len(chosen), 1 + len(shown))
        for row, number in enumerate(chosen):
            scene = scenes[number]
            wanted = srgb_from_linear(scene.background[:, edge:-edge, edge:-edge])
            columns = [("scene", wanted, "covered", np.broadcast_to(1 - scene.covered, wanted.shape))]
            for name, pictures in shown.items():
                raw, found = pictures[number, np.inf]
                value = float(psnr(found[None], wanted[None], scene.covered[None])[0])
                columns.append((name, raw, f"{value:.1f} dB", found))
            for column, (above, first, below, second) in enumerate(columns):
                for line, words, image in ((0, above, first), (1, below, second)):
                    axes = grid[2 * row + line, column]
                    axes.imshow(np.clip(image, 0, 1).transpose(1, 2, 0), origin="lower")
                    axes.set_axis_off()
                    axes.set_title(words, fontsize=SMALL)
    save(figure, path)


def run(out: Path, plan: Plan, images: Sequence[Path], judged: Sequence[Path]) -> dict[str, Any]:
    """Design, train and judge; return the summary."""
    pools = [Pictures(tuple(files), 512) for files in (images, judged)]
    asked = {"spec_sha256": spec_digest(load_spec(cameras.SPEC)), "plan": asdict(plan)}
    with study_folder(out, {**asked, "pictures_sha256": [pool.digest() for pool in pools]}):
        return _run(out, plan, pools)


def _run(out: Path, plan: Plan, pools: Sequence[Pictures]) -> dict[str, Any]:
    optimize(cameras.SPEC, out / "design")
    designs = {"optimised": open_design(out / "design")}
    kinds = cameras.CAMERAS + (cameras.CLASSIC if plan.classic else ())
    for kind in kinds:
        if kind.plate in wide_plates.TRIES:
            folder = out / "classic" / kind.plate
            optimize(wide_plates.spec_of(kind.plate, wide_plates.best_start(kind.plate)[1], 0), folder)
            designs[kind.plate] = open_design(folder)
    training = scenes_of(pools[0], plan, plan.scenes if plan.steps else 0, 0)
    seen = scenes_of(pools[1], plan, plan.judged, 1)
    rows: list[Judged] = []
    shown: dict[str, dict[Any, np.ndarray]] = {}
    edge = 0
    for kind in kinds:
        folder = out / kind.name
        design = designs.get(kind.plate)
        drawn = partial(_drawn, kind, design)
        bench = cameras.Bench(kind, plan.size, folder, drawn)
        network = trained(bench, training, plan, folder) if plan.steps else None
        edge = (bench.camera.window - 1) // 2
        found, shown[kind.name] = judge(bench, network, seen, plan, "drawn", (1.0, 0.1), bench)
        rows += found
        for number in range(DRAWS if kind.plate == "optimised" else 0):
            make = partial(_fabricated, kind, designs[kind.plate], number)
            made = cameras.Bench(kind, plan.size, folder / f"draw_{number}", make)
            found, shown["plate, fabricated"] = judge(bench, network, seen, plan, f"fabricated {number}", (1.0,), made)
            rows += found
        write_atomic(out / "scores.csv", csv_table(rows, 6).encode())
    found = summary_of(rows)
    write_atomic(out / "summary.json", canonical_json(found))
    draw(out / "wide_aperture.png", seen, shown, edge, plan)
    return found


def _drawn(kind: cameras.CameraKind, design: Design | None) -> CellOptic:
    camera, _ = cameras.camera_of(kind)
    return HeightOptic.of(camera, None if design is None else design.level_map.height_m)


def _fabricated(kind: cameras.CameraKind, design: Design, number: int) -> CellOptic:
    camera, spec = cameras.camera_of(kind)
    return replace(design, camera=camera).fabricated(
        seed=0, draw=f"normal/{number}", depths=(min(cameras.depths_of(spec)), np.inf)
    )


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--images", type=Path, nargs="*", help="folders to train on; scikit-image's pictures if none")
    parser.add_argument("--judged", type=Path, nargs="*", help="folders to judge by; scikit-image's last two if none")
    for name in ("size", "scenes", "judged-scenes", "steps", "batch", "width"):
        field = "judged" if name == "judged-scenes" else name
        parser.add_argument(f"--{name}", type=int, default=getattr(Plan(), field), dest=f"plan_{field}")
    parser.add_argument("--behind", choices=sorted(BEHIND), default=Plan().behind, dest="plan_behind")
    parser.add_argument("--classic", action="store_true", dest="plan_classic", help="judge classic plates, too")
    parser.add_argument("--out", type=Path, default=Path("runs/wide_aperture"))
    given = parser.parse_args()

    def work() -> None:
        samples = list(sample_files())
        images = [file for folder in given.images or () for file in picture_files(folder)] or samples[:-2]
        judged = [file for folder in given.judged or () for file in picture_files(folder)] or samples[-2:]
        plan = Plan(**{key[5:]: value for key, value in vars(given).items() if key.startswith("plan_")})
        print(json.dumps(run(given.out, plan, images, judged), indent=1))

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
