"""What a run sheet foretells."""

import math
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from doedesign.build import with_edge_moves
from doedesign.design.design import Design
from doedesign.lab.predictions import grating_orders, predict_sheet, rank_importance
from doedesign.prediction import predict
from fab.aperture import MaskAperture
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.process import Normal, Process, Variation
from fab.units import NM, UM
from sim.camera import Camera, Colour
from sim.material import refractive_index
from tests.fab.sheets import spreads_of

LEVELS = Levels(16, 75 * NM)
CAMERA = Camera(
    Grid((64, 64), 1.85 * UM), 64 * 1.85 * UM, "fused_silica", (Colour("green", (550e-9,), (1.0,)),), 1e-3, 3.7 * UM, 48
)


@pytest.fixture(scope="module")
def design() -> Design:
    y, x = np.indices((64, 64)) - 31.5
    level = (np.mod(np.hypot(y, x) / 8, 1) * 16).astype(np.uint8)
    level_map = LevelMap(level, LEVELS, CAMERA.grid, CAMERA.aperture_m, "ring")
    return Design(level_map, CAMERA, (4e-3, 6e-3, 9e-3), (5.0, np.inf))


def test_gratings_are_the_sums_over_their_stripes():
    """Against the mean of exp(i phi) over the stripes themselves."""
    depths = np.array([75, 150, 300, 600]) * NM * (1 + np.array([0.02, -0.01, 0.03, 0.04]))
    for wavelength in (450e-9, 520e-9, 552e-9, 700e-9):
        wave = 2j * np.pi * (refractive_index("fused_silica", wavelength) - 1) / wavelength
        codes = np.arange(16)[:, None] >> np.arange(4) & 1
        blazed = abs(np.exp(wave * (codes @ depths)).mean()) ** 2
        binary = abs((1 + np.exp(wave * depths[3])) / 2) ** 2
        assert grating_orders(depths, "fused_silica", wavelength) == pytest.approx((binary, blazed), abs=1e-12)


def test_the_published_zeroth_orders_of_depth_errors():
    """16 levels, all depths off by a share at the design wavelength: 3.9e-4 at 2 %, 2.3e-3 at 5 %, 8.1e-3 at 10 %."""
    line = 552e-9
    exact = line / (refractive_index("fused_silica", line) - 1) / 16 * np.array([1, 2, 4, 8])
    for share, wanted in ((0.02, 3.9e-4), (0.05, 2.3e-3), (0.0645, 3.7e-3), (0.10, 8.1e-3)):
        # Two digits are given.
        assert grating_orders(exact * (1 + share), "fused_silica", line)[1] == pytest.approx(wanted, rel=0.03)


def test_no_other_etch_makes_up_for_a_wrong_depth():
    """The sheet says so: the correction that keeps the sum of depths doubles the loss of light, and leaks."""
    waves = np.array([1, 2, 4, 8]) / 16
    codes = np.arange(16)[:, None] >> np.arange(4) & 1
    miss = 0.03

    def light(errors: list[float]) -> tuple[float, float]:
        wrong = codes @ np.array(errors)
        meant = codes @ waves
        return (
            abs(np.exp(2j * np.pi * wrong).mean()) ** 2,
            abs(np.exp(2j * np.pi * (meant + wrong)).mean()) ** 2,
        )

    left, leaked = light([0, 0, miss, 0])
    corrected, leaking = light([0, 0, miss, -miss])
    assert left == pytest.approx(math.cos(math.pi * miss) ** 2)
    assert corrected == pytest.approx(left**2)
    assert leaked == pytest.approx(0, abs=1e-12)
    assert leaking > 1e-3


@pytest.mark.slow
def test_the_outlook_is_the_prediction_of_one_depth(design):
    spreads = {"common_depth_scale": Normal(0.03, 0.01), "overlay_x_m[3]": Normal(0.1 * UM, 0.3 * UM)}
    process = Process(LEVELS, spreads=spreads)
    predictions, draw = predict_sheet(design, process, 550e-9)
    picture = draw()
    assert [(seen.depth_m, seen.far_spot) for seen in predictions.drawn] == [(6e-3, None)]
    short = replace(design, near_m=(6e-3,), far_m=())
    # The plate as drawn is cut into the pieces of the other one, and added up again in single precision.
    for seen, plate, within in (
        (predictions.drawn, Variation(), 1e-4),
        (predictions.expected, process.expected(), 1e-12),
    ):
        for one, row in zip(seen, predict(short, process, plate).rows, strict=True):
            numbers = {key: value for key, value in one._asdict().items() if isinstance(value, float)}
            assert numbers == pytest.approx({key: row[key] for key in numbers}, rel=within)
            assert {"strehl", "zeroth_order", "throughput", "ring_to_disc"} < set(numbers)
    assert predictions.expected[0].strehl < 0.99
    # 16 x 75 nm of fused silica is one wave at 552 nm, and 1.0645 waves at 520 nm.
    assert predictions.full_wave_m == pytest.approx(552e-9, abs=0.5e-9)
    assert predictions.probe_waves == pytest.approx(1.0645, abs=1e-4)
    assert Image.open(BytesIO(picture)).format == "PNG"


def test_a_design_without_near_depths_is_foretold_for_its_farthest(design):
    far = predict_sheet(replace(design, near_m=()), Process(LEVELS), 550e-9).predictions
    assert [(seen.depth_m, seen.ring_to_disc) for seen in far.drawn] == [(None, None)]
    assert far.drawn == far.expected
    assert far.ranking == ()


