"""Energies of pixels that lie anywhere on a sampled intensity: behind a lens that distorts, or on a turned sensor.

A smooth map says where the point (row, column) of the window, in pixels from its middle, lies on the intensity, in
samples from its middle one. Pixels are then no grid, and weights along the two axes no longer the same for every row
and column. Two passes of one dimension each remain (E. Catmull and A. R. Smith, "3-D transformations of images in
scanline order", SIGGRAPH 1980). Along every row of samples the light is counted into columns of the window, from the
place where the column's left edge crosses that row to that of its right edge; then along every column, from the lower
to the upper edge of every pixel,

    E[v, u] = sum_j W_vu(j) H[j, u],    H[j, u] = sum_i W_ju(i) I[j, i],    W(i) = step(i - low) - step(i - high)

(`sim.propagation.edge_step`). The product of the two extents is the pixel's area on the intensity, so that light is
neither lost nor counted twice, and nothing is rescaled afterwards. A pixel's upper and lower edge are taken as
parallel to the rows of samples: 0.3 % of a rough image for every degree by which the map turns or shears them, 1 % of
its speckle. The predicted error counts that.

Gathers and scatters with an index per element are slow on a processor. Places change slowly from row to row, so `rows`
rows are taken together: their weights are interpolated between `_NODES` of them, and eight neighbouring pixels use one
short window of samples at a computed start. What remains are small matrix products. The way back is the same with the
parts exchanged: 64 samples use one short window of pixels.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import dynamic_slice
from jaxtyping import Array, Float

from sim.propagation.edge_step import REACH, edge_step, fit_edge_step
from sim.propagation.pixel import disc_autocorrelation

PlaceMap = Callable[[Any, Any], tuple[Any, Any]]
"""(row, column), pixels from the window's middle -> (y, x), samples from the middle one; smooth, of plain arithmetic,
for arrays of numpy or jax."""

_TILE = 8  # pixels that share a window of samples
_SAMPLES = 64  # samples that share a window of pixels on the way back
_NODES = 3  # rows at which the weights of a strip are known: they are a parabola between
# Samples by which an edge may move from side to side of a strip. At the highest frequency of the intensity, half a wave
# per sample, the parabola then misses a weight by 6 % of an edge's share, at an image's worst corner.
_MOST_SHEAR = 0.9
_LOOKS, _WAVES, _SMALL_SLOPE = 17, 301, 1e-3  # for the predicted error: places and frequencies along an axis
_STEPS = 5  # of Newton's method, which finds where a column crosses a row of samples


class MappedPixels(eqx.Module):
    """Pixels of a window at the places of a map.

    Attributes:
        along_x: samples -> columns of the window, for every row of samples.
        along_y: samples of a column -> its pixels, for every column.
        factor: what a sample counts, along either axis.
        window: pixels per side.
        fill: side of a pixel over the distance of two.
    """

    along_x: "Strips"
    along_y: "Strips"
    factor: Float[Array, " sample"]
    window: int = eqx.field(static=True)
    fill: float = eqx.field(static=True)

    def energy(self, intensity: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """Energy in every pixel; differentiable in the intensity and in the edges of the passes.

        NaN in pixels that lie beyond the samples, or farther from the planned places than the room that was left.
        """
        columns = self.along_x.gather(intensity * self.factor[:, None] * self.factor)
        return self.along_y.gather(columns.T).T

    def at(self, places: PlaceMap) -> "MappedPixels":
        """The same pixels at the places of another map, which may depend on traced values."""
        way = places, self.window, self.fill
        along_x = _at_edges(self.along_x, *_column_edges(*way, self.along_x.samples, self.along_x.rows))
        return eqx.tree_at(
            lambda p: (p.along_x, p.along_y),
            self,
            (along_x, _at_edges(self.along_y, *_row_edges(*way, self.along_y.rows))),
        )


class Strips(eqx.Module):
    """One pass: products along the last axis with weights that change from row to row.

    Attributes:
        low: first edge of every pixel at the nodes of every strip of rows, samples from the middle one.
        high: the other edge.
        coefficients: of the step (`sim.propagation.edge_step`).
        rows: rows of a strip.
        samples: length of the axis.
        window: samples that `_TILE` pixels use.
        touched: pixels that use any of `_SAMPLES` samples.
        whole: whether every pixel ends where the next begins.
    """

    low: Float[Array, "strip node pixel"]
    high: Float[Array, "strip node pixel"]
    coefficients: Float[Array, " term"]
    rows: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    window: int = eqx.field(static=True)
    touched: int = eqx.field(static=True)
    whole: bool = eqx.field(static=True)

    def weights(
        self,
        at: Float[Array, "tile sample"],
        low: Float[Array, "tile node pixel"],
        high: Float[Array, "tile node pixel"],
    ) -> Float[Array, "tile part sample"]:
        """Shares that samples at some places count in pixels between some edges; a part is a pixel at a node."""

        def beyond(edge: Array) -> Array:
            return edge_step(self.coefficients, at[:, None, None] - edge[..., None])

        if self.whole:
            steps = beyond(jnp.concatenate([low, high[..., -1:]], -1))
            found = steps[..., :-1, :] - steps[..., 1:, :]
        else:
            found = beyond(low) - beyond(high)
        return found.reshape(len(at), -1, at.shape[1])

    def gather(self, x: Float[Array, "row sample"]) -> Float[Array, "row pixel"]:
        """Light in every pixel; NaN where the samples, or the room that was planned for the map, do not reach."""
        return _gathered((x, self.low, self.high), jax.lax.stop_gradient(self))

    @property
    def edges(self) -> tuple[Array, Array]:
        """Both edges, padded to whole tiles by pixels of no width."""
        last = self.high[..., -1:]
        empty = jnp.broadcast_to(last, (*last.shape[:2], -self.low.shape[2] % _TILE))
        return jnp.concatenate([self.low, empty], -1), jnp.concatenate([self.high, empty], -1)

    def over_strips(self, of_strip: Callable[[Any], Array], inputs: Any) -> Array:
        """`of_strip` of every strip's inputs, one after another on a processor and all at once elsewhere."""
        together = None if jax.default_backend() == "cpu" else len(self.low)
        out = jax.lax.map(of_strip, inputs, batch_size=together)
        return out.reshape(-1, out.shape[-1])

    def strips_of(self, x: Float[Array, "row s"]) -> Float[Array, "strip line s"]:
        """Rows as strips, with dark ones added."""
        return jnp.pad(x, ((0, len(self.low) * self.rows - len(x)), (0, 0))).reshape(len(self.low), self.rows, -1)


