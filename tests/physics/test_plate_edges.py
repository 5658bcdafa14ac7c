"""Plates as fabricated with the light of their walls, against a sum over pieces and walls that knows no moments."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from scipy.special import wofz

from fab.grid import Grid
from fab.levels import Levels, height_of
from fab.process import Process, Variation
from sim.camera import Camera, Colour
from sim.material import refractive_index
from sim.metrics import zeroth_order
from sim.psf_bank import psf
from sim.rigorous.edge_optic import with_edges
from sim.rigorous.edge_widths import edge_dipoles, edge_widths
from sim.rigorous.rows import Polarisation, orders_of, row_slabs
from sim.surface import as_fabricated
from sim.surface.lines import shared_light

CELL, STEP, BLUE, GREEN, RED = 1.85e-6, 75e-9, 486e-9, 552e-9, 656e-9
PERIOD, CELLS = 12, 96
LEVELS, TOP = Levels(16, STEP), 15 * STEP
FINE = CELL / 20  # a wafer's errors here are whole numbers of these, for the rigorous slabs
ORDERS = np.arange(-5, 6)


def camera(wavelength_m: float, polarisation: str) -> Camera:
    """A lens that sees five orders of the period to either side, 0.42 waves per cell."""
    window = 440 if wavelength_m == BLUE else 600
    colours = (Colour("one", (wavelength_m,), (1.0,)),)
    aperture = 1.6 * CELLS * CELL  # wider than the grid: its middle is like one without end
    return Camera(
        Grid((CELLS, CELLS), CELL),
        aperture,
        "fused_silica",
        colours,
        8e-3,
        4e-6,
        window,
        light="edges",
        polarisation=polarisation,
    )


class Row:
    """A row of random cells that repeats, its masks off by some of `FINE` and its openings wider on either side."""

    def __init__(self, seed: int, shift: float, bias: int, walls_along: str):
        rng = np.random.default_rng(seed)
        self.level = rng.integers(0, 16, PERIOD)
        self.shift = rng.integers(-int(shift), int(shift) + 1, 4)
        self.bias = rng.integers(-bias, bias + 1, 4)
        self.opens = (15 - self.level)[None] >> np.arange(4)[:, None] & 1
        self.walls_along = walls_along

    def variation(self) -> Variation:
        """The errors of the plate, masks moved across the walls."""
        moved = tuple(float(s) for s in self.shift * FINE)
        grown = tuple(float(b) for b in self.bias * FINE)
        if self.walls_along == "y":
            return Variation(overlay_x_m=moved, cd_bias_m=grown)
        return Variation(overlay_y_m=moved, cd_bias_m=grown)

    def plate(self) -> np.ndarray:
        """The level map whose rows (or columns) repeat it."""
        row = np.tile(self.level, CELLS // PERIOD).astype(np.uint8)
        level = np.broadcast_to(row, (CELLS, CELLS))
        return np.ascontiguousarray(level if self.walls_along == "y" else level.T)

    def height_m(self) -> np.ndarray:
        """Height of every twentieth of a cell, from the masks' samples."""
        height = np.full(20 * PERIOD, TOP)
        for k in range(4):
            samples = np.repeat(self.opens[k], 20).astype(bool)
            for _ in range(abs(self.bias[k])):
                before, behind = np.roll(samples, 1), np.roll(samples, -1)
                samples = samples | before | behind if self.bias[k] > 0 else samples & before & behind
            height -= STEP * 2**k * np.roll(samples, self.shift[k])
        return height

    def walls(self) -> list[list[tuple[float, float, float]]]:
        """For every border: place (cells) of the walls of its masks in order, rise, and height behind each."""
        found = []
        for cell in range(PERIOD):
            height = TOP - sum(STEP * 2**k * self.opens[k, cell - 1] for k in range(4))
            own = []
            for k in range(4):
                opens = int(self.opens[k, cell]) - int(self.opens[k, cell - 1])
                if opens:
                    own.append((cell + (self.shift[k] - self.bias[k] * opens) / 20, -opens * STEP * 2**k))
            border = []
            for place, rise in sorted(own):
                height += rise
                border.append((place, rise, height))
            found.append(border)
        return found


