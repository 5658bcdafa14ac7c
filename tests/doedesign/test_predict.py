"""Numbers of a plate, against the metrics of its PSFs and against what a known error must do to them."""

import dataclasses

import numpy as np
import pytest

from doedesign.design.design import Design
from doedesign.design.metrics import design_metrics
from doedesign.prediction import Prediction, plate_rows, predict
from fab.errors import InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels, height_of
from fab.process import Process, Variation
from sim.camera import Camera, Colour
from sim.metrics import energy_budget, energy_within, mean_wavelength_m, ring_to_disc, spot_radius_m, zeroth_order
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.surface import as_fabricated
from tests.doedesign.calibration_fakes import plate_drawn, usual_process

PITCH_M = 1.85e-6
CELLS = 64
LEVELS = Levels(16, 75e-9)
PROCESS = Process(LEVELS)
COLOURS = (Colour("red", (640e-9,), (1.0,)), Colour("green", (530e-9, 550e-9), (0.3, 0.7)))
CAMERA = Camera(Grid((CELLS, CELLS), PITCH_M), CELLS * PITCH_M, "fused_silica", COLOURS, 1e-3, 3.7e-6, 48)
NEAR_M, FAR_M = (6e-3,), (5.0, np.inf)


@pytest.fixture(scope="module")
def design() -> Design:
    """A ring that keeps some light on the axis."""
    y, x = np.indices((CELLS, CELLS)) - (CELLS - 1) / 2
    level = (np.mod(np.hypot(y, x) / 8, 1) * 13).astype(np.uint8)
    level_map = LevelMap(level, LEVELS, CAMERA.grid, CAMERA.aperture_m, "ring")
    return Design(level_map, CAMERA, NEAR_M, FAR_M)


@pytest.fixture(scope="module")
def nominal(design: Design) -> Prediction:
    return predict(design, PROCESS, Variation())


def test_there_is_a_row_for_every_depth_and_colour_near_depths_first(nominal: Prediction):
    assert [(row["depth_m"], row["colour"]) for row in nominal.rows] == [
        (depth, colour) for depth in (6e-3, 5.0, None) for colour in ("red", "green")
    ]
    for row in nominal.rows:
        # A near source is judged by its ring, a far one by its spot.
        assert ("ring_to_disc" in row) == (row["depth_m"] in NEAR_M)
        assert ("far_spot" in row) == (row["depth_m"] not in NEAR_M)
        assert all(isinstance(v, float) for k, v in row.items() if k not in ("colour", "depth_m"))


def test_the_bank_of_a_plate_without_errors_is_that_of_its_height_map(design: Design, nominal: Prediction):
    bank = psf(height_of(design.level_map.level, LEVELS), CAMERA, design.depths_m)
    np.testing.assert_allclose(nominal.bank.energy, bank.energy, rtol=0, atol=1e-6 * bank.energy.max())
    assert (nominal.bank.depths_m, nominal.bank.colours) == (bank.depths_m, bank.colours)
    surface = as_fabricated(design.level_map.level, CAMERA, PROCESS, Variation())
    np.testing.assert_array_equal(np.asarray(nominal.surface.transmission), np.asarray(surface.transmission))


def test_rows_are_the_metrics_of_the_plates_psfs(design: Design, nominal: Prediction):
    doe = HeightOptic.of(CAMERA, height_of(design.level_map.level, LEVELS))
    orders = dict(zip(doe.wavelengths_m, zeroth_order(doe), strict=True))
    for row in nominal.rows:
        c = [colour.name for colour in COLOURS].index(row["colour"])
        colour = COLOURS[c]
        depth = np.inf if row["depth_m"] is None else row["depth_m"]
        psf = nominal.bank.energy[c, design.depths_m.index(depth)]
        budget = energy_budget(doe, psf, depth, colour)
        weighted = list(zip(colour.wavelengths_m, colour.weights, strict=True))
        wanted = sum(weight * orders[line] for line, weight in weighted)
        assert row["zeroth_order"] == pytest.approx(wanted, rel=1e-4)
        assert row["strehl"] == pytest.approx(1.0, abs=1e-5)  # the sine of the fields is good to 4e-6
        assert row["throughput"] == pytest.approx(budget.far_spot + budget.window_beside_spot, abs=1e-6)
        assert row["outside_window"] == pytest.approx(budget.uncollected + budget.higher_orders, abs=1e-4)
        assert row["chrome"] == pytest.approx(0.0, abs=1e-4)
        assert row["throughput"] + row["outside_window"] + budget.reflected == pytest.approx(1.0, abs=1e-4)
        if depth in NEAR_M:
            assert row["ring_to_disc"] == ring_to_disc(psf, CAMERA, depth).ratio
        else:
            radius = spot_radius_m(CAMERA, mean_wavelength_m(colour))
            assert row["far_spot"] == energy_within(psf, CAMERA.pixel_m, radius)


