"""Light behind apertures of any mask, against closed forms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from fab.aperture import MaskAperture, RectangularAperture
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, Variation
from sim.aperture import displaced_cells, open_cells
from sim.camera import Camera, Colour
from sim.metrics import energy_budget, opening
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.surface import FabricatedDoe, as_fabricated

WAVE_M, FOCAL_M, PITCH_M, SIDE = 550e-9, 4e-3, 4e-6, 96
GREEN = (Colour("green", (WAVE_M,), (1.0,)),)
GRID = Grid((SIDE, SIDE), PITCH_M)


def mask_of(boxes: list[tuple[int, int, int, int]]) -> MaskAperture:
    """Boxes y0, x0, y1, x1 in cells, one after the other: what an even number of them covers is closed."""
    plane = np.zeros(GRID.shape, bool)
    for y0, x0, y1, x1 in boxes:
        plane[y0:y1, x0:x1] ^= True
    return MaskAperture.of(plane, PITCH_M)


TWO_SLITS = [(24, 16, 72, 32), (24, 64, 72, 80)]
RING = [(8, 8, 88, 88), (24, 24, 72, 72)]  # a square frame about the middle
CROSS = [(8, 40, 88, 56), (40, 8, 56, 40), (40, 56, 56, 88)]
ASIDE = [(10, 12, 34, 28), (60, 70, 80, 94)]  # with nothing in the middle


def camera_of(aperture: MaskAperture, **changes) -> Camera:
    return replace(Camera(GRID, aperture, "fused_silica", GREEN, FOCAL_M, 1.5e-6, 41), **changes)


def expected(boxes: list[tuple[int, int, int, int]], camera: Camera, points: int = 60) -> np.ndarray:
    """Light of boxes on every pixel: the square of the sum of their sinc functions, each about its middle, by the
    midpoint rule. The sign of a box follows from whether others cover it."""
    inside = ((np.arange(points) + 0.5) / points - 0.5) * camera.pixel_m
    places = (camera.axis_m()[:, None] + inside).ravel() / (WAVE_M * FOCAL_M)

    def factor(low: int, high: int) -> np.ndarray:
        side, middle = (high - low) * PITCH_M, ((low + high) / 2 - SIDE / 2) * PITCH_M
        return side * np.sinc(side * places) * np.exp(-2j * np.pi * middle * places)

    field, area = np.zeros((len(places), len(places)), complex), 0.0
    for number, (y0, x0, y1, x1) in enumerate(boxes):
        holes = sum(a <= y0 and b <= x0 and y1 <= c and x1 <= d for a, b, c, d in boxes[:number])
        field += (-1) ** holes * np.outer(factor(y0, y1), factor(x0, x1))
        area += (-1) ** holes * (y1 - y0) * (x1 - x0) * PITCH_M**2
    light = np.abs(field) ** 2 / area / (WAVE_M * FOCAL_M) ** 2 * camera.pixel_m**2
    shape = (camera.window, points, camera.window, points)
    return light.reshape(shape).mean(axis=(1, 3)) * camera.transmission(WAVE_M)


def test_two_slits_are_a_cosine_squared_times_a_sinc_squared():
    """The closed form of `expected` is that of the textbook."""
    camera = camera_of(mask_of(TWO_SLITS), window=31, pixel_m=0.05e-6)  # points, next to pixels
    at = camera.axis_m() / (WAVE_M * FOCAL_M)
    height, width, apart = 48 * PITCH_M, 16 * PITCH_M, 48 * PITCH_M
    along_x = width * np.sinc(width * at) ** 2 * 2 * np.cos(np.pi * apart * at) ** 2
    per_m = camera.pixel_m / (WAVE_M * FOCAL_M)
    wanted = np.outer(height * np.sinc(height * at) ** 2, along_x) * per_m**2 * camera.transmission(WAVE_M)
    np.testing.assert_allclose(expected(TWO_SLITS, camera), wanted, rtol=2e-3, atol=1e-4 * wanted.max())


@pytest.mark.parametrize("boxes", [TWO_SLITS, RING, CROSS, ASIDE], ids=["two slits", "ring", "cross", "aside"])
def test_the_psf_of_a_mask_is_that_of_its_boxes(boxes):
    camera = camera_of(mask_of(boxes))
    got, wanted = psf(HeightOptic.of(camera)).energy[0, 0], expected(boxes, camera)
    # As for a rectangle: the rule of the samples promises 0.2 %.
    assert np.linalg.norm(got - wanted) < 4e-3 * np.linalg.norm(wanted)
    assert float(got.sum()) == pytest.approx(wanted.sum(), rel=1e-3)


def test_the_direct_path_agrees():
    fine = Grid((192, 192), 2e-6)
    plane = np.kron(mask_of(TWO_SLITS).plane, np.ones((2, 2), bool))
    camera = camera_of(MaskAperture.of(plane, 2e-6), grid=fine, window=21)
    direct, wanted = psf(HeightOptic.of(camera), propagation="fresnel").energy[0, 0], expected(TWO_SLITS, camera)
    assert np.linalg.norm(direct - wanted) < 0.02 * np.linalg.norm(wanted)


def test_a_mask_that_is_a_rectangle_images_like_it():
    box, middle = RectangularAperture((48 * PITCH_M, 64 * PITCH_M)), [(24, 16, 72, 80)]
    height = np.random.default_rng(1).uniform(0, 1e-6, GRID.shape).astype(np.float32)
    for overlap_m in (0.0, 5e-6, 8e-6):
        cameras = [camera_of(one.shrunk(overlap_m)) for one in (mask_of(middle), box)]  # type: ignore[attr-defined]
        images = [np.asarray(psf(HeightOptic.of(camera, height)).energy[0, 0]) for camera in cameras]
        np.testing.assert_allclose(images[0], images[1], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("boxes", [RING, ASIDE], ids=["ring", "aside"])
def test_energy_is_per_light_on_the_mask_and_the_budget_sums_to_one(boxes):
    camera = camera_of(mask_of(boxes), window=201)
    optic = HeightOptic.of(camera)
    assert float(opening(optic, WAVE_M)) == pytest.approx(1.0, rel=1e-6)
    bank = psf(optic)
    assert float(bank.energy.sum()) == pytest.approx(expected(boxes, camera, 8).sum(), rel=1e-3)
    smaller = HeightOptic.of(replace(camera, aperture=mask_of(boxes).shrunk(5e-6)))
    for one in (optic, smaller):
        budget = energy_budget(one, psf(one).energy[0, 0], np.inf, camera.colours[0])
        assert sum(budget) == pytest.approx(1.0, abs=1e-6)
        assert min(budget) >= 0
    assert float(opening(smaller, WAVE_M)) == pytest.approx(1.0, rel=1e-6)


# The open share of cells, as counted on a raster of which every cell has 16 x 16 samples.
FINE = 16
STEP_M = PITCH_M / FINE
SMALL = Grid((40, 56), PITCH_M)


def blocks(seed: int) -> np.ndarray:
    """Blocks of 4 x 4 cells within a closed rim; some touch at corners."""
    plane = np.random.default_rng(seed).random((8, 12)) < 0.5
    return np.pad(np.kron(plane, np.ones((4, 4), bool)), 4)


def counted(plane: np.ndarray, inward: int, steps: tuple[int, int]) -> np.ndarray:
    """Open share of every cell with the rim moved inward, and all moved up and right, by so many samples."""
    found = np.kron(plane, np.ones((FINE, FINE), bool))
    found = binary_erosion(found, np.ones((2 * inward + 1, 2 * inward + 1), bool)) if inward else found
    found = np.roll(found, steps, (0, 1))
    return found.reshape(SMALL.shape[0], FINE, SMALL.shape[1], FINE).mean(axis=(1, 3))


@pytest.mark.parametrize(
    ("inset", "wider", "steps"), [(12, 0, (0, 0)), (12, 8, (5, -31)), (20, -6, (-16, 8)), (4, 8, (3, 3))]
)
def test_a_mask_that_lies_off_and_is_wider_covers_the_counted_areas(inset, wider, steps):
    plane = blocks(3)
    mask = MaskAperture.of(plane, PITCH_M).shrunk(inset * STEP_M)
    wanted = counted(plane, inset - wider // 2, steps)
    wider_m, centre_m = wider * STEP_M, (steps[0] * STEP_M, steps[1] * STEP_M)
    got = np.asarray(displaced_cells(SMALL, mask, wider_m, centre_m))
    np.testing.assert_allclose(got, wanted, atol=1e-6)
    if not any((wider, *steps)):
        np.testing.assert_array_equal(open_cells(SMALL, mask), got)
    traced = np.asarray(jax.jit(lambda w, c: displaced_cells(SMALL, mask, w, c))(wider_m, centre_m))
    # Places of 1e-4 m in single precision are right to 1e-11 m.
    np.testing.assert_allclose(traced, wanted, atol=2e-5)
    # Cells that are open or closed are so exactly.
    whole = (wanted == 0) | (wanted == 1)
    np.testing.assert_array_equal(traced[whole], wanted[whole])


def test_a_mask_wider_than_its_cells_grows_but_for_parts_that_meet():
    plane = np.zeros(SMALL.shape, bool)
    plane[8:30, 10:20] = plane[12:20, 20:40] = True
    mask = MaskAperture.of(plane, PITCH_M)
    got = np.asarray(displaced_cells(SMALL, mask, 8 * STEP_M, (0.0, 0.0)))
    fine = np.kron(~np.pad(plane, 1), np.ones((FINE, FINE), bool))
    shrunk = binary_erosion(fine, np.ones((9, 9), bool), border_value=1)[FINE:-FINE, FINE:-FINE]
    wanted = 1 - shrunk.reshape(SMALL.shape[0], FINE, SMALL.shape[1], FINE).mean(axis=(1, 3))
    np.testing.assert_allclose(got, wanted, atol=2e-5)


def test_the_slope_of_the_open_area_is_the_length_of_the_rim():
    plane = blocks(5)
    mask = MaskAperture.of(plane, PITCH_M).shrunk(3e-6)
    loops = mask.outlines_m(4)
    rim_m = sum(float(np.abs(np.roll(loop, -1, axis=0) - loop).sum()) for loop in loops)
    around = [np.sign(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) for x, y in (loop.T for loop in loops)]

    def area(wider_m, y_m, x_m):
        return displaced_cells(SMALL, mask, wider_m, (y_m, x_m)).sum() * PITCH_M**2

    wider, y, x = jax.grad(area, (0, 1, 2))(0.07e-6, 0.3e-6, 0.2e-6)
    # A part has four more corners that point outward than inward, and the rim of a hole four less.
    assert float(wider) == pytest.approx(rim_m / 2 + 4 * sum(around) * 0.07e-6 / 2, rel=1e-4)
    assert abs(float(y)) + abs(float(x)) < 1e-7


@pytest.mark.parametrize("pitch_m", [0.5e-6, 1.85e-6, 40e-6])
def test_cells_of_a_large_mask_are_found_tile_by_tile(pitch_m):
    """A window of lines about each tile is all that is looked at."""
    grid = Grid((150, 210), pitch_m)
    plane = np.random.default_rng(2).random((30, 42)) < 0.5
    mask = MaskAperture.of(np.kron(plane, np.ones((5, 5), bool)), pitch_m).shrunk(0.3 * pitch_m)
    errors = 0.2 * pitch_m, (1.7 * pitch_m, -3.3 * pitch_m)
    wanted = np.asarray(displaced_cells(grid, mask, *errors))
    traced = jax.jit(lambda w, c: displaced_cells(grid, mask, w, c))(jnp.float32(errors[0]), errors[1])
    np.testing.assert_allclose(np.asarray(traced), wanted, atol=1e-4)


def fabricated(parts: int) -> FabricatedDoe:
    """A plate whose chrome lies off and is wider, drawn in cells, or the same in parts of them."""
    level = np.random.default_rng(3).integers(0, 4, (48, 48)).astype(np.uint8)
    plane = np.zeros((48, 48), bool)
    plane[8:40, 6:18] = plane[8:40, 30:42] = plane[20:28, 18:30] = True  # an H
    mask = MaskAperture.of(np.kron(plane, np.ones((parts, parts), bool)), PITCH_M / parts).shrunk(3e-6)
    grid = Grid((48 * parts, 48 * parts), PITCH_M / parts)
    camera = camera_of(mask, grid=grid, window=48, pixel_m=4e-6)
    errors = Variation(chrome_x_m=2.2e-6, chrome_y_m=-1e-6, chrome_diameter_m=1.5e-6, overlay_x_m=(0.2e-6, 0.0))
    return as_fabricated(np.kron(level, np.ones((parts, parts), np.uint8)), camera, Process(Levels(4, 0.3e-6)), errors)


def test_chrome_that_lies_off_and_is_wider_opens_the_exact_areas():
    doe = fabricated(1)
    # The H has bars of 12 x 32 and one of 12 x 8 cells; its rim lies 3 um in, and the chrome is wider by 1.5 um.
    inward_um = 3 - 0.75
    bars = 2 * (12 * 4 - 2 * inward_um) * (32 * 4 - 2 * inward_um) + (12 * 4 + 2 * inward_um) * (8 * 4 - 2 * inward_um)
    assert float(np.asarray(doe.coverage).sum()) * 16 == pytest.approx(bars, rel=1e-5)
    nominal = 2 * (48 - 6) * (128 - 6) + (48 + 6) * (32 - 6)
    assert float(opening(doe, WAVE_M)) == pytest.approx(bars / nominal, rel=1e-5)


@pytest.mark.slow
def test_light_through_cells_on_the_rim_is_that_of_finer_cells():
    images = [psf(fabricated(parts)).energy[0, 0] for parts in (1, 4)]
    # As for a rectangle: its corners, and a rim that is even within a sixth of a cell.
    assert np.linalg.norm(images[0] - images[1]) < 0.01 * np.linalg.norm(images[1])


def test_a_fabricated_plate_behind_a_mask_that_is_a_rectangle_is_the_same():
    level = np.random.default_rng(4).integers(0, 4, (48, 48)).astype(np.uint8)
    plane = np.zeros((48, 48), bool)
    plane[8:40, 6:42] = True
    errors = Variation(chrome_x_m=0.7e-6, chrome_diameter_m=0.6e-6, common_depth_scale=0.01, overlay_y_m=(0.0, 0.2e-6))
    images = []
    for aperture in (MaskAperture.of(plane, PITCH_M), RectangularAperture((32 * PITCH_M, 36 * PITCH_M))):
        camera = camera_of(aperture.shrunk(3e-6), grid=Grid((48, 48), PITCH_M), window=48, pixel_m=4e-6)  # type: ignore[arg-type]
        images.append(np.asarray(psf(as_fabricated(level, camera, Process(Levels(4, 0.3e-6)), errors)).energy[0, 0]))
    assert np.linalg.norm(images[0] - images[1]) < 2e-6 * np.linalg.norm(images[1])


def test_the_brightest_pixel_is_the_area_of_the_mask():
    peaks = {}
    for name, boxes in {"ring": RING, "cross": CROSS, "slits": TWO_SLITS}.items():
        camera = camera_of(mask_of(boxes), pixel_m=0.2e-6)
        light = psf(HeightOptic.of(camera)).energy[0, 0]
        peaks[name] = float(light[20, 20]) / (camera.opening.area_m2 * camera.pixel_m**2)
    # The peak per area is 1 / (wavelength f)² and the loss of both faces, for all of them.
    wanted = camera_of(mask_of(RING)).transmission(WAVE_M) / (WAVE_M * FOCAL_M) ** 2
    assert list(peaks.values()) == pytest.approx([wanted] * 3, rel=5e-3)
