"""Light by its direction, without lens and sensor: places are angles, in specs, in numbers, and on pictures."""

import json
from pathlib import Path

import numpy as np
import pytest

from doedesign.areas.design import AreaTask
from doedesign.areas.shape import area_table, areas_of_design
from doedesign.areas.target import AreaTarget
from doedesign.build import camera_from_spec
from doedesign.capture.from_spec import sensor_side
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec, spec_from_json, spec_to_json, spec_to_toml, spec_warnings
from doedesign.spots.design import spots_from_spec
from doedesign.spots.orders import order_table
from fab.errors import InputError
from fab.figure import single
from fab.units import DEGREES, MILLIMETRES
from sim.optic import HeightOptic
from sim.plots.places import label_places, size_text
from sim.psf_bank import psf
from sim.store import read_bank, write_bank

SPEC = """
name = "angles"

[optics]
wavelengths = ["532 nm"]
design_wavelength = "532 nm"

[doe]
samples = 96
pitch = "2 um"
aperture = "192 um"
material = "fused_silica"

[process]
levels = 16
level_step = "72 nm"

[scene]
far = ["inf"]

[sensor]
pixel_angle = "0.2 deg"
window = 64

[optimize]
steps = 40
"""
GRID = 'spots={ count = [3, 2], spacing = "1 deg" }'
AREA = 'area={ shape = "rectangle", width = "5 deg", height = "4 deg" }'


def spec_of(tmp_path: Path, *overrides: str) -> Spec:
    path = tmp_path / "angles.toml"
    path.write_text(SPEC)
    return load_spec(path, overrides)


def test_pixels_are_equally_wide_in_the_sine(tmp_path: Path):
    spec = spec_of(tmp_path, GRID, "sensor.binning=2")
    camera = camera_from_spec(spec)
    assert camera.in_angles
    assert camera.pixel_m == pytest.approx(2 * np.sin(np.radians(0.2)), rel=1e-12)
    assert np.diff(camera.axis_m()) == pytest.approx(camera.pixel_m)
    assert (camera.curvature_per_m(), camera.curvature_per_m(3.0)) == (0.0, 3.0)
    assert camera.propagation == "far_field"
    assert spec.image_distance_m == 1.0


def test_angles_of_spots_and_areas_are_those_of_their_light(tmp_path: Path):
    spots = spec_of(
        tmp_path, 'spots={ arrangement = "list", places = [["-3 deg", "0 deg"], ["40 mrad", "2 deg"]] }'
    ).spots
    camera = camera_from_spec(spec_of(tmp_path, GRID))
    assert spots is not None
    sines = spots_from_spec(spots, camera).waves_per_m * 532e-9
    assert sines == pytest.approx(np.sin([[0, np.radians(-3)], [np.radians(2), 0.04]]), abs=1e-11)
    area = spec_of(
        tmp_path, 'area={ shape = "ring", width = "6 deg", inner = "3 deg", offset = ["1 deg", "0 deg"] }'
    ).areas[0]
    assert area.size_m[1] == pytest.approx(2 * np.sin(np.radians(3)), rel=1e-11)
    assert area.offset_m == pytest.approx((np.sin(np.radians(1)), 0), rel=1e-11)


@pytest.mark.parametrize("table", [GRID, AREA, 'area={ shape = "line", width = "9.7 deg", edge = "0.3123456 deg" }'])
def test_a_spec_is_written_in_angles_and_read_as_the_same(tmp_path: Path, table: str):
    spec = spec_of(tmp_path, table)
    text = spec_to_toml(spec)
    assert 'pixel_angle = "0.2 deg"' in text
    assert any(f'"{angle} deg"' in text for angle in ("1", "5", "9.7"))
    (tmp_path / "again.toml").write_text(text)
    assert load_spec(tmp_path / "again.toml") == spec
    assert spec_from_json(json.loads(json.dumps(spec_to_json(spec))), "again") == spec


@pytest.mark.parametrize("angle", ["7.431723 mrad", "6.516 mrad", "0.0123456789 rad", "0.1 mrad"])
def test_a_pixel_in_other_units_than_degrees_is_read_as_the_same(tmp_path: Path, angle: str):
    """No 15 digits in degrees give the first two back: a run would not know its own spec again."""
    spec = spec_of(tmp_path, GRID, f"sensor.pixel_angle={angle}", "sensor.window=16")
    (tmp_path / "again.toml").write_text(spec_to_toml(spec))
    again = load_spec(tmp_path / "again.toml")
    assert again.sensor.pixel_angle_rad == spec.sensor.pixel_angle_rad
    assert again == spec