def left_of_shared(apart_m: float, layers: list[tuple[float, float]], wavelength_m: float) -> complex:
    """Light that crosses two walls between any two depths, over that of walls in one place, by quadrature.

    Of a plane wave that diffraction spreads over a depth z as if by a normal distribution of variance
    i z wavelength / (2 pi), E[max(x - apart, 0)] crosses both.
    """
    nodes, weights = np.polynomial.legendre.leggauss(60)
    (a, b), (c, d) = layers
    depth = np.abs(((a + b) / 2 + (b - a) / 2 * nodes)[:, None] - ((c + d) / 2 + (d - c) / 2 * nodes)) + 1e-13
    spread = np.sqrt(1j * depth * wavelength_m / (2 * np.pi))

    def crossing(apart_m: float) -> complex:
        z = apart_m / spread / np.sqrt(2)
        # wofz keeps erfc of large arguments within range.
        density = np.exp(-(z**2)) * (spread / np.sqrt(2 * np.pi) - apart_m / 2 * wofz(1j * z))
        return complex(weights @ density @ weights)

    return crossing(apart_m) / crossing(0.0)


def expected_orders(row: Row, wavelength_m: float, way: str) -> np.ndarray:
    """Intensities of the orders of the thin pieces and of the lines of all walls, border by border."""
    index = refractive_index("fused_silica", wavelength_m)
    rate, height = (index - 1) / wavelength_m, row.height_m()
    places = (np.arange(20 * PERIOD) + 0.5) / 20
    field = np.exp(2j * np.pi * (rate * height - np.outer(ORDERS, places) / PERIOD)).sum(1) / 20
    field = field * np.sinc(ORDERS / PERIOD / 20)

    def line(place: float, rise: float, height: float) -> np.ndarray:
        if abs(rise) < 1e-12:
            return np.zeros(len(ORDERS))
        # TM where the field is across the walls.
        known: dict[str, tuple[Polarisation, ...]] = {"unpolarised": ("TE", "TM"), row.walls_along: ("TE",)}
        ways = known.get(way, ("TM",))
        given, foot = ((abs(rise),), wavelength_m, index), height - max(rise, 0)
        air = np.exp(-2j * np.pi * abs(rise) / wavelength_m)
        width, dipole = (air * np.mean([of(*given, one)[0] for one in ways]) for of in (edge_widths, edge_dipoles))
        below, above = (np.exp(2j * np.pi * rate * at) for at in (foot, foot + abs(rise)))
        stands = 1j * wavelength_m / (4 * np.pi * index) * (foot - TOP / 2) * (above - below)
        dipole = np.sign(rise) * (stands + dipole * below) / CELL**2
        waves = ORDERS / PERIOD
        return (width / CELL * below + 2j * np.pi * waves * dipole) * np.exp(-2j * np.pi * waves * place)

    for border in row.walls():
        heights = [border[0][2] - border[0][1], *(height for _, _, height in border)] if border else []

        def joint(first: int, last: int, place: float, heights: list[float] = heights) -> np.ndarray:
            return line(place, heights[last] - heights[first], heights[last])

        for last in range(len(border)):
            for first in range(last + 1):
                ends = border[first][0], border[last][0]
                middle = (ends[0] + ends[1]) / 2
                both = joint(first, last + 1, middle)
                if first < last:
                    both = both - joint(first, last, middle) - joint(first + 1, last + 1, middle)
                    both = both + joint(first + 1, last, middle)
                    layers = [(heights[k], heights[k + 1]) for k in (first, last)]
                    both = both * left_of_shared((ends[1] - ends[0]) * CELL, layers, wavelength_m)
                field = field + both
    return np.abs(field / PERIOD) ** 2


