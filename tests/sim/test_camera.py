import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.reference import make_camera
from fab.aperture import RectangularAperture
from fab.errors import InputError
from sim.camera import Colour
from sim.lens import direction_sines
from sim.material import refractive_index
from sim.source import path_at_m, source_path_m, wrapped_waves

CAMERA = make_camera(64, 4.4e-3, 8e-3, 3.7e-6, 32)


def direct_path(y: np.ndarray, x: np.ndarray, depth_m: float, field_rad: tuple[float, float]) -> np.ndarray:
    """Path from the source minus that of the chief ray and minus its tilt, in extended precision."""
    y0, x0 = (-np.longdouble(depth_m) * np.tan(np.longdouble(a)) for a in field_rad)
    y, x, z = y.astype(np.longdouble), x.astype(np.longdouble), np.longdouble(depth_m)
    chief = np.sqrt(y0**2 + x0**2 + z**2)
    return np.sqrt((y - y0) ** 2 + (x - x0) ** 2 + z**2) - chief + (y0 * y + x0 * x) / chief


@pytest.mark.parametrize("depth_m", [0.05, 0.12, 5.0, 1e4])
@pytest.mark.parametrize("field_rad", [(0.0, 0.0), (0.2, -0.1)])
def test_source_path_does_not_cancel(depth_m: float, field_rad: tuple[float, float]):
    y, x = (CAMERA.grid.axis_m(a) for a in ("y", "x"))
    wanted = direct_path(y[:, None], x[None, :], depth_m, field_rad)
    got = source_path_m(CAMERA, depth_m, field_rad)
    # 1e-5 of a visible wave; at 10 km a naive difference in float64 would already be off by 2e-12 m.
    assert np.abs(got - wanted).max() < 5e-12


def test_a_star_in_focus_has_no_path_differences():
    assert np.all(source_path_m(CAMERA, np.inf) == 0)


def test_a_sensor_out_of_focus_leaves_a_quadratic_path():
    camera = make_camera(64, 4.4e-3, 8e-3, 3.7e-6, 32, defocus_m=2e-4)
    square = camera.grid.axis_m("y")[:, None] ** 2 + camera.grid.axis_m("x")[None, :] ** 2
    np.testing.assert_allclose(source_path_m(camera, np.inf), square / 2 * (1 / 8.2e-3 - 1 / 8e-3), rtol=1e-9)
    # The lens equation: an object at z is sharp at f z / (z - f), apart from the sphere's fourth-order term r^4/8z^3.
    depth = 0.4
    sharp = make_camera(64, 4.4e-3, 8e-3, 3.7e-6, 32, defocus_m=8e-3 * depth / (depth - 8e-3) - 8e-3)
    assert np.abs(source_path_m(sharp, depth)).max() < 1.01 * square.max() ** 2 / 8 / depth**3
    assert sharp.defocus_radius_m(depth) == pytest.approx(0, abs=1e-12)


def test_path_at_points_equals_path_on_the_grid():
    y, x = (CAMERA.grid.axis_m(a) for a in ("y", "x"))
    np.testing.assert_array_equal(
        path_at_m(CAMERA, y[:, None], x[None, :], 0.1, (0.1, 0.0)), source_path_m(CAMERA, 0.1, (0.1, 0.0))
    )


def test_defocus_radius_in_the_focal_plane():
    assert CAMERA.defocus_radius_m(0.05) == pytest.approx(4.4e-3 * 8e-3 / (2 * 0.05))
    assert CAMERA.defocus_radius_m(np.inf) == 0


def test_wrapping_keeps_the_wave():
    path = np.linspace(-1e-4, 1e-4, 1001)
    waves = wrapped_waves(path, 589e-9)
    assert waves.dtype == np.float32
    assert np.abs(waves).max() <= 0.5
    # Half a unit in the last place of a float32 near 1/2, times 2 pi.
    np.testing.assert_allclose(np.exp(2j * np.pi * waves), np.exp(2j * np.pi * path / 589e-9), atol=4e-7)


@pytest.mark.parametrize("field_rad", [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.4)])
def test_direction_sines_are_those_of_the_ray(field_rad: tuple[float, float]):
    ray = np.array([np.tan(field_rad[0]), np.tan(field_rad[1]), 1.0])
    np.testing.assert_allclose(direction_sines(field_rad), (ray / np.linalg.norm(ray))[:2], rtol=1e-12)


def test_delay_of_a_plate_under_an_angle():
    """Snell's law for a thin plate of thickness t: n t cos(inside) - t cos(outside)."""
    angle = 0.35
    index = refractive_index("fused_silica", 589e-9)
    inside = np.arcsin(np.sin(angle) / index)
    wanted = (index * np.cos(inside) - np.cos(angle)) / 589e-9
    assert CAMERA.waves_per_metre(589e-9, (0.0, angle)) == pytest.approx(wanted, rel=1e-12)
    assert CAMERA.waves_per_metre(589e-9) == pytest.approx((index - 1) / 589e-9, rel=1e-12)


