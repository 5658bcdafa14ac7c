"""Light without a lens: near the DOE against direct sums of Rayleigh and Sommerfeld, far from it against both paths."""

from dataclasses import replace

import numpy as np
import pytest

from fab.aperture import RectangularAperture
from fab.errors import InputError
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.illumination import EvenBeam
from sim.metrics import energy_budget
from sim.optic import HeightOptic
from sim.psf_bank import psf

WAVE = 850e-9
PITCH = 4e-6
PARTS = 12  # of a cell, per axis: a third of a micrometre, over which phases change by an eighth of a wave at most
CAMERA = Camera(
    grid=Grid((64, 64), PITCH),
    aperture=256e-6,
    material="fused_silica",
    colours=(Colour("infrared", (WAVE,), (1.0,)),),
    focal_length_m=np.inf,
    pixel_m=1.5e-6,
    window=40,
    distance_m=2e-3,
)


def lens_height_m(focal_m: float, camera: Camera = CAMERA) -> np.ndarray:
    square = camera.grid.axis_m("y")[:, None] ** 2 + camera.grid.axis_m("x") ** 2
    wave = 1 / camera.waves_per_metre(WAVE)
    return np.mod(-(np.sqrt(square + focal_m**2) - focal_m) / WAVE, 1.0) * wave


def rayleigh_sommerfeld(camera: Camera, height_m: np.ndarray, at_m: np.ndarray) -> np.ndarray:
    """Intensity at places `[point, (y, x)]` of unit light through the DOE, by a sum over the parts of every cell.

    The first integral of Rayleigh and Sommerfeld (J. W. Goodman, Introduction to Fourier Optics, §3.5).
    """
    assert camera.distance_m is not None
    offsets = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * camera.grid.pitch_m
    axis = (camera.grid.axis_m("y")[:, None] + offsets).ravel()
    # Cells on the rim are grey, as everywhere: what that costs is told apart (`doedesign.design.accuracy`).
    open_ = np.asarray(circle_coverage(camera.grid, camera.aperture_m), np.float64)
    y, x = np.nonzero(np.kron(open_, np.ones((PARTS, PARTS))))
    field = (open_ * np.exp(2j * np.pi * camera.waves_per_metre(WAVE) * height_m))[y // PARTS, x // PARTS]
    area, wavenumber, depth = (camera.grid.pitch_m / PARTS) ** 2, 2 * np.pi / WAVE, camera.distance_m
    found = []
    for row, column in at_m:
        far = np.sqrt((axis[y] - row) ** 2 + (axis[x] - column) ** 2 + depth**2)
        kernel = depth / (2 * np.pi * far**2) * (1 / far - 1j * wavenumber) * np.exp(1j * wavenumber * far)
        found.append(np.abs(np.sum(field * kernel) * area) ** 2)
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distance_m", "way"),
    [
        (0.4e-3, "angular_spectrum"),
        pytest.param(1e-3, "angular_spectrum", marks=pytest.mark.slow),
        (2e-3, "far_field"),
        pytest.param(40e-3, "far_field", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("kind", ["lens", "random"])
def test_light_is_that_of_rayleigh_and_sommerfeld(distance_m: float, way: str, kind: str):
    camera = replace(CAMERA, distance_m=distance_m, pixel_m=max(1e-6, WAVE * distance_m / 256e-6 / 8))
    assert camera.propagation == way
    if kind == "lens":
        height = lens_height_m(distance_m)
    else:
        rough = np.random.default_rng(5).uniform(0, 1, (16, 16)) / camera.waves_per_metre(WAVE)
        height = np.kron(rough, np.ones((4, 4)))
    image = np.asarray(psf(HeightOptic.of(camera, height)).energy[0, 0], np.float64)
    axis = camera.axis_m()
    rows = np.arange(4, 37, 5)  # 19 is beside the axis
    points = np.array([(axis[row], axis[column]) for row in rows for column in rows])
    # A pixel is small beside what light can draw, and its mean is that of four places in it.
    quarter = camera.pixel_m / np.sqrt(12)
    corners = [points + quarter * np.array([dy, dx]) for dy in (-1, 1) for dx in (-1, 1)]
    direct = np.mean([rayleigh_sommerfeld(camera, height, at) for at in corners], axis=0)
    direct *= camera.pixel_m**2 / (np.pi * camera.aperture_m**2 / 4) * camera.transmission(WAVE)
    found = image[np.ix_(rows, rows)].ravel()
    assert np.linalg.norm(found - direct) < 0.01 * np.linalg.norm(direct)


@pytest.mark.parametrize(("from_m", "as_beam"), [(1.5e-3, True), (1.5e-3, False), (6e-3, False)])
def test_a_near_point_lights_cells_as_it_lights_parts_of_them(from_m: float, as_beam: bool):
    """Up to 0.4 waves per cell at the rim, which goes on within the cell: the same relief on cells of a fourth."""
    relief = 100e-9 * np.random.default_rng(2).integers(0, 8, (64, 64))
    found = []
    for parts in (1, 4):
        beam, depth = (EvenBeam(from_m), np.inf) if as_beam else (None, from_m)
        grid, aperture = Grid((64 * parts, 64 * parts), PITCH / parts), RectangularAperture((256e-6, 256e-6))
        camera = replace(CAMERA, grid=grid, aperture=aperture, pixel_m=4e-6, window=64, beam=beam)
        height = np.kron(relief, np.ones((parts, parts)))
        found.append(np.asarray(psf(height, camera, [depth]).energy[0, 0], np.float64))
    # An eighth of a wave across a sample at the rim. With cells lit evenly 0.05 and 0.46.
    assert np.linalg.norm(found[0] - found[1]) < 0.01 * np.linalg.norm(found[1])


def test_a_lens_focuses_into_its_airy_disc():
    image = psf(HeightOptic.of(CAMERA, lens_height_m(2e-3)))
    # 84 % of what goes into the first order: the cells' sinc² of 0.3 at the rim leaves 87 % of the light there.
    within = np.asarray(image.encircled_energy([1.22 * WAVE * 2e-3 / 256e-6]))[0, 0]
    assert 0.65 < within / CAMERA.transmission(WAVE) < 0.84


def test_the_budget_adds_up_without_a_lens():
    optic = HeightOptic.of(CAMERA, lens_height_m(2e-3))
    budget = energy_budget(optic, np.asarray(psf(optic).energy[0, 0]), np.inf, CAMERA.colours[0])
    assert sum(budget) == pytest.approx(1, abs=1e-6)
    assert budget.blocked == 0
    assert budget.uncollected > -0.01
    assert budget.window_beside_spot + budget.far_spot > 0.6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"distance_m": None}, "a lens, or a sensor"),
        ({"focal_length_m": 0.1}, "a lens, or a sensor"),
        ({"mapping": "tangent"}, "without a lens"),
        ({"doe_distance_m": 0.1}, "without a lens"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, object], words: str):
    with pytest.raises(InputError, match=words):
        replace(CAMERA, **changes)  # pyright: ignore[reportArgumentType]


