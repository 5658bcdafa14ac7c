"""Photographs of a point source through a plate with hidden errors, for a first `doedesign calibrate`.

    python examples/measure_psfs.py RUN [--out RUN/measurement] [--seed 6]

The plate is simulated: its depth, line width and overlay are drawn from the run's process, its other errors are the
process's means. Its light at the two depths of examples/measurement/measurement.toml falls on a sensor of 12 bits with
photon noise, reading noise and an offset, the chief ray a little off the middle. The folder gets the frames, the file
that describes them, and the truth as hidden.toml. Then

    doedesign calibrate RUN RUN/measurement/measurement.toml

should explain the images and find overlay to about 20 nm and the common depth to about 0.1 %, as it does for the quick
example. Seed 0 hides a mask a micrometre off, half a cell: there the search ends beside the truth, and says that the
images are not explained.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from doedesign.calibration.measurement import MeasurementSpec, load_measurement
from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.runs.level_maps import open_design
from doedesign.spec import variation_to_toml
from fab.draws import variation_at
from fab.files import write_atomic
from fab.process import Process, Variation
from sim.camera import Colour
from sim.psf_bank import psf

MEASUREMENT = Path(__file__).parent / "measurement" / "measurement.toml"
HIDDEN = ("common_depth_scale", "common_cd_bias_m", "overlay_y_m", "overlay_x_m")
SEED = 6  # etches 2 % too deep, and openings 0.13 um too wide on either side
BLACK, TOP = 64, 4095
PEAK = 0.7  # of the range, that the brightest pixel reaches in the shortest exposure
BACKGROUND_E_PER_S = 1e4  # electrons per pixel from elsewhere
MARGIN, OFF = 32, (3, -5)  # pixels round the design's window; of the chief ray from the middle


def hidden_errors(design: Design, process: Process, seed: int) -> Variation:
    """Errors of a plate to four digits: those looked for by default drawn from a process, all others at its means.

    Places are relative to the first mask, by whose marks all others and the chrome are aligned.
    """
    drawn = variation_at(process, seed, max(design.camera.grid.extent_m), "normal/0")
    found = {name: getattr(drawn, name) for name in HIDDEN}
    found |= {name: tuple(m - found[name][0] for m in found[name]) for name in ("overlay_y_m", "overlay_x_m")}
    found = {name: tuple(map(rounded, m)) if isinstance(m, tuple) else rounded(m) for name, m in found.items()}
    return replace(process.expected(), **found)


def rounded(value: float) -> float:
    """A number with four digits."""
    return float(f"{value:.4g}")


def light_of(design: Design, process: Process, errors: Variation, spec: MeasurementSpec) -> list[np.ndarray]:
    """Energy per pixel at every depth of a measurement, ``[y, x]``, row 0 at the lowest y."""
    probe = Colour("probe", (spec.probe_m,), (1.0,))
    camera = replace(design.camera, colours=(probe,), pixel_m=spec.pixel_m, window=design.camera.window + MARGIN)
    plate = replace(design, camera=camera).fabricated(process, variation=errors)
    bank = psf(plate, depths=[image.depth_m for image in spec.image])
    return [np.roll(np.asarray(energy), OFF, (0, 1)) for energy in bank.energy[0]]


def exposed(electrons: np.ndarray, spec: MeasurementSpec, rng: np.random.Generator) -> np.ndarray:
    """Counts of one exposure with mean `electrons` per pixel, the first row at the top."""
    seen = rng.poisson(electrons) + rng.normal(0, spec.read_noise, electrons.shape)
    return np.clip(np.rint(seen / spec.gain) + BLACK, 0, TOP).astype(np.uint16)[::-1]


def measure(run: Path, out: Path, seed: int = SEED) -> Path:
    """Write frames, description and truth into a folder; return the description.

    Args:
        run: a finished run whose process has errors.
        out: the folder.
        seed: of errors and noise.
    """
    spec, design = load_measurement(MEASUREMENT), open_design(run)
    process = design.process()
    errors = hidden_errors(design, process, seed)
    made = photographed(light_of(design, process, errors, spec), spec, out, np.random.default_rng(seed))
    write_atomic(out / "hidden.toml", variation_to_toml(errors, ["errors of the photographed plate"]).encode())
    return made


def photographed(lights: list[np.ndarray], spec: MeasurementSpec, out: Path, rng: np.random.Generator) -> Path:
    """Write the frames of a measurement and its description into a folder; return the description.

    Args:
        lights: energy per pixel of every image, ``[y, x]``, row 0 at the lowest y.
        spec: the measurement.
        out: the folder.
        rng: of the noise.
    """
    shortest = min(seconds for image in spec.image for seconds in image.exposures)
    per_s = PEAK * (TOP - BLACK) * spec.gain / shortest / max(light.max() for light in lights)
    out.mkdir(parents=True, exist_ok=True)
    for image, light in zip(spec.image, lights, strict=True):
        for name, dark, seconds in zip(image.files, image.dark, image.exposures, strict=True):
            imageio.imwrite(out / name, exposed((light * per_s + BACKGROUND_E_PER_S) * seconds, spec, rng))
            imageio.imwrite(out / dark, exposed(0 * light, spec, rng))
    write_atomic(out / MEASUREMENT.name, MEASUREMENT.read_bytes())
    return out / MEASUREMENT.name


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--out", type=Path, help="folder for the frames; RUN/measurement by default")
    parser.add_argument("--seed", type=int, default=SEED, help="of errors and noise")
    given = parser.parse_args()
    return exit_code(lambda: print(measure(given.run, given.out or given.run / "measurement", given.seed)))


if __name__ == "__main__":
    sys.exit(main())
