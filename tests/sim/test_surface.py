"""The plate as fabricated, where the answer is known exactly; tests/physics compares it with a raster."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import relative_error
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels, height_of, level_map_from_planes, planes
from fab.process import Disc, MaskDisc, Process, Variation, error_names, variation_of
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.optic import HeightOptic
from sim.propagation.pupil import cis
from sim.psf_bank import psf
from sim.surface import FabricatedDoe, as_fabricated
from sim.surface.relief import TilePlan, plan_of

PITCH_M = 1.85e-6
CELLS = 48
LEVELS = Levels(16, 75e-9)
PROCESS = Process(LEVELS)
GRID = Grid((CELLS, CELLS), PITCH_M)
LINES_M = (656e-9, 486e-9)
CAMERA = Camera(
    GRID,
    1.5 * CELLS * PITCH_M,  # wider than the grid: all cells are open
    "fused_silica",
    tuple(Colour(name, (line,), (1.0,)) for name, line in zip(("red", "blue"), LINES_M, strict=True)),
    1e-3,
    3.7e-6,
    48,
)
# Both are polynomials for the same wave, good to 4e-6, and heights of a micrometre are rounded to 1e-7 of a wave.
SAME_LIGHT = 1e-5


NOTHING = Variation()


ROUND = dataclasses.replace(CAMERA, aperture=0.9 * CELLS * PITCH_M)


def plate(
    level: np.ndarray, variation: Variation = NOTHING, process: Process = PROCESS, camera: Camera = CAMERA
) -> FabricatedDoe:
    return as_fabricated(level, camera, process, variation, depths_m=(4e-3, np.inf))


@pytest.fixture(scope="module")
def level() -> np.ndarray:
    """Random levels in the middle, blank around."""
    inner = np.random.default_rng(3).integers(0, 16, (CELLS - 12, CELLS - 12)).astype(np.uint8)
    return np.pad(inner, 6, constant_values=15)


def test_parts_of_a_plate_join_to_the_whole():
    """Ten rows of tiles, in two parts; and all of them in one program, as in a trace."""
    shape = (300, 40)
    camera = dataclasses.replace(CAMERA, grid=Grid(shape, PITCH_M), aperture=1.2 * max(shape) * PITCH_M)
    level = np.random.default_rng(4).integers(0, 16, shape).astype(np.uint8)
    errors = Variation(overlay_y_m=(0.4e-6, -0.3e-6, 0.5e-6, 0.0), cd_bias_m=(0.1e-6, 0.0, 0.05e-6, -0.1e-6))
    made = as_fabricated(level, camera, PROCESS, errors)
    whole = jax.jit(lambda traced: as_fabricated(level, camera, PROCESS, traced).transmission)(errors)
    assert made.transmission.shape == whole.shape == (2, *shape)
    # Sums of single precision in another order.
    np.testing.assert_allclose(made.transmission, whole, atol=2e-6)


def test_errors_of_a_plate_go_with_their_wavelength(level: np.ndarray):
    """Before a camera of the same colours in another order, and before one of a single colour."""
    height_m = LEVELS.heights_m()[level].astype(np.float32)
    made = plate(level, Variation(common_depth_scale=0.05))
    optic = HeightOptic.of(CAMERA).made_as(made, jnp.asarray(height_m)).with_heights(jnp.asarray(height_m))
    wanted = psf(made).energy
    # Heights are added to the phase and taken away again, in single precision.
    assert relative_error(psf(optic).energy, wanted) < 1e-4
    for way in (slice(None, None, -1), slice(1, 2)):
        other = dataclasses.replace(CAMERA, colours=CAMERA.colours[way])
        assert relative_error(psf(optic.with_camera(other)).energy, wanted[way]) < 1e-4


def expected(height_m: np.ndarray) -> np.ndarray:
    """Transmission of cells of these heights, float64."""
    rates = np.array([CAMERA.waves_per_metre(line) for line in LINES_M])
    return np.exp(2j * np.pi * rates[:, None, None] * height_m)


def shifted_planes(level: np.ndarray, mask: int, by: tuple[int, int]) -> np.ndarray:
    """The level map when one mask's plane is moved by whole pixels (y, x)."""
    masks = planes(level, LEVELS)
    masks[mask] = np.roll(masks[mask], by, axis=(0, 1))
    return level_map_from_planes(masks, LEVELS)