def along_a_chief_ray(camera: Camera, height_m: np.ndarray, angle_rad: float, at_m: np.ndarray) -> np.ndarray:
    """Intensity at places along x about the chief ray of plane light at an angle, on a sensor square to the axis."""
    assert camera.distance_m is not None
    offsets = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * camera.grid.pitch_m
    axis = (camera.grid.axis_m("y")[:, None] + offsets).ravel()
    fine = np.ones((PARTS, PARTS))
    rate = camera.waves_per_metre(WAVE, (0.0, angle_rad))
    field = np.kron(circle_coverage(camera.grid, camera.aperture_m) * np.exp(2j * np.pi * rate * height_m), fine)
    field = field * np.exp(2j * np.pi / WAVE * axis * np.sin(angle_rad))
    found = []
    for place in camera.distance_m * np.tan(angle_rad) + at_m:
        far = np.sqrt(axis[:, None] ** 2 + (axis - place) ** 2 + camera.distance_m**2)
        found.append(np.abs(np.sum(field * np.exp(2j * np.pi / WAVE * far) / far**2)) ** 2)
    return np.array(found)


def test_light_too_far_aslant_for_a_sensor_without_a_lens_is_refused():
    """At the largest angle that is taken a focus is as on the axis; at six times it, a fifth as bright."""
    # A smaller DOE than elsewhere in this file, for the sums.
    camera = replace(CAMERA, grid=Grid((32, 32), PITCH), aperture=128e-6, distance_m=1e-3)
    height = lens_height_m(1e-3, camera)
    optic = HeightOptic.of(camera, height)
    with pytest.raises(InputError, match=r"field_rad: without a lens, light must arrive within [\d.]+ deg.*got 30 deg"):
        psf(optic, field_rad=(0.0, np.pi / 6))
    steepest = np.arcsin(camera._steepest_sine)
    assert 0.03 < steepest < 0.1
    places = np.arange(-4, 5) * 1e-6
    upright, limit, beyond = (
        along_a_chief_ray(camera, height, angle, places) for angle in (0.0, 0.98 * steepest, 6 * steepest)
    )
    # A Strehl ratio of 0.98, obliquity, and places that are farther apart by 1 %.
    assert limit == pytest.approx(upright, abs=0.04 * upright.max())
    assert beyond.max() < 0.2 * upright.max()
    psf(optic, field_rad=(0.0, 0.98 * steepest))


def test_a_window_beyond_the_grid_is_refused_with_its_limit():
    camera = replace(CAMERA, window=600)
    with pytest.raises(InputError, match="three apertures"):
        psf(HeightOptic.of(camera))


def test_the_budget_of_a_near_point_is_that_of_its_beam_and_of_parts_of_cells():
    """A fifth of the band at the rim: light of a depth, of a beam from there, and on cells of half the width."""
    relief, from_m, found = 100e-9 * np.random.default_rng(2).integers(0, 8, (64, 64)), 8e-3, []
    for beam, depth_m, parts in ((None, from_m, 1), (EvenBeam(from_m), np.inf, 1), (None, from_m, 2)):
        grid, aperture = Grid((64 * parts, 64 * parts), PITCH / parts), RectangularAperture((256e-6, 256e-6))
        camera = replace(CAMERA, grid=grid, aperture=aperture, beam=beam)
        optic = HeightOptic.of(camera, np.kron(relief, np.ones((parts, parts))))
        dark = np.zeros((camera.window, camera.window))  # so that all light of the band is `uncollected`
        found.append(energy_budget(optic, dark, depth_m, camera.colours[0], pitch_m=PITCH))
    assert found[0].higher_orders > 0.1
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-6)  # single precision of the fields
    # Light within a cell is interpolated between three directions: 1e-5 here, and 1e-2 of it at four times the angle.
    np.testing.assert_allclose(found[2], found[0], rtol=0, atol=1e-4)
