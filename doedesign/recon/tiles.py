r"""Captures of any size through a network, by overlapping tiles without seams.

All tiles have one shape, so a network is compiled once. Along an axis they lie an overlap apart; each looks as if the
picture ended at its edges, and so its outermost pixels are the worst it has. Of an overlap the outer quarter of both
tiles is therefore not used at all, and in its middle half one tile fades into the other with a raised cosine:

    tile k             ... 1 1 1 1 1 \ 0 |
    tile k + 1                   | 0 / 1 1 1 1 1 ...
                                 overlap

Tiles begin at multiples of `multiple`, the pixels that a network halves away, for it treats these places alike. So
the last tile of an axis may look a little beyond the picture, which is mirrored there about its outermost pixels.

Shares add up to one. A result that depends on a quarter of the overlap around each pixel is that of the whole picture,
so extended, to the rounding. What depends on a tile as a whole (its normalisations) differs from tile to tile and
changes over half an overlap instead of jumping.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.units import number_of

TILE, OVERLAP = 1536, 256

# A network, or anything that is called like one: from `[b, c, y, x]` capture, far and near PSFs to display values.
Reconstructs = Callable[[Array, Array, Array], Array]


class Tiling(NamedTuple):
    """Pixels (y, x) of a picture and of its tiles, pixels that neighbours share, and number of tiles along y and x."""

    shape: tuple[int, int]
    tile: tuple[int, int]
    overlap: int
    counts: tuple[int, int]

    @property
    def total(self) -> int:
        """Number of tiles."""
        return self.counts[0] * self.counts[1]


def plan_tiles(shape: tuple[int, int], tile: int = TILE, overlap: int = OVERLAP, multiple: int = 16) -> Tiling:
    """Cut a picture of `shape` (y, x) into as few tiles as will do, and these as small as will do.

    Sides of at most `tile` pixels, and the overlap, are multiples of `multiple` (`NetworkShape.multiple`).

    Raises:
        ValueError: a tile or an overlap that is no such multiple, or an overlap of more than half a tile.
    """
    for name, value in (("tile", tile), ("overlap", overlap)):
        if not number_of(value) >= multiple or value % multiple:
            raise ValueError(f"`{name}` must be a multiple of {multiple}, but got {value}")
    if 2 * overlap > tile:
        raise ValueError(f"`overlap` must be at most half of the tile of {tile}, but got {overlap}")
    counts, sides = zip(*(_fitted(samples, tile, overlap, multiple) for samples in shape), strict=True)
    return Tiling(shape, (sides[0], sides[1]), overlap, (counts[0], counts[1]))


def _fitted(samples: int, tile: int, overlap: int, multiple: int) -> tuple[int, int]:
    """Number of tiles along an axis, and their side."""
    count = max(1, -(-(samples - overlap) // (tile - overlap)))
    side = -(-(samples + (count - 1) * overlap) // count)
    # Two tiles that share more than half of themselves would meet a third.
    return count, max(-(-side // multiple) * multiple, 2 * overlap if count > 1 else multiple)


def reconstruct_tiled(
    network: Reconstructs,
    capture: Float[np.ndarray, "c y x"],
    far: Float[np.ndarray, "c ky kx"],
    near: Float[np.ndarray, "c kv ku"],
    *,
    tile: int = TILE,
    overlap: int = OVERLAP,
    multiple: int = 16,
    on_tile: Callable[[int], None] = lambda _: None,
) -> Float[np.ndarray, "c y x"]:
    """Reconstruct a capture of any size: display values as the network gives them.

    A capture that fits into a tile goes through as one, extended to multiples of `multiple`. Capture and PSFs are those
    of one item of `doedesign.recon.network.Network`, tiles those of `plan_tiles`; time and seams shrink as they grow,
    memory grows with their square. `on_tile` is called after each tile with the number of those done.
    """
    plan = plan_tiles((capture.shape[1], capture.shape[2]), tile, overlap, multiple)
    rows, columns = (list(_pieces(plan, axis)) for axis in (0, 1))
    psfs = jnp.asarray(far, jnp.float32)[None], jnp.asarray(near, jnp.float32)[None]
    result, done = np.zeros(capture.shape, np.float32), 0
    for y in rows:
        for x in columns:
            seen = capture[:, y.source[:, None], x.source[None, :]][None]
            found = np.asarray(_called(network, jnp.asarray(seen, jnp.float32), *psfs))[0]
            share = y.share[:, None] * x.share[None, :]
            result[:, y.place, x.place] += (found * share)[:, : y.kept, : x.kept]
            done += 1
            on_tile(done)
    return result


@eqx.filter_jit
def _called(network: Reconstructs, capture: Array, far: Array, near: Array) -> Array:
    return network(capture, far, near)


class _Piece(NamedTuple):
    """One tile along one axis."""

    source: np.ndarray  # which pixel of the picture each of its pixels shows
    share: np.ndarray  # weight of each
    place: slice  # where it goes
    kept: int  # how many of its pixels that are


def _pieces(plan: Tiling, axis: int) -> Iterator[_Piece]:
    samples, side, count = plan.shape[axis], plan.tile[axis], plan.counts[axis]
    step = side - plan.overlap
    beyond = max((count - 1) * step + side - samples, 0)
    index = np.pad(np.arange(samples), (0, beyond), mode="reflect")
    rise = _rise(side, plan.overlap)
    for k in range(count):
        start = k * step
        kept = min(side, samples - start)
        share = rise.copy() if k else np.ones(side)
        if k < count - 1:
            share[step:] *= 1 - rise[: plan.overlap]
        yield _Piece(index[start : start + side], share.astype(np.float32), slice(start, start + kept), kept)


def _rise(side: int, overlap: int) -> np.ndarray:
    """Share of a tile from its beginning on: nothing for a quarter of the overlap, then a raised cosine, then all."""
    quarter = overlap / 4
    place = np.clip((np.arange(side) + 0.5 - quarter) / (overlap - 2 * quarter), 0, 1)
    return np.sin(np.pi / 2 * place) ** 2