# --- nothing wrong with the plate -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "nothing",
    [Variation(), Variation(seed=5, correlation_m=1e-6), Variation(overlay_x_m=(0.0,) * 4, repeats=(0,) * 4)],
    ids=["empty", "idle", "zeros"],
)
def test_without_errors_the_plate_is_as_drawn_bit_for_bit(level: np.ndarray, nothing: Variation):
    surface = plate(level, nothing)
    height = jnp.asarray(height_of(level, LEVELS), jnp.float32)
    wave = jax.jit(lambda rate: cis(height * rate))
    for line in LINES_M:
        drawn = np.asarray(wave(jnp.float32(CAMERA.waves_per_metre(line))))
        np.testing.assert_array_equal(np.asarray(surface.at(line)), drawn)
    np.testing.assert_array_equal(np.asarray(surface.coverage), circle_coverage(GRID, CAMERA.aperture_m))
    assert surface.wavelengths_m == LINES_M
    assert surface.grid == GRID


@pytest.mark.slow
def test_without_errors_the_bank_is_that_of_the_height_map(level: np.ndarray):
    made = psf(plate(level, camera=ROUND), depths=[4e-3, np.inf])
    drawn = psf(height_of(level, LEVELS), ROUND, [4e-3, np.inf])
    # The same field but for the order in which phases are added, in float32.
    assert relative_error(made.energy, drawn.energy.astype(np.float64)) < 1e-6
    assert (made.colours, made.depths_m, made.pixel_m) == (drawn.colours, drawn.depths_m, drawn.pixel_m)


@pytest.mark.parametrize("window", [48, 72], ids=["cells", "half cells"])
def test_from_a_field_angle_glass_delays_light_more(level: np.ndarray, window: int):
    camera, field = dataclasses.replace(CAMERA, window=window), (0.0, np.radians(25))
    nearly = Variation(common_depth_scale=1e-9, overlay_x_m=(0.0, 1e-13, 0.0, 0.0))
    made = plate(level, nearly, camera=camera)
    assert made.grid.shape == (CELLS * (1 + (window > 48)),) * 2
    found = psf(made, depths=[np.inf], field_rad=field).energy.astype(np.float64)
    drawn = psf(height_of(level, LEVELS), camera, [np.inf], field_rad=field).energy.astype(np.float64)
    assert relative_error(found, drawn) < 1e-4  # float32; measured 2e-5
    # As if lit along the axis it would be off by far more.
    straight = psf(made, depths=[np.inf]).energy.astype(np.float64)
    assert relative_error(straight, drawn) > 0.05


def test_the_wavelengths_are_those_of_the_camera_once_each_or_those_asked_for(level: np.ndarray):
    twice = dataclasses.replace(CAMERA, colours=(CAMERA.colours[1], CAMERA.colours[0], CAMERA.colours[1]))
    assert as_fabricated(level, twice, PROCESS, Variation()).wavelengths_m == LINES_M[::-1]
    only = as_fabricated(level, CAMERA, PROCESS, Variation(), (550e-9,))
    assert only.wavelengths_m == (550e-9,)
    assert only.transmission.shape == (1, CELLS, CELLS)


