"""Light behind a rectangular aperture, against closed forms."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from fab.aperture import RectangularAperture, RoundAperture
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, Variation
from sim.aperture import displaced_cells, open_cells
from sim.camera import Camera, Colour
from sim.metrics import energy_budget, opening
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.surface import FabricatedDoe, as_fabricated

WAVE_M, FOCAL_M, PITCH_M = 550e-9, 4e-3, 4e-6
GREEN = (Colour("green", (WAVE_M,), (1.0,)),)
HEIGHT_M, WIDTH_M = 48 * PITCH_M, 96 * PITCH_M  # whole cells
SLIT = RectangularAperture((HEIGHT_M, WIDTH_M))
CAMERA = Camera(Grid((96, 96), PITCH_M), SLIT, "fused_silica", GREEN, FOCAL_M, 1.5e-6, 41)


def sinc_squared(side_m: float, camera: Camera, points: int = 200) -> np.ndarray:
    """Share of the light of a slit that falls on every pixel along an axis, by the midpoint rule."""
    inside = ((np.arange(points) + 0.5) / points - 0.5) * camera.pixel_m
    places = camera.axis_m()[:, None] + inside
    per_m = side_m / (WAVE_M * FOCAL_M)
    return np.mean(per_m * np.sinc(per_m * places) ** 2, axis=1) * camera.pixel_m


def expected(camera: Camera) -> np.ndarray:
    height, width = camera.opening.extent_m
    return np.outer(sinc_squared(height, camera), sinc_squared(width, camera)) * camera.transmission(WAVE_M)


@pytest.mark.parametrize(("mapping", "fill"), [("sine", 1.0), ("sine", 0.6), ("tangent", 1.0)])
def test_the_psf_is_a_sinc_squared_along_either_axis(mapping, fill):
    camera = replace(CAMERA, mapping=mapping, fill=fill)
    got = psf(HeightOptic.of(camera)).energy[0, 0]
    narrow = replace(camera, pixel_m=camera.pixel_m * fill)
    # Pixels of a share of the pitch, about the same middles.
    inside = [sinc_squared(side, replace(narrow, window=1)) for side in SLIT.extent_m]
    if fill == 1.0:
        wanted = expected(camera)
        # The rule of the samples promises 0.2 %; a tangent bends places by 1e-5 here.
        assert np.linalg.norm(got - wanted) < 4e-3 * np.linalg.norm(wanted)
        assert float(got.sum()) == pytest.approx(wanted.sum(), rel=1e-3)
    else:
        brightest = camera.transmission(WAVE_M) * inside[0][0] * inside[1][0]
        assert got[20, 20] == pytest.approx(brightest, rel=3e-3)
    # The narrower side spreads light more: first dark lines at wavelength x focal length / side.
    across, along = got[:, 20], got[20]
    dark_y, dark_x = (WAVE_M * FOCAL_M / side / camera.pixel_m for side in SLIT.extent_m)
    assert dark_y == pytest.approx(2 * dark_x)
    assert np.argmin(across[20 : 20 + 12]) == pytest.approx(dark_y, abs=0.6)
    assert np.argmin(along[20 : 20 + 6]) == pytest.approx(dark_x, abs=0.6)


def test_a_bare_transform_and_the_direct_path_agree_with_the_closed_form():
    fine = replace(CAMERA, grid=Grid((192, 192), 2e-6), window=21)
    wanted = expected(fine)
    direct = psf(HeightOptic.of(fine), propagation="fresnel").energy[0, 0]
    assert np.linalg.norm(direct - wanted) < 0.02 * np.linalg.norm(wanted)
    bare = psf(HeightOptic.of(CAMERA), sampling=1.0).energy[0, 0]
    assert float(bare.sum()) == pytest.approx(expected(CAMERA).sum(), rel=0.05)


def test_energy_is_per_light_on_the_rectangle_and_the_budget_sums_to_one():
    camera = replace(CAMERA, window=301)
    optic = HeightOptic.of(camera)
    assert float(opening(optic, WAVE_M)) == pytest.approx(1.0, rel=1e-6)
    bank = psf(optic)
    budget = energy_budget(optic, bank.energy[0, 0], np.inf, camera.colours[0])
    assert sum(budget) == pytest.approx(1.0, abs=1e-6)
    # Far wings hold 1 / (pi² n) of the light beyond n dark lines, per side and axis.
    assert float(bank.energy.sum()) == pytest.approx(expected(camera).sum(), rel=1e-3)
    assert 0 < budget.higher_orders < 5e-3


def exact_area(grid: Grid, size_m: tuple[float, float], centre_m: tuple[float, float]) -> np.ndarray:
    parts = []
    for axis, side, middle in zip(("y", "x"), size_m, centre_m, strict=True):
        low, high = middle - side / 2, middle + side / 2
        edges = grid.axis_m(axis) - grid.pitch_m / 2
        parts.append(np.clip(np.minimum(edges + grid.pitch_m, high) - np.maximum(edges, low), 0, None) / grid.pitch_m)
    return np.outer(*parts)


@pytest.mark.parametrize("centre_m", [(0.0, 0.0), (1.3e-6, -7.7e-6), (-4e-6, 8e-6)])
@pytest.mark.parametrize("wider_m", [0.0, 2.5e-6, -1.1e-6])
def test_a_displaced_rectangle_covers_the_exact_areas(centre_m, wider_m):
    grid, slit = Grid((60, 110), PITCH_M), RectangularAperture((150e-6, 301e-6))
    wanted = exact_area(grid, (150e-6 + wider_m, 301e-6 + wider_m), centre_m)
    got = np.asarray(displaced_cells(grid, slit, wider_m, centre_m))
    np.testing.assert_allclose(got, wanted, atol=1e-6)
    if not any((*centre_m, wider_m)):
        np.testing.assert_array_equal(open_cells(grid, slit), got)
    traced = jax.jit(lambda w, c: displaced_cells(grid, slit, w, c))(wider_m, centre_m)
    # Places of 1e-4 m in single precision are right to 1e-11 m.
    np.testing.assert_allclose(np.asarray(traced), wanted, atol=1e-5)


def test_the_slope_of_the_open_area_is_the_length_of_the_rim():
    grid, slit = Grid((60, 110), PITCH_M), RectangularAperture((150e-6, 301e-6))

    def area(wider_m, y_m, x_m):
        return displaced_cells(grid, slit, wider_m, (y_m, x_m)).sum() * PITCH_M**2

    wider, y, x = jax.grad(area, (0, 1, 2))(0.7e-6, 0.3e-6, 0.2e-6)
    assert float(wider) == pytest.approx(150e-6 + 301e-6 + 2 * 0.7e-6, rel=1e-4)
    assert abs(float(y)) + abs(float(x)) < 1e-8  # what one side gains the other loses


def fabricated(parts: int) -> FabricatedDoe:
    """A plate whose chrome lies off and is wider, drawn in cells, or the same in parts of them."""
    level = np.random.default_rng(3).integers(0, 4, (48, 48)).astype(np.uint8)
    camera = replace(CAMERA, aperture=RectangularAperture((90e-6, 180e-6)), window=48, pixel_m=4e-6)
    camera = replace(camera, grid=Grid((48 * parts, 48 * parts), PITCH_M / parts))
    errors = Variation(chrome_x_m=2.2e-6, chrome_y_m=-1e-6, chrome_diameter_m=1.5e-6, overlay_x_m=(0.2e-6, 0.0))
    drawn = np.kron(level, np.ones((parts, parts), np.uint8))
    return as_fabricated(drawn, camera, Process(Levels(4, 0.3e-6)), errors)


def test_chrome_that_lies_off_and_is_wider_opens_the_exact_areas():
    doe = fabricated(1)
    wanted = exact_area(doe.grid, (91.5e-6, 181.5e-6), (-1e-6, 2.2e-6))
    np.testing.assert_allclose(np.asarray(doe.coverage), wanted, atol=1e-5)
    assert float(opening(doe, WAVE_M)) == pytest.approx((91.5 * 181.5) / (90 * 180), rel=1e-5)


@pytest.mark.slow
def test_light_through_cells_on_the_rim_is_that_of_finer_cells():
    images = [psf(fabricated(parts)).energy[0, 0] for parts in (1, 4)]
    # What the edge optic of a cell leaves out: the opening's corners, and a rim that is even within a sixth of a cell.
    assert np.linalg.norm(images[0] - images[1]) < 0.01 * np.linalg.norm(images[1])


def test_a_square_of_the_area_of_a_disc_passes_as_much():
    side = float(np.sqrt(np.pi)) / 2 * 300e-6
    square = replace(CAMERA, aperture=RectangularAperture((side, side)), window=255)
    disc = replace(CAMERA, aperture=RoundAperture(300e-6), window=255)
    assert square.opening.area_m2 == pytest.approx(disc.opening.area_m2)
    peaks = [psf(HeightOptic.of(one)).energy[0, 0].max() for one in (square, disc)]
    # The peak of either is area / (wavelength f)², but for the width of a pixel.
    assert peaks[0] == pytest.approx(peaks[1], rel=0.02)


def plates(shape: tuple[int, int], side: int) -> list[Camera]:
    """A slit on a raster that it fills, and on a square one with cells to spare."""
    slit = RectangularAperture((shape[0] * PITCH_M, shape[1] * PITCH_M))
    return [replace(CAMERA, grid=Grid(grid, PITCH_M), aperture=slit) for grid in (shape, (side, side))]


def on_square(map_: np.ndarray, side: int) -> np.ndarray:
    """A map with blank cells around it, as many on either side."""
    return np.pad(map_, [((side - n) // 2,) * 2 for n in map_.shape])


@pytest.mark.parametrize(
    ("shape", "side", "way"),
    [
        ((48, 96), 96, {}),
        ((48, 96), 96, {"depths": 0.05}),
        ((97, 49), 97, {"sampling": 1.0}),
        pytest.param((97, 49), 97, {"mapping": "tangent"}, marks=pytest.mark.slow),
        ((97, 49), 97, {"propagation": "fresnel"}),
    ],
    ids=str,
)
def test_a_plate_that_is_not_square_images_like_a_square_one_around_it(shape, side, way):
    height = np.random.default_rng(1).uniform(0, 1e-6, shape).astype(np.float32)
    given = {key: value for key, value in way.items() if key != "mapping"}
    images = []
    for camera, map_ in zip(plates(shape, side), (height, on_square(height, side)), strict=True):
        lens = replace(camera, mapping=way["mapping"]) if "mapping" in way else camera
        lens = replace(lens, focal_length_m=30e-3, window=21) if "propagation" in way else lens
        images.append(np.asarray(psf(HeightOptic.of(lens, map_), **given).energy[0, 0], np.float64))
    # The same sums in single precision, but for how blocks of rows are rounded.
    assert np.linalg.norm(images[0] - images[1]) < 2e-5 * np.linalg.norm(images[1])


def test_gradients_of_a_plate_that_is_not_square_are_those_of_the_square():
    shape, side = (24, 40), 40
    height = np.random.default_rng(2).uniform(0, 1e-6, shape).astype(np.float32)
    found = []
    for camera, map_ in zip(plates(shape, side), (height, on_square(height, side)), strict=True):
        small = replace(camera, window=15)
        found.append(np.asarray(jax.grad(lambda h, c=small: psf(h, c).energy[0, 0, 7, 5])(jax.numpy.asarray(map_))))
    inner = found[1][8:32]
    assert np.linalg.norm(found[0] - inner) < 1e-4 * np.linalg.norm(inner)


def test_a_plate_of_an_odd_and_an_even_number_of_cells_has_the_psf_of_closed_form():
    camera = plates((49, 96), 96)[0]
    got, wanted = psf(HeightOptic.of(camera)).energy[0, 0], expected(camera)
    assert np.linalg.norm(got - wanted) < 4e-3 * np.linalg.norm(wanted)
    budget = energy_budget(HeightOptic.of(camera), got, np.inf, camera.colours[0])
    assert sum(budget) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["scalar", "edges"])
def test_a_fabricated_plate_that_is_not_square_is_the_middle_of_a_square_one(light):
    levels, shape, side = Levels(4, 0.3e-6), (40, 72), 72
    level = np.random.default_rng(4).integers(0, 4, shape).astype(np.uint8)
    errors = Variation(overlay_x_m=(0.3e-6, 0.0), common_depth_scale=0.02, chrome_y_m=0.6e-6)
    images = []
    blank = np.full((side, side), 3, np.uint8)
    blank[16:56] = level
    for camera, map_ in zip(plates(shape, side), (level, blank), strict=True):
        # Cells beyond the raster are under chrome in the square one.
        small = replace(camera, aperture=RectangularAperture((120e-6, 240e-6)), window=48, pixel_m=4e-6, light=light)
        images.append(psf(as_fabricated(map_, small, Process(levels), errors)).energy[0, 0])
    # Weights of moments are fitted anew at the border of a raster, a few cells from the opening here.
    assert np.linalg.norm(images[0] - images[1]) < 1e-3 * np.linalg.norm(images[1])
