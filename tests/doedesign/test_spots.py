"""Spots and orders: sums over cells in closed form, the search against known ceilings, and a judge of its own."""

import tracemalloc
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from doedesign.spec.targets.arrangements import grid_orders, hexagonal_places, ring_places
from doedesign.spec.targets.spots import open_periods
from doedesign.spots import search
from doedesign.spots.exchange import _merit, cooled, exchange, offered, offers
from doedesign.spots.orders import ceiling_of, order_table
from doedesign.spots.problem import SpotProblem
from doedesign.spots.search import search_phases, search_points
from doedesign.spots.spots import Spots, shares_of
from doedesign.spots.superposition import Staircase, WaveSet, spot_light
from fab.aperture import MaskAperture, RectangularAperture
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.illumination import EvenBeam
from sim.material import refractive_index
from sim.optic import HeightOptic
from sim.propagation.directions import DirectionSum, efficiencies

PITCH_M, GREEN_M = 2e-6, 532e-9


def orders_of(count: tuple[int, int], cells: int) -> Spots:
    """Orders of a unit cell of so many cells."""
    orders, step = grid_orders(count), 1 / (cells * PITCH_M)
    return Spots(orders * step, shares_of((), len(orders)), orders, (step, step))


def even(count: int) -> Staircase:
    """Levels in equal parts of a turn."""
    return Staircase.of(2 * np.pi * np.arange(count) / count)


def problem(count: tuple[int, int], cells: int, levels: int) -> SpotProblem:
    shape = (cells if count[1] > 1 else 1, cells if count[0] > 1 else 1)
    return SpotProblem.on(Grid(shape, PITCH_M), np.ones(shape, np.float32), orders_of(count, cells), even(levels))


# --- sums over cells --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("levels", "percent"), [(2, 40.5), (3, 68.4), (4, 81.1), (5, 87.5), (6, 91.2), (8, 95.0), (16, 98.7)]
)
def test_a_blazed_grating_has_its_efficiency_in_the_first_order(levels: int, percent: float):
    """sinc²(1/L), where a level is as wide as a cell: the cell's sinc is then all that the levels cost."""
    field = np.tile(even(levels).light, (1, 8))
    step = 1 / (levels * PITCH_M)
    found = efficiencies(field, np.ones(field.shape), Grid(field.shape, PITCH_M), step * np.array([[0, 1], [0, 0]]))
    assert found[0] == pytest.approx(np.sinc(1 / levels) ** 2, abs=1e-6)  # single precision
    assert 100 * found[0] == pytest.approx(percent, abs=0.06)
    assert found[1] == pytest.approx(0, abs=1e-10)


def test_directions_have_the_projects_signs():
    """Glass that thickens toward +y sends light to +y."""
    wedge = np.exp(2j * np.pi * np.arange(16) / 4)[:, None] * np.ones((16, 16))
    up = 1 / (4 * PITCH_M)
    found = efficiencies(wedge, np.ones((16, 16)), Grid((16, 16), PITCH_M), np.array([[up, 0], [-up, 0], [0, up]]))
    assert found[0] == pytest.approx(np.sinc(0.25) ** 2, abs=1e-5)
    assert found[1:] == pytest.approx(0, abs=1e-9)


def test_superposition_is_the_adjoint_of_the_sum():
    rng, grid = np.random.default_rng(1), Grid((12, 20), PITCH_M)
    sums = DirectionSum(grid, rng.normal(0, 5e4, (7, 2)))
    field = rng.normal(size=(12, 20)) + 1j * rng.normal(size=(12, 20))
    waves = rng.normal(size=7) + 1j * rng.normal(size=7)
    assert np.vdot(waves, sums.amplitudes(field)) == pytest.approx(np.vdot(sums.superposition(waves), field), rel=1e-5)


