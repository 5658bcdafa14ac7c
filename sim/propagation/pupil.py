"""The field behind the DOE, written for a block of rows so that it never has to exist as a whole."""

import operator
from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

PupilRows = Callable[[Any, Any], Complex[Array, "row x"]]
"""(rows of the inputs, inputs shared by all rows) -> complex field of those rows."""


@jax.custom_jvp
def cis(waves: Float[Array, "*s"]) -> Complex[Array, "*s"]:
    """exp(2 pi i waves), to 4e-6, several times faster than the library's sine and cosine on a processor.

    The argument is reduced to a quarter wave (exactly, in float32) where two short polynomials suffice.
    """
    half = jnp.round(2.0 * waves)
    r = waves - 0.5 * half
    z = r * r
    sine = r * (6.2831853 + z * (-41.341702 + z * (81.605249 + z * (-76.704978 + z * 42.058))))
    cosine = 1.0 + z * (-19.739209 + z * (64.939394 + z * (-85.456817 + z * (60.24464 + z * -26.42626))))
    sign = 1.0 - 2.0 * jnp.abs(half - 2.0 * jnp.round(0.5 * half))
    return jax.lax.complex(sign * cosine, sign * sine)


@cis.defjvp
def _cis_tangent(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    wave = cis(primals[0])
    rate = 2 * np.pi * tangents[0]
    return wave, jax.lax.complex(-wave.imag * rate, wave.real * rate)


class DoeRows(NamedTuple):
    """Rows of a DOE and of the wave that lights it; every array's first axis is the grid's y."""

    coverage: Float[Array, "y x"] | None  # open share of every cell, or None where the transmission has it
    height_m: Float[Array, "y x"] | None  # DOE height, metres, or None
    transmission: Complex[Array, "y x"] | None  # transmission besides that of the height, or None for 1
    source: Any  # rows of the source (`sim.source`)
    light: Complex[Array, "y x"] | None = None  # amplitude of the beam, or None for 1

    @property
    def amplitude(self) -> Array:
        """Open share times transmission times the beam's amplitude; one of the first two must be there."""
        given = [part for part in (self.coverage, self.transmission, self.light) if part is not None]
        return reduce(operator.mul, given)


@runtime_checkable
class SourceColumns(Protocol):
    """The part of a source that all rows share."""

    def waves(self, rows: Any, height_m: Float[Array, "y x"] | None) -> Float[Array, "y x"]:
        """Optical path through a DOE height (None: no relief) from the source, waves."""
        ...


def doe_field(rows: DoeRows, columns: SourceColumns) -> Complex[Array, "y x"]:
    """Field coverage * transmission * exp(2 pi i waves) behind the DOE: eqs. 1, 2 and 4 without the lens."""
    wave = cis(columns.waves(rows.source, rows.height_m))
    return rows.amplitude * wave


# One block of rows (64-256 of a few thousand samples) fits a processor's second-level cache.
_BLOCK = 128
# The FFT library transforms a batch in groups of 16 rows and the rest one by one, with other rounding, and it
# splits the batch over as many threads as happen to be free. Blocks that are whole groups for one and for two
# threads make the result independent of that, so that the same inputs give the same bytes.
_GROUP = 32


def block_size(count: int) -> int:
    """Rows per block for `count` rows: a divisor near 128 if there is one, else 128 and the last block is padded."""
    if jax.default_backend() != "cpu":
        return count
    good = [block for block in range(2 * _GROUP, 257, _GROUP) if count % block == 0]
    return min(good, key=lambda block: abs(block - _BLOCK)) if good else _BLOCK


def in_blocks(rows: PyTree, block: int) -> PyTree:
    """Every leaf `[row, ...]` as `[count, block, ...]`, padded with zeros (closed aperture) to whole blocks."""

    def cut(leaf: Array) -> Array:
        missing = -leaf.shape[0] % block
        if missing:
            leaf = jnp.concatenate([leaf, jnp.zeros((missing, *leaf.shape[1:]), leaf.dtype)])
        return leaf.reshape(-1, block, *leaf.shape[1:])

    return jax.tree.map(cut, rows)