def orders_found(row: Row, lens: Camera) -> np.ndarray:
    """Orders of the cells in the middle of the plate as fabricated."""
    doe = as_fabricated(row.plate(), lens, Process(LEVELS), row.variation())
    assert doe.grid.shape == (CELLS, CELLS)
    values = np.asarray(doe.at(doe.wavelengths_m[0]), complex)
    values = values[CELLS // 2] if row.walls_along == "y" else values[:, CELLS // 2]
    places = np.arange(PERIOD) + 0.5
    waves = np.exp(-2j * np.pi * np.outer(ORDERS, places) / PERIOD)
    field = waves @ values[4 * PERIOD : 5 * PERIOD] / PERIOD * np.sinc(ORDERS / PERIOD)
    return np.abs(field) ** 2


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wavelength", "way", "walls_along", "shift", "bias"),
    [
        (BLUE, "x", "y", 1, 0),
        (BLUE, "unpolarised", "x", 5, 0),
        (RED, "y", "y", 0, 2),
        (RED, "x", "x", 4, 2),
    ],
)
def test_lines_are_where_the_masks_have_their_walls(
    wavelength: float, way: str, walls_along: str, shift: int, bias: int
):
    """As well as pieces of cells are by their moments: 0.1 to 0.8 % here; a thin element is off by 4 to 19 %."""
    row, lens = Row(3, shift, bias, walls_along), camera(wavelength, way)
    expected = expected_orders(row, wavelength, way)
    assert off(orders_found(row, lens), expected) < 0.01
    assert off(orders_found(row, replace(lens, light="scalar")), expected) > 0.03


def test_walls_share_light_as_diffraction_over_their_depth_has_it():
    """The series leaves 0.001; the quadrature, whose integrand has a root at depth 0, less."""
    height, wavelength = 0.6e-6, 552e-9
    distances = np.linspace(0, 3, 13)
    found = np.asarray(shared_light(distances)[0]) + 1j * np.asarray(shared_light(distances)[1])
    unit = np.sqrt(height * wavelength / np.pi)
    expected = [left_of_shared(one * unit, [(0.0, height)] * 2, wavelength) for one in distances]
    np.testing.assert_allclose(found, expected, atol=0.002)
    assert abs(found[-1]) < 0.003 < abs(found[-4])
    np.testing.assert_array_equal(shared_light(np.float32(7.0)), shared_light(np.float32(3.0)))


def test_plates_as_fabricated_are_near_to_maxwells_equations_with_edges():
    """Two rows, TE: a thin element misses 6.3 and 6.1 % of the orders, one with edges 1.2 and 1.4 %."""
    index = refractive_index("fused_silica", RED)
    for seed in (1, 5):
        row, lens = Row(seed, 2, 1, "y"), camera(RED, "y")
        kept = int(np.ceil(1.3 * PERIOD * CELL * index / RED))
        solved = orders_of(row_slabs(row.height_m(), FINE, index), RED, index, "TE", kept)
        first = solved.at(int(ORDERS[0]))
        rigorous = solved.transmitted[first : first + len(ORDERS)] * (1 + index) ** 2 / (4 * index)
        with_walls, thin = (off(orders_found(row, each), rigorous) for each in (lens, replace(lens, light="scalar")))
        assert with_walls < 0.3 * thin
        assert with_walls < 0.018


def level_map() -> np.ndarray:
    return np.random.default_rng(2).integers(0, 16, (64, 64)).astype(np.uint8)


def small(**given: object) -> Camera:
    colours = (Colour("red", (RED,), (1.0,)), Colour("blue", (BLUE,), (1.0,)))
    one = Camera(Grid((64, 64), CELL), 64 * CELL, "fused_silica", colours, 2e-3, CELL, 200, light="edges")
    return replace(one, **given)  # type: ignore[arg-type]


@pytest.mark.slow
def test_without_errors_it_is_the_drawn_doe_with_edges_bit_for_bit():
    lens, depths = small(), (5e-3, np.inf)
    made = as_fabricated(level_map(), lens, Process(LEVELS), Variation(), depths_m=depths)
    drawn = with_edges(height_of(level_map(), LEVELS), lens, depths_m=depths)
    np.testing.assert_array_equal(psf(made, depths=depths).energy, psf(drawn, depths=depths).energy)
    np.testing.assert_array_equal(zeroth_order(made), zeroth_order(drawn))


