"""Gradient noise on a grid of pixels.

On a lattice of random unit gradients a point's value is the fade-weighted mean of the four ramps of its cell's corners
(K. Perlin, "An image synthesizer", SIGGRAPH 1985; fade 6t^5 - 15t^4 + 10t^3 of "Improving noise", SIGGRAPH 2002). Here
the points are the crossings of rows and columns, so a ramp times its weight is a product of a function of y and one of
x, and the whole picture is two products of thin matrices. A Gaussian low-pass is separable, too: it is applied to the
thin matrices, exactly and almost for free.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array

_REACH = 4.0  # sigmas of the Gaussian


def gradients(rng: np.random.Generator, shape: tuple[int, int]) -> Float[np.ndarray, "2 j i"]:
    """Random unit vectors (y, x) for every corner of a lattice."""
    angle = rng.uniform(0, 2 * np.pi, shape)
    return np.stack([np.sin(angle), np.cos(angle)])


def _weights(
    places: Float[np.ndarray, " n"], corners: int
) -> tuple[Float[np.ndarray, "n j"], Float[np.ndarray, "n j"]]:
    """Weight of every corner at every place along one axis, and weight times offset from the corner."""
    cell: Int[np.ndarray, " n"] = np.floor(places).astype(np.int64)
    part = places - cell
    fade = part**3 * (part * (6 * part - 15) + 10)
    rows = np.arange(len(places))
    plain, ramp = np.zeros((2, len(places), corners))
    plain[rows, cell], plain[rows, cell + 1] = 1 - fade, fade
    ramp[rows, cell], ramp[rows, cell + 1] = (1 - fade) * part, fade * (part - 1)
    return plain, ramp


def _factors(
    lattice: Float[np.ndarray, "2 j i"],
    y: tuple[Float[np.ndarray, "n j"], Float[np.ndarray, "n j"]],
    x: tuple[Float[np.ndarray, "m i"], Float[np.ndarray, "m i"]],
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "m k"]]:
    """The thin matrices whose product is the noise, from the weights of rows and columns."""
    # A place knows few corners. Sparse products also stay on one core: a picture is too small to share out.
    return np.hstack(y), np.hstack([csr_array(x[1]) @ lattice[1].T, csr_array(x[0]) @ lattice[0].T])


def perlin(
    lattice: Float[np.ndarray, "2 j i"], y: Float[np.ndarray, " n"], x: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "n m"]:
    """Noise at the crossings of rows and columns: -1 to 1, mostly within 0.5.

    Places are counted in cells, from 0 to below the last corner of the lattice of gradients.
    """
    return _product(*_factors(lattice, _weights(y, lattice.shape[1]), _weights(x, lattice.shape[2])))


def _product(left: Float[np.ndarray, "n k"], right: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "n m"]:
    return np.ascontiguousarray(csr_array(left) @ np.ascontiguousarray(right.T))


def layered_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float,
    *,
    octaves: int = 1,
    persistence: float = 0.5,
    blur: float = 0.0,
) -> Float[np.ndarray, "y x"]:
    """Noise of several scales (`octaves`), each half as wide as the one before, low-pass filtered; float32.

    Lengths are in pixels: `cell` the width of the widest cells, at least two, whose scale has Perlin's amplitude, and
    `blur` the sigma of the Gaussian. Finer scales with cells below two pixels are left out. `persistence` is the
    amplitude of a scale over that of the one before.
    """
    # The widest, too: finer cells are noise of pixels, and their vectors more than those.
    cell, margin = max(cell, 2.0), int(np.ceil(_REACH * blur))

    def low_pass(weights: Float[np.ndarray, "n j"]) -> Float[np.ndarray, "m j"]:
        return gaussian_filter1d(weights, blur, axis=0, truncate=_REACH)[margin:-margin] if margin else weights

    lefts, rights = [], []
    for octave in range(octaves):
        width = cell / 2**octave
        if octave and width < 2:
            break
        start = rng.uniform(0, 1, 2)
        y, x = (begin + np.arange(n + 2 * margin) / width for begin, n in zip(start, shape, strict=True))
        lattice = gradients(rng, (int(y[-1]) + 2, int(x[-1]) + 2))
        weights_y, weights_x = _weights(y, lattice.shape[1]), _weights(x, lattice.shape[2])
        left, right = _factors(
            lattice, (low_pass(weights_y[0]), low_pass(weights_y[1])), (low_pass(weights_x[0]), low_pass(weights_x[1]))
        )
        lefts.append(persistence**octave * left)
        rights.append(right)
    return _product(np.hstack(lefts), np.hstack(rights)).astype(np.float32)
