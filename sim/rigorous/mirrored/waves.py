"""Cosines and sines of matrices without their eigenvectors, and the fields that they carry through a layer."""

import math

import numpy as np
import scipy.sparse as sparse

_HALVINGS = 3  # of the depth, before the power series
_DEGREE = 24  # of the polynomials that carry fields


def cosine_and_sine(squared: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cos(d q), sin(d q) / q and (1 - cos(d q)) / q² of a square root q of a matrix.

    Args:
        squared: the matrix q².
        depth: the number d.
    """
    step = depth / 2**_HALVINGS
    x = squared * step**2
    x2 = x @ x
    x3 = x2 @ x
    one = np.identity(len(x), x.dtype)

    def series(first: int) -> np.ndarray:
        c = [(-1) ** k / math.factorial(2 * k + first) for k in range(9)]
        found = c[6] * one + c[7] * x + c[8] * x2
        for k in (3, 0):
            found = found @ x3
            found += c[k] * one + c[k + 1] * x + c[k + 2] * x2
        return found

    cosine, sine = series(0), step * series(1)
    for _ in range(_HALVINGS - 1):
        cosine, sine = 2 * (cosine @ cosine) - one, 2 * (sine @ cosine)
    return 2 * (cosine @ cosine) - one, 2 * (sine @ cosine), 2 * (sine @ sine)


def times_sparse(matrix: np.ndarray, thin: sparse.csr_array) -> np.ndarray:
    """Product of a full matrix with a sparse one, as a full one."""
    return (thin.T @ matrix.T).T


def real_columns(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return real columns whose product left @ right.T is the real part of that of these complex ones."""
    pairs = ((np.real(left), -np.imag(left)), (np.real(right), np.imag(right)))
    first, second = (np.concatenate(pair, 1).astype(np.float32) for pair in pairs)
    return first, second


def fields_before(
    g: np.ndarray,
    b: np.ndarray,
    squared: np.ndarray,
    known: tuple[np.ndarray, np.ndarray],
    way: np.ndarray,
    bounds: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return both fields `[function, distance]` at distances before a place where they are known.

    These are exp(-i A s) times the known ones, A = [[0, G], [B, 0]], by Chebyshev polynomials of G B.

    Args:
        g: the matrix G.
        b: the matrix B.
        squared: their product G B.
        known: both fields there.
        way: the distances s.
        bounds: the least and the largest eigenvalue that G B may have.
    """
    h, e = known
    middle, half = (bounds[1] + bounds[0]) / 2, (bounds[1] - bounds[0]) / 2
    given = np.stack([h, times_columns(g, e)], 1)
    given = np.concatenate([np.real(given), np.imag(given)], 1).astype(g.dtype)

    def times(columns: np.ndarray) -> np.ndarray:
        return (squared @ columns - np.float32(middle) * columns) / np.float32(half)

    chain = [given, times(given)]
    while len(chain) < _DEGREE:
        chain.append(2 * times(chain[-1]) - chain[-2])
    columns = np.stack(chain)
    columns = columns[..., :2] + 1j * columns[..., 2:]
    points = np.cos(np.pi * (np.arange(_DEGREE) + 0.5) / _DEGREE)
    q = np.sqrt(middle + half * points + 0j)[:, None]
    values = np.stack([np.cos(q * way), np.sin(q * way) / q, (1 - np.cos(q * way)) / q**2]).real
    weights = np.einsum("fps,kp->fks", values, np.cos(np.arange(_DEGREE)[:, None] * np.arccos(points))) * 2 / _DEGREE
    weights[:, 0] /= 2
    cosine, sine, both = np.einsum("fks,knv->fnvs", weights, columns)
    found = cosine[:, 0] - 1j * sine[:, 1]
    return found, e[:, None] - times_columns(b, both[:, 1] + 1j * sine[:, 0])


def times_columns(matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Product of a real matrix with few complex columns, without a complex copy of the matrix."""
    found = matrix @ np.stack([np.real(columns), np.imag(columns)], -1).reshape(len(columns), -1).astype(matrix.dtype)
    return found[:, ::2].reshape(columns.shape) + 1j * found[:, 1::2].reshape(columns.shape)
