"""Score a splitter of the public invrs case by its own definition: 7 x 7 orders, too fine for scalar light.

    python examples/invrs_splitter.py design.npy --height 0.7262474um
    python examples/invrs_splitter.py design.npy --height 0.7262474um --thin

The case (invrs-gym, `diffractive_splitter`): a cell of 7.2 um that repeats, 180 x 180 pixels of 40 nm, one etch of 0.5
to 1.5 um between silica (1.46) and air, light of 632.8 nm from the silica at normal incidence. The score is the light
in the orders -3 to 3 along both axes, all together, times 1 - (max - min) / (max + min). The public board takes 800
terms of a circular truncation with fmmax's formulation JONES_DIRECT_FOURIER; fewer than about 600 mean nothing. One
score takes one to four minutes and 2 GB.

A design is an array of 180 x 180 numbers from 0 (etched) to 1 (not), `.npy`, x along its first axis as fmmax has it; or
a PNG of 8 bits, black where it is etched, x to the right and y upwards.
`--thin` adds what a thin element would say of it. The best public entry (0.5964, features of 400 nm and more) scores
0.5991 here in light along y, the public case's TE, and 0.5024 in light along x; as a thin element 0.2746.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fab.errors import InputError
from fab.files import read_npy
from fab.pictures import read_pixels
from fab.units import metres
from sim.rigorous.crossed import layered_orders, require_fmmax

PERIOD_M, WAVELENGTH_M, GLASS, ORDERS, TERMS = 7.2e-6, 632.8e-9, 1.46, 3, 800
PIXELS = 180


class Score(NamedTuple):
    """Light of the orders that count, `[y, x]`, shares of the incident light."""

    orders: np.ndarray

    @property
    def total(self) -> float:
        """Light of all together."""
        return float(self.orders.sum())

    @property
    def uniformity_error(self) -> float:
        """(max - min) / (max + min)."""
        return float(np.ptp(self.orders) / (self.orders.max() + self.orders.min()))

    @property
    def value(self) -> float:
        """The score."""
        return self.total * (1 - self.uniformity_error)

    def __str__(self) -> str:
        """Return the three numbers and the 0th order over the mean."""
        middle = self.orders[ORDERS, ORDERS] / self.orders.mean()
        return (
            f"{self.value:.4f}: total {self.total:.4f}, uniformity error {self.uniformity_error:.4f}, "
            f"0th order {middle:.2f} of the mean"
        )


def read_design(path: Path) -> np.ndarray:
    """Read a design; an InputError for anything else than 180 x 180 numbers from 0 to 1, or grey levels of 8 bits."""
    picture = path.suffix.lower() == ".png"
    design = read_pixels(path)[::-1].T / 255 if picture else read_npy(path)
    within = design.dtype.kind == "f" and design.shape == (PIXELS, PIXELS) and design.min() >= 0 and design.max() <= 1
    if not within:
        rule = f"a design is {PIXELS} x {PIXELS} numbers from 0 to 1"
        raise InputError(str(path), rule, f"{design.dtype} of shape {design.shape}", "Give such an array.")
    return design.astype(np.float64)


def thin_score(design: np.ndarray, height_m: float) -> Score:
    """Score of a thin element, Fresnel loss of a bare face taken off."""
    phase = 2 * np.pi * (GLASS - 1) * height_m / WAVELENGTH_M
    orders = np.fft.fftshift(np.abs(np.fft.fft2(np.exp(1j * phase * design), norm="forward")) ** 2)
    middle, face = PIXELS // 2, 4 * GLASS / (1 + GLASS) ** 2
    kept = slice(middle - ORDERS, middle + ORDERS + 1)
    return Score(face * orders[kept, kept])


def rigorous_scores(design: np.ndarray, height_m: float, terms: int = TERMS) -> tuple[Score, Score]:
    """Scores of light polarised along x and along y, by Fourier modes; the public one is of light along y (TE).

    Raises:
        InputError: fmmax is missing.
    """
    formulation = require_fmmax().Formulation.JONES_DIRECT_FOURIER
    pattern = 1.0 + (GLASS**2 - 1.0) * design.T
    layers = [np.array([[GLASS**2]]), pattern, np.array([[1.0]])]
    found = layered_orders(layers, [0.0, height_m, 0.0], (PERIOD_M, PERIOD_M), WAVELENGTH_M, terms, formulation)
    along_x, along_y = found.within(ORDERS, ORDERS)
    return Score(along_x), Score(along_y)


def main() -> int:
    """Print the scores of a design."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("design", type=Path, help="180 x 180 numbers from 0 to 1, .npy, or a PNG")
    parser.add_argument("--height", required=True, help='depth of the etch, such as "0.7262474um"')
    parser.add_argument("--terms", type=int, default=TERMS, help="orders that are kept (800)")
    parser.add_argument("--thin", action="store_true", help="also say what a thin element would make of it")
    given = parser.parse_args()
    try:
        design, height_m = read_design(given.design), metres(given.height)
    except (InputError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if given.thin:
        print(f"thin element              {thin_score(design, height_m)}")
    begun = time.perf_counter()
    try:
        scores = rigorous_scores(design, height_m, given.terms)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for axis, score in zip("xy", scores, strict=True):
        print(f"rigorous, light along {axis}   {score}")
    print(f"{given.terms} terms, {time.perf_counter() - begun:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