@eqx.filter_custom_vjp
def _gathered(operands: tuple[Array, Array, Array], strips: Strips) -> Array:
    return _gather(*operands, strips)


@_gathered.def_fwd
def _gathered_forward(_perturbed: Any, operands: tuple[Array, Array, Array], strips: Strips) -> Any:
    return _gather(*operands, strips), None


@_gathered.def_bwd
def _gathered_back(
    _kept: None,
    cotangent: Array,
    perturbed: tuple[bool, bool, bool],
    operands: tuple[Array, Array, Array],
    strips: Strips,
) -> tuple[Array | None, Array | None, Array | None]:
    x, low, high = operands
    to_edges: Any = None, None
    if perturbed[1] or perturbed[2]:
        to_edges = jax.vjp(lambda low, high: _gather(x, low, high, strips), low, high)[1](cotangent)
    return (_spread(cotangent, strips) if perturbed[0] else None, *to_edges)


def _interpolation(rows: int) -> tuple[Float[np.ndarray, " node"], Float[np.ndarray, "row node"]]:
    """Places of the nodes in rows from a strip's first one, at Chebyshev's points, and the weights of every row."""
    places = (rows - 1) / 2 + rows / 2 * np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    powers = np.vander((np.arange(rows) - (rows - 1) / 2) / rows, _NODES)
    return places, np.linalg.solve(np.vander((places - (rows - 1) / 2) / rows, _NODES).T, powers.T).T


def _gather(x: Array, low: Array, high: Array, strips: Strips) -> Array:
    middle, count = strips.samples // 2, low.shape[2]
    low, high = _at_edges(strips, low, high).edges
    mix = jnp.asarray(_interpolation(strips.rows)[1], jnp.float32)
    window, tiles = strips.window, low.shape[2] // _TILE

    @jax.checkpoint
    def of_strip(inputs: tuple[Array, Array, Array]) -> Array:
        block, low, high = inputs
        low, high = (jnp.moveaxis(edge.reshape(_NODES, tiles, _TILE), 1, 0) for edge in (low, high))
        least, most = (jax.lax.stop_gradient(jnp.stack([low, high])) for _ in range(2))
        least, most = least.min((0, 2, 3)) - REACH, most.max((0, 2, 3)) + REACH
        start = jnp.clip(jnp.ceil(least).astype(jnp.int32) + middle, 0, strips.samples - window)
        at = start[:, None] - middle + jnp.arange(window)
        turned = jnp.abs(jax.lax.stop_gradient(low[:, 0] - low[:, -1])).max(1)
        seen = (least > at[:, 0] - 1) & (most < at[:, -1] + 1) & (turned < 1.25 * _MOST_SHEAR)
        cut = jax.vmap(lambda first: dynamic_slice(block, (0, first), (len(block), window)))(start)
        weights = strips.weights(at.astype(jnp.float32), low, high)
        nodes = jnp.einsum("tri,tpi->trp", cut, weights, precision="highest").reshape(tiles, -1, _NODES, _TILE)
        out = jnp.einsum("trnp,rn->rtp", nodes, mix, precision="highest")
        return jnp.where(seen[:, None], out, jnp.nan).reshape(len(block), -1)

    return strips.over_strips(of_strip, (strips.strips_of(x), low, high))[: len(x), :count]