@pytest.mark.slow
def test_errors_that_vanish_lead_to_the_plate_as_drawn(level: np.ndarray):
    """Cut, rounded and tilted, but by next to nothing: the whole machinery against the height map."""
    tiny = Variation(
        overlay_x_m=(1e-13, -1e-13, 2e-13, 0.0),
        overlay_y_m=(0.0, 3e-13, 1e-13, -1e-13),
        common_cd_bias_m=1e-13,
        corner_radius_m=1e-12,
        sidewall_rad=1e-7,
    )
    np.testing.assert_allclose(
        np.asarray(plate(level, tiny).transmission), expected(height_of(level, LEVELS)), atol=1e-4
    )


# --- where masks lie --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mask", range(4))
@pytest.mark.parametrize("by", [(1, 0), (-1, 0), (0, 1), (0, -1)], ids=["up", "down", "right", "left"])
def test_overlay_by_a_pixel_is_a_shift_of_one_plane_by_a_pixel(level: np.ndarray, mask: int, by: tuple[int, int]):
    """Up is toward higher rows, right toward higher columns; nothing else moves."""
    y, x = ([0.0] * 4 for _ in range(2))
    y[mask], x[mask] = by[0] * PITCH_M, by[1] * PITCH_M
    surface = plate(level, Variation(overlay_y_m=tuple(y), overlay_x_m=tuple(x)))
    moved = height_of(shifted_planes(level, mask, by), LEVELS)
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(moved), atol=SAME_LIGHT)


@pytest.mark.parametrize("by", [(2, 0), (0, -2), (-1, 2)])
def test_overlay_by_several_pixels(level: np.ndarray, by: tuple[int, int]):
    """In float32 multiples of the pitch need not divide into whole numbers: a sliver of 1e-7 cells may be left."""
    surface = plate(
        level,
        Variation(overlay_y_m=(0.0, by[0] * PITCH_M, 0.0, 0.0), overlay_x_m=(0.0, by[1] * PITCH_M, 0.0, 0.0)),
    )
    moved = height_of(shifted_planes(level, 1, by), LEVELS)
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(moved), atol=SAME_LIGHT)


def test_masks_that_overlap_make_floors_of_no_level():
    """Six levels beside each other; the deepest mask of three lies a pixel off, on what the middle one etches."""
    six = Levels(6, 200e-9)
    level = np.full((CELLS, CELLS), 5, np.uint8)
    level[10:30, 12:24] = np.repeat(np.arange(6), 2)
    surface = plate(level, Variation(overlay_x_m=(0.0, 0.0, PITCH_M)), Process(six))
    # Drawn are 5 5 4 4 3 3 2 2 1 1 0 0 steps; those of 4 come a pixel later, and 7 where 3 are etched anyway.
    etched = np.array([1, 5, 4, 4, 7, 3, 2, 2, 1, 1, 0, 0])
    depth_m = np.zeros((CELLS, CELLS))
    depth_m[10:30, 12:24] = etched * 200e-9
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(1000e-9 - depth_m), atol=SAME_LIGHT)


def test_a_mask_toward_plus_y_moves_an_opening_to_higher_rows():
    """Half a cell: the opening covers half of its own row and half of the next."""
    single = np.full((CELLS, CELLS), 15, np.uint8)
    single[20, 10] = 15 - 4
    values = np.asarray(plate(single, Variation(overlay_y_m=(0.0, 0.0, PITCH_M / 2, 0.0))).at(LINES_M[0]))
    blank = expected(np.full((1, 1), 15 * 75e-9))[0, 0, 0]
    changed = np.abs(values - blank).sum(axis=1)
    assert np.abs(values[:, 10] - blank).sum() > 100 * np.abs(np.delete(values, 10, axis=1) - blank).sum()
    # What spills further makes the two rows look like an opening between them; the sum is that of one cell.
    assert set(np.argsort(changed)[-2:]) == {20, 21}
    assert changed[20] == pytest.approx(changed[21], rel=1e-3)
    step = expected(np.full((1, 1), 11 * 75e-9))[0, 0, 0] - blank
    # Against the plate's own blank cells, because 4e-6 of two thousand of them would be as much as a hundredth.
    assert (values - values[0, -1]).sum(dtype=complex) == pytest.approx(step, abs=2e-5)


