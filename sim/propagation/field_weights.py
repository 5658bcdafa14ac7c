"""Weights that interpolate the field behind an aperture from few samples, with the diffraction of its square cells.

The field holds half the frequencies of its intensity; its samples need not be as fine.
"""

import numpy as np
from jaxtyping import Float, Inexact

FIELD_TAPS = 20  # samples that a place between them takes
_FLOOR = 1e-9  # keeps the weights small where the band leaves them free


def field_weights(
    positions: Float[np.ndarray, " fine"],
    samples: int,
    length: int,
    aperture: float,
    slope: float | None,
    is_round: bool = True,
) -> tuple[Inexact[np.ndarray, "sample fine"], float]:
    """Weights that interpolate the field behind an aperture of square cells, and their relative RMS error on one axis.

    `positions` count samples, whose middle one lies on the axis, from the first; `length` is that of their transform;
    `aperture` is in cells; `slope` is the direction in which a cell is lit, in waves per cell and cell from the axis,
    or None to leave out the factor sinc(direction of observation - direction of light) of a square cell.

    Real weights if the imaginary part is zero. Least squares over the aperture, weighted by its chords: those of a disc
    if it `is_round`, equal ones otherwise. Every cell x contributes exp(-2 pi i k x / length) at sample k and, to the
    wanted field, the same at a fractional k times its sinc.
    """
    first = np.floor(positions - (FIELD_TAPS - 1) / 2 + 0.5).astype(np.int64)
    # One cell more than the aperture: for an even count its centre lies half a cell off the transform's origin.
    # Gauss's rule for the weight sqrt(1 - x²), with enough nodes for the waves across twenty taps.
    angle = np.arange(1, 65) * np.pi / 65
    cell, power = np.cos(angle) * (aperture + 1) / 2, np.sin(angle) ** 2 * 2 / 65
    if not is_round:
        nodes, shares = np.polynomial.legendre.leggauss(64)
        cell, power = nodes * (aperture + 1) / 2, shares / 2
    lags = np.arange(FIELD_TAPS)
    gram = np.cos(2 * np.pi * (lags[:, None] - lags)[:, :, None] * cell / length) @ power + _FLOOR * np.eye(FIELD_TAPS)
    # The wave of a cell at a tap is that at the first tap, turned by that of the lag.
    waves = np.exp(2j * np.pi * (first - positions)[:, None] * cell / length)
    turns = np.exp(2j * np.pi * lags[:, None] * cell / length)
    seen = (positions - samples // 2)[:, None] / length
    target = np.ones((len(positions), len(cell))) if slope is None else np.sinc(seen - slope * cell)
    weights = np.linalg.solve(gram, turns @ (waves * power * target).T).T
    missed = np.abs((weights @ turns.conj()) * waves.conj() - target) ** 2 @ power
    matrix = np.zeros((samples, len(positions)), np.complex128)
    matrix[first[:, None] + lags, np.arange(len(positions))[:, None]] = weights
    error = float(np.sqrt(missed.mean() / (target**2 @ power).mean()))
    return matrix if slope else matrix.real, error
