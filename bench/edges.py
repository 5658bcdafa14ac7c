"""PSFs with the light of walls against those of a thin element: time, forward and with gradient.

    python -m bench.edges            N = 2400, about a minute
    python -m bench.edges --quick    N = 600

The plate of the automotive design's size with random levels, one colour, a far source and one at 5 cm; heights are an
argument of what is compiled, so that walls are computed every time. Methods take turns, and a ratio is the median of
the ratios within rounds.
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
from sim.camera import Camera, Colour
from sim.psf_bank import psf
from sim.rigorous.edge_optic import with_edges

PITCH_M, STEP_M, ROUNDS = 1.85e-6, 75e-9, 7
TARGET = {"x": 1.5, "unpolarised": 2.5}


def ways(camera: Camera, depth_m: float) -> dict[str, Callable[[Any], Any]]:
    """PSF of a height map as a thin element, and with walls in polarised and in unpolarised light."""
    found: dict[str, Callable[[Any], Any]] = {"thin": lambda height: psf(height, camera, depth_m).energy}
    for polarisation in TARGET:
        found[polarisation] = lambda height, way=polarisation: (
            psf(with_edges(height, replace(camera, polarisation=way), depths_m=(depth_m,)), depths=depth_m).energy
        )
    return found


def report(cells: int, wavelength_m: float, depth_m: float) -> None:
    """Measure and print one source."""
    camera = Camera(
        Grid((cells, cells), PITCH_M),
        cells * PITCH_M,
        "fused_silica",
        (Colour("one", (wavelength_m,), (1.0,)),),
        8e-3 * cells / 2400,
        PITCH_M,
        800 * cells // 2400,
    )
    height = STEP_M * np.random.default_rng(0).integers(0, 16, (cells, cells))
    plate, depth_m = jnp.asarray(height, jnp.float32), depth_m * cells / 2400
    print(f"\nN = {cells}, {wavelength_m * 1e9:.0f} nm, source at {depth_m:.3g} m")
    for part in ("forward", "value and gradient"):
        calls = {}
        for name, way in ways(camera, depth_m).items():
            value = jax.jit(way if part == "forward" else jax.value_and_grad(lambda h, way=way: jnp.sum(way(h) ** 2)))
            calls[name] = lambda value=value: jax.block_until_ready(value(plate))
        seconds = time_rounds(calls, ROUNDS)
        for name, each in seconds.items():
            ratios = each / seconds["thin"]
            told = verdict(float(np.median(ratios)), TARGET.get(name))
            spread = f"({ratios.min():.2f}-{ratios.max():.2f})"
            print(
                f"  {part:20s}{name:14s}{np.median(each) * 1e3:8.0f} ms{np.median(ratios):7.2f} x thin {spread}{told}"
            )


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description="PSFs with the light of walls against those of a thin element.")
    parser.add_argument("--quick", action="store_true", help="N = 600")
    given = parser.parse_args()
    for wavelength_m in (656e-9, 486e-9):
        for depth_m in (np.inf, 0.05):
            report(600 if given.quick else 2400, wavelength_m, depth_m)


if __name__ == "__main__":
    main()