@pytest.mark.parametrize("phases", [[0.0, 1.5, 3.1, 4.4], [5.0, 0.2, 2.9], [7.0, -1.0], [0.0]])
def test_every_phase_gets_the_nearest_level(phases: list[float]):
    field = np.exp(1j * np.linspace(-9, 9, 801))
    staircase = Staircase.of(np.array(phases))
    away = np.abs(field[:, None] - staircase.light[None, :])
    chosen = away[np.arange(801), staircase.level(field)]
    np.testing.assert_allclose(chosen, away.min(axis=1), atol=1e-6)


# --- where spots lie --------------------------------------------------------------------------------------------------


def test_orders_of_odd_and_even_counts():
    np.testing.assert_array_equal(grid_orders((3, 1)), [[0, -1], [0, 0], [0, 1]])
    np.testing.assert_array_equal(grid_orders((2, 2)), [[-1, -1], [-1, 1], [1, -1], [1, 1]])


def test_hexagons_and_rings():
    places = hexagonal_places(2, 3.0)
    assert len(places) == 19
    between = np.hypot(*(places[:, None] - places[None]).T)
    assert np.sort(between[between > 0])[0] == pytest.approx(3.0)
    assert sum(np.isclose(between, 3.0).sum(axis=0) == 6) == 7  # all but the outer ring has six neighbours
    ring = ring_places(5, 2.0)
    assert np.hypot(*ring.T) == pytest.approx(2.0)
    assert ring[0] == pytest.approx([0.0, 2.0])


# --- the search -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "known"),
    # Romero and Dickey's optima of any phase; 8 / pi² for two beams.
    [((2, 1), 8 / np.pi**2), ((3, 1), 0.9256), ((5, 1), 0.9212), ((7, 1), 0.9684)],
)
def test_the_search_finds_the_known_optimum(count: tuple[int, int], known: float):
    spots = orders_of(count, 64)
    points = search_points(spots, 0, (1.0, 1.0))
    found = search_phases(spots, points, starts=40, seed=0, uniformity=1.0)
    # Some two dozen points stand for a period: 0.6 % for two beams, whose phase jumps.
    assert found.efficiency == pytest.approx(known, abs=6e-3)
    assert ceiling_of(count, 10**5).efficiency == pytest.approx(known, abs=5e-5)  # four digits


def test_the_search_goes_axis_by_axis_where_orders_are_many(monkeypatch: pytest.MonkeyPatch):
    """The same sums as by one matrix of all spots and points; 64 x 64 orders, for which that has 33 GB, find light."""
    spots = orders_of((6, 4), 64)
    points = search_points(spots, 0, (1.0, 1.0))
    found = []
    for dense in (2**20, 0):
        monkeypatch.setattr(search, "_DENSE", dense)
        monkeypatch.setattr(search, "_STEPS", 3)
        found.append(search_phases(spots, points, starts=3, seed=0, uniformity=1.0))
    # Single precision, and few steps: more would only widen what rounding leaves.
    assert found[1].efficiency == pytest.approx(found[0].efficiency, abs=1e-6)
    for one, other in zip(found[0].waves, found[1].waves, strict=True):
        np.testing.assert_allclose(one.amplitudes, other.amplitudes, atol=1e-5)
    monkeypatch.setattr(search, "_STEPS", 1)
    spots = orders_of((64, 64), 1024)
    tracemalloc.start()
    found = search_phases(spots, search_points(spots, 0, (1.0, 1.0)), starts=2, seed=0, uniformity=1.0)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2**28
    assert found.efficiency > 0.7  # random phases alone keep pi / 4


def test_a_step_evens_out_what_levels_spoil():
    """Four levels of 5 x 5 orders: beams that begin off by 33 % end off by 3.3 %, with as much light."""
    task = problem((5, 5), 40, 4)
    spots = task.spots
    waves = search_phases(spots, search_points(spots, 0, (1, 1)), starts=20, seed=0, uniformity=1.0).waves[0]
    lights = []
    for _ in range(40):
        waves, light = task.step(waves)
        lights.append(light)
    best = max(lights, key=lambda light: light.merit(1.0))
    assert best.uniformity_error < lights[0].uniformity_error / 7
    assert best.efficiency > lights[0].efficiency


