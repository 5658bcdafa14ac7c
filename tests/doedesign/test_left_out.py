"""What a spec may leave out because its task says it, and by which rules it is filled in."""

import math
from pathlib import Path

import numpy as np
import pytest

from doedesign.build import camera_from_spec
from doedesign.capture.from_spec import sensor_side
from doedesign.spec import Spec, load_spec, spec_to_resolved_toml, spec_warnings
from doedesign.templates import template_text
from fab.errors import InputError
from fab.units import parse_angle

SPEC = """
name = "short"

[optics]
wavelengths = ["532 nm"]
design_wavelength = "532 nm"

[doe]
samples = 256
pitch = "2 um"
aperture = "512 um"
material = "fused_silica"

[process]
levels = 16
level_step = "72 nm"
"""
ORDERS = 'spots={ count = [7, 7], period = "64 um" }'
LENS = 'optics.focal_length="20 mm"'
WAVELENGTH, APERTURE = 532e-9, 512e-6


def start(name: str, **options: object) -> list[str]:
    written = ", ".join(
        f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in options.items()
    )
    return [f'optimize={{ start = "{name}", start_options = {{ {written} }} }}']


def spec_of(tmp_path: Path, *overrides: str, text: str = SPEC) -> Spec:
    path = tmp_path / "short.toml"
    path.write_text(text)
    return load_spec(path, overrides)


def test_orders_of_a_cell_are_looked_at_by_their_direction(tmp_path: Path):
    spec = spec_of(tmp_path, ORDERS)
    assert spec.scene.far_m == (math.inf,)
    assert spec.sensor.in_angles
    # Two pixels to what an aperture can show, and the third order with a quarter more to either side.
    assert spec.sensor.pixel_m == pytest.approx(WAVELENGTH / APERTURE / 2, rel=5e-3)
    assert spec.sensor.window_m / 2 == pytest.approx(1.25 * 3 * WAVELENGTH / 64e-6, rel=0.02)
    assert spec_warnings(spec) == []
    assert camera_from_spec(spec).in_angles


def test_what_is_filled_in_is_written_and_stays(tmp_path: Path):
    spec = spec_of(tmp_path, ORDERS)
    text = spec_to_resolved_toml(spec, [])
    assert 'far = ["inf"]' in text
    assert 'pixel_angle = "0.0298 deg"' in text
    # As the head of the file says.
    assert text.startswith("# defaults are filled in; optional keys that are not here have their usual values\n")
    assert "uniformity" not in text
    assert "steps = " in text
    again = tmp_path / "again.toml"
    again.write_text(text)
    assert load_spec(again) == spec


@pytest.mark.parametrize(
    ("task", "half_mm", "distance_mm"),
    [
        ([ORDERS, LENS], 20 * 3 * 532e-6 / 64e-3, 20),
        (['spots={ count = [5, 3], spacing = "250 um" }', LENS], 0.5 + 2 * 0.0208, 20),
        (['area={ shape = "rectangle", width = "1 mm", offset = ["0.2 mm", "0 mm"] }', LENS], 0.7 + 2 * 0.0208, 20),
        ([*start("blazed", period="20 um"), LENS], 20 * 532e-6 / 20e-3, 20),
        ([*start("axicon", angle="1 deg"), LENS], 20 * math.sin(math.radians(1)), 20),
        ([*start("axicon", angle="1 deg"), 'sensor.distance="20 mm"'], 20 * math.sin(math.radians(1)) + 0.256, 20),
        (start("lens_array", pitch="128 um", focal_length="8 mm"), 0.256, 8),
        (start("axilens", near="10 mm", far="12 mm"), 0.0, 10),
        (start("fresnel", focal_length="10 mm"), 0.0, 10),
        (['focus={ distances = ["8 mm", "16 mm"] }'], 0.0, 8),
    ],
)
def test_the_window_holds_what_is_asked_for(tmp_path: Path, task: list[str], half_mm: float, distance_mm: float):
    spec = spec_of(tmp_path, *task)
    detail = WAVELENGTH * distance_mm * 1e-3 / APERTURE
    assert spec.image_distance_m == pytest.approx(distance_mm * 1e-3)
    assert spec.sensor.pixel_m == pytest.approx(detail / 2, rel=5e-3)
    wanted = max(1.25 * half_mm * 1e-3, 16 * detail)
    assert spec.sensor.window_m / 2 == pytest.approx(wanted, abs=1.2 * spec.sensor.pixel_m, rel=6e-3)
    assert spec_warnings(spec) == []


@pytest.mark.parametrize("name", ["vortex", "cubic"])
def test_a_classic_design_needs_neither_steps_nor_objectives(tmp_path: Path, name: str):
    spec = spec_of(tmp_path, *start(name))
    assert spec.optimize.steps == 0
    assert spec.sensor.in_angles
    assert spec_of(tmp_path, *start(name), "optimize.steps=3", 'objective=[{ name = "far_spot" }]').optimize.steps == 3


def test_what_is_given_stays(tmp_path: Path):
    spec = spec_of(tmp_path, ORDERS, 'sensor.pixel_angle="0.1 deg"')
    assert spec.sensor.pixel_angle_rad == parse_angle("0.1 deg")
    assert spec.sensor.window_m / 2 == pytest.approx(1.25 * 3 * WAVELENGTH / 64e-6, abs=2.2 * spec.sensor.pixel_m)
    spec = spec_of(tmp_path, ORDERS, "sensor.window=300", "sensor.binning=2")
    assert (spec.sensor.window, spec.sensor.pixel_m) == (300, pytest.approx(WAVELENGTH / APERTURE / 2, rel=1e-2))
    assert spec_of(tmp_path, ORDERS, LENS, 'scene.far=["inf"]', 'scene.occlusion="paper"').scene.occlusion == "paper"