def test_a_turned_mask_far_from_the_wafers_middle_is_a_shifted_one(level: np.ndarray):
    """At (y, x) a turn from +x toward +y by theta moves it by theta x toward +y and by theta y toward -x."""
    y, x = 20e-3, 30e-3
    theta = PITCH_M / x  # a pixel up, two thirds of a pixel to the left
    far = Process(LEVELS, die_m=(y, x))
    turned = plate(level, Variation(rotation_rad=(0.0, theta, 0.0, 0.0)), far)
    shift = Variation(overlay_y_m=(0.0, PITCH_M, 0.0, 0.0), overlay_x_m=(0.0, -theta * y, 0.0, 0.0))
    # Over the plate itself the turn is 0.003 cells.
    np.testing.assert_allclose(np.asarray(turned.transmission), np.asarray(plate(level, shift).transmission), atol=0.01)


def test_a_mask_that_grew_lies_further_out(level: np.ndarray):
    y, x = 20e-3, -30e-3
    growth = PITCH_M / y
    far = Process(LEVELS, die_m=(y, x))
    grown = plate(level, Variation(magnification=(0.0, growth, 0.0, 0.0)), far)
    shift = Variation(overlay_y_m=(0.0, PITCH_M, 0.0, 0.0), overlay_x_m=(0.0, growth * x, 0.0, 0.0))
    np.testing.assert_allclose(np.asarray(grown.transmission), np.asarray(plate(level, shift).transmission), atol=0.01)


@pytest.mark.parametrize("error", ["rotation_rad", "magnification"])
def test_each_tile_is_shifted_as_its_middle(level: np.ndarray, error: str):
    """The first tile reaches from row and column 0 to 31, so its middle lies 8 cells below that of 48."""
    size = 5e-3
    own = plate(level, Variation(**{error: (0.0, 0.0, size, -size)}))  # type: ignore[arg-type]
    y, x = -8 * PITCH_M * size, (-8 if error == "magnification" else 8) * PITCH_M * size
    shift = Variation(overlay_y_m=(0.0, 0.0, y, -y), overlay_x_m=(0.0, 0.0, x, -x))
    # Within twenty cells of the tile's edges its neighbours' light is mixed in.
    inside = (slice(None), slice(0, 11), slice(0, 11))
    np.testing.assert_allclose(
        np.asarray(own.transmission)[inside], np.asarray(plate(level, shift).transmission)[inside], atol=SAME_LIGHT
    )


@pytest.mark.slow
def test_three_wavelengths_together_are_those_one_by_one(level: np.ndarray):
    """Behind the chrome, and rough, so that every factor that belongs to a wavelength is there."""
    lines = (656e-9, 550e-9, 486e-9)
    rough = Variation(overlay_x_m=(0.0, 0.3e-6, 0.0, 0.0), roughness_m=20e-9, correlation_m=1e-6)
    together = as_fabricated(level, ROUND, PROCESS, rough, lines)
    for line in lines:
        alone = as_fabricated(level, ROUND, PROCESS, rough, (line,))
        np.testing.assert_allclose(np.asarray(together.at(line)), np.asarray(alone.at(line)), atol=SAME_LIGHT)
        number = together.wavelengths_m.index(line)
        np.testing.assert_allclose(np.asarray(together.means[number]), np.asarray(alone.means[0]), atol=SAME_LIGHT)


# --- how deep etches are ----------------------------------------------------------------------------------------------


def test_depth_errors_multiply_and_add_up(level: np.ndarray):
    own, common = (0.05, -0.02, 0.03, 0.01), -0.015
    depths = np.array([2**k * 75e-9 * (1 + own[k]) * (1 + common) for k in range(4)])
    height = 15 * 75e-9 - np.tensordot(depths, planes(level, LEVELS).astype(float), 1)
    surface = plate(level, Variation(depth_scale=own, common_depth_scale=common))
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(height), atol=SAME_LIGHT)