def test_as_drawn_at_another_wavelength_and_on_whole_cells():
    """As `lab.predictions` asks for a design wavelength, and trainings for one grid."""
    level = level_map()[:24, :24]
    lens = small(grid=Grid((24, 24), CELL), aperture=24 * CELL, focal_length_m=0.8e-3)
    made = as_fabricated(level, lens, Process(LEVELS), Variation(), (GREEN,))
    drawn = with_edges(height_of(level, LEVELS), lens, wavelengths_m=(GREEN,))
    assert made.wavelengths_m == (GREEN,)
    np.testing.assert_array_equal(made.transmission, drawn.coverage * drawn.transmission)
    assert made.transmission.shape[1:] == (48, 48)  # light to the window's edge is too oblique for whole cells
    whole = as_fabricated(level, lens, Process(LEVELS), Variation(), whole_cells=True)
    assert whole.transmission.shape[1:] == (24, 24)


def test_a_camera_of_another_polarisation_is_refused():
    level, lens = level_map()[:24, :24], small(grid=Grid((24, 24), CELL), aperture=24 * CELL, polarisation="x")
    made = as_fabricated(level, lens, Process(LEVELS), Variation())
    with pytest.raises(ValueError, match="the polarisation that the walls are lit in, x, but got y"):
        psf(made, replace(lens, polarisation="y"))


@pytest.mark.slow
@pytest.mark.parametrize("radius_m", [0.0, 49e-3])
def test_walls_much_higher_than_drawn(radius_m: float):
    """Up to 1.6 times as deep, by errors of depth and evenness: a DOE drawn with such levels has the same light."""
    scale, bowl = 0.24, 0.3
    lens = small(aperture=1.6 * 64 * CELL, colours=(Colour("blue", (BLUE,), (1.0,)),))
    level = np.pad(level_map()[8:-8, 8:-8], 8, constant_values=15)
    process = replace(Process(LEVELS), die_m=(0.0, radius_m))
    made = as_fabricated(level, lens, process, Variation(common_depth_scale=scale, radial_nonuniformity=bowl))
    deeper = (1 + scale) * (1 + bowl * (radius_m / process.wafer_radius_m) ** 2)
    # Etched from the same face, so that the deepest level lies lower.
    height = TOP + deeper * (height_of(level, LEVELS) - TOP)
    drawn = with_edges(height, lens)
    found, expected = np.asarray(psf(made).energy), np.asarray(psf(drawn).energy)
    # 1e-4 here, and 0.46 where series are taken beyond their tables.
    assert off(found, expected) < 5e-4


@pytest.mark.slow
def test_errors_that_vanish_lead_to_the_drawn_doe_with_edges():
    """Another sum than that of heights: lines keep second moments and a series of their widths, good to 0.2 nm."""
    lens = small(aperture=1.6 * 64 * CELL)  # no rim, whose cells have moments only where walls move
    level = np.pad(level_map()[8:-8, 8:-8], 8, constant_values=15)  # and no walls at the border
    drawn = as_fabricated(level, lens, Process(LEVELS), Variation())
    made = as_fabricated(level, lens, Process(LEVELS), Variation(common_depth_scale=1e-7))
    thin = as_fabricated(level, replace(lens, light="scalar"), Process(LEVELS), Variation())
    energies = [np.asarray(psf(doe).energy) for doe in (made, drawn, thin)]
    assert off(energies[0], energies[1]) < 0.01
    assert off(energies[2], energies[1]) > 0.05
    np.testing.assert_allclose(zeroth_order(made), zeroth_order(drawn), atol=2e-4)


@pytest.mark.study
def test_gradients_go_through_the_light_of_walls():
    lens, process = small(grid=Grid((32, 32), CELL), aperture=32 * CELL, window=64), Process(LEVELS)

    def spot(value: Any) -> Any:
        errors = Variation(common_depth_scale=value, overlay_x_m=(0.0, 0.3e-6, -0.2e-6 + 1e-5 * value, 0.1e-6))
        image = psf(as_fabricated(level_map()[:32, :32], lens, process, errors)).energy[:, 0]
        return image[..., 20:44, 20:44].sum()

    slope = jax.grad(spot)(0.01)
    # Single precision of a sum over a thousand cells limits the difference to a percent.
    assert float(slope) == pytest.approx((float(spot(0.012)) - float(spot(0.008))) / 0.004, rel=0.03)