def test_a_wide_pattern_gets_wider_pixels_and_no_more_than_cells_can_light(tmp_path: Path):
    wide = ["doe.samples=2000", 'doe.aperture="4 mm"', 'area={ shape = "ellipse", width = "13 deg" }']
    spec = spec_of(tmp_path, *wide)
    assert spec.sensor.window in (1022, 1024)
    assert np.degrees(np.arcsin(spec.sensor.window_m / 2)) == pytest.approx(7.64, abs=0.02)  # asin(532 nm / 4 um)
    assert spec_warnings(spec) == []


def test_a_beam_takes_the_place_of_the_scene(tmp_path: Path):
    text = SPEC + '[illumination]\ndiameter = "0.2 mm"\n[sensor]\npixel_angle = "0.1 deg"\nwindow = 32\n'
    spec = spec_of(tmp_path, 'optimize={ steps = 0, start = "random" }', text=text)
    assert spec.scene.far_m == (math.inf,)


@pytest.mark.parametrize(
    "task",
    [
        ['spot={ count = [7, 7], period = "64 um" }'],
        ['optimise={ start = "axicon", start_options = { angle = "1 deg" } }'],
        ['optimize={ strat = "axicon", start_options = { angle = "1 deg" } }'],
    ],
)  # fmt: skip
def test_a_slip_in_the_task_is_told_alone(tmp_path: Path, task: list[str]):
    with pytest.raises(InputError, match=r"must be a known key.*Did you mean") as refused:
        spec_of(tmp_path, *task)
    assert "must be given" not in str(refused.value)


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (['optimize={ start = "random", steps = 0 }'], ["scene: must be given", "sensor: must be given"]),
        ([], ["scene: must be given", "sensor: must be given"]),
        (['spots={ count = [7, 7], period = "64 seconds" }'], ["spots.period", "75 nm"]),
        ([ORDERS, 'sensor.pitch="2 um"'], ["optics.focal_length", "a lens, or a sensor at a distance"]),
        ([ORDERS, LENS, 'sensor.defocus="-10 mm"'], ["sensor.defocus", "beyond half the focal length"]),
        ([ORDERS, 'optics.focal_length="1 mm"', 'sensor.defocus="-2 mm"'], ["sensor.defocus", "half the focal length"]),
        ([ORDERS, "sensor.pixels=3"], ["sensor.pixels", "must be a known key"]),
        ([ORDERS, "sensor=3"], ["sensor", "must be a table"]),
        ([ORDERS, "optics=3"], ["optics", "must be a table"]),
        ([ORDERS, 'scene.near=["5 mm"]'], ["scene.far", "must be given"]),
        (["focus={ distances = [] }"], ["focus.distances", "must not be empty"]),
        (['focus={ distances = ["8 mm"] }', LENS], ["sensor.distance", "foci lie behind a DOE without a lens"]),
        (start("fresnel", focal_length="10 nonsense"), ["sensor.distance", "75 nm"]),
        (["spots={ count = [7, 7] }"], ["spots.spacing", "needs it"]),
    ],
)  # fmt: skip
def test_mistakes_are_those_of_the_spec(tmp_path: Path, task: list[str], words: list[str]):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, *task)
    for word in words:
        assert word in str(refused.value)


@pytest.mark.parametrize(
    ("task", "only"),
    [
        (["spots=3"], "spots: must be a table"),
        (["area=3"], "area: must be a list"),
        (['focus="8 mm"'], "focus: must be a table"),
        (["focus={ distances = [3] }"], "focus.distances[0]: must be a number with a unit"),
        (['focus={ distances = ["8 deg"] }'], "focus.distances[0]: must be a number with a unit"),
        (["optimize=3"], "optimize: must be a table"),
        ([ORDERS, LENS, 'doe.aperture="3 um"'], "doe.aperture: must equal samples x pitch"),
    ],
)
def test_what_would_follow_from_a_mistake_is_no_second_one(tmp_path: Path, task: list[str], only: str):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, *task)
    assert only in str(refused.value)
    assert not any(word in str(refused.value) for word in ("sensor", "scene"))


def test_options_of_a_start_without_end_say_nothing_of_the_sensor(tmp_path: Path):
    """They are refused where the start is made."""
    assert spec_of(tmp_path, *start("vortex", charge="inf")).sensor.window == 64


def test_a_lens_beside_angles_is_one_mistake(tmp_path: Path):
    with pytest.raises(InputError, match="directions are looked at without lens") as refused:
        spec_of(tmp_path, ORDERS, LENS, 'sensor.pixel_angle="0.1 deg"')
    assert "sensor.pitch" not in str(refused.value)


def test_pictures_of_scenes_ask_for_photosites(tmp_path: Path):
    with pytest.raises(InputError, match=r"sensor\.resolution: pictures need the photosites"):
        sensor_side(spec_of(tmp_path, ORDERS, LENS))
    assert sensor_side(spec_of(tmp_path, ORDERS, LENS, "sensor.resolution=[640, 480]", "sensor.binning=2")) == 240


@pytest.mark.parametrize("name", ["bifocal", "edof", "fan_out", "lens", "lens_array", "splitter", "vortex"])
def test_templates_say_no_more_than_their_task(name: str):
    assert "[sensor]" not in template_text(name)
    assert "[scene]" not in template_text(name)