def test_exchange_finds_dammanns_grating_and_never_spoils():
    """Three equal beams of two levels: 66.4 % (H. Dammann and E. Klotz, Optica Acta 24, 505, 1977)."""
    task = problem((3, 1), 64, 2)

    def start(seed: int) -> np.ndarray:
        return np.random.default_rng(seed).integers(0, 2, (1, 64)).astype(np.uint8)

    found = [exchange(task, start(k), sweeps=1000, seed=k, uniformity=0.5, heat=0.05) for k in range(10)]
    lights = [task.light(level) for level in found]
    best = max(lights, key=lambda light: light.merit(0.5))
    assert best.efficiency == pytest.approx(0.664, abs=0.01)  # edges lie on 64 places
    assert best.uniformity_error < 0.03
    np.testing.assert_array_equal(exchange(task, start(3), sweeps=1000, seed=3, uniformity=0.5, heat=0.05), found[3])
    for level, light in zip(found[:3], lights, strict=False):
        again = exchange(task, level, sweeps=20, seed=9, uniformity=0.0, heat=0.05)
        assert task.light(again).efficiency >= light.efficiency * (1 - 1e-6)


def test_offers_are_of_levels_of_neighbours_or_of_others():
    level = np.random.default_rng(5).integers(0, 7, (3, 4)).astype(np.uint8)
    neighbours = [np.roll(level, step, axis) for axis in (0, 1) for step in (-1, 1)]  # below, above, behind, before
    for y, x in np.ndindex(level.shape):
        assert [offered(level, y, x, 0, side, 7) for side in range(4)] == [each[y, x] for each in neighbours]
        assert [offered(level, y, x, k, 0, 7) for k in range(1, 7)] == [(level[y, x] + k) % 7 for k in range(1, 7)]
    order, chance, others, sides = offers(np.random.default_rng(6), 40000, 7, 0.3)
    assert np.array_equal(np.sort(order), np.arange(40000))
    assert 0 <= chance.min() < 0.01 < 0.99 < chance.max() < 1
    # Half of the others are the next level up or down, the rest any: of 40 000, within five standard deviations.
    wanted = np.array([0.7, *(0.3 * (0.25 * np.isin(k, (1, 6)) + 0.5 / 6) for k in range(1, 7))])
    assert np.bincount(others, minlength=7) / 40000 == pytest.approx(wanted, abs=5 * (0.3 * 0.7 / 40000) ** 0.5)
    assert np.bincount(sides) / 40000 == pytest.approx(0.25, abs=5 * (0.25 * 0.75 / 40000) ** 0.5)
    assert set(offers(np.random.default_rng(6), 1000, 2, 0.3).others) == {0, 1}
    assert [cooled(2.0, sweep, 10) for sweep in (0, 7, 9)] == pytest.approx([2.0, 0.0, 0.0])
    assert cooled(2.0, 3, 10) == pytest.approx(2.0 * (4 / 7) ** 2)


def test_the_merit_of_an_exchange_is_that_of_its_formula():
    """Four spots of unequal shares: their sum, or the light in a wave, less what fourth powers of deviations say."""
    rng, shares = np.random.default_rng(7), shares_of((1, 2, 3, 4), 4)
    light = 0.4 * (rng.normal(size=4) + 1j * rng.normal(size=4))
    power = np.abs(light) ** 2
    uneven = 1.4 * np.mean((power / shares / np.mean(power / shares) - 1) ** 4) ** 0.25
    none, wave = np.zeros(0, complex), np.sqrt(shares) * np.exp(1j * rng.uniform(0, 6, 4))
    assert _merit(light, shares, 1, none, 0.6) == pytest.approx(power.sum() - 0.6 * uneven, rel=1e-12)
    in_wave = abs(np.vdot(wave, light)) ** 2
    assert _merit(light, shares, 1, wave.conj(), 0.6) == pytest.approx(in_wave - 0.6 * uneven, rel=1e-12)
    assert np.isfinite(_merit(0 * light, shares, 1, none, 0.6))