@pytest.mark.slow
def test_an_area_in_degrees_is_that_of_a_lens(tmp_path: Path):
    """1 mm at f is the same plate as 2 asin(1 mm / 2 f); and its light has half its value where the angle says.

    After 120 steps: grains of light that 40 steps leave at the edges can move half the light by more than a detail.
    """
    bare = spec_of(tmp_path, AREA, "optimize.steps=120")
    wide, high = (f"{40 * np.sin(np.radians(angle) / 2):.15g} mm" for angle in (5, 4))
    path = tmp_path / "lens.toml"
    path.write_text(
        SPEC.replace('pixel_angle = "0.2 deg"', 'pitch = "69.813 um"').replace(
            "[optics]", '[optics]\nfocal_length = "20 mm"'
        )
    )
    lens = load_spec(path, [f'area={{ shape = "rectangle", width = "{wide}", height = "{high}" }}'])
    targets = [AreaTask.from_spec(spec).targets[0] for spec in (bare, lens)]
    assert targets[0].value == pytest.approx(targets[1].value, abs=1e-9)
    assert targets[0].sines_x == pytest.approx(targets[1].sines_x, rel=1e-12)
    design = optimize(bare)
    (table,) = areas_of_design(design, design.as_optic())
    numbers = table.summary()
    detail = 532e-9 / 182e-6  # the chrome leaves an opening of 182 um
    assert numbers["size_x_rad"] == pytest.approx(np.radians(5), abs=detail / 2)
    assert numbers["size_y_rad"] == pytest.approx(np.radians(4), abs=detail / 2)
    assert numbers["on_target"] > 0.7
    assert "deg at half the light" in table.describe()
    assert table.to_csv().startswith("axis,place_deg,")
    assert not any(key.endswith("_m") for key in numbers)


def test_profiles_of_an_area_are_told_by_angle_from_its_middle(tmp_path: Path):
    """Four degrees off the axis, where differences of sines are smaller by 0.4 %."""
    spec = spec_of(tmp_path, AREA.replace(" }", ', offset = ["4 deg", "-3 deg"] }'))
    camera = camera_from_spec(spec)
    assert spec.areas
    target = AreaTarget.of(spec.areas[0], camera)
    table = area_table(HeightOptic.of(camera), target)
    for profile, sines, middle in ((table.along_x, target.sines_x, 4), (table.along_y, target.sines_y, -3)):
        assert profile is not None
        assert profile.in_angles
        degrees = np.degrees(np.arcsin(sines)) - middle
        np.testing.assert_allclose(profile.in_unit(profile.place_m, DEGREES), degrees, rtol=0, atol=1e-9)
    row = table.to_csv().splitlines()[1].split(",")
    assert table.to_csv().startswith("axis,place_deg,")
    assert float(row[1]) == pytest.approx(np.degrees(np.arcsin(target.sines_x[0])) - 4)


def test_the_table_of_spots_tells_degrees(tmp_path: Path):
    spec = spec_of(tmp_path, 'spots={ count = [3, 1], period = "64 um" }')
    assert spec.spots is not None
    camera = camera_from_spec(spec)
    table = order_table(HeightOptic.of(camera), spots_from_spec(spec.spots, camera))
    rows = [line.split(",") for line in table.to_csv().splitlines()]
    assert rows[0][2:4] == ["x_deg", "y_deg"]
    assert [float(row[2]) for row in rows[1:]] == pytest.approx(
        [np.degrees(np.arcsin(m * 532e-9 / 64e-6)) for m in (-1, 0, 1)], rel=1e-8
    )


def test_what_is_said_of_light_knows_no_lens(tmp_path: Path):
    camera = camera_from_spec(spec_of(tmp_path, GRID))
    bank = psf(np.zeros(camera.grid.shape), camera)
    assert bank.camera is not None
    assert "no lens" in camera.lens_text
    assert "of 0.2°" in bank._repr_html_()
    write_bank(tmp_path / "bank.exr", bank)
    assert b"pixel_sine" in (tmp_path / "bank.exr").read_bytes()
    assert b"pixel_m" not in (tmp_path / "bank.exr").read_bytes()
    again = read_bank(tmp_path / "bank.exr")
    assert (again.pixel_m, again.in_angles) == (bank.pixel_m, True)
    assert "of 0.2°" in again._repr_html_()
    write_bank(tmp_path / "again.exr", again)
    assert (tmp_path / "again.exr").read_bytes() == (tmp_path / "bank.exr").read_bytes()
    with pytest.raises(InputError, match="directions"):
        read_bank(tmp_path / "bank.exr", pixel_m=bank.pixel_m)


