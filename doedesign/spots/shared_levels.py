"""The level of a cell that suits the light of several colours at once."""

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def best_levels(
    fields: NDArray[np.complex64], real: NDArray[np.float32], imag: NDArray[np.float32]
) -> NDArray[np.uint8]:  # pragma: no cover - compiled
    """The level of every cell where the real part of field times conjugate light, over all colours, is largest.

    Args:
        fields: `[colour, cell]` sums of plane waves.
        real: `[colour, level]` real part of the light of every level.
        imag: its imaginary part.
    """
    colours, count = real.shape
    found, score = np.empty(fields.shape[1], np.uint8), np.empty(count, np.float32)
    for at in range(fields.shape[1]):
        score[:] = 0.0
        for colour in range(colours):
            x, y = fields[colour, at].real, fields[colour, at].imag
            for level in range(count):
                score[level] += x * real[colour, level] + y * imag[colour, level]
        best = 0
        for level in range(1, count):
            if score[level] > score[best]:
                best = level
        found[at] = best
    return found