def test_an_exchange_without_heat_takes_what_is_better_and_nothing_else():
    task = problem((3, 1), 32, 4)
    begun = np.random.default_rng(8).integers(0, 4, (1, 32)).astype(np.uint8)
    merits, none = [], np.zeros(0, complex)
    for sweeps in range(6):
        level = exchange(task, begun, sweeps=sweeps, seed=1, uniformity=0.5, heat=0.0)
        merits.append(_merit(task.amplitudes(level).astype(complex), task.spots.shares, 1, none, 0.5))
    assert (np.diff(merits) > -1e-6).all()  # single precision
    assert merits[1] > merits[0] + 0.1
    assert merits[-1] > merits[1]


@pytest.mark.parametrize(("count", "shape"), [((3, 1), (1, 16)), ((1, 3), (16, 1)), ((3, 3), (16, 16))])
def test_a_coarser_cell_has_the_same_orders(count: tuple[int, int], shape: tuple[int, int]):
    """Half as many cells, twice as wide, along every axis that has several: levels that both have are the same DOE."""
    fine = problem(count, 16, 4)
    coarse = fine.coarser()
    assert coarse.grid.shape == tuple(n // 2 if n > 1 else 1 for n in shape)
    assert coarse.grid.pitch_m == 2 * PITCH_M
    level = np.random.default_rng(4).integers(0, 4, coarse.grid.shape).astype(np.uint8)
    drawn = np.kron(level, np.ones([2 if n > 1 else 1 for n in shape], np.uint8))
    np.testing.assert_allclose(coarse.amplitudes(level), fine.amplitudes(drawn), rtol=0, atol=1e-6)  # single precision


def test_spots_without_light_are_not_uneven():
    assert spot_light(np.zeros(3), np.full(3, 1 / 3)) == (0.0, 0.0)
    assert spot_light(np.array([0.1, 0.3]), np.array([0.25, 0.75])) == pytest.approx((0.4, 0.0))
    assert spot_light(np.array([0.1, 0.3]), np.array([0.5, 0.5])) == pytest.approx((0.4, 0.5))
    assert spot_light(np.array([0.1, 0.3]), np.array([0.5, 0.5])).merit(0.6) == pytest.approx(0.1)


def test_weights_are_obeyed():
    spots = Spots(orders_of((3, 1), 64).waves_per_m, shares_of((1, 2, 1), 3))
    task = SpotProblem.on(Grid((1, 64), PITCH_M), np.ones((1, 64), np.float32), spots, even(64))
    waves = WaveSet(np.sqrt(spots.shares), np.array([0.0, np.pi / 2, 0.0]))
    for _ in range(60):
        waves, _ = task.step(waves)
    found = np.abs(task.amplitudes(task.level(waves))) ** 2
    assert found / found.sum() == pytest.approx(spots.shares, abs=0.01)  # 64 cells of 64 levels


# --- the table --------------------------------------------------------------------------------------------------------


def camera(cells: int) -> Camera:
    colour = Colour("green", (GREEN_M,), (1.0,))
    grid = Grid((cells, cells), PITCH_M)
    return Camera(grid, cells * PITCH_M, "fused_silica", (colour,), 20e-3, 3.45e-6, 64)


def judged(height_m: np.ndarray, optics: Camera, orders: np.ndarray, period: int) -> np.ndarray:
    """Orders by a transform of a raster of 8 x 8 samples per cell, in double precision: another way than the table's.

    The samples' own sinc is put in by hand.
    """
    rate, fine = optics.waves_per_metre(GREEN_M), 8
    cell = np.kron(np.exp(2j * np.pi * rate * height_m[:period, :period]), np.ones((fine, fine)))
    waves = np.fft.fft2(cell, norm="forward")
    y, x = orders.T
    sinc = np.sinc(y / (period * fine)) * np.sinc(x / (period * fine))
    return np.abs(waves[y, x] * sinc) ** 2


def test_the_table_of_a_repeated_cell_is_that_of_a_transform():
    period, count = 16, (5, 3)
    height = np.tile(np.random.default_rng(3).uniform(0, 1.2e-6, (period, period)), (5, 5))
    optics = camera(5 * period)
    spots = orders_of(count, period)
    table = order_table(HeightOptic.of(optics, height), spots, period_m=period * PITCH_M, levels=8, count=count)
    assert spots.orders is not None
    wanted = judged(height, optics, spots.orders, period)
    np.testing.assert_allclose(table.efficiency, wanted, rtol=1e-4)  # single precision of heights and sums
    assert table.zeroth_order == pytest.approx(judged(height, optics, np.array([[0, 0]]), period)[0], rel=1e-4)
    every = [(y, x) for y in range(-4, 5) for x in range(-5, 6) if abs(y) > 1 or abs(x) > 2]
    assert table.strongest_stray == pytest.approx(judged(height, optics, np.array(every), period).max(), rel=1e-4)
    assert table.total == pytest.approx(wanted.sum(), rel=1e-4)
    assert table.uniformity_error == pytest.approx(spot_light(wanted, spots.shares).uniformity_error, rel=1e-3)
    assert table.rmse == pytest.approx(np.std(wanted) / np.mean(wanted), rel=1e-3)
    assert table.signal_to_noise == pytest.approx(wanted.mean() / (table.strongest_stray or 1), rel=1e-3)
    assert table.fresnel == pytest.approx(optics.transmission(GREEN_M))


@pytest.mark.parametrize("beam", [EvenBeam(angle_rad=(0.0, 0.35)), EvenBeam(tilt_rad=(-0.2, 0.1))])
def test_the_table_of_a_beam_aslant_has_the_delay_of_oblique_glass(beam: EvenBeam):
    """The path in glass less that in air, for the sine of the beam: 4 % more than along the axis at 20 degrees."""
    period, count = 16, (3, 3)
    height = np.tile(np.random.default_rng(5).uniform(0, 1.2e-6, (period, period)), (4, 4))
    optics = replace(camera(4 * period), beam=beam)
    spots = orders_of(count, period)
    table = order_table(HeightOptic.of(optics, height), spots, period_m=period * PITCH_M, levels=8, count=count)
    tangent_square = np.sum(np.tan([*beam.angle_rad, *beam.tilt_rad]) ** 2)  # one of the two is zero
    square, index = tangent_square / (1 + tangent_square), refractive_index("fused_silica", GREEN_M)
    rate = (np.sqrt(index**2 - square) - np.sqrt(1 - square)) / GREEN_M
    assert spots.orders is not None
    wanted = judged(height * rate * GREEN_M / (index - 1), camera(4 * period), spots.orders, period)
    np.testing.assert_allclose(table.efficiency, wanted, rtol=1e-4, atol=1e-7)  # single precision of heights and sums


def test_places_and_text_of_a_table():
    spots = orders_of((3, 1), 16)
    table = order_table(HeightOptic.of(camera(64)), spots, period_m=16 * PITCH_M, levels=2, count=(3, 1))
    # A flat plate sends all light straight on.
    assert table.efficiency == pytest.approx([0, 1, 0], abs=1e-6)
    assert table.places_m[:, 1] == pytest.approx(np.array([-1, 0, 1]) * GREEN_M * 20e-3 / (16 * PITCH_M))
    lines = table.to_csv().splitlines()
    assert lines[0] == "order_x,order_y,x_mm,y_mm,efficiency,over_wanted"
    assert lines[2].startswith("0,0,0,0,1")
    assert "none known" in table.describe()
    assert "0th order 100.000 % (one of the spots)" in table.describe()


def test_an_even_grid_has_no_spot_in_the_0th_order():
    height = np.random.default_rng(1).uniform(0, 1e-6, (64, 64))
    for count, wanted in (((2, 2), False), ((3, 1), True), ((2, 3), False)):
        table = order_table(HeightOptic.of(camera(64), height), orders_of(count, 16), period_m=16 * PITCH_M)
        assert table.zeroth_order_wanted == wanted == ("one of the spots" in table.describe())
        assert table.summary()["zeroth_order_wanted"] is wanted


def test_ceilings_name_their_source():
    assert ceiling_of((7, 1), 16).efficiency == pytest.approx(0.9684 * np.sinc(1 / 16) ** 2)
    assert "Romero" in ceiling_of((1, 7), 16).source
    for other in (
        ceiling_of((8, 3), 16),
        ceiling_of(None, 16),
        ceiling_of((7, 1), 2),
        ceiling_of((7, 1), 8, equal=False),
    ):
        assert (other.efficiency, other.source) == (None, "none known")


def test_ceilings_are_known_of_rows_and_squares():
    """The phases of two rows, one along each axis, add up to a square with the product of what each has."""
    rows, squares = [(n, 1) for n in (2, 3, 5, 6, 7, 8, 9)], [(n, n) for n in range(2, 10)]
    known = {(x, y): ceiling_of((x, y), 10**5).efficiency for x in range(1, 11) for y in range(1, x + 1)}
    assert [count for count, efficiency in known.items() if efficiency is not None] == sorted(rows + squares)
    for count, _ in rows:
        row, square = known[count, 1], known[count, count]
        assert row is not None
        assert square is not None
        assert row**2 - 1e-4 <= square < 1  # four digits


def test_a_picture_of_a_table():
    table = order_table(
        HeightOptic.of(camera(64)), orders_of((3, 3), 16), period_m=16 * PITCH_M, levels=8, count=(3, 3)
    )
    bars = cast(Any, table.plot()).axes[0].containers[0]
    assert [bar.get_height() for bar in bars] == pytest.approx(100 * table.efficiency, abs=1e-4)


@pytest.mark.parametrize("shape", [(48, 48), (24, 48)])
def test_the_table_of_a_slit_looks_at_all_its_whole_periods(shape):
    slit = replace(camera(48), grid=Grid(shape, PITCH_M), aperture=RectangularAperture((24 * PITCH_M, 48 * PITCH_M)))
    height = np.tile(np.random.default_rng(6).uniform(0, 1e-6, (8, 8)), (6, 6))[: shape[0]]
    spots = orders_of((3, 3), 8)
    assert spots.orders is not None
    found = order_table(HeightOptic.of(slit, height), spots, period_m=8 * PITCH_M)
    np.testing.assert_allclose(found.efficiency, judged(height, slit, spots.orders, 8), rtol=1e-3)


def test_the_table_of_a_mask_looks_at_its_whole_periods_alone():
    """A diamond and a frame around a closed middle, both off the centre: orders are those of the cell alone."""
    y, x = np.arange(64)[:, None], np.arange(64)
    frame = np.maximum(abs(y - 34), abs(x - 30))
    height = np.tile(np.random.default_rng(8).uniform(0, 1e-6, (8, 8)), (8, 8))
    spots = orders_of((3, 3), 8)
    assert spots.orders is not None
    for open_ in (abs(y - 30) + abs(x - 34) < 28, (frame > 12) & (frame < 27)):
        masked = replace(camera(64), aperture=MaskAperture.of(open_, PITCH_M))
        found = order_table(HeightOptic.of(masked, height), spots, period_m=8 * PITCH_M)
        np.testing.assert_allclose(found.efficiency, judged(height, masked, spots.orders, 8), rtol=1e-3)  # as of a slit


def test_open_periods_begin_where_most_of_them_fit():
    cells = np.zeros((7, 9), bool)
    cells[1:5, 2:9] = True
    cells[6] = True
    wanted = np.zeros((7, 9), bool)
    wanted[1:5, 3:9] = True  # or from 2 to 8
    np.testing.assert_array_equal(open_periods(cells, (2, 3)), wanted)
    np.testing.assert_array_equal(open_periods(cells, (7, 9)), np.zeros((7, 9), bool))
    np.testing.assert_array_equal(open_periods(cells, (1, 1)), cells)
    for none in ((9, 3), (2, 20), (0, 3)):
        assert not open_periods(cells, none).any()