def _spread(x: Float[Array, "row pixel"], strips: Strips) -> Float[Array, "row sample"]:
    """Transpose of `_gather`."""
    (low, high), count = strips.edges, len(x)
    x = jnp.pad(x, ((0, 0), (0, low.shape[2] - x.shape[1])))
    mix = jnp.asarray(_interpolation(strips.rows)[1], jnp.float32)
    touched = min(strips.touched, low.shape[2])
    at = jnp.arange(strips.samples, dtype=jnp.float32).reshape(-1, _SAMPLES) - strips.samples // 2

    def of_strip(inputs: tuple[Array, Array, Array]) -> Array:
        block, low, high = inputs
        beyond = jnp.maximum(low, high).max(0) + REACH  # increases from pixel to pixel
        first = jnp.sum(beyond < at[:, :1], axis=1)
        start = jnp.clip(first, 0, low.shape[1] - touched)

        def cut(values: Array) -> Array:
            return jax.vmap(lambda first: dynamic_slice(values, (0, first), (len(values), touched)))(start)

        weights = strips.weights(at, cut(low), cut(high))
        nodes = (mix[:, :, None] * cut(block)[:, :, None]).reshape(len(start), len(block), -1)
        out = jnp.matmul(nodes, weights, precision="highest")
        return jnp.moveaxis(out, 0, 1).reshape(len(block), -1)

    return strips.over_strips(of_strip, (strips.strips_of(x), low, high))[:count]


def _at_edges(strips: Strips, low: Any, high: Any) -> Strips:
    """The same pass at other edges."""
    edges = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)
    return eqx.tree_at(lambda s: (s.low, s.high), strips, edges)


def plan_mapped_pixels(
    places: PlaceMap,
    window: int,
    fill: float,
    cutoff: float,
    factor: Float[np.ndarray, " sample"],
    room: float = 0.0,
    is_round: bool = True,
) -> tuple[MappedPixels, float]:
    """Prepare the two passes for a map, on the host.

    Args:
        places: the map; it may stretch and turn the window, but not mirror it or fold it over.
        window: pixels per side.
        fill: side of a pixel over the distance of two.
        cutoff: highest frequency of the intensity, cycles per sample.
        factor: what a sample counts, along either axis; there are as many as samples.
        room: how far other maps (`MappedPixels.at`) may differ from this one in their derivatives, relatively.
        is_round: whether the light is that behind a disc, and not behind another aperture.

    Returns:
        the passes, and the predicted relative L2 error of the energies of a speckle-like image.
    """
    samples, way = len(factor), (places, window, fill)
    tall = float(places(0.5, 0.0)[0] - places(-0.5, 0.0)[0])
    wide = float(places(0.0, 0.5)[1] - places(0.0, -0.5)[1])
    step = fit_edge_step(fill * np.sqrt(tall * wide), cutoff, is_round)

    def planned(edges: Callable[[int], Any], across: float) -> Strips:
        """One pass; `across` is the distance of two pixels along it in samples."""
        rows = _SAMPLES
        while rows > 1:
            low, high = edges(rows)
            shear = np.abs(low[:, 0] - low[:, -1]).max() + room * rows * across
            if shear <= _MOST_SHEAR:
                break
            rows //= 2
        low, high = edges(rows)
        last = np.minimum(np.arange(0, window, _TILE) + _TILE - 1, window - 1)
        span = (high[..., last].max(1) - low[..., ::_TILE].min(1)).max() * (1 + room) + room * rows * across
        narrowest = np.diff(low, axis=-1).min() * (1 - room)
        reach = _SAMPLES + 2 * REACH + np.abs(low[:, 0] - low[:, -1]).max() + room * rows * across
        return Strips(
            jnp.asarray(low, jnp.float32),
            jnp.asarray(high, jnp.float32),
            jnp.asarray(step.coefficients, jnp.float32),
            rows,
            samples,
            min(int(np.ceil(span + 2 * REACH)) + 2, samples),
            int(np.ceil(reach / narrowest)) + 2,
            fill == 1,
        )

    with jax.ensure_compile_time_eval():  # plans are kept, also those made while something is traced
        along_x = planned(lambda rows: _column_edges(*way, samples, rows), 1.0)
        along_y = planned(lambda rows: _row_edges(*way, rows), tall)
        pixels = MappedPixels(along_x, along_y, jnp.asarray(factor, jnp.float32), window, fill)
    turned = _error_per_slope(fill * np.sqrt(tall * wide), cutoff, is_round) * _slope(places, window)
    return pixels, float(np.hypot(np.sqrt(2) * step.expected_error, turned))


