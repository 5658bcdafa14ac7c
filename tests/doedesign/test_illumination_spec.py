"""The table [illumination]: from the file to a camera's beam, what is refused, and what a run keeps of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import doedesign.optimization as optimization
from doedesign.build import camera_from_spec
from doedesign.optimization import optimize
from doedesign.runs.folder import open_run
from doedesign.spec import Spec, load_spec, spec_digest, spec_to_toml, spec_warnings
from doedesign.spots.design import spots_from_spec
from doedesign.spots.orders import order_table
from fab.aperture import RectangularAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.pictures import write_pixels
from fab.units import parse_angle
from sim.illumination import EvenBeam, GaussianBeam, MeasuredBeam, power_through
from sim.metrics import energy_budget
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.transfer import mtf
from tests.doedesign.test_spots_run import SPEC
from tests.pictures import leave_out_pictures

GAUSSIAN = """
[illumination]
kind = "gaussian"
diameter = ["120 um", "100 um"]
"""
PLANE = '[illumination]\nkind = "plane"\n'
POINT = '[illumination]\nkind = "point"\ndistance = "50 mm"\n'
PICTURE = """
[illumination]
kind = "picture"
picture = "beam.png"
pixel = "4 um"
"""


def spec_of(tmp_path: Path, table: str, *overrides: str) -> Spec:
    path = tmp_path / "fan.toml"
    path.write_text(SPEC + table)
    return load_spec(path, overrides)


def beam_picture(path: Path) -> np.ndarray:
    at = (np.arange(64) - 31.5) * 4e-6
    grey = np.rint(60000 * np.exp(-2 * ((at[:, None] - 20e-6) ** 2 + at**2) / 60e-6**2)).astype(np.uint16)
    write_pixels(path, grey)
    return grey


@pytest.mark.parametrize("key", ["angle", "tilt"])
def test_the_level_step_for_a_beam_aslant_is_that_of_oblique_glass(tmp_path: Path, key: str):
    """One wave at 532 nm and 20 degrees: 532 nm / (sqrt(n² - sin²) - cos), n = 1.46071, is 1107.4 nm."""
    aslant = f"illumination.{key}=['20 deg', '0 deg']"
    (warning,) = [w for w in spec_warnings(spec_of(tmp_path, PLANE, aslant)) if w.startswith("process.level_step")]
    assert "is passed by the beam 20 degrees off the axis" in warning
    assert "+4.0 % off" in warning
    assert 'A level_step of "138.42 nm" would.' in warning
    good = spec_of(tmp_path, PLANE, aslant, "process.level_step=138.4 nm")
    assert not [w for w in spec_warnings(good) if w.startswith("process.level_step")]


def test_a_spec_has_x_before_y_and_a_beam_y_before_x(tmp_path: Path):
    given = ("illumination.m_squared=[1.5, 1.0]", "illumination.angle=['0 deg', '1 deg']")
    more = ("illumination.centre=['5 um', '0 um']", 'illumination.waist_distance="-0.2 m"')
    beam = camera_from_spec(spec_of(tmp_path, GAUSSIAN, *given, *more)).beam
    assert isinstance(beam, GaussianBeam)
    assert (beam.radius_m, beam.waist_distance_m, beam.m_squared, beam.centre_m) == (
        (50e-6, 60e-6),
        -0.2,
        (1.0, 1.5),
        (0.0, 5e-6),
    )
    assert beam.angle_rad == pytest.approx((np.deg2rad(1), 0.0))
    single = camera_from_spec(spec_of(tmp_path, GAUSSIAN, 'illumination.diameter="80 um"')).beam
    assert single == GaussianBeam((40e-6, 40e-6))
    assert camera_from_spec(spec_of(tmp_path, "")).beam is None


def test_light_without_a_shape_is_plane_or_comes_from_a_point(tmp_path: Path):
    """On the opening that the chrome leaves, tilted or not."""
    plane = spec_of(tmp_path, PLANE, 'illumination.tilt=["2 deg", "-1 deg"]')
    assert isinstance(plane.doe.aperture_m, float)
    opening = plane.doe.aperture_m - 2 * plane.process.chrome_overlap_m
    assert camera_from_spec(plane).aperture_m == pytest.approx(opening)
    assert camera_from_spec(plane).beam == EvenBeam(tilt_rad=(parse_angle("-1 deg"), parse_angle("2 deg")))
    point = camera_from_spec(spec_of(tmp_path, POINT, 'illumination.angle=["0 deg", "1 deg"]')).beam
    assert point == EvenBeam(0.05, (parse_angle("1 deg"), 0.0))
    assert camera_from_spec(spec_of(tmp_path, POINT, 'illumination.distance="inf"')).beam == EvenBeam()


def test_a_beam_without_a_kind_is_gaussian(tmp_path: Path):
    spec = spec_of(tmp_path, GAUSSIAN.replace('kind = "gaussian"\n', ""))
    assert spec_digest(spec) == spec_digest(spec_of(tmp_path, GAUSSIAN))


def test_orders_of_a_tilted_beam_are_told_where_they_land(tmp_path: Path):
    """asin(order wavelength / period + sin(tilt)) along the tilt; on a sensor, the focal length times that sine."""
    spec = spec_of(tmp_path, PLANE, 'illumination.tilt=["2 deg", "0 deg"]')
    assert spec.spots is not None
    camera = camera_from_spec(spec)
    spots = spots_from_spec(spec.spots, camera)
    found = order_table(HeightOptic.of(camera), spots).places_m
    moved = order_table(HeightOptic.of(replace(camera, beam=None)), spots).places_m
    assert found[:, 1] - moved[:, 1] == pytest.approx(camera.focal_length_m * np.sin(np.deg2rad(2)), rel=1e-9)
    assert found[:, 0] == pytest.approx(moved[:, 0], abs=1e-12)


def test_a_window_that_tilted_light_leaves_is_warned_of(tmp_path: Path):
    straight, tilted = (spec_of(tmp_path, PLANE, f'illumination.tilt=["{tilt} deg", "0 deg"]') for tilt in (0, 8))
    assert [w for w in spec_warnings(straight) if w.startswith("sensor.window")] == []
    (warning,) = [w for w in spec_warnings(tilted) if w.startswith("sensor.window")]
    assert "from where light arrives" in warning


@pytest.mark.parametrize(
    "table", ["{}angle = ['0 deg', '1 deg']\nm_squared = 1.5", "{}", "{}tilt = ['1 deg', '0 deg']"]
)
def test_a_spec_is_written_as_it_was_read(tmp_path: Path, table: str):
    beam = GAUSSIAN if "m_squared" in table else POINT
    spec = spec_of(tmp_path, table.format(beam))
    path = tmp_path / "again.toml"
    path.write_text(spec_to_toml(spec))
    assert load_spec(path) == spec


@pytest.mark.parametrize(
    ("table", "changes", "where", "words"),
    [
        (GAUSSIAN, ['illumination.kind="laser"'], "illumination.kind", "gaussian"),
        (GAUSSIAN, ["illumination.m_squared=0.5"], "illumination.m_squared", "between 1 and 3"),
        (GAUSSIAN, ["illumination.diameter=['1 mm', '1 mm', '1 mm']"], "illumination.diameter", "one number or"),
        (GAUSSIAN, ['illumination.picture="a.png"'], "illumination.picture", "takes: diameter"),
        (GAUSSIAN, ['scene.far=["1 m"]'], "scene.far", "takes the place of sources"),
        ('[illumination]\nkind = "gaussian"\n', [], "illumination.diameter", "needs it"),
        (PICTURE, ['illumination.picture="beam.gif"'], "illumination.picture", ".png"),
        (PICTURE, ["illumination.m_squared=1.5"], "illumination.m_squared", "takes: picture, pixel"),
        ('[illumination]\nkind = "point"\n', [], "illumination.distance", "needs it"),
        (POINT, ['illumination.distance="20 um"'], "illumination.distance", "cannot follow the wave of the point"),
        (POINT, ['illumination.diameter="1 mm"'], "illumination.diameter", "takes: distance, angle, tilt"),
        (PLANE, ['illumination.distance="5 mm"'], "illumination.distance", "takes: angle, tilt"),
        (PLANE, ['illumination.centre=["1 um", "0 um"]'], "illumination.centre", "takes: angle, tilt"),
        (PLANE, ['illumination.tilt="1 deg"'], "illumination.tilt", "must be a list"),
        (PLANE, ['illumination.tilt=["90 deg", "0 deg"]'], "illumination.tilt[0]", "must lie between"),
        (PLANE, ['illumination.tilt=["1 um", "0 deg"]'], "illumination.tilt[0]", "deg, mrad or rad"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, table: str, changes: list[str], where: str, words: str):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, table, *changes)
    assert where in str(refused.value)
    assert words in str(refused.value)


@pytest.mark.slow
def test_a_run_keeps_the_picture_of_its_beam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    leave_out_pictures(monkeypatch, optimization)
    grey = beam_picture(tmp_path / "beam.png")
    spec = spec_of(tmp_path, PICTURE)
    # A picture of the name of a run's copy, beside the spec of a user, is somebody else's.
    write_pixels(tmp_path / "illumination_picture.png", np.zeros((8, 8), np.uint16))
    optimize(spec, tmp_path / "run")
    (tmp_path / "beam.png").unlink()
    beam = camera_from_spec(open_run(tmp_path / "run").spec).beam
    assert isinstance(beam, MeasuredBeam)
    np.testing.assert_array_equal(beam.intensity, grey)  # the brightest place above the middle
    copy = tmp_path / "run/illumination_picture.png"
    beam_picture(copy)
    write_pixels(copy, grey[::-1])
    with pytest.raises(InputError, match="must be the file this run wrote"):
        open_run(tmp_path / "run")


def test_a_black_or_missing_picture_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="the file must exist"):
        optimize(spec_of(tmp_path, PICTURE))
    write_pixels(tmp_path / "beam.png", np.zeros((8, 8), np.uint16))
    with pytest.raises(InputError, match="must have some light"):
        optimize(spec_of(tmp_path, PICTURE))


BESIDE = 'illumination.centre=["5 mm", "0 mm"]'
NARROW = GAUSSIAN.replace('["120 um", "100 um"]', '"100 um"')


@pytest.mark.parametrize("more", [[], ["illumination.m_squared=2.0"], ['illumination.waist_distance="20 mm"']])
def test_a_beam_beside_the_aperture_is_refused(tmp_path: Path, more: list[str]):
    """Its shares of light would be nothing over nothing."""
    with pytest.raises(InputError, match=r"illumination\.centre: light of the beam must reach the aperture"):
        optimize(spec_of(tmp_path, NARROW, BESIDE, *more))
    beam_picture(tmp_path / "beam.png")
    with pytest.raises(InputError, match=r"illumination\.centre: light of the beam must reach the aperture"):
        camera_from_spec(spec_of(tmp_path, PICTURE, BESIDE))


def test_little_light_of_a_beam_is_enough(tmp_path: Path):
    """A few millionths of a percent of the power: numbers are finite and say how little it is."""
    centre = 'illumination.centre=["235 um", "0 um"]'
    spots = 'spots={ count = [3, 3], spacing = "500 um", starts = 8 }'
    design = optimize(spec_of(tmp_path, NARROW, centre, spots, "optimize.steps=2"))
    camera = design.camera
    assert camera.beam is not None
    share = power_through(camera.beam, camera.grid, camera.opening, 532e-9)
    assert 1e-9 < share < 1e-8
    energy = psf(design.as_optic()).energy
    assert np.isfinite(energy).all()
    assert 0 < energy.sum() < share
    assert np.isfinite([row["loss"] for row in design.history]).all()


def test_power_through_an_aperture_is_that_of_the_whole_beam(tmp_path: Path):
    """A beam of several modes, its axis on a side of a wide aperture: half of its light passes."""
    grid = Grid((256, 256), 4e-6)
    for beam in (GaussianBeam((40e-6, 40e-6), 0.0, (2.0, 2.0), (0.0, 0.512e-3)), GaussianBeam((40e-6, 40e-6))):
        share = power_through(beam, grid, RectangularAperture((1.024e-3, 1.024e-3)), 532e-9)
        assert share == pytest.approx(0.5 if any(beam.centre_m) else 1.0, rel=1e-3)


def test_spots_of_a_gaussian_beam_are_equal(tmp_path: Path):
    """Spots that lie apart, in the light of the beam: their phases are searched for it, and their table is of it."""
    from doedesign.prediction import on_target

    text = GAUSSIAN.replace('["120 um", "100 um"]', '"120 um"')
    spec = spec_of(tmp_path, text, 'spots={ count = [3, 3], spacing = "500 um", starts = 8 }', "optimize.steps=60")
    design = optimize(spec)
    lit, even = (on_target(one, one.as_optic()) for one in (design, optimize(spec_of(tmp_path, ""))))
    assert lit is not None
    assert even is not None
    assert lit.measures()["uniformity_error"] < 0.05
    assert lit.measures()["on_target"] > 0.75


@pytest.mark.parametrize("radius_m", [60e-6, 91e-6])
@pytest.mark.parametrize(
    "where", ["spots={ arrangement = 'list', places = [['0 um', '0 um'], ['400 um', '0 um']] }", ""]
)
def test_spots_are_shares_of_the_power_of_a_beam(tmp_path: Path, radius_m: float, where: str):
    """A flat plate leaves all that passes in the middle: 1 - exp(-2 R² / w²) of a Gaussian, as its budget says."""
    diameter = f'illumination.diameter="{2e6 * radius_m:g} um"'
    spec = spec_of(tmp_path, GAUSSIAN, diameter, *([where] if where else []))
    assert spec.spots is not None
    camera, table = camera_from_spec(spec), spec.spots
    flat = HeightOptic.of(camera)
    found = order_table(flat, spots_from_spec(table, camera), period_m=table.period_m, count=table.count, levels=8)
    passed = 1 - np.exp(-2 * (camera.aperture_m / 2 / radius_m) ** 2)
    assert found.zeroth_order == pytest.approx(passed, rel=1e-3)  # of cells of 2 um on the rim
    dark = np.zeros((camera.window, camera.window))
    budget = energy_budget(flat, dark, np.inf, camera.colours[0])
    assert found.zeroth_order == pytest.approx(1 - budget.blocked, rel=1e-6)  # the same sums, in another order
    if found.ceiling.efficiency is not None:
        plain = order_table(HeightOptic.of(replace(camera, beam=None)), found.spots, count=table.count, levels=8)
        assert plain.ceiling.efficiency is not None
        assert found.ceiling.efficiency == pytest.approx(passed * plain.ceiling.efficiency, rel=1e-3)


@pytest.mark.slow
def test_modes_share_one_transfer_function(tmp_path: Path):
    """Fewer than the beam's modes would leave a larger coherent part: MTF of one mode of M² = 1 lies above."""
    design = optimize(spec_of(tmp_path, GAUSSIAN, "optimize.steps=2"))
    mixed = optimize(spec_of(tmp_path, GAUSSIAN, "illumination.m_squared=1.8", "optimize.steps=2"))
    one, many = (mtf(each).transfer for each in (design, mixed))
    assert one[0, 0, 0] == pytest.approx(1)
    assert many[0, 0, 0] == pytest.approx(1)
    assert not np.allclose(one, many, atol=0.01)
