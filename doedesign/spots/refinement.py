"""Refinement of the unit cell of a grid of orders by rigorous light and its gradient.

From the cell that scalar light found:

1. heights of all cells move freely between the levels, by the gradient (Adam), while slabs between levels are pressed
   to glass or air more and more; of two levels with a narrowest line or space, a smoothed outline moves;
2. the better one of that cell, on levels, and of the one at the start has cells exchanged, those that promise most by
   the gradient, as long as its score grows; then the best one with a few cells changed at random, for as many steps as
   there are. Of two levels with a narrowest line or space, strokes of its brush are exchanged (`fab.rules.strokes`), so
   that every cell on the way can be printed.

What is scored is efficiency less `uniformity` times how unequal the spots are, by the smooth measure of `exchange`; the
cell with the most efficiency less `uniformity` times the uniformity error is kept.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float, Int, UInt8

from doedesign.spots.exchange import FLAT
from doedesign.spots.spots import Spots
from doedesign.spots.superposition import SpotLight, spot_light
from fab.levels import Levels
from fab.rules.strokes import Strokes
from sim.rigorous.slab_cell import SlabCell

_SHARPNESS = (3.0, 16.0)  # of slabs, at the beginning of the first part and at its end
_FREE = 40  # steps of the first part at most
_ADAM = optax.scale_by_adam(0.8, 0.95, 1e-12)
_RATE = 0.05  # steps of a level per step, at first
_MOST = 30  # exchanges at a time
_TRIES, _ROW_TRIES = 40, 200  # exchanges that are tried one by one where several at a time do not help
_SHAKEN = 100  # cells of which one is changed, and two at least, before exchanges begin anew
_OFFERS = 400  # that are looked at


class RefinementState(NamedTuple):
    """Everything a step changes.

    Attributes:
        height: `[y, x]` free heights, in levels from the lowest.
        mean: of their gradients, for Adam.
        square: of the squares of those.
        cell: `[y, x]` levels from the lowest that are exchanged.
        best: those of the best cell so far.
        numbers: score of `cell`, none before exchanges begin; merit of `best`; exchanges at a time; and how often they
            have begun anew.
        step: steps done.
    """

    height: Float[np.ndarray, "y x"]
    mean: Float[np.ndarray, "y x"]
    square: Float[np.ndarray, "y x"]
    cell: UInt8[np.ndarray, "y x"]
    best: UInt8[np.ndarray, "y x"]
    numbers: Float[np.ndarray, "4"]
    step: int

    @property
    def arrays(self) -> list[np.ndarray]:
        """Arrays that a checkpoint keeps."""
        return list(self[:-1])


class _Offer(NamedTuple):
    """A change of a cell: its pixels, and the level that they get."""

    pixels: np.ndarray
    value: int


@dataclass(frozen=True, eq=False)
class RefinementTask:
    """A unit cell that is to be refined.

    Attributes:
        solver: light of its slabs, which are those between its levels.
        spots: where light should go, as orders.
        uniformity: how much efficiency a uniformity error is worth.
        ways: `[x and y]` share of the light with its electric field along x and along y.
        start: `[y, x]` levels from the lowest to begin with.
        count: number of levels.
        strokes: what the process prints of two levels; None where any cell will do.
        steps: in all; at most two thirds of them, and 40, of free heights.
        seed: of what is shaken.
    """

    solver: SlabCell
    spots: Spots
    uniformity: float
    ways: Float[np.ndarray, "2"]
    start: UInt8[np.ndarray, "y x"]
    count: int
    strokes: Strokes | None
    steps: int
    seed: int

    @property
    def free_steps(self) -> int:
        """Steps of free heights."""
        return min(2 * self.steps // 3, _FREE)

    @property
    def template(self) -> list[np.ndarray]:
        """Arrays of the shapes and kinds of a checkpoint's."""
        like = self.start.astype(np.float64)
        return [like, like, like, self.start, self.start, np.zeros(4)]

    def filled(self, cell: UInt8[np.ndarray, "y x"]) -> Float[np.ndarray, "slab y x"]:
        """Share of glass of every slab, the one nearest to the air first."""
        return (cell > np.arange(self.count - 1)[::-1, None, None]).astype(np.float64)

    def light(self, orders: Float[np.ndarray, "2 order"], number: Int[np.ndarray, "order 2"]) -> SpotLight:
        """Sum and uniformity error of the spots' light.

        Args:
            orders: shares of the light along x and along y.
            number: `[order, y and x]` of every order.
        """
        return spot_light(self.ways @ orders[:, places_of(self.spots, number)], self.spots.shares)

    def initial_state(self) -> RefinementState:
        """The cell to begin with."""
        none, height = np.zeros(self.first.shape), self.first.astype(np.float64)
        return RefinementState(height, none, none, self.first, self.first, np.array([np.nan, -np.inf, _MOST, 0.0]), 0)

    @cached_property
    def first(self) -> UInt8[np.ndarray, "y x"]:
        """The cell at the start, or the nearest one that can be printed."""
        return self._printable(self.start - (self.count - 1) / 2, self.start)

    def run(self, state: RefinementState) -> Iterator[tuple[RefinementState, dict[str, Any]]]:
        """Do the remaining steps one by one; yields the state, and the line of the history."""
        while state.step < self.steps:
            step = state.step
            state, light = (self._free_step if step < self.free_steps else self._exchange_step)(state)
            terms = [float(part) for part in light]
            loss = 1 - light.merit(self.uniformity)
            yield state, {"step": step, "loss": loss, "terms": terms, "names": ["efficiency", "uniformity_error"]}

    def _score(self, orders: Any) -> Any:
        """Efficiency less how unequal spots are."""
        light = self.ways @ orders[:, places_of(self.spots, self.solver.number)]
        over = light / self.spots.shares
        spread = (((over / over.mean() - 1) ** 4).mean() + 1e-16) ** 0.25
        return light.sum() - self.uniformity * FLAT * spread

    def _solved(self, cell: np.ndarray) -> tuple[float, SpotLight]:
        orders = self.solver.transmitted(self.filled(cell))
        return float(self._score(orders)), self.light(orders, self.solver.number)

    def _free_step(self, state: RefinementState) -> tuple[RefinementState, SpotLight]:
        done = state.step / max(self.free_steps, 1)
        sharpness = _SHARPNESS[0] * (_SHARPNESS[1] / _SHARPNESS[0]) ** done
        height = self._smoothed(state.height)
        below = np.arange(self.count - 1)[::-1, None, None]
        bent = np.tanh(sharpness * (height - below - 0.5))
        _, orders, change = self.solver.gradient((1 + bent) / 2, self._score)
        slope = self._smoothed((change * sharpness * (1 - bent**2) / 2).sum(0))
        with jax.enable_x64(True):
            moments: Any = optax.ScaleByAdamState(jnp.asarray(state.step), state.mean, state.square)
            found, moments = _ADAM.update(slope, moments)
        move, mean, square = map(np.asarray, (found, moments.mu, moments.nu))
        moved = (state.height + _RATE * (1 - 0.7 * done) * move).clip(-0.3, self.count - 0.7)
        state = state._replace(height=moved, mean=mean, square=square, step=state.step + 1)
        return state, self.light(orders, self.solver.number)

    def _begin_exchange(self, state: RefinementState) -> RefinementState:
        """Begin with the better one of the free heights on levels and the first cell, then with the best, shaken."""
        begun, (merit, best) = state.numbers[3], (state.numbers[1], state.best)
        if begun == 0:
            height = self._smoothed(state.height)
            rounded = np.rint(height).clip(0, self.count - 1).astype(np.uint8)
            cells = [self._printable(height - (self.count - 1) / 2, rounded), self.first]
        else:
            rng = np.random.default_rng((self.seed, state.step))
            offers = self._offers(best, rng.normal(size=(self.count - 1, *best.shape)))
            cells = [self._changed(best, offers, max(2, best.size // _SHAKEN))]
        found = [(*self._solved(cell), cell) for cell in cells]
        for _, light, cell in found:
            if light.merit(self.uniformity) > merit:
                merit, best = light.merit(self.uniformity), cell
        score, _, cell = max(found, key=lambda each: each[0])
        return state._replace(cell=cell, best=best, numbers=np.array([score, merit, _MOST, begun + 1]))

    def _exchange_step(self, state: RefinementState) -> tuple[RefinementState, SpotLight]:
        if np.isnan(state.numbers[0]):
            state = self._begin_exchange(state)
        score, merit, most, begun = state.numbers
        _, orders, change = self.solver.gradient(self.filled(state.cell), self._score)
        light = self.light(orders, self.solver.number)
        offers = self._offers(state.cell, change[::-1])
        sizes = list(dict.fromkeys(max(1, round(most / 3**part)) for part in range(4)))
        tried = [self._changed(state.cell, offers, size) for size in sizes]
        alone = (self._changed(state.cell, [offer], 1) for offer in offers)
        tried += list(islice((cell for cell in alone if not np.array_equal(cell, state.cell)), 1, self._tries))
        for number, cell in enumerate(tried):
            if np.array_equal(cell, state.cell):
                continue
            found, own = self._solved(cell)
            if found > score + 1e-9:
                most = 1.5 * sizes[number] if number < len(sizes) else 1.0
                best = state.best
                if own.merit(self.uniformity) > merit:
                    best, merit = cell, own.merit(self.uniformity)
                numbers = np.array([found, merit, min(most, _MOST), begun])
                return state._replace(cell=cell, best=best, numbers=numbers, step=state.step + 1), own
        # Nothing is left here.
        state = state._replace(cell=self.first, numbers=np.array([np.nan, merit, _MOST, begun]))
        return state._replace(step=state.step + 1), light

    @property
    def _tries(self) -> int:
        return _ROW_TRIES if 1 in self.start.shape else _TRIES

    def _offers(self, cell: np.ndarray, change: np.ndarray) -> list[_Offer]:
        """Changes by what they promise, the most first; `change`: of the score, by the glass of every slab, upward."""
        if self.strokes is not None:
            gains, offers = self._offered_strokes(cell, change[0], self.strokes)
        else:
            reached = np.concatenate([np.zeros((1, *cell.shape)), np.cumsum(change, 0)])
            gains = (reached - np.take_along_axis(reached, cell[None].astype(np.int64), 0)).ravel()
            gains[np.flatnonzero((np.arange(self.count)[:, None, None] == cell).ravel())] = -np.inf
            offers = [_Offer(np.array([at % cell.size]), at // cell.size) for at in range(gains.size)]
        order = np.argsort(-gains, kind="stable")[:_OFFERS]
        # The gradient alone does not say how much a whole slab does: of a row, all are worth a try.
        least = -np.inf if 1 in cell.shape else 0.0
        return [offers[at] for at in order if gains[at] > least]

    def _offered_strokes(
        self, cell: np.ndarray, change: np.ndarray, strokes: Strokes
    ) -> tuple[np.ndarray, list[_Offer]]:
        gains, offers, (ny, nx) = list[float](), list[_Offer](), cell.shape
        for glass in (True, False):
            gain = np.where((cell > 0) != glass, change if glass else -change, 0.0)
            for y in range(ny):
                for x in range(nx):
                    pixels = strokes.stroke(cell.shape, y, x, glass)
                    pixels = pixels[cell.flat[pixels] != glass]
                    if pixels.size:
                        gains.append(float(gain.flat[pixels].sum()))
                        offers.append(_Offer(pixels, int(glass)))
        return np.array(gains), offers

    def _changed(self, cell: np.ndarray, offers: list[_Offer], most: int) -> np.ndarray:
        """The cell with the first changes, as many as `most`, that leave it printable and each other alone."""
        cell, taken, free = cell.copy(), 0, np.ones(cell.size, bool)
        for offer in offers[: 20 * most]:
            if not free[offer.pixels].all():
                continue
            before = cell.flat[offer.pixels]
            cell.flat[offer.pixels] = offer.value
            if self.strokes is not None and not self.strokes.follows(cell > 0):
                cell.flat[offer.pixels] = before
                continue
            free[offer.pixels], taken = False, taken + 1
            if taken == most:
                break
        return cell

    def _printable(self, outline: np.ndarray, cell: np.ndarray) -> UInt8[np.ndarray, "y x"]:
        if self.strokes is None or self.strokes.follows(cell > 0):
            return cell
        found: Bool[np.ndarray, "y x"] | None = self.strokes.nearest(outline)
        return self.start if found is None else found.astype(np.uint8)

    def _smoothed(self, height: np.ndarray) -> np.ndarray:
        """Smooth by a cone as wide as the wider brush; its own adjoint."""
        if self.strokes is None or max(self.strokes[:2]) == 1:
            return height
        y, x = (np.fft.fftfreq(count, 1 / count) for count in height.shape)
        cone = np.maximum(0, 1 - np.hypot(y[:, None], x) / max(self.strokes[:2]))
        return np.fft.ifft2(np.fft.fft2(height) * np.fft.fft2(cone / cone.sum())).real


def places_of(spots: Spots, number: Int[np.ndarray, "order 2"]) -> Int[np.ndarray, " m"]:
    """Where the orders of spots stand among those that were solved.

    Args:
        spots: of a grid of orders.
        number: `[order, y and x]` of every order.

    Raises:
        KeyError: an order was not solved.
    """
    assert spots.orders is not None
    place = {(int(y), int(x)): at for at, (y, x) in enumerate(number)}
    return np.array([place[int(y), int(x)] for y, x in spots.orders])


def ranks(levels: Levels) -> tuple[UInt8[np.ndarray, " level"], UInt8[np.ndarray, " level"]]:
    """Levels from the lowest to the highest, and the place of every level among them.

    Args:
        levels: a staircase.
    """
    order = levels.by_height()[0]
    return order, np.argsort(order).astype(np.uint8)