def test_a_height_without_a_full_wave_is_said_so(design):
    flat = replace(design, level_map=replace(design.level_map, levels=Levels(16, 20 * NM)), near_m=())
    assert predict_sheet(flat, Process(flat.levels), 550e-9).predictions.full_wave_m is None


@pytest.mark.slow
def test_compensated_masks_bring_the_expected_plate_back(design):
    process = Process(LEVELS, spreads=spreads_of(LEVELS, common_cd_bias_m=(80 * NM, 0.0)))
    moved = with_edge_moves(process, (-80 * NM,) * 4)
    predictions = predict_sheet(design, process, 550e-9, edge_moves_m=(-80 * NM,) * 4).predictions
    assert moved.expected().common_cd_bias_m + moved.expected().cd_bias_m[0] == 0
    # Widened and narrowed by the same, the plate goes through the model of pieces, which rounds differently.
    for a, b in zip(predictions.drawn, predictions.expected, strict=True):
        assert b.strehl == pytest.approx(a.strehl, abs=1e-5)
    assert predict_sheet(design, process, 550e-9).predictions.expected[0].strehl < 0.99


@pytest.mark.slow
def test_errors_are_ranked_about_the_plate_that_should_come_out(design):
    """Depths that are commanded 10 % short, for the process etches 10 % too deep, rank as those of an ideal one."""
    short = Levels(LEVELS.count, LEVELS.step_m, tuple(depth / 1.1 for depth in LEVELS.depths_m))
    commanded = replace(design, level_map=replace(design.level_map, levels=short), aim=design.level_map)
    wide = {"cd_bias_m[3]": Normal(0.0, 0.1 * UM)}
    deep = Process(short, spreads={**wide, "common_depth_scale": Normal(0.1, 0.022)})
    ideal = Process(LEVELS, spreads={**wide, "common_depth_scale": Normal(0.0, 0.02)})
    found, wanted = rank_importance(commanded, deep, 550e-9), rank_importance(design, ideal, 550e-9)
    assert [one.measured for one in found] == [one.measured for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        assert one.strehl == pytest.approx(other.strehl, abs=0.01)  # 0.9 and 0.1 about the commanded plate


def test_what_is_closed_does_not_count(design):
    pattern = np.tile(np.random.default_rng(3).integers(0, 16, (8, 8)), (8, 8)).astype(np.uint8)

    def ranked(level: np.ndarray, plane: np.ndarray, *errors: str) -> list[tuple[float, ...]]:
        aperture = MaskAperture.of(plane, CAMERA.grid.pitch_m)
        level_map = LevelMap(level, LEVELS, CAMERA.grid, aperture, "holes")
        process = Process(LEVELS, spreads=dict(zip(errors, (Normal(0.0, 0.04), Normal(0.0, 0.1)), strict=True)))
        found = rank_importance(Design(level_map, replace(CAMERA, aperture=aperture), (), (np.inf,)), process, 550e-9)
        return [one[1:] for one in sorted(found)]

    # Depths leave walls where they are, so that whole periods of a pattern that are missing change nothing.
    holes = np.ones(CAMERA.grid.shape, bool)
    holes[16:32, 40:64] = False
    depths = "depth_scale[3]", "depth_scale[1]"
    wanted = ranked(pattern, np.ones_like(holes), *depths)
    np.testing.assert_allclose(ranked(pattern, holes, *depths), wanted, atol=1e-4)  # sums in single precision
    # A plate whose right half is closed is looked at where it is open.
    left = np.zeros_like(holes)
    left[8:56, 8:24] = True
    right, level = np.roll(left, 32, axis=1), np.roll(design.level_map.level, 32, axis=1)
    wanted = ranked(level, right, "depth_scale[3]", "depth_scale[0]")
    assert ranked(design.level_map.level, left, "depth_scale[3]", "depth_scale[0]") == wanted


@pytest.mark.slow
@pytest.mark.parametrize("light", ["scalar", "edges"])
def test_the_largest_error_matters_most(design, light):
    """At a wavelength that is none of the camera's lines, as a design wavelength may be."""
    design = replace(design, camera=replace(design.camera, light=light))
    spreads = {
        "overlay_x_m[3]": Normal(0.0, 0.4 * UM),
        "overlay_y_m[3]": Normal(0.0, 0.4 * UM),
        "overlay_x_m[0]": Normal(0.0, 0.05 * UM),
        "depth_scale[3]": Normal(0.0, 0.04),
        "chrome_x_m": Normal(0.0, 5 * UM),
    }
    ranking = rank_importance(design, Process(LEVELS, spreads=spreads), 532e-9)
    assert ranking[0].measured == "overlay of mask 4"
    # A mask that lies off makes two walls of one, whose light goes straight on, too.
    most = {"scalar": "depth of mask 4", "edges": "overlay of mask 4"}[light]
    assert max(ranking, key=lambda one: one.zeroth_order).measured == most
    assert {one.measured for one in ranking} == {"overlay of mask 4", "overlay of mask 1", "depth of mask 4"}
    assert sum(one.strehl for one in ranking) == pytest.approx(1)
    assert sum(one.zeroth_order for one in ranking) == pytest.approx(1)
    assert rank_importance(design, Process(LEVELS), 550e-9) == ()