def test_a_missed_etch_leaves_its_mask_out_and_a_doubled_one_counts_twice(level: np.ndarray):
    masks = planes(level, LEVELS).astype(float)
    for repeats in ((0, -1, 0, 0), (1, 0, 0, -1)):
        depths = np.array([(1 + n) * 2**k * 75e-9 for k, n in enumerate(repeats)])
        height = 15 * 75e-9 - np.tensordot(depths, masks, 1)
        surface = plate(level, Variation(repeats=repeats))
        np.testing.assert_allclose(np.asarray(surface.transmission), expected(height), atol=SAME_LIGHT)  # pyright: ignore[reportArgumentType]


def test_a_plate_whose_only_etch_was_missed_has_no_walls():
    camera = dataclasses.replace(CAMERA, light="edges")
    drawn = np.random.default_rng(0).integers(0, 2, GRID.shape).astype(np.uint8)
    made = as_fabricated(drawn, camera, Process(Levels(2, 500e-9)), Variation(repeats=(-1,)))
    np.testing.assert_allclose(np.abs(made.transmission[0]), made.coverage, atol=SAME_LIGHT)


@pytest.mark.parametrize("shape", [(CELLS // 2, CELLS // 2), (CELLS, CELLS + 1)])
def test_a_level_map_of_another_shape_is_refused(shape: tuple[int, int]):
    with pytest.raises(ValueError, match="must have the grid's shape"):
        as_fabricated(np.zeros(shape, np.uint8), CAMERA, PROCESS, Variation(common_depth_scale=0.02))


def test_uniformity_is_a_bowl_and_a_tilt_over_the_wafer(level: np.ndarray):
    die, radius = (12e-3, -31e-3), 40e-3
    wafer = Process(LEVELS, die_m=die, wafer_radius_m=radius)
    bowl, tilt_y, tilt_x = 0.04, -0.03, 0.02
    surface = plate(
        level,
        Variation(radial_nonuniformity=bowl, linear_nonuniformity_y=tilt_y, linear_nonuniformity_x=tilt_x),
        wafer,
    )
    y, x = die[0] + GRID.axis_m("y")[:, None], die[1] + GRID.axis_m("x")[None, :]
    share = 1 + (bowl * (y**2 + x**2) / radius + tilt_y * y + tilt_x * x) / radius
    height = 15 * 75e-9 - (15 - level) * 75e-9 * share
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(height), atol=SAME_LIGHT)


@pytest.mark.parametrize("along", ["y", "x"])
def test_narrow_openings_are_less_deep(along: str):
    """Slots of 1 to 12 pixels lose lag x depth / width of their depth; what counts is their shorter side."""
    drawn = np.full((CELLS, CELLS), 15, np.uint8)
    columns = {1: 3, 2: 6, 3: 10, 5: 16, 12: 26}
    for width, first in columns.items():
        drawn[4:44, first : first + width] = 15 - 8 - 2
    lag = 0.05
    share = {mask: {w: 1 - lag * 2**mask * 75e-9 / (w * PITCH_M) for w in columns} for mask in (1, 3)}
    height = np.full((CELLS, CELLS), 15 * 75e-9)
    for width, first in columns.items():
        lost = sum(2**mask * 75e-9 * share[mask][width] for mask in (1, 3))
        height[4:44, first : first + width] -= lost
    if along == "y":
        drawn, height = drawn.T.copy(), height.T
    surface = plate(drawn, Variation(etch_lag=lag))
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(height), atol=SAME_LIGHT)


def test_an_opening_cannot_lose_more_than_its_depth(level: np.ndarray):
    surface = plate(level, Variation(etch_lag=1e6))
    np.testing.assert_allclose(
        np.asarray(surface.transmission), expected(np.full_like(level, 15 * 75e-9, float)), atol=SAME_LIGHT
    )


# --- defects and chrome -----------------------------------------------------------------------------------------------


def test_a_particle_keeps_one_etch_off_the_pixels_whose_centres_it_covers():
    etched = np.zeros((CELLS, CELLS), np.uint8)  # every mask open everywhere
    y, x = GRID.axis_m("y"), GRID.axis_m("x")
    particle = MaskDisc(2, float(y[30]) + 0.4e-6, float(x[12]), 2.1 * PITCH_M)
    covered = np.hypot(y[:, None] - particle.y_m, x[None, :] - particle.x_m) <= particle.radius_m
    assert 10 < covered.sum() < 18
    height = np.where(covered, 4 * 75e-9, 0.0)
    surface = plate(etched, Variation(particles=(particle,)))
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(height), atol=SAME_LIGHT)