def _slope(places: PlaceMap, window: int) -> float:
    """Slope of pixels' upper and lower edges to the rows of samples, root mean square over the window."""
    at = (np.arange(_LOOKS) + 0.5) / _LOOKS * window - window / 2
    (low_y, low_x), (high_y, high_x) = (places(at[:, None], at + side) for side in (-0.5, 0.5))
    return float(np.sqrt(np.mean(((high_y - low_y) / (high_x - low_x)) ** 2)))


@lru_cache(maxsize=32)
def _error_per_slope(width: float, cutoff: float, is_round: bool) -> float:
    """Relative L2 error of the energies of a speckle-like image for a small slope, over that slope.

    A pixel of slope s integrates a wave (u, v) along x and y to sinc(w (u + s v)) sinc(w v), and not to
    sinc(w u) sinc(w v).
    """
    v, u = np.meshgrid(*[np.linspace(-cutoff, cutoff, _WAVES)] * 2, indexing="ij")
    if is_round:
        power = disc_autocorrelation(np.minimum(np.hypot(v, u) / cutoff, 1.0))
    else:
        power = (1 - np.abs(v) / cutoff) * (1 - np.abs(u) / cutoff)
    power *= np.sinc(width * v) ** 2
    level, sloping = np.sinc(width * u), np.sinc(width * (u + _SMALL_SLOPE * v))
    return float(np.sqrt((power * (sloping - level) ** 2).sum() / (power * level**2).sum()) / _SMALL_SLOPE)


def _boundaries(window: int, fill: float) -> list[Float[np.ndarray, " pixel"]]:
    """First and last edges of the pixels of a window, pixels from its middle."""
    centres = np.arange(window) - (window - 1) / 2
    return [centres - fill / 2, centres + fill / 2]


def _column_edges(places: PlaceMap, window: int, fill: float, samples: int, rows: int) -> list[Any]:
    """Where the edges of all columns cross the nodes of all strips of sample rows, samples along x."""
    nodes = np.arange(samples // rows)[:, None, None] * rows + _interpolation(rows)[0][:, None] - samples // 2
    ends = np.array([-window / 2, window / 2])
    return [_crossing(places, nodes, column, ends, REACH + 2 + rows) for column in _boundaries(window, fill)]


def _crossing(places: PlaceMap, rows: Any, column: Any, ends: Any, margin: float) -> Any:
    """Place along x where columns of the window cross rows of samples, by Newton's method.

    Rows farther than `margin` samples from where the columns end are taken as if they lay there: no light of theirs is
    counted, and the map may end beyond.
    """
    low, high = (_constant(places(end, column)[0]) for end in ends)
    wanted = (rows - low) / (high - low)  # share of the way
    beyond = margin / abs(high - low)
    wanted = low + (high - low) * wanted.clip(-beyond, 1 + beyond)
    at = ends[0] + (wanted - low) / (high - low) * (ends[1] - ends[0])
    for _ in range(_STEPS):
        at = _constant(at)
        found, slope = places(at, column)[0], _constant(places(at + 0.5, column)[0] - places(at - 0.5, column)[0])
        # Only the last step is differentiated: with the slope held it has the derivative of the solution.
        at = at - (found - wanted) / slope
    return places(at, column)[1] + np.zeros(np.broadcast_shapes(rows.shape, column.shape))  # also if no row matters


def _row_edges(places: PlaceMap, window: int, fill: float, rows: int) -> list[Any]:
    """Edges of the pixels of columns at the nodes of all strips of columns, samples along y."""
    nodes = np.arange(-(-window // rows))[:, None, None] * rows + _interpolation(rows)[0][:, None] - (window - 1) / 2
    return [places(row, nodes)[0] + np.zeros((*nodes.shape[:2], window)) for row in _boundaries(window, fill)]


def _constant(value: Any) -> Any:
    """The value without its derivative."""
    return value if isinstance(value, np.ndarray | float) else jax.lax.stop_gradient(value)
