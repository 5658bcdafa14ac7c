"""Blooming: charge beyond the full well runs over into the pixels above and below.

The charge of a full pixel runs along its column, half of what is too much to either side, and fills pixel after pixel
until none is left or the column ends. Sensors have drains for it, which take the share `1 - spilled` at the pixel where
it arises; a modern CMOS sensor spills next to nothing, a CCD without drains all.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from sim.tracing import is_traced

Signal = Float[Array, "*b y x"] | Float[np.ndarray, "*b y x"]


def bloomed(signal: Signal, full: "float | Array | np.ndarray", spilled: float) -> Float[Array, "*b y x"]:
    """Signal after charge has run over along columns.

    Args:
        signal: `[..., y, x]` electrons, or light in any unit, at least 0.
        full: what a pixel holds, in the same unit; a number, or an array as `[c, 1, 1]` that goes with the signal.
        spilled: share of the charge beyond it that reaches neighbours instead of a drain, 0 to 1.

    Returns:
        signal of at most `full` in every pixel. With `spilled` at 1 the sum is that of before, less what runs out at
        the ends of columns.

    Raises:
        InputError: a full well that is not positive, or a share out of range.
    """
    if not is_traced(full) and not np.all(np.asarray(full) > 0):
        raise InputError("full", "must be positive", str(full), "Give the full well in the unit of the signal.")
    if not 0 <= spilled <= 1:
        raise InputError("spilled", "must lie from 0 to 1", f"{spilled:g}", "0 is for a sensor without blooming.")
    signal = jnp.asarray(signal)
    return _bloomed(signal, jnp.broadcast_to(jnp.asarray(full), signal.shape), jnp.asarray(spilled))


@jax.jit
def _bloomed(signal: Array, full: Array, spilled: Array) -> Array:
    held = jnp.minimum(signal, full)
    half = (signal - held) * spilled / 2
    upward = _run(held, half, full)
    return _run(*(each[..., ::-1, :] for each in (upward, half, full)))[..., ::-1, :]


def _run(held: Array, source: Array, full: Array) -> Array:
    """Let charge run toward higher rows: it fills what is free in every pixel that it passes."""

    def pixel(carried: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        inside, own, room = row
        taken = jnp.minimum(room - inside, carried)
        return carried - taken + own, inside + taken

    rows = (jnp.moveaxis(held, -2, 0), jnp.moveaxis(source, -2, 0), jnp.moveaxis(full, -2, 0))
    _, filled = jax.lax.scan(pixel, jnp.zeros_like(rows[0][0]), rows)
    return jnp.moveaxis(filled, 0, -2)