def test_a_particle_off_the_plate_does_nothing(level: np.ndarray):
    surface = plate(level, Variation(particles=(MaskDisc(0, 1.0, 1.0, 1e-6),)))
    np.testing.assert_allclose(np.asarray(surface.transmission), expected(height_of(level, LEVELS)), atol=SAME_LIGHT)


def test_pinholes_open_the_chrome_where_it_was_closed(level: np.ndarray):
    y, x = 21 * PITCH_M, -20 * PITCH_M
    hole = Disc(y, x, 1.5e-6)
    nominal, pierced = (
        np.asarray(plate(level, v, camera=ROUND).coverage) for v in (Variation(), Variation(pinholes=(hole,)))
    )
    assert (pierced >= nominal).all()
    assert nominal[44:, :6].sum() == 0
    # 64 strips per cell of a hole of two cells.
    assert (pierced - nominal).sum() == pytest.approx(np.pi * (1.5e-6 / PITCH_M) ** 2, rel=2e-3)
    row, column = np.unravel_index(np.argmax(pierced - nominal), pierced.shape)
    assert abs(GRID.axis_m("y")[row] - y) < PITCH_M
    assert abs(GRID.axis_m("x")[column] - x) < PITCH_M
    # In the open part a hole changes nothing.
    inside = plate(level, Variation(pinholes=(Disc(0.0, 0.0, 3e-6),)), camera=ROUND)
    np.testing.assert_array_equal(np.asarray(inside.coverage), nominal)


def test_the_chrome_opening_moves_and_grows(level: np.ndarray):
    error = Variation(chrome_y_m=1.2e-6, chrome_x_m=-0.7e-6, chrome_diameter_m=2.1e-6)
    coverage = np.asarray(plate(level, error, camera=ROUND).coverage)
    exact = circle_coverage(GRID, ROUND.aperture_m + 2.1e-6, (1.2e-6, -0.7e-6))
    # Straight within a cell: the bow is a cell / (8 radius) at most, 0.006 of an edge cell's width.
    np.testing.assert_allclose(coverage, exact, atol=0.006)
    area = np.pi / 4 * ((ROUND.aperture_m + 2.1e-6) / PITCH_M) ** 2
    assert coverage.sum(dtype=float) == pytest.approx(area, rel=5e-4)  # the mean of the bow over the edge cells


# --- how finely the plate is cut --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_wider_sensor_is_served_in_half_cells(level: np.ndarray):
    """At 0.46 waves per cell the second moments give out; a plate as drawn needs no moments."""
    wide = dataclasses.replace(CAMERA, window=72)
    moved = as_fabricated(level, wide, PROCESS, Variation(overlay_x_m=(0.0, PITCH_M, 0.0, 0.0)))
    assert moved.grid == Grid((2 * CELLS, 2 * CELLS), PITCH_M / 2)
    assert moved.coverage.shape == (2 * CELLS, 2 * CELLS)
    # A whole pixel again, so that both halves of a cell are what the cell is.
    height = height_of(shifted_planes(level, 1, (0, 1)), LEVELS)
    twice = np.kron(expected(height), np.ones((1, 2, 2)))
    np.testing.assert_allclose(np.asarray(moved.transmission), twice, atol=SAME_LIGHT)
    assert as_fabricated(level, wide, PROCESS, Variation(common_depth_scale=0.1)).grid == GRID
    # Parts of a cell give the same PSF as the cell.
    drawn = as_fabricated(shifted_planes(level, 1, (0, 1)), wide, PROCESS, Variation())
    fine, coarse = (psf(s, depths=[np.inf]).energy for s in (moved, drawn))
    assert relative_error(fine, coarse.astype(np.float64)) < 1e-4  # float32; measured 2e-5