@pytest.mark.slow
def test_a_deeper_etch_shows_in_every_number_it_should(design: Design, nominal: Prediction):
    """All etches 8 % too deep: the overlap with the design falls as the square of the rms phase."""
    deep = predict(design, PROCESS, Variation(common_depth_scale=0.08))
    open_ = np.asarray(nominal.surface.coverage, float)
    lost = (15 - design.level_map.level) * 75e-9 * 0.08
    for row in deep.rows[:2]:
        colour = next(colour for colour in COLOURS if colour.name == row["colour"])
        wanted = 0.0
        for line, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
            wrong = np.exp(-2j * np.pi * CAMERA.waves_per_metre(line) * lost)
            wanted += weight * abs((wrong * open_).sum() / open_.sum()) ** 2
        assert wanted < 0.99
        assert row["strehl"] == pytest.approx(wanted, abs=2e-5)  # twice the sine's 4e-6 and float32
    for row, other in zip(deep.rows, nominal.rows, strict=True):
        passed = other["throughput"] + other["outside_window"]
        # Light goes elsewhere and is not lost.
        assert row["throughput"] + row["outside_window"] == pytest.approx(passed, abs=1e-6)


@pytest.mark.slow
def test_chrome_out_of_place_is_booked_as_such(design: Design, nominal: Prediction):
    wide = 0.02 * CAMERA.aperture_m
    narrow = predict(design, PROCESS, Variation(chrome_diameter_m=-wide))
    for row, other in zip(narrow.rows, nominal.rows, strict=True):
        passed = other["throughput"] + other["outside_window"]
        # Circles of 64 cells with straight rims: 1e-4 of their area.
        assert row["chrome"] == pytest.approx(passed * (0.98**2 - 1), abs=2e-4)
        assert row["throughput"] + row["outside_window"] == pytest.approx(passed + row["chrome"], abs=2e-4)
        assert row["throughput"] < other["throughput"]


def test_strehl_does_not_fall_with_a_plate_that_only_leaks_less_light_through_its_chrome(design: Design):
    """The overlap is one over the open cells, so a displaced opening before a perfect plate leaves it at 1."""
    moved = as_fabricated(design.level_map.level, CAMERA, PROCESS, Variation(chrome_x_m=2e-6))
    bank = psf(moved, depths=(np.inf,))
    rows = plate_rows(design, moved, bank)
    assert [row["strehl"] for row in rows] == pytest.approx([1.0, 1.0], abs=2e-5)


def test_predictions_repeat_to_the_last_bit(design: Design):
    short = dataclasses.replace(design, near_m=(), far_m=(np.inf,))
    rough = Variation(roughness_m=4e-9, correlation_m=2e-6, seed=9, depth_scale=(0.01, 0.0, -0.02, 0.01))
    one, two = (predict(short, PROCESS, rough) for _ in range(2))
    np.testing.assert_array_equal(one.bank.energy, two.bank.energy)
    assert one.rows == two.rows


def test_another_design_is_not_compared_with_the_one_before(design: Design, nominal: Prediction):
    """The plate as drawn is kept between predictions; a new level map or camera must not meet the old one."""
    short = dataclasses.replace(design, near_m=(), far_m=(np.inf,))
    other = dataclasses.replace(
        short, level_map=design.level_map.with_level(np.roll(design.level_map.level, 3, axis=0))
    )
    assert predict(other, PROCESS, Variation()).rows[0]["strehl"] == pytest.approx(1.0, abs=1e-5)
    blue = dataclasses.replace(CAMERA, colours=(Colour("blue", (450e-9,), (1.0,)),))
    rows = predict(dataclasses.replace(other, camera=blue), PROCESS, Variation()).rows
    assert rows[0]["strehl"] == pytest.approx(1.0, abs=1e-5)
    assert predict(short, PROCESS, Variation()).rows == nominal.rows[-2:]


def test_digests_tell_designs_apart(design: Design):
    level_map = design.level_map
    assert level_map.digest == dataclasses.replace(level_map, name="copy").digest
    assert level_map.digest != level_map.with_level(np.roll(level_map.level, 1, axis=0)).digest
    assert design.depths_m == (*NEAR_M, *FAR_M)


def test_errors_beyond_the_model_are_refused(design: Design):
    with pytest.raises(InputError, match="half a cell"):
        predict(design, PROCESS, Variation(common_cd_bias_m=PITCH_M))


def test_errors_of_one_doe_come_from_one_source():
    design = plate_drawn(32, 4, window=16)
    process = usual_process(design)
    given = Variation(common_depth_scale=0.01)
    assert design.plate_errors(process, given) == (given, "given errors")
    expected, words = design.plate_errors(process)
    assert expected == process.expected()
    assert words == "every error of the process usual at its mean"
    drawn, words = design.plate_errors(process, seed=3)
    assert words == "draw normal/0 of seed 3 of the process usual"
    assert drawn != expected
    assert drawn != design.plate_errors(process, seed=4)[0]
    assert drawn == design.plate_errors(process, seed=3)[0]
    with pytest.raises(InputError, match="seed: a plate has one source of errors"):
        design.plate_errors(process, given, seed=3)


def test_a_row_of_a_design_says_where_its_light_goes():
    design = plate_drawn(64, 4, window=24)
    optic = HeightOptic.of(design.camera, design.height_m)
    depths = (6e-3, np.inf)
    lens = HeightOptic.of(design.camera, np.zeros((64, 64)))
    rows = design_metrics(optic, psf(optic, depths=depths), (6e-3,), psf(lens, depths=depths))
    assert len(rows) == 2
    for row in rows:
        assert sum(row["budget"].values()) == pytest.approx(1)
        shares = row["budget"]
        assert shares["far_spot"] + shares["window_beside_spot"] == pytest.approx(row["throughput"], rel=1e-5)
