"""The shadow kernel of the clear aperture: an evenly lit disc, of unit sum, on pixels."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.grid import Grid
from sim.aperture import circle_coverage, displaced_circle_coverage


def disc_window(diameter_px: float) -> int:
    """Pixels of the smallest odd window that holds a centred disc."""
    return 2 * max(int(np.ceil(diameter_px / 2 - 0.5)), 0) + 1


def shadow_disc(
    diameter_px: Float[Array, ""] | float, window: int
) -> Float[Array, "{window} {window}"] | Float[np.ndarray, "{window} {window}"]:
    """Disc `[y, x]` of unit sum in an odd window, every pixel weighted by the area of it that the disc covers.

    A traced diameter (pixels, above 0) is differentiable: the circle counts as straight within a pixel, and a disc
    larger than the window is NaN. A ValueError for an even window, or a disc known to be larger than the window.
    """
    if window % 2 == 0:
        raise ValueError(f"`window` must be odd, but got {window}")
    if not isinstance(diameter_px, jax.Array):
        if window < disc_window(diameter_px):
            raise ValueError(f"`window` must hold the disc of {diameter_px:.1f} pixels, but got {window}")
        return _known_disc(float(diameter_px), window)
    covered = displaced_circle_coverage(Grid((window, window), 1.0), diameter_px, (0.0, 0.0))
    return jnp.where(diameter_px <= window, covered / jnp.sum(covered), jnp.nan)


@lru_cache(maxsize=32)
def _known_disc(diameter_px: float, window: int) -> Float[np.ndarray, "y x"]:
    """Disc of a plain number; kept and read-only, for scenes of a stream share their depths."""
    covered = circle_coverage(Grid((window, window), 1.0), diameter_px).astype(np.float64)
    disc = (covered / covered.sum()).astype(np.float32)
    disc.setflags(write=False)
    return disc