# --- what the model does not describe is refused ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("variation", "where", "rule"),
    [
        (Variation(common_cd_bias_m=0.51 * PITCH_M), "variation.cd_bias", "half a cell"),
        (Variation(cd_bias_m=(0.0, 0.0, 0.0, -0.6 * PITCH_M)), "variation.cd_bias", "half a cell"),
        # Walls narrow floors by half their width on top of what the line width loses.
        (Variation(common_cd_bias_m=-0.45 * PITCH_M, sidewall_rad=0.5), "variation.cd_bias", "half a cell"),
        (Variation(corner_radius_m=0.51 * PITCH_M), "variation.corner_radius", "half a cell"),
        (Variation(sidewall_rad=-0.1), "variation.sidewall", "0 and 45"),
        (Variation(sidewall_rad=0.8), "variation.sidewall", "0 and 45"),
        (Variation(cd_bias_m=(0.0, float("nan"), 0.0, 0.0)), "variation.cd_bias_m", "finite"),
        (Variation(common_depth_scale=float("nan")), "variation.common_depth_scale", "finite"),
        (Variation(corner_radius_m=-0.1e-6), "variation.corner_radius_m", "not be negative"),
        (Variation(roughness_m=-5e-9), "variation.roughness_m", "not be negative"),
        (Variation(overlay_y_m=(0.0, 8.5 * PITCH_M, 0.0, 0.0)), "variation.overlay", "8 cells"),
        (Variation(overlay_x_m=(0.0, 0.0, -20e-6, 0.0)), "variation.overlay", "8 cells"),
        (Variation(depth_scale=(0.1,)), "variation.depth_scale", "one value per mask, 4"),
        (Variation(overlay_x_m=(0.1e-6,) * 5), "variation.overlay_x_m", "one value per mask, 4"),
        (Variation(repeats=(-1, 0)), "variation.repeats", "one value per mask, 4"),
    ],
)
def test_errors_beyond_the_model_are_refused_by_name(level: np.ndarray, variation: Variation, where: str, rule: str):
    with pytest.raises(InputError, match=rule) as refused:
        plate(level, variation)
    assert where in str(refused.value)


def test_the_halo_of_unknown_errors_is_that_of_masks_off_by_less_than_a_cell():
    """Under a derivative it is chosen before the errors are known; and such plates share one compiled program."""

    def planned(overlay: float, traced: bool) -> TilePlan:
        shifted = Variation(
            overlay_y_m=(overlay * PITCH_M,) * 4, common_cd_bias_m=1e-8, corner_radius_m=1e-8, sidewall_rad=0.01
        )
        return plan_of(CAMERA, PROCESS, shifted, LINES_M, (np.inf, np.inf), traced)[0]

    unknown = planned(0.0, True)
    assert [planned(overlay, False) == unknown for overlay in (0.0, 0.5, -0.99, 1.01)] == [True, True, True, False]
    assert planned(1.01, False).reach > unknown.reach


def test_a_turned_mask_counts_where_it_lies(level: np.ndarray):
    """The same turn is refused at the edge of the wafer and fine in its middle."""
    turned = Variation(rotation_rad=(0.0, 1e-3, 0.0, 0.0))
    plate(level, turned)
    with pytest.raises(InputError, match="8 cells"):
        plate(level, turned, Process(LEVELS, die_m=(0.0, 40e-3)))


