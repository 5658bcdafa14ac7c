"""The phase that carries a beam to an area as rays would: optimal transport between two pictures of light.

A smooth phase sends the light of every place of a DOE into one direction. Of all such maps from the beam to the area
one is the gradient of a convex function, and that function is the phase (Y. Brenier, Comm. Pure Appl. Math. 44, 375,
1991). It has no vortices, so light that starts from it has no speckle. It is found by Sinkhorn's iteration with ever
less blur (M. Cuturi, Adv. Neural Inf. Process. Syst. 26, 2292, 2013); on two rectangular grids a step is four small
matrix products.
"""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RectBivariateSpline

_CELLS = 96  # of either picture, per axis
_BLURS = (0.3, 0.1, 0.03, 0.01, 0.004, 0.0015)  # squares of the widths of both pictures
_STEPS = 60  # with each of them
_TINY = 1e-300


def transport_phase(
    light: Float[np.ndarray, "y x"],
    light_axes: tuple[Float[np.ndarray, " y"], Float[np.ndarray, " x"]],
    wanted: Float[np.ndarray, "v u"],
    wanted_axes: tuple[Float[np.ndarray, " v"], Float[np.ndarray, " u"]],
) -> Float[np.ndarray, "y x"]:
    """Phase `[y, x]`, radians, whose gradient over 2 pi carries light to where it is wanted.

    Args:
        light: power on every cell.
        light_axes: their places (y, x), metres.
        wanted: light wanted in every direction, in any unit.
        wanted_axes: the directions (y, x), waves per metre.
    """
    source, source_axes = _coarse(light, light_axes)
    target, target_axes = _coarse(wanted, wanted_axes)
    wide = max(np.ptp(axis) for axis in source_axes)
    far = max(np.ptp(axis) for axis in target_axes)
    middles = [axis.mean() for axis in target_axes]
    costs = [
        (one[:, None] / wide - (other - middle) / far) ** 2 / 2
        for one, other, middle in zip(source_axes, target_axes, middles, strict=True)
    ]
    potential = _potential(source, target, costs)
    y, x = source_axes
    # The convex function whose gradient is the map, in units of both widths.
    convex = ((y[:, None] ** 2 + x**2) / wide**2 / 2 - potential) * wide * far
    smooth = RectBivariateSpline(y, x, convex, kx=3, ky=3)(*light_axes)
    tilt = middles[0] * light_axes[0][:, None] + middles[1] * light_axes[1]
    return 2 * np.pi * (smooth + tilt)


def _coarse(
    picture: Float[np.ndarray, "y x"], axes: tuple[Float[np.ndarray, " y"], Float[np.ndarray, " x"]]
) -> tuple[Float[np.ndarray, "v u"], list[np.ndarray]]:
    """A picture on at most so many cells per axis, each with all light that falls on it, its sum 1, and their places.

    The outermost cells lie as far out as those of the picture.
    """
    rows, columns = (_overlaps(n, min(n, _CELLS)) for n in picture.shape)
    smaller = rows @ np.maximum(picture, 0) @ columns.T
    places = [np.linspace(axis[0], axis[-1], m) for axis, m in zip(axes, smaller.shape, strict=True)]
    return smaller / smaller.sum(), places


def _overlaps(fine: int, coarse: int) -> Float[np.ndarray, "coarse fine"]:
    """Share of every fine cell that lies on every coarse one, on one axis; the middles of those at its ends agree."""
    if fine == coarse:
        return np.eye(fine)
    wide = (fine - 1) / (coarse - 1)  # a coarse cell, in fine ones
    ends = (np.arange(1, coarse) - 0.5) * wide + 0.5  # between coarse cells, from the edge of the first fine one
    edges = np.concatenate([[0.0], ends, [float(fine)]])
    first, cells = np.maximum(edges[:-1, None], np.arange(fine)), np.arange(1, fine + 1)
    return np.maximum(np.minimum(edges[1:, None], cells) - first, 0.0)


def _potential(
    source: Float[np.ndarray, "y x"], target: Float[np.ndarray, "v u"], costs: list[np.ndarray]
) -> Float[np.ndarray, "y x"]:
    """Kantorovich's potential of the source, for costs `[y, v]` and `[x, u]` that add up."""
    outward, inward = np.zeros(source.shape), np.zeros(target.shape)
    for blur in _BLURS:
        # Potentials are taken out of the exponent, so that it stays small.
        rows, columns = (np.exp(-cost / blur) for cost in costs)
        ahead = target * np.exp((inward - inward.max()) / blur)
        for _ in range(_STEPS):
            back = source / np.maximum(rows @ ahead @ columns.T, _TINY)
            ahead = target / np.maximum(rows.T @ back @ columns, _TINY)
        outward = -blur * np.log(np.maximum(rows @ ahead @ columns.T, _TINY))
        inward = blur * np.log(np.maximum(ahead, _TINY) / np.maximum(target, _TINY))
    return outward
