"""Cosines and sines that a field with a mirror consists of, and matrices of multiplication by a raster between them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Sector(NamedTuple):
    """Functions cos(m x) or sin(m x) times cos(n y), or sin(|n| y) of a negative n; those in a circle."""

    m: Int[np.ndarray, " function"]
    n: Int[np.ndarray, " function"]
    even: bool

    def places(self) -> dict[tuple[int, int], int]:
        """Number of every function by its (m, n)."""
        return {key: i for i, key in enumerate(zip(self.m.tolist(), self.n.tolist(), strict=True))}


class Product:
    """Matrix of multiplication by a raster, from functions of one sector to those of another."""

    def __init__(self, rows: Sector, columns: Sector, shape: tuple[int, int]) -> None:
        self.shape, self.odd = shape, rows.even != columns.even
        m, n, over, up = rows.m[:, None], abs(rows.n)[:, None], columns.m, abs(columns.n)
        near = -1 if rows.even and not columns.even else 1
        far = 1 if rows.even or columns.even else -1
        sine, other = rows.n[:, None] < 0, columns.n < 0
        scale = np.sqrt(2.0) ** (1.0 * (m > 0) + (over > 0) + (n > 0) + (up > 0)) / 4
        size = shape[0] * shape[1]
        places, signs = [], []
        # Re(s s' conj(Z(n + n'))) and Re(s conj(s') conj(Z(n - n'))) with s = 1 of a cosine, -i of a sine.
        for step, sign in ((n + up, np.where(sine | other, -1.0, 1.0)), (n - up, np.where(sine & ~other, -1.0, 1.0))):
            for along, weight in ((m - over, near), (m + over, far)):
                places.append(size * (sine != other) + (step % shape[0]) * shape[1] + along % shape[1])
                signs.append(scale * sign * weight)
        self._places, self._signs = np.array(places), np.array(signs)

    def matrix(self, raster: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "row column"]:
        """Return the matrix."""
        waves = np.fft.fft2(raster) / raster.size
        waves = 1j * waves if self.odd else waves
        return (np.concatenate([waves.real.ravel(), waves.imag.ravel()])[self._places] * self._signs).sum(0)

    def adjoint(self, matrix: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "y x"]:
        """Return the gradient by the raster (an even one) of a number whose gradient by the matrix is given."""
        size = self.shape[0] * self.shape[1]
        flat = np.bincount(self._places.ravel(), (self._signs * matrix).ravel(), 2 * size)
        real, imaginary = flat.reshape(2, *self.shape)
        return np.fft.ifft2(real + 1j * imaginary).real