def test_the_largest_errors_that_are_described(level: np.ndarray):
    """Just inside the limits nothing overflows: eight cells of overlay, almost half a cell of bias."""
    far = (0.0, 8 * PITCH_M, -8 * PITCH_M, 0.0)
    surface = plate(level, Variation(overlay_y_m=far, overlay_x_m=far, common_cd_bias_m=-0.49 * PITCH_M))
    values = np.asarray(surface.transmission)
    assert np.isfinite(values).all()
    # Single pixels shrink to dust of a fiftieth of a cell, so what is not part of a larger opening is blank.
    assert np.abs(values - expected(np.full((1, 1), 15 * 75e-9))).mean() < 0.5


def test_every_float_of_a_variation_is_a_leaf_for_derivatives():
    full = variation_of(4, dict.fromkeys(error_names(4), 1.0), repeats=(0, 1, 0, 0), seed=3)
    leaves, structure = jax.tree.flatten(full)
    assert len(leaves) == len(error_names(4))
    assert jax.tree.unflatten(structure, leaves) == full
    # What no derivative is taken of is part of the structure.
    assert jax.tree.structure(dataclasses.replace(full, seed=4)) != structure


# --- views ------------------------------------------------------------------------------------------------------------

# The automotive optics: near sources light the rim's cells by a sixth of a wave per cell in blue.
BLUE = Colour("blue", (486e-9,), (1.0,))
RED = Colour("red", (656e-9,), (1.0,))
WIDE = Camera(Grid((48, 48), 1.85e-6), 48 * 1.85e-6, "fused_silica", (RED, BLUE), 8e-3, 3.7e-6, 512)
NEAREST_M = 1e-3


@pytest.mark.slow
def test_a_wavelength_has_as_many_views_as_its_band_is_too_wide(level: np.ndarray):
    """The window takes 0.67 waves per cell in red and 0.90 in blue, near sources another 0.12 and 0.17 of the 0.965."""
    moved = as_fabricated(level, WIDE, PROCESS, Variation(common_cd_bias_m=1e-7), depths_m=(NEAREST_M, np.inf))
    assert [view.wavelength_m for view in moved.views] == [656e-9] + 3 * [486e-9]
    assert moved.transmission.shape == (4, 48, 48)
    blue = moved.views[1:]
    assert (blue[0].farthest_m, blue[-1].nearest_m) == (np.inf, NEAREST_M)
    assert [view.nearest_m for view in blue] == pytest.approx([3e-3, 1.5e-3, 1e-3])
    assert [moved.view(486e-9, depth) for depth in (np.inf, 4e-3, 2e-3, 1.2e-3, 1e-3)] == [1, 1, 2, 3, 3]
    # A plate whose edges did not move looks the same from everywhere, and has the same views.
    still = as_fabricated(level, WIDE, PROCESS, Variation(common_depth_scale=0.1), depths_m=(NEAREST_M, np.inf))
    assert still.views == moved.views
    np.testing.assert_array_equal(still.transmission[1], still.transmission[3])


def test_from_elsewhere_a_plate_looks_as_from_the_nearest_depth(level: np.ndarray):
    moved = as_fabricated(level, WIDE, PROCESS, Variation(common_cd_bias_m=1e-7), depths_m=(1.5e-3, 6e-3))
    blue = [view for view in moved.views if view.wavelength_m == 486e-9]
    assert [view.farthest_m for view in blue] == pytest.approx([6e-3, 2.4e-3])
    for depth_m, other_m in ((np.inf, 6e-3), (1e-3, 1.5e-3)):
        np.testing.assert_array_equal(moved.at(486e-9, depth_m), moved.at(486e-9, other_m))
    assert not np.array_equal(moved.at(486e-9, 6e-3), moved.at(486e-9, 1.5e-3))
    with pytest.raises(ValueError, match="`wavelength_m` must be one of"):
        moved.at(500e-9)