def test_pictures_have_round_degrees_on_an_axis_of_sines(tmp_path: Path):
    camera = camera_from_spec(spec_of(tmp_path, GRID))
    assert size_text(camera.in_angles, 1.0) == "60°"  # 30 to either side
    assert camera.told_in(MILLIMETRES) is DEGREES
    with single(None, (4, 4)) as axes:
        axes.set(xlim=(-0.8, 0.8), ylim=(-0.1, 0.1))
        label_places(axes, DEGREES)
        assert axes.get_xlabel() == "x (°, even in its sine)"
        ticks = axes.get_xticks()
    assert np.degrees(np.arcsin(ticks)) == pytest.approx(np.round(np.degrees(np.arcsin(ticks))), abs=1e-9)
    assert axes.xaxis.get_major_formatter()(0.5) == "30"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([GRID, 'optics.focal_length="20 mm"'], ["optics.focal_length", "without lens and sensor"]),
        ([GRID, 'sensor.distance="20 mm"'], ["sensor.distance", "without lens and sensor"]),
        ([GRID, 'sensor.pitch="2 um"'], ["sensor.pitch", "without lens and sensor"]),
        ([GRID, "sensor.resolution=[640, 480]"], ["sensor.resolution", "without lens and sensor"]),
        ([GRID, 'optics.mapping="tangent"'], ["optics.mapping", "belongs to a lens"]),
        ([GRID, 'sensor.pixel_angle="2 um"'], ["sensor.pixel_angle", "2 deg", "deg, mrad or rad"]),
        ([GRID, 'sensor.pixel_angle="80 deg"'], ["sensor.pixel_angle", "must lie between"]),
        ([GRID, 'sensor.pixel_angle="2 deg"'], ["sensor.window", "a sine of 1.117", "Set window = 57 or less"]),
        (['spots={ count = [3, 3], spacing = "100 um" }'], ["spots.spacing", "2 deg", "give optics.focal_length"]),
        (['spots={ count = [3, 3], spacing = "0 deg" }'], ["spots.spacing", "must be greater than 0"]),
        (['spots={ count = [9, 9], spacing = "4 deg" }'], ["spots", "7.643 deg far at most", "16.2"]),
        (['area={ shape = "line", width = "20 deg" }'], ["area", "light places up to 6.6", "10 deg"]),
        (['area={ shape = "line", width = "200 deg" }'], ["area.width", "between 0 deg and 180 deg"]),
        (['area={ shape = "ring", width = "2 deg", inner = "3 deg" }'], ["area.inner", "width, 2 deg", "3 deg"]),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_degrees(tmp_path: Path, changes: list[str], words: list[str]):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, *changes)
    for word in words:
        assert word in str(refused.value)
    assert " um " not in str(refused.value).replace("cells of 2 um steer", "").replace("cells of 2 um light", "")


def test_an_angle_needs_pixels_that_are_angles(tmp_path: Path):
    path = tmp_path / "angles.toml"
    path.write_text(SPEC.replace('pixel_angle = "0.2 deg"', 'pitch = "2 um"\ndistance = "20 mm"'))
    with pytest.raises(InputError, match=r"area\.width: must be a length on the sensor"):
        load_spec(path, [AREA])


def test_doubtful_pixels_and_windows_are_warned_of_with_the_number_that_would_do(tmp_path: Path):
    assert spec_warnings(spec_of(tmp_path, GRID)) == []
    (fine,) = spec_warnings(spec_of(tmp_path, GRID, 'sensor.pixel_angle="0.005 deg"'))
    assert "pixels of 0.005 deg are more than 16 times finer" in fine
    assert '0.1588 deg at 532 nm; "0.04 deg" is enough' in fine
    (wide,) = spec_warnings(spec_of(tmp_path, GRID, "sensor.window=100"))
    assert "ends 10.05 deg from the axis" in wide
    assert "only 7.643 deg far" in wide
    assert "At most 76 pixels" in wide


def test_pictures_of_scenes_ask_for_a_sensor(tmp_path: Path):
    with pytest.raises(InputError, match=r"sensor\.pixel_angle: pictures are taken by a sensor"):
        sensor_side(spec_of(tmp_path, GRID))


@pytest.mark.slow
def test_a_pattern_for_objectives_is_told_in_degrees(tmp_path: Path):
    pattern = (
        'objective=[{ name = "target_pattern", options = { pattern = "spots", count = [3, 1], spacing = "2 deg" } }]'
    )
    design = optimize(
        spec_of(tmp_path, pattern, 'optimize.start="random"', 'optimize.sampling="exact"', "optimize.steps=40")
    )
    image = psf(design).energy[0, 0]
    column = image.sum(0)
    brightest = np.sort(np.argsort(column)[-3:])
    at = np.degrees(np.arcsin(design.camera.axis_m()[brightest]))
    assert at == pytest.approx([-2, 0, 2], abs=0.21)
    with pytest.raises(InputError, match="must be an angle with a unit"):
        optimize(spec_of(tmp_path, pattern.replace("2 deg", "250 um")))
