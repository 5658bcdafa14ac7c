"""Does heavier dirt make a conventional capture worse than one through the plate, as Table 2 of the paper has it?

    python examples/heavier_dirt.py RUN [--images DIR ...] [--pairs 60] [--out heavier_dirt.csv]

The paper has 14.2 dB (14.7 over the full image) for a conventional capture behind dirt and 17.5 (17.9) for one through
its plate. RUN is a design as `optimize examples/automotive_cpu.toml` leaves it. Both cameras photograph the same pairs
under eq. 10, behind dirt that covers little or nearly all, in wide or narrow clumps, and behind that of the paper's
public code; in linear light, and in display values, which that code takes for light. Two minutes on a core;
`examples/results/heavier_dirt.csv` is what 60 pairs of the photographs in `judged` left.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from doedesign.capture.images import picture_files, sample_files
from doedesign.cli import exit_code
from doedesign.evaluation.pairs import PairSet
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec
from doedesign.training.scores import mean_and_interval, paired_difference, psnr
from fab.files import csv_table, write_atomic
from sim.imaging.scene import Obstruction, Scene
from sim.light import srgb_from_linear
from sim.optic import HeightOptic
from sim.psf_bank import psf

# Kind and options of what covers the view.
DIRT: Mapping[str, tuple[str, str]] = {
    "that of the table": ("dirt", 'clump = ["6 mm", "12 mm"], coverage = [0.15, 0.4]'),
    "covers half": ("dirt", 'clump = ["6 mm", "12 mm"], coverage = [0.4, 0.6]'),
    "covers nine tenths": ("dirt", 'clump = ["6 mm", "12 mm"], coverage = [0.85, 0.95]'),
    "narrow clumps cover nine tenths": ("dirt", "coverage = [0.85, 0.95]"),
    "that of the public code": ("release_dirt", ""),
}


class Row(NamedTuple):
    """PSNR of captures behind one kind of dirt: where it covers, and over the full image; means over pairs, dB.

    `gain` is that of the plate's capture over the conventional one where dirt covers, with its 95 % interval.
    """

    dirt: str
    values: str
    covered: float
    conventional: float
    conventional_full: float
    plate: float
    plate_full: float
    gain: float
    gain_low: float
    gain_high: float


def in_display_values(scene: Scene) -> Scene:
    """The scene with display values in the place of light."""

    def shown(light: Any) -> np.ndarray:
        return srgb_from_linear(np.asarray(light))

    layers = tuple(Obstruction(o.mask, shown(o.radiance), o.depth_m) for o in scene.obstructions)
    return Scene(shown(scene.background), scene.background_depth_m, layers)


def compare(run: Path, files: Sequence[Path], dirt: str, pairs: int, *, display: bool) -> Row:
    """Photograph pairs behind one kind of dirt with the plate of a run and without."""
    (kind, options), file = DIRT[dirt], run / "spec.toml"
    spec = load_spec(file, [f'obstruction.kind="{kind}"', f"obstruction.options={{ {options} }}"])
    drawn = PairSet.of(spec, str(file), files, occlusion="paper")
    camera = drawn.model.camera
    plates = HeightOptic.of(camera), HeightOptic.of(camera, open_design(run).level_map.height_m)
    banks = [psf(plate, camera, drawn.depths_m) for plate in plates]
    found, covered = np.empty((2, 2, pairs)), []
    for number in range(pairs):
        scene = drawn.scene(number)
        light, mask = drawn.shown(scene)
        wanted, seen = srgb_from_linear(light)[None], scene
        if display:
            seen = scene._replace(scene=in_display_values(scene.scene))
        covered.append(float(np.mean(mask >= 0.5)))
        for k, bank in enumerate(banks):
            capture = drawn.photographed(number, seen, bank)
            shown = (capture if display else srgb_from_linear(np.clip(capture, 0, 1)))[None]
            found[k, 0, number] = psnr(shown, wanted, mask[None])[0]
            found[k, 1, number] = psnr(shown, wanted)[0]
    within = [list(scores[0]) for scores in found]
    gain = paired_difference(within[1], within[0])
    plain, plain_full, plate, plate_full = (mean_and_interval(list(one)).mean for one in found.reshape(4, pairs))
    values, share = "display values" if display else "linear light", float(np.mean(covered))
    return Row(dirt, values, share, plain, plain_full, plate, plate_full, gain.mean, gain.low, gain.high)


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="finished run of automotive_cpu.toml")
    parser.add_argument("--images", type=Path, nargs="*", help="folders to judge by; scikit-image's pictures if none")
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("heavier_dirt.csv"))
    given = parser.parse_args()

    def work() -> None:
        files = [file for folder in given.images or () for file in picture_files(folder)] or list(sample_files())
        rows: list[Row] = []
        for dirt in DIRT:
            for display in (False, True):
                rows.append(compare(given.run, files, dirt, given.pairs, display=display))
                write_atomic(given.out, csv_table(rows, 4).encode())
                print(rows[-1], flush=True)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
