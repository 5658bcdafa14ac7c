"""PSFs behind a lens that images tangents, and on a turned sensor, against those behind one that images sines: time.

    python -m bench.lens            N = 2400, about a minute
    python -m bench.lens --quick    N = 600

The automotive design's camera, a plate of random levels, one colour, a far source. Methods take turns, and a ratio is
the median of the ratios within rounds.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.psf import time_rounds, verdict
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.propagation.farfield import FarField, bent, plan_far_field
from sim.propagation.places import CUBIC
from sim.propagation.pupil import DoeRows, doe_field
from sim.source import MapColumns

PITCH_M, STEP_M, WAVELENGTH_M, ROUNDS, TURN_RAD = 1.85e-6, 75e-9, 550e-9, 7, 0.017
TARGET = {"tangent": 1.3, "distorted": 1.3}


def plans(camera: Camera) -> dict[str, Callable[[], FarField]]:
    """Plans of every lens and sensor; that of the turned sensor is finished within the compiled function."""
    lenses = {
        "sine": camera,
        "tangent": replace(camera, mapping="tangent"),
        "distorted": replace(camera, mapping="tangent", distortion=(-0.1, 0.0)),
    }
    straight = {name: plan_far_field(lens, WAVELENGTH_M) for name, lens in lenses.items()}
    half_m = camera.window * camera.pixel_m / 2
    turn = np.zeros((2, len(CUBIC)))
    turn[0, CUBIC.index((0, 1))], turn[1, CUBIC.index((1, 0))] = TURN_RAD * half_m, -TURN_RAD * half_m
    roomy = plan_far_field(camera, WAVELENGTH_M, room=0.05)
    found: dict[str, Callable[[], FarField]] = {name: lambda plan=plan: plan for name, plan in straight.items()}
    return {**found, "turned": lambda: bent(roomy, camera, jnp.asarray(turn, jnp.float32))}


def report(cells: int) -> None:
    """Measure and print one size."""
    grid, one = Grid((cells, cells), PITCH_M), (Colour("one", (WAVELENGTH_M,), (1.0,)),)
    focal_m, window = 8e-3 * cells / 2400, 512 * cells // 2400
    camera = Camera(grid, cells * PITCH_M, "fused_silica", one, focal_m, 2 * PITCH_M, window)
    levels = np.random.default_rng(0).integers(0, 16, (cells, cells))
    height, coverage = jnp.asarray(STEP_M * levels, jnp.float32), jnp.asarray(circle_coverage(grid, camera.aperture_m))
    columns = MapColumns(jnp.float32(camera.waves_per_metre(WAVELENGTH_M)))
    print(f"\nN = {cells}, window of {window} pixels, {WAVELENGTH_M * 1e9:.0f} nm, source at infinity")
    for part in ("forward", "value and gradient"):
        calls = {}
        for name, plan in plans(camera).items():

            def energy(height: Any, plan: Callable[[], FarField] = plan) -> Any:
                rows = DoeRows(coverage, height, None, jnp.zeros_like(height))
                return plan().energy(doe_field, rows, columns)

            way = energy if part == "forward" else jax.value_and_grad(lambda h, way=energy: jnp.sum(way(h) ** 2))
            value = jax.jit(way)
            calls[name] = lambda value=value: jax.block_until_ready(value(height))
        seconds = time_rounds(calls, ROUNDS)
        for name, each in seconds.items():
            ratios = each / seconds["sine"]
            told = verdict(float(np.median(ratios)), TARGET.get(name))
            spread = f"({ratios.min():.2f}-{ratios.max():.2f})"
            print(
                f"  {part:20s}{name:14s}{np.median(each) * 1e3:8.0f} ms{np.median(ratios):7.2f} x sine {spread}{told}"
            )


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description="PSFs behind lenses that do not image sines.")
    parser.add_argument("--quick", action="store_true", help="N = 600")
    report(600 if parser.parse_args().quick else 2400)


if __name__ == "__main__":
    main()