def test_a_camera_can_be_a_static_argument():
    again = make_camera(64, 4.4e-3, 8e-3, 3.7e-6, 32)
    assert hash(again) == hash(CAMERA)
    assert again == CAMERA


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"focal_length_m": 0.0}, "focal_length_m: must be metres, a positive number"),
        ({"focal_length_m": -8e-3}, "focal_length_m: must be metres"),
        ({"focal_length_m": np.nan}, "focal_length_m: must be metres"),
        ({"pixel_m": 0.0}, "pixel_m: must be metres"),
        ({"pixel_m": 3.7}, "pixel_m: must be at most twice the sensor's distance, 8 mm"),
        ({"window": 0}, "window: must be a whole number of pixels"),
        ({"defocus_m": np.inf}, "defocus_m: must be metres, a number that is finite"),
        ({"defocus_m": -8e-3}, "defocus_m: the sensor must lie behind the lens"),
        ({"defocus_m": -16e-3}, "defocus_m: the sensor must lie behind the lens"),
        ({"focal_length_m": np.inf, "distance_m": -0.1}, "distance_m: must be metres"),
        ({"material": "glass"}, "material: must be one of"),
        ({"aperture": 0.0}, "aperture: must be at least a cell wide"),
        ({"aperture": np.nan}, "aperture: must be a diameter or [width, height], but got nan"),
        ({"aperture": 1e-9}, "aperture: must be at least a cell wide"),  # sampled for hours
        ({"aperture": np.inf}, "aperture: must be at least a cell wide"),
        ({"aperture": RectangularAperture((1e-3, -1e-3))}, "aperture: must be at least a cell wide"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(InputError) as error:
        replace(CAMERA, **changes)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("wavelengths", "weights", "message"),
    [
        ((550.0,), (1.0,), "colour g: wavelengths_m: must be metres"),
        ((0.0,), (1.0,), "colour g: wavelengths_m: must be metres"),
        ((550e-9, 600e-9), (2.0, -1.0), "colour g: weights: must be numbers that are not negative"),
        ((550e-9,), (np.nan,), "colour g: weights: must be numbers that are not negative"),
        ((), (), "colour g: weights: must be one for each wavelength"),
    ],
)
def test_a_colour_that_cannot_be_is_refused(wavelengths: Any, weights: Any, message: str):
    with pytest.raises(InputError) as error:
        Colour("g", wavelengths, weights)
    assert str(error.value).startswith(message)


# Without the checks of types that tests have: values of other kinds, as a script may give them.
OTHER_KINDS = """
from dataclasses import replace
import numpy as np
from bench.reference import make_camera
from sim.camera import Colour

camera = make_camera(64, 4.4e-3, 8e-3, 3.7e-6, 32)
for changes in (
    {"grid": (64, 64)}, {"focal_length_m": "8 mm"}, {"pixel_m": "3.7 um"}, {"window": 31.5}, {"window": (32, 32)},
    {"doe_distance_m": "1 mm"}, {"colours": (550e-9,)}, {"material": 1.52},
):
    try:
        replace(camera, **changes)
    except Exception as error:
        print(type(error).__name__, error)
for wavelengths in (550e-9, ("550 nm",), "5"):
    try:
        Colour("g", wavelengths, (1.0,))
    except Exception as error:
        print(type(error).__name__, error)
listed = replace(camera, colours=[Colour("g", np.array([500e-9, 600e-9]), [0.5, 0.5])])
print(hash(listed) == hash(replace(camera, colours=(Colour("g", (500e-9, 600e-9), (0.5, 0.5)),))))
"""


def test_values_of_other_kinds_are_refused_and_lists_are_taken():
    root = Path(__file__).parents[2]
    run = subprocess.run([sys.executable, "-c", OTHER_KINDS], cwd=root, capture_output=True, text=True, check=True)
    *told, last = run.stdout.splitlines()
    wanted = (
        "grid: must be the raster of the DOE",
        "focal_length_m: must be metres",
        "pixel_m: must be metres",
        "window: must be a whole number of pixels",
        "window: must be a whole number of pixels",
        "doe_distance_m: must be metres",
        "colours: must be colour channels",
        "material: must be one of",
        *["colour g: wavelengths_m: must be a list of numbers"] * 2,
        "colour g: weights: must be one for each wavelength",  # of no number at all
    )
    for line, start in zip(told, wanted, strict=True):
        assert line.startswith(f"InputError {start}")
    assert last == "True"
