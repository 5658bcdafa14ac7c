"""One plate as fabricated at full size, from its masks to its PSFs, against the PSFs of the plate as drawn.

    python -m bench.plate            minutes
    python -m bench.plate --quick    N = 600; the targets are for the full size
    python -m bench.plate --light edges    one light alone

A draw of the stock process `contact_aligner`, every error at once: 2400 x 2400 cells, 16 levels, three colours, a near
and a far depth, as a thin element and with the light of walls. Both take their turn in every round; the table gives the
median of the ratios within rounds. Then draws of a tolerance study on one worker and on two, and 12 draws against 24:
their rates leave out the start.
"""

import argparse
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from bench.reference import wrapped_map
from doedesign.build import camera_from_spec, process_from_spec
from doedesign.design.design import Design
from doedesign.prediction import predict
from doedesign.runtime.memory import peak_bytes
from doedesign.runtime.pool import evaluate_here
from doedesign.spec import load_spec
from doedesign.tolerancing.pool import DrawModel, predicted_rows
from fab.draws import normal_draw
from fab.level_map import LevelMap
from fab.levels import Levels, height_of, quantise
from fab.process import Process
from sim.camera import Light
from sim.psf_bank import psf

SPEC = Path(__file__).parent.parent / "examples" / "automotive.toml"
TARGET_RATIO, TARGET_PEAK_GB, TARGET_SPEEDUP = 6.0, 4.0, 1.7


def make_task(cells: int) -> tuple[Design, Process]:
    """The automotive camera with a plate of so many cells, and the contact aligner."""
    aperture = f"doe.aperture={cells * 1.85} um"
    spec = load_spec(SPEC, (f"doe.samples={cells}", aperture, "process.stock=contact_aligner"))
    camera, levels = camera_from_spec(spec), Levels(spec.process.levels, spec.process.level_step_m)
    full = levels.count * levels.step_m
    height = np.mod(wrapped_map(cells, smooth_cells=4.0), full)
    level = quantise(height, levels)
    level_map = LevelMap(level, levels, camera.grid, spec.doe.relief, "bench")
    design = Design(level_map, camera, spec.scene.near_m[:1], spec.scene.far_m[:1])
    return design, process_from_spec(spec.process)


def time_draws(design: Design, process: Process, rounds: int) -> None:
    """Print draw against nominal bank."""
    height = height_of(design.level_map.level, design.levels).astype(np.float32)
    side = max(design.camera.grid.extent_m)
    draw_s, bank_s, ratios = [], [], []
    for index in range(rounds + 1):
        start = time.perf_counter()
        predict(design, process, normal_draw(process, 0, index, side))
        middle = time.perf_counter()
        psf(height, design.camera, design.depths_m)
        end = time.perf_counter()
        if index:  # the first round compiles
            draw_s.append(middle - start)
            bank_s.append(end - middle)
            ratios.append(draw_s[-1] / bank_s[-1])
    peak = peak_bytes() / 1e9
    ratio, cells = float(np.median(ratios)), design.camera.grid.shape[0]
    print(f"Plate as fabricated, N = {cells}, 16 levels, 3 colours, 2 depths, every error of a contact aligner")
    print(f"  light: {design.camera.light}")
    print(f"  draw {np.median(draw_s):6.2f} s    PSFs of the plate as drawn {np.median(bank_s):6.2f} s")
    verdict = "ok" if ratio <= TARGET_RATIO else "missed"
    print(f"  ratio {ratio:5.2f}  (target <= {TARGET_RATIO:g}: {verdict}; {min(ratios):.2f}-{max(ratios):.2f})")
    print(f"  peak {peak:6.2f} GB  (target < {TARGET_PEAK_GB:g}: {'ok' if peak < TARGET_PEAK_GB else 'missed'})")


def seconds_of(design: Design, process: Process, count: int, workers: int) -> float:
    """Seconds that `count` draws take after each worker has compiled its first ones."""
    side = max(design.camera.grid.extent_m)
    plates = {f"normal/{i}": normal_draw(process, 0, i, side) for i in range(count + 2 * workers)}
    begun = 0.0
    for done, _ in enumerate(evaluate_here(DrawModel(predicted_rows, design, process), plates, workers), 1):
        if done == 2 * workers:
            begun = time.perf_counter()
    return time.perf_counter() - begun


def time_workers(design: Design, process: Process) -> None:
    """Print the rates of one worker and of two, and of 12 and of 24 draws."""
    one, two = (seconds_of(design, process, 24, workers) for workers in (1, 2))
    half = seconds_of(design, process, 12, 1)
    speedup, growth = one / two, one / half
    print(f"  24 draws, N = {design.camera.grid.shape[0]}: one worker {one:.1f} s, two workers {two:.1f} s")
    verdict = "ok" if speedup >= TARGET_SPEEDUP else "missed"
    print(f"  two workers / one {speedup:5.2f}  (target >= {TARGET_SPEEDUP:g}: {verdict})")
    print(f"  24 draws / 12 draws {growth:5.2f}  (linear: 2)")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="a small plate, in a minute")
    parser.add_argument("--light", choices=get_args(Light), help="draws in this light alone")
    given = parser.parse_args()
    if given.light is None:
        for light in get_args(Light):  # in processes of their own, so that each has its own peak
            subprocess.run([sys.executable, "-m", "bench.plate", "--light", light, *sys.argv[1:]], check=True)
        time_workers(*make_task(600))
    else:
        design, process = make_task(600 if given.quick else 2400)
        time_draws(replace(design, camera=replace(design.camera, light=given.light)), process, rounds=3)


if __name__ == "__main__":
    main()
