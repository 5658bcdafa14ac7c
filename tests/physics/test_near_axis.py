"""Light near the axis behind a DOE without a lens: closed forms, and sums over parts of cells written out."""

from dataclasses import replace

import numpy as np
import pytest

from fab.aperture import RectangularAperture
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.optic import HeightOptic
from sim.propagation.near_axis import Octant, profiles

WAVE, PITCH = 850e-9, 3e-6
RED = Colour("red", (WAVE,), (1.0,))


def camera(cells: int, distance_m: float = 20e-3, pitch_m: float = PITCH) -> Camera:
    grid = Grid((cells, cells), pitch_m)
    return Camera(grid, cells * pitch_m, "fused_silica", (RED,), np.inf, 1e-6, 64, distance_m=distance_m)


def thin(waves: np.ndarray, own: Camera) -> HeightOptic:
    return HeightOptic.of(own, np.float32(np.mod(waves, 1.0) / own.waves_per_metre(WAVE)))


def light_of(doe: HeightOptic, places_m: np.ndarray, distance_m: float) -> tuple[np.ndarray, float]:
    line = doe.camera.lines[0]
    return profiles(doe.camera, np.asarray(doe.field(line)), line, places_m, distance_m)


def radius_of(own: Camera) -> np.ndarray:
    return np.hypot(own.grid.axis_m("y")[:, None], own.grid.axis_m("x"))


@pytest.mark.parametrize("distance", [0.3e-3, 1e-3, 4e-3, 20e-3])
def test_behind_a_round_opening_light_on_the_axis_is_that_of_the_closed_form(distance: float):
    """The first Rayleigh-Sommerfeld integral of a disc: |1 - z / R exp(i k (R - z))|² on the axis."""
    own = camera(400, pitch_m=0.3e-6)
    field, _ = light_of(HeightOptic.of(own), np.zeros(1), distance)
    rim, area = own.aperture_m / 2, np.pi * own.aperture_m**2 / 4
    path = np.hypot(rim, distance)
    wanted = abs(1 - distance / path * np.exp(2j * np.pi / WAVE * (path - distance))) ** 2 / area
    # Cells on the rim have the light of a part of them over their whole square: 0.5 % of the amplitude.
    assert np.abs(field[:, 0]) ** 2 == pytest.approx([wanted] * 2, rel=0.02, abs=0.01 / area)


def test_the_focus_of_an_ideal_lens_is_an_airy_disc():
    own = camera(400)
    distance, waves = 60e-3, -(np.hypot(radius_of(own), 60e-3) - 60e-3) / WAVE
    airy = WAVE * distance / own.aperture_m
    places = np.array([0.0, 0.5145, 1.22]) * airy
    field, ideal = light_of(thin(waves, own), places, distance)
    light = np.abs(field) ** 2
    # A cell of the rim takes a tenth of a wave off the lens's slope: 1 - (pi / 10)² / 6 of its light.
    assert light[:, 0] == pytest.approx([ideal**2] * 2, rel=0.02)
    assert ideal**2 == pytest.approx(np.pi / 4 / airy**2, rel=1e-3)
    assert light[:, 1] / light[:, 0] == pytest.approx([0.5] * 2, abs=0.01)
    assert (light[:, 2] < 2e-4 * light[:, 0]).all()


@pytest.mark.parametrize("distance", [1.5e-3, 6e-3, 50e-3])
def test_profiles_are_those_of_a_sum_over_parts_of_cells(distance: float):
    """Random heights, not symmetric: every path written out, 9 x 9 points per cell."""
    own, parts = camera(60), 9
    waves = np.random.default_rng(3).uniform(0, 1, own.grid.shape)
    doe = thin(waves, own)
    places = np.linspace(-1, 1, 5) * WAVE * distance / own.aperture_m
    found, _ = light_of(doe, places, distance)
    at = (np.arange(60 * parts) - (60 * parts - 1) / 2) * PITCH / parts
    field = np.kron(np.asarray(doe.coverage) * np.exp(2j * np.pi * waves), np.ones((parts, parts)))
    area = np.pi * own.aperture_m**2 / 4
    for axis, along in enumerate(found):
        wanted = []
        for place in places:
            y, x = (at - place, at) if axis == 0 else (at, at - place)
            path = np.sqrt(y[:, None] ** 2 + x**2 + distance**2)
            turns = np.exp(2j * np.pi / WAVE * (path - distance))
            wanted.append(np.sum(field * distance / path**2 * turns) * (PITCH / parts) ** 2 / (1j * WAVE))
        error = np.abs(np.abs(along) ** 2 - np.abs(wanted) ** 2 / area).max() / np.abs(along).max() ** 2
        # Near the axis: (x r)² / (2 R³) is at most 0.01 waves at these places.
        assert error < 0.01


def test_the_camera_s_own_sensor_does_not_matter():
    one, other = camera(60), replace(camera(60), distance_m=7e-3)
    waves = np.random.default_rng(0).uniform(0, 1, one.grid.shape)
    light = [np.abs(light_of(thin(waves, own), np.zeros(1), 30e-3)[0]) for own in (one, other)]
    np.testing.assert_allclose(*light, rtol=1e-4)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_single_line_of_cells_has_the_light_of_its_sum(axis: int):
    """Across the line nothing changes near the axis; along it, every cell's path written out."""
    shape, sides, place = ((1, 60), (60, 1))[axis], [PITCH, 60 * PITCH], 2e-6
    opening = RectangularAperture((sides[axis], sides[1 - axis]))
    own = Camera(Grid(shape, PITCH), opening, "fused_silica", (RED,), np.inf, 1e-6, 64, distance_m=6e-3)
    waves = np.random.default_rng(5).uniform(0, 1, shape)
    found, _ = light_of(thin(waves, own), np.array([0.0, place]), 6e-3)
    assert found[axis] == pytest.approx([found[1 - axis, 0]] * 2, rel=1e-6)
    at = (np.arange(60) - 29.5) * PITCH
    path, seen = np.hypot(at, 6e-3), np.sinc(at / np.hypot(at, 6e-3) * PITCH / WAVE)
    turns = np.exp(2j * np.pi * (waves.ravel() + (path - 6e-3 - place * at / path) / WAVE))
    wanted = np.sum(turns * seen / path**2) * PITCH**2 * 6e-3 / (1j * WAVE) / np.sqrt(60 * PITCH**2)
    # Bins of directions, and the single precision of the field.
    assert abs(found[1 - axis, 1]) == pytest.approx(abs(wanted), rel=1e-4)


@pytest.mark.parametrize("cells", [61, 60])
def test_rings_of_an_octant_make_the_light_of_the_plate(cells: int):
    own = camera(cells)
    ring_m, line = PITCH / 3, own.lines[0]
    number = (radius_of(own) / ring_m).astype(int)
    heights = np.random.default_rng(1).uniform(0, 1, number.max() + 1)
    octant = Octant.of(own, np.asarray(HeightOptic.of(own).field(line)), line, ring_m)
    kernel = octant.kernel(np.zeros(1), 12e-3, line, PITCH, int(number.max()) + 1)
    wanted, _ = light_of(thin(heights[number], own), np.zeros(1), 12e-3)
    area = np.pi * own.aperture_m**2 / 4
    found = kernel[0] @ np.exp(2j * np.pi * heights) / np.sqrt(area)
    # Bins of directions on one side, single precision on both.
    assert abs(found) == pytest.approx(abs(wanted[0, 0]), rel=2e-3)
