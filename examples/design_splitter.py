"""Design a splitter for the public invrs case: a thin element first, then by Maxwell's equations and their gradient.

    python examples/design_splitter.py splitter.png
    python examples/design_splitter.py splitter.png --resume 0.6828558um --rounds 20

The case is that of `invrs_splitter.py`, which scores what this writes. The cell is its own mirror image, which makes
light of 800 terms cheap (`sim.rigorous.mirrored`) and costs little: thin elements reach 0.725 instead of 0.752, and
0.546 if mirrored along both axes (the best of six each). From seeded noise:

1. thin: a smoothed density, pressed to 0 or 1, and the depth, by the gradient of a soft score;
2. few terms: the same density by rigorous light of 450 terms;
3. all terms: by 800, widths held by the rule of M. Zhou et al., Comput. Methods Appl. Mech. Eng. 293, 266 (2015);
4. outline: the wall itself is moved. Every step draws the nearest cell whose features and gaps are made of strokes of a
   round brush of 10 pixels, without exception, and the best one is kept;
5. exchange: bumps and dents of walls that follow the same rule, those that promise most by the derivatives of all
   orders, as long as the score grows. `--resume` goes on with it.

It prints lines of the score by its own light; `invrs_splitter.py` has the last word. Eleven minutes on two busy
cores made `examples/results/invrs_splitter.png` (seed 10, depth 0.6828558 um), which scores 0.6877 there.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from invrs_splitter import GLASS, ORDERS, PERIOD_M, PIXELS, TERMS, WAVELENGTH_M, Score, read_design
from scipy.ndimage import distance_transform_edt

from fab.errors import InputError
from fab.pictures import write_pixels
from fab.units import metres
from sim.rigorous import MirroredLayer

BRUSH = 10  # pixels
_SMOOTHED = 10.0  # pixels, radius of the cone that smoothes densities; a width of the same is held by 0.75 and 0.25
_WIDE = 0.75
_SHARPEST = 64.0  # of the projection
_FEW_TERMS = 450
_REACH = 5.0  # pixels to either side, over which the outline remembers where it was


class Design(NamedTuple):
    """A cell that can be made, and its light.

    Attributes:
        glass: `[y, x]` whether a pixel is left unetched; light is along x or y as `MirroredLayer` was told.
        height_m: depth of the etch.
        score: by the light of all terms.
    """

    glass: np.ndarray
    height_m: float
    score: Score


def soft_score(orders: np.ndarray, power: float) -> tuple[float, np.ndarray]:
    """Score with means of a high power for the largest and the least order, and its derivative by every order."""
    total, mean = orders.sum(), orders.mean()
    share = orders / mean
    most, least = (np.mean(share**sign_power) ** (1 / sign_power) for sign_power in (power, -power))
    value = total * 2 * least / (most + least)
    by_most = most * share ** (power - 1) / (share**power).sum() * -value / (most + least)
    by_least = least * share ** (-power - 1) / (share**-power).sum() * value * most / (least * (most + least))
    by_share = by_most + by_least
    return float(value), by_share / mean - (by_share * orders).sum() / mean**2 / orders.size + value / total


def _mirrored(raster: np.ndarray) -> np.ndarray:
    """Mean of a raster and its mirror image, as `MirroredLayer` has it."""
    return (raster + np.roll(raster[:, ::-1], 1, 1)) / 2


def _smoothed(raster: np.ndarray, radius: float) -> np.ndarray:
    """Smooth by a cone."""
    place = np.fft.fftfreq(PIXELS, 1 / PIXELS)
    cone = np.maximum(0, 1 - np.hypot(place[:, None], place) / radius)
    return np.fft.ifft2(np.fft.fft2(raster) * np.fft.fft2(cone / cone.sum())).real


def _slopes(raster: np.ndarray) -> np.ndarray:
    """Length of the gradient, per pixel."""
    y, x = ((np.roll(raster, -1, axis) - np.roll(raster, 1, axis)) / 2 for axis in (0, 1))
    return np.hypot(y, x)


class Density:
    """Smoothed and pressed density of a cell, from any numbers per pixel; Adam moves those.

    Args:
        latent: `[y, x]` the numbers.
    """

    def __init__(self, latent: np.ndarray) -> None:
        self.latent, self._mean, self._square, self._count = latent, np.zeros_like(latent), np.zeros_like(latent), 0

    def pressed(self, sharpness: float) -> np.ndarray:
        """Density, from 0 to 1."""
        self._share = 1 / (1 + np.exp(-self.latent))
        self.smooth = _smoothed(self._share, _SMOOTHED)
        bent, self._end = np.tanh(sharpness * (self.smooth - 0.5)), np.tanh(sharpness / 2)
        self._slope = sharpness * (1 - bent**2) / (2 * self._end)
        self.now = (self._end + bent) / (2 * self._end)
        return self.now

    def ascend(self, gradient: np.ndarray, rate: float, widths: float) -> None:
        """Take a step.

        Args:
            gradient: of what shall grow, by the density that `pressed` gave last.
            rate: length of the step.
            widths: weight of the rule of widths: that the middle of features and gaps be wide of one half.
        """
        middle = np.exp(-8 * (_SMOOTHED * _slopes(self.smooth)) ** 2)
        missing = np.minimum(self.smooth - _WIDE, 0) * middle * self.now
        missing -= np.minimum(1 - _WIDE - self.smooth, 0) * middle * (1 - self.now)
        inner = gradient * self._slope - widths * 2 * missing / missing.size
        change = _mirrored(_smoothed(inner, _SMOOTHED) * self._share * (1 - self._share))
        self._count += 1
        self._mean = 0.9 * self._mean + 0.1 * change
        self._square = 0.99 * self._square + 0.01 * change**2
        mean, square = self._mean / (1 - 0.9**self._count), self._square / (1 - 0.99**self._count)
        self.latent = self.latent + rate * mean / (np.sqrt(square) + 1e-12)


class _Step:
    """Adam for one number."""

    def __init__(self) -> None:
        self._mean = self._square = 0.0
        self._count = 0

    def __call__(self, gradient: float, rate: float) -> float:
        self._count += 1
        self._mean = 0.9 * self._mean + 0.1 * gradient
        self._square = 0.99 * self._square + 0.01 * gradient**2
        return rate * (self._mean / (1 - 0.9**self._count)) / np.sqrt(self._square / (1 - 0.99**self._count))


def thin_start(seed: int, steps: int) -> tuple[Density, float]:
    """Design a thin element from noise: its density, and its depth in metres."""
    noise = _mirrored(_smoothed(np.random.default_rng(seed).normal(size=(PIXELS, PIXELS)), _SMOOTHED))
    density, phase, turn = Density(noise / noise.std()), np.pi, _Step()
    own = np.ix_(np.arange(-ORDERS, ORDERS + 1), np.arange(-ORDERS, ORDERS + 1))
    for step in range(steps):
        done = step / steps
        wave = np.exp(1j * phase * density.pressed(4 * 16**done))
        amplitude = np.fft.fft2(wave, norm="forward")[own]
        slopes = np.zeros((PIXELS, PIXELS), complex)
        slopes[own] = soft_score(abs(amplitude) ** 2, 2 + 10 * done)[1] * amplitude.conj()
        change = 2j * np.fft.fft2(slopes, norm="forward") * wave
        by_phase = float((change * density.now).sum().real)
        density.ascend((change * phase).real, 0.1, 30 * max(0.0, 2 * done - 1))
        phase += turn(by_phase, 0.01)
    return density, phase * WAVELENGTH_M / (2 * np.pi * (GLASS - 1))


def _layer(terms: int) -> MirroredLayer:
    return MirroredLayer(PIXELS, PERIOD_M, WAVELENGTH_M, (GLASS, 1.0), terms)


def _growing(power: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda orders: soft_score(orders, power)[1][None]


def _permittivity(density: np.ndarray) -> np.ndarray:
    return 1 + (GLASS**2 - 1) * density


def refine(density: Density, height_m: float, few: int, steps: int) -> float:
    """Move a density by rigorous light; returns the depth.

    Args:
        density: moved in place.
        height_m: depth at first.
        few: steps with few terms.
        steps: of all.
    """
    layer, turn = _layer(_FEW_TERMS), _Step()
    density.latent = density.latent.clip(-2.5, 2.5)
    begun = time.perf_counter()
    for step in range(steps):
        layer = _layer(TERMS) if step == few else layer
        done = step / steps
        permittivity = _permittivity(density.pressed(6 * (_SHARPEST / 6) ** min(1, done / 0.85)))
        walls, power = layer.products_of_directions(permittivity), 2 + 12 * done
        light, (change,) = layer.gradients(permittivity, height_m, walls, ORDERS, _growing(power))
        rate = 0.1 if done < 0.8 else 0.04
        density.ascend(change.permittivity * (GLASS**2 - 1), rate, 60 * max(0.0, 2 * done - 0.6))
        height_m += turn(change.depth * 1e-6, 0.006 if done < 0.5 else 0.002) * 1e-6
        if step % 10 == 0 or step == steps - 1:
            _say(f"density {step:3d}", begun, Score(light.orders), height_m)
    density.pressed(_SHARPEST)
    return height_m


def _brush() -> np.ndarray:
    """Pixels of the round brush: those whose centres lie within it."""
    place = np.arange(BRUSH) - (BRUSH - 1) / 2
    return np.argwhere(place[:, None] ** 2 + place**2 < (BRUSH / 2) ** 2)


def painted(cell: np.ndarray) -> np.ndarray:
    """Part of a cell's features that strokes of the brush within them cover; across the cell's rim they go on."""
    inside, covered = np.ones_like(cell), np.zeros_like(cell)
    for y, x in _brush():
        inside &= np.roll(cell, (-y, -x), (0, 1))
    for y, x in _brush():
        covered |= np.roll(inside, (y, x), (0, 1))
    return covered


def drawn(outline: np.ndarray) -> np.ndarray | None:
    """Cell near to where an outline is positive, of which features and gaps are painted whole; None if none is found.

    Args:
        outline: `[y, x]` signed distance from the wall, pixels, about.
    """
    cell, weight = outline > 0, abs(outline) + 1e-3
    mean = weight.mean()
    for _ in range(400):
        closed, opened = ~painted(~cell), painted(cell)
        first, second = painted(closed), ~painted(~opened)
        cell = first if (weight * (first != cell)).sum() <= (weight * (second != cell)).sum() else second
        wrong = cell != painted(cell)
        wrong |= ~cell & ~painted(~cell)
        if not wrong.any():
            return cell
        # The pixel that matters most gets a stroke of glass or air that covers it, whichever changes least.
        y, x = np.unravel_index(np.argmax(np.where(wrong, weight, -1)), cell.shape)
        strokes = [(_brush() - corner + (y, x)) % PIXELS for corner in _brush()]
        costs = [(weight[*s.T] * (cell[*s.T] != glass)).sum() for glass in (True, False) for s in strokes]
        best = int(np.argmin(costs))
        stroke = strokes[best % len(strokes)]
        for across in (stroke[:, 1], -stroke[:, 1] % PIXELS):
            cell[stroke[:, 0], across] = best < len(strokes)
            weight[stroke[:, 0], across] = 1.5 * weight[stroke[:, 0], across] + 0.02 * mean
    return None


def move_outline(outline: np.ndarray, height_m: float, steps: int) -> Design:
    """Move an outline by rigorous light, drawing at every step; the best cell drawn.

    Args:
        outline: `[y, x]` signed distance from the wall, pixels, about.
        height_m: depth at first.
        steps: how many.
    """
    layer, begun = _layer(TERMS), time.perf_counter()
    best, kept, speed, turn, scale, rate = None, outline, np.zeros_like(outline), 0.0, 0.0, 0.15
    for step in range(steps):
        done = step / steps
        cell = drawn(outline)
        if cell is None:
            outline = _smoothed(outline, 2)
            continue
        permittivity, power = _permittivity(cell), 12 * 3**done
        walls = layer.products_of_directions(permittivity)
        light, (change,) = layer.gradients(permittivity, height_m, walls, ORDERS, _growing(power))
        design = Design(cell, height_m, Score(light.orders))
        if best is None or design.score.value > best.score.value:
            best, kept = design, outline
        if step % 10 == 0 or step == steps - 1:
            _say(f"outline {step:3d}", begun, best.score, best.height_m)
        if design.score.value < best.score.value - 0.03:
            # Features have joined or parted: back, give way where the rule overruled, and go slower.
            outline, height_m, rate = np.where(best.glass != (kept > 0), 0.5 * kept, kept), best.height_m, 0.6 * rate
            speed, turn = np.zeros_like(outline), 0.0
            continue
        gain = change.exchanged(permittivity, _permittivity(~cell))
        force = _smoothed(np.where(cell, -gain, gain), 4)
        size = float(np.sqrt(np.mean(force[abs(outline) < 2] ** 2)))
        scale = scale or size
        speed = 0.7 * speed + 0.3 * force / max(size, 0.3 * scale)
        moved = _mirrored(outline + rate * (1 - 0.8 * done) * speed).clip(-_REACH, _REACH)
        # Where the rule overrules the outline it gives way, lest it run away unseen.
        outline = np.where(cell != (outline > 0), 0.7 * moved, moved)
        turn = 0.7 * turn + 0.3 * change.depth * 1e-6
        height_m += 1e-6 * float(np.clip(0.002 * turn, -0.003, 0.003))
    if best is None:
        raise InputError("outline", "features and gaps of 10 pixels", "none found", "Take another seed.")
    return best


class _Exchange(NamedTuple):
    """A change that can be drawn: its pixels, and what it adds to every order."""

    pixels: np.ndarray
    change: np.ndarray


def _followed(cell: np.ndarray) -> bool:
    """Whether features and gaps are painted whole."""
    return np.array_equal(cell, painted(cell)) and np.array_equal(~cell, painted(~cell))


def _distance(cell: np.ndarray) -> np.ndarray:
    """Signed distance from the wall, pixels, positive in glass."""
    tiles = np.tile(cell, (3, 3))
    inside, outside = (np.asarray(distance_transform_edt(each)) for each in (tiles, ~tiles))
    away = np.where(tiles, inside - 0.5, 0.5 - outside)
    return away[PIXELS : 2 * PIXELS, PIXELS : 2 * PIXELS]


def _exchanges(cell: np.ndarray, by_pixel: np.ndarray, count: int, rng: np.random.Generator) -> list[_Exchange]:
    """Bumps and dents of walls at random places; `by_pixel`: what every order gains by exchanging a pixel."""
    outline, place = _distance(cell), np.arange(PIXELS)
    walls, found = np.argwhere(abs(outline) < 1), list[_Exchange]()
    while len(found) < count:
        y, x = ((place - at + PIXELS // 2) % PIXELS - PIXELS // 2 for at in walls[rng.integers(len(walls))])
        radius, height = rng.uniform(5, 14), rng.choice([-1, 1]) * rng.uniform(0.7, 2.0)
        bump = height * np.maximum(0, 1 - np.hypot(y[:, None], x) / radius)
        changed = drawn(outline + bump + np.roll(bump[:, ::-1], 1, 1))
        if changed is not None and 0 < (changed != cell).sum() <= 120:
            pixels = changed != cell
            found.append(_Exchange(pixels, by_pixel[:, pixels].sum(1)))
    return found


def _chosen(design: Design, orders: np.ndarray, exchanges: list[_Exchange], deeper: np.ndarray, limit: int) -> Design:
    """Take the exchanges and changes of depth that promise most, one after another, none near another; unscored."""

    def promise(change: np.ndarray) -> float:
        half = (orders + change).reshape(-1, ORDERS + 1)
        return soft_score(np.concatenate([half[:, :0:-1], half], 1), 40)[0]

    cell, height_m, near, taken = design.glass, design.height_m, np.zeros_like(design.glass), 0
    steps = [1e-9 * by for by in (-1.0, -0.3, 0.3, 1.0)]
    while taken < limit:
        exchanges = [one for one in exchanges if not (one.pixels & near).any()]
        promised = [promise(one.change) for one in exchanges]
        turned = [promise(deeper * by) for by in steps]
        if max(promised + turned) < promise(0 * deeper) + 1e-5:
            break
        if max(turned) > max(promised, default=0.0):
            by = steps[int(np.argmax(turned))]
            height_m, orders = height_m + by, orders + deeper * by
            continue
        one = exchanges.pop(int(np.argmax(promised)))
        if _followed(cell ^ one.pixels):
            cell, orders, taken = cell ^ one.pixels, orders + one.change, taken + 1
            near = near | (_smoothed(one.pixels, 7) > 1e-9)
    return Design(cell, height_m, design.score)


def exchange(design: Design, rounds: int, seed: int) -> Design:
    """Exchange pixels at walls, by how every order changes with every pixel, as long as the score grows.

    Args:
        design: to begin with.
        rounds: how many times orders are differentiated.
        seed: of the places.
    """
    layer, rng, begun, most = _layer(TERMS), np.random.default_rng(seed), time.perf_counter(), 30.0
    side = 2 * ORDERS + 1
    half = [(y, x) for y in range(side) for x in range(ORDERS, side)]

    def each(_: np.ndarray) -> np.ndarray:
        units = np.zeros((len(half), side, side))
        units[np.arange(len(half)), *np.transpose(half)] = 1
        return units

    for step in range(rounds):
        permittivity = _permittivity(design.glass)
        walls = layer.products_of_directions(permittivity)
        light, slopes = layer.gradients(permittivity, design.height_m, walls, ORDERS, each)
        design = design._replace(score=Score(light.orders))
        _say(f"exchange {step:2d}", begun, design.score, design.height_m)
        other = _permittivity(~design.glass)
        by_pixel = np.stack([slope.exchanged(permittivity, other) for slope in slopes])
        deeper = np.array([slope.depth for slope in slopes])
        found = _exchanges(design.glass, by_pixel, 200, rng)
        for limit in (most, most / 3, most / 10):
            chosen = _chosen(design, light.orders[:, ORDERS:].ravel(), found, deeper, max(1, round(limit)))
            permittivity = _permittivity(chosen.glass)
            walls = layer.products_of_directions(permittivity)
            orders = layer.solve(permittivity, chosen.height_m, walls, ORDERS).orders
            if Score(orders).value > design.score.value:
                design, most = chosen._replace(score=Score(orders)), min(30.0, 1.3 * most)
                break
        else:
            most = max(3.0, 0.6 * most)
    return design


def _say(what: str, begun: float, score: Score, height_m: float) -> None:
    print(f"{what}  {time.perf_counter() - begun:5.0f} s  {height_m * 1e6:.4f} um  {score}", flush=True)


def main() -> int:
    """Design, and write the cell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, help="PNG to write")
    parser.add_argument("--seed", type=int, default=10, help="of the noise (10)")
    parser.add_argument("--resume", metavar="HEIGHT", help="exchange only, in that PNG with this depth")
    parser.add_argument("--rounds", type=int, default=10, help="of exchanges (10)")
    given = parser.parse_args()
    begun = time.perf_counter()
    if given.resume is None:
        density, height_m = thin_start(given.seed, 600)
        height_m = refine(density, height_m, 110, 150)
        outline = (density.smooth - 0.5) / np.maximum(_slopes(density.smooth), 0.02)
        design = move_outline(outline.clip(-4, 4), height_m, 45)
        _write(given.result, design, begun)
    else:
        glass, height_m = read_design(given.result).T > 0.5, metres(given.resume)
        design = Design(glass, height_m, Score(np.full((2 * ORDERS + 1, 2 * ORDERS + 1), np.nan)))
    # To the last digit that is printed, so that what was written can be resumed.
    design = design._replace(height_m=round(design.height_m * 1e6, 7) * 1e-6)
    _write(given.result, exchange(design, given.rounds, given.seed), begun)
    return 0


def _write(path: Path, design: Design, begun: float) -> None:
    write_pixels(path, np.where(design.glass, 255, 0).astype(np.uint8))
    print(f"{design.score}\ndepth {design.height_m * 1e6:.7f} um, {time.perf_counter() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    sys.exit(main())
