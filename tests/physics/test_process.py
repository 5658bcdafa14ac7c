"""Closed forms of process errors: gratings of wrong depth and width, displaced masks, sloping walls, rough glass."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter

from bench.reference import YELLOW_M
from fab.grid import Grid
from fab.levels import Levels, height_of, planes
from fab.process import Process, Variation, variation_of
from sim.camera import Camera, Colour
from sim.metrics import mean_transmission, strehl, zeroth_order
from sim.psf_bank import PsfBank, psf
from sim.surface import FabricatedDoe, as_fabricated

PITCH_M = 1.85e-6
CELLS = 96  # more than twice the reach of moments around the period in the middle
FLOAT32 = 1e-5  # heights in waves, and the 4e-6 of the sine


def camera(cells: int = CELLS, window: int = 64, pixel_m: float = 3.7e-6, open_share: float = 1.0) -> Camera:
    """A plate of one colour whose band is 0.4 waves per cell; an open share of 1.5 leaves no chrome on it."""
    grid = Grid((cells, cells), PITCH_M)
    colour = Colour("yellow", (YELLOW_M,), (1.0,))
    return Camera(grid, open_share * cells * PITCH_M, "fused_silica", (colour,), 1e-3, pixel_m, window)


CAMERA = camera()
RATE = CAMERA.waves_per_metre(YELLOW_M)
WHOLE = camera(open_share=1.5)  # no chrome


def made(
    level: np.ndarray, levels: Levels, variation: Variation, optics: Camera = WHOLE, depth_m: float = np.inf
) -> FabricatedDoe:
    return as_fabricated(level, optics, Process(levels), variation, depths_m=(depth_m,))


def along_x(line: np.ndarray, cells: int = CELLS) -> np.ndarray:
    """A grating of which every row is this line, repeated."""
    return np.broadcast_to(np.resize(line, cells), (cells, cells)).astype(np.uint8).copy()


# --- depth ------------------------------------------------------------------------------------------------------------

STAIRS = Levels(16, 1 / RATE / 16)  # one wave in sixteen steps
BLAZED = along_x(np.arange(16))


def blazed_efficiency(order: int, depth: float) -> float:
    """Share of the light in an order of a 16-level grating whose depth is this factor of a wave."""
    off = np.sin(np.pi * (depth - order) / 16)
    steps = 1.0 if abs(off) < 1e-12 else (np.sin(np.pi * (depth - order)) / (16 * off)) ** 2
    return float(np.sinc(order / 16) ** 2 * steps)


def orders(surface: FabricatedDoe, period: int) -> np.ndarray:
    """Amplitudes of the orders of a grating along x, without the cell's own sinc: a plain Fourier sum of one period."""
    line = np.asarray(surface.transmission, complex)[0, CELLS // 2, CELLS // 2 : CELLS // 2 + period]
    return np.fft.fft(line) / period


@pytest.mark.parametrize("depth", [0.9, 0.95, 0.99, 1.02, 1.0645, 1.1])
def test_orders_of_a_blazed_grating_etched_too_deep(depth: float):
    found = np.abs(orders(made(BLAZED, STAIRS, Variation(common_depth_scale=depth - 1)), 16)) ** 2
    for order in (-7, -2, -1, 0, 1, 2, 3, 8):
        share = found[order] * np.sinc(order / 16) ** 2
        assert share == pytest.approx(blazed_efficiency(order, depth), abs=2 * FLOAT32)
    # Where the light of the first order goes is known to all orders: a plate of phases loses nothing.
    assert found.sum() == pytest.approx(1.0, abs=2 * FLOAT32)


def test_a_common_depth_error_is_an_error_of_every_mask():
    both = made(BLAZED, STAIRS, Variation(common_depth_scale=0.05))
    each = made(BLAZED, STAIRS, Variation(depth_scale=(0.05,) * 4))
    np.testing.assert_allclose(np.asarray(both.transmission), np.asarray(each.transmission), atol=FLOAT32)


@pytest.mark.slow
def test_orders_of_a_blazed_grating_on_the_sensor():
    """The same through the whole path: chrome, transform, pixels. Boxes about the orders, against a flat plate's."""
    cells, per_order = 256, 15
    spacing = YELLOW_M * 8e-3 / (16 * PITCH_M)
    optics = dataclasses.replace(camera(cells, 5 * per_order, spacing / per_order), focal_length_m=8e-3)

    def bank(level: np.ndarray, depth: float) -> PsfBank:
        return psf(made(level, STAIRS, Variation(common_depth_scale=depth - 1), optics), depths=[np.inf])

    def box(found: PsfBank, order: int) -> float:
        rows = np.arange(per_order) + 2 * per_order
        return float(found.energy[0, 0][np.ix_(rows, rows + order * per_order)].sum())

    flat = box(bank(np.full((cells, cells), 15, np.uint8), 1.0), 0)
    for depth in (0.75, 0.9, 1.1):
        found = bank(along_x(np.arange(16), cells), depth)
        for order in (-1, 0, 1, 2):
            # Airy tails of a strong neighbour reach into the box with 4e-3 of its light, and beat with what is there.
            wanted = blazed_efficiency(order, depth)
            assert box(found, order) / flat == pytest.approx(wanted, abs=5e-3 + 0.01 * np.sqrt(wanted))


@pytest.mark.parametrize("depth", [0.0, 0.5, 0.8, 1.0, 1.3, 2.0])
def test_zeroth_order_of_a_binary_grating_over_depth(depth: float):
    """cos²(phi / 2) for ridges as wide as grooves, phi = pi x depth."""
    halves = Levels(2, 0.5 / RATE)
    surface = made(along_x(np.repeat([0, 1], 8)), halves, Variation(common_depth_scale=depth - 1))
    assert zeroth_order(surface)[0] == pytest.approx(np.cos(np.pi * depth / 2) ** 2, abs=FLOAT32)


def test_a_missed_and_a_doubled_etch_of_a_binary_grating():
    """Missed, the plate is flat; doubled at a quarter wave, it is a half-wave plate and has no 0th order."""
    quarter = Levels(2, 0.25 / RATE)
    level = along_x(np.repeat([0, 1], 8))
    powers = [zeroth_order(made(level, quarter, Variation(repeats=(n,))))[0] for n in (-1, 0, 1)]
    assert powers == pytest.approx([1.0, 0.5, 0.0], abs=FLOAT32)


# --- line width and overlay -------------------------------------------------------------------------------------------


def middle(surface: FabricatedDoe, period: int) -> complex:
    """Mean over one period and a few rows, away from the plate's own edges."""
    start = (CELLS - period) // 2
    values = np.asarray(surface.transmission, complex)[0, 24:40, start : start + period]
    return complex(values.mean())


@pytest.mark.parametrize("bias", [-0.45, -0.2, 0.1, 0.3, 0.49])
@pytest.mark.parametrize("depth", [0.25, 0.5])
def test_zeroth_order_of_a_binary_grating_over_line_width(bias: float, depth: float):
    """An opening of four cells of eight grows by the bias at both edges: |1 - f + f exp(-i phi)|^2 with its share f."""
    levels = Levels(2, depth / RATE)
    surface = made(along_x(np.repeat([0, 1], 4)), levels, Variation(common_cd_bias_m=bias * PITCH_M))
    share = (4 + 2 * bias) / 8
    expected = abs(1 - share + share * np.exp(-2j * np.pi * depth)) ** 2
    assert abs(middle(surface, 8)) ** 2 == pytest.approx(expected, abs=2 * FLOAT32)


def test_overlay_alone_leaves_the_zeroth_order_of_one_mask_alone():
    levels = Levels(2, 0.3 / RATE)
    level = along_x(np.repeat([0, 1], 4))
    drawn, moved = (
        abs(middle(made(level, levels, Variation(overlay_x_m=(shift,))), 8)) for shift in (0.0, 0.37 * PITCH_M)
    )
    assert moved == pytest.approx(drawn, abs=FLOAT32)


def ring_map(cells: int, rng: np.random.Generator) -> np.ndarray:
    """Wrapped cone of 60 cells per wave with smoothed radial noise."""
    y, x = np.indices((cells, cells)) - (cells - 1) / 2
    radius = np.hypot(y, x)
    noise = gaussian_filter(rng.normal(size=cells), 4)
    waves = radius / 60 + np.interp(radius, np.arange(cells), noise / noise.std() * 0.25)
    return np.floor(np.mod(waves, 1) * 16).astype(np.uint8)


def noise_map(cells: int, rng: np.random.Generator) -> np.ndarray:
    noise = gaussian_filter(rng.normal(size=(cells, cells)), 6, mode="wrap")
    return np.floor(np.mod(noise / noise.std() * 0.5, 1) * 16).astype(np.uint8)


@pytest.mark.parametrize("mask", range(4))
@pytest.mark.parametrize("drawn", [ring_map, noise_map], ids=["ring", "noise"])
@pytest.mark.parametrize("axis", [0, 1], ids=["y", "x"])
def test_overlay_costs_as_much_strehl_as_the_strips_it_displaces(drawn, mask: int, axis: int):
    """1 - 2 f (1 - cos(2 pi 2^k / 16)) for the area f of the strips along the edges of mask k, read off the mask."""
    cells, shift = 128, 0.3 * PITCH_M
    optics = camera(cells, open_share=1.5)
    level = drawn(cells, np.random.default_rng(4))
    name = ("overlay_y_m", "overlay_x_m")[axis]
    moved = made(level, STAIRS, variation_of(4, {f"{name}[{mask}]": shift}), optics)
    found = strehl(moved, made(level, STAIRS, Variation(), optics))[0]
    # Before the first row or column there is blank glass; what is pushed over the far end is not seen.
    edges = np.count_nonzero(np.diff(planes(level, STAIRS)[mask], axis=axis, prepend=0))
    share = edges * shift / PITCH_M / cells**2
    wrong = 1 - np.cos(2 * np.pi * 2**mask / 16)
    # The law is the first order in f; what it leaves out is (f (1 - cos))^2, at most 0.03 here.
    assert found == pytest.approx(1 - 2 * share * wrong, abs=0.03)
    # With its square the law is exact where as many strips open as close.
    assert found == pytest.approx((1 - share * wrong) ** 2, abs=2e-3)
    assert share * wrong > 0.004


# --- walls ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth", "degrees"), [(0.5, 3), (0.5, 8), (0.3, 8), (0.9, 8)])
def test_orders_of_a_binary_grating_with_sloping_walls(depth: float, degrees: float):
    """Floors are narrower than drawn by the walls' width at each side, and the light of the walls is an integral."""
    period, deep = 8, depth / RATE
    surface = made(along_x(np.repeat([0, 1], 4)), Levels(2, deep), Variation(sidewall_rad=np.radians(degrees)))
    ramp = deep * np.tan(np.radians(degrees)) / PITCH_M  # cells
    start = (CELLS - period) // 2
    line = np.asarray(surface.transmission, complex)[0, CELLS // 2, start : start + period]
    first = start % period

    def order(m: int, upright: bool = False) -> complex:
        """Fourier coefficient of the exact profile, an opening from 0 to 4 in a period of 8 cells."""
        width = 0.0 if upright else ramp

        def profile(x: float) -> complex:
            inside = min(x, 4 - x)
            depth_there = 0.0 if inside <= 0 else 1.0 if inside >= width else inside / width
            return np.exp(2j * np.pi * (depth * (1 - depth_there) - m * x / period)) / period

        kinks = sorted({0.0, width, 4 - width, 4.0})
        return quad(profile, 0, period, points=kinks, complex_func=True, limit=200)[0]

    x = np.arange(period) + first + 0.5
    change = max(abs(order(m, upright=True) - order(m)) for m in (0, 1, 2))
    assert change > 5e-3
    for m in (-2, -1, 0, 1, 2):
        found = (line * np.exp(-2j * np.pi * m * x / period)).mean() * np.sinc(m / period)
        # On the axis the walls' light is exact; a quarter wave per cell off it, cells lack their third moments.
        assert abs(found - order(m)) < (0.02 * change if m else 0.0) + FLOAT32


# --- roughness --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("length_cells", "rms_m"), [(0.1, 90e-9), (0.6, 20e-9), (0.6, 90e-9), (1.5, 90e-9)])
def test_a_rough_plate_keeps_the_share_of_a_gaussian_phase(length_cells: float, rms_m: float):
    """|<t>|^2 = exp(-sigma²), whether hills are finer than a cell or coarser; total scatter is the rest of it."""
    flat = np.zeros((CELLS, CELLS), np.uint8)
    sigma = 2 * np.pi * RATE * rms_m
    kept = []
    for seed in range(4):
        rough = Variation(roughness_m=rms_m, correlation_m=length_cells * PITCH_M, seed=seed)
        kept.append(zeroth_order(made(flat, STAIRS, rough))[0])
    # Hills of area pi L² / 2 scatter independently: the mean phase of a plate strays (and does not count), and so does
    # its amplitude, by half the spread of a sample variance. Four standard deviations of four plates, and the light
    # that a few hundred random phasors add up to.
    hills = 4 * CELLS**2 / max(np.pi * length_cells**2 / 2, 1.0)
    spread = 4 * sigma**2 * np.exp(-(sigma**2)) * np.sqrt(2 / hills) + 6 * (1 - np.exp(-(sigma**2))) / hills
    assert np.mean(kept) == pytest.approx(np.exp(-(sigma**2)), abs=spread + FLOAT32)
    if sigma < 0.2:
        # Total integrated scatter of polished glass: (2 pi (n - 1) rms / lambda)^2.
        assert 1 - np.mean(kept) == pytest.approx(sigma**2, rel=0.1)


def test_what_is_finer_than_a_cell_is_lost_to_the_sensor_and_the_rest_is_not():
    """Mean power of the cells: all of it for hills much longer than a cell, exp(-sigma²) for much shorter ones."""
    flat = np.zeros((CELLS, CELLS), np.uint8)
    sigma = 2 * np.pi * RATE * 60e-9
    powers = []
    for length in (0.02, 30.0):
        rough = made(flat, STAIRS, Variation(roughness_m=60e-9, correlation_m=length * PITCH_M))
        powers.append(float(np.mean(np.abs(np.asarray(rough.transmission)) ** 2)))
    # pi (L / pitch)² of the variance is left in cells of hills so short, 1 / (3 (L / pitch)²) is lost from the long.
    assert powers == pytest.approx([np.exp(-(sigma**2)), 1.0], abs=2e-3 * sigma**2)


# --- chrome -----------------------------------------------------------------------------------------------------------


def test_chrome_out_of_place_moves_and_changes_the_light_that_passes():
    """A flat plate under an opening that is wider by a hundredth passes two hundredths more, wherever it lies."""
    optics, depth_m = camera(128, 64, 3.7e-6, open_share=0.9), 3e-3
    flat = np.full((128, 128), 15, np.uint8)
    wide = 0.01 * optics.aperture_m
    drawn, grown, moved = (
        psf(made(flat, STAIRS, error, optics, depth_m), depths=[depth_m]).energy[0, 0].astype(float)
        for error in (
            Variation(common_depth_scale=1e-6),
            Variation(chrome_diameter_m=wide),
            Variation(chrome_x_m=5e-6, chrome_y_m=-3e-6),
        )
    )
    # Of the light that passes the window holds the same share; edge cells count by their share, not by its square.
    assert grown.sum() / drawn.sum() == pytest.approx(1.01**2, abs=1e-3)
    assert moved.sum() / drawn.sum() == pytest.approx(1.0, abs=1e-3)
    # Out of focus the image is the opening's shadow: it moves by f / z times as much, the same way round.
    axis = optics.axis_m()
    centre_y, centre_x = ((moved.sum(axis=a) * axis).sum() / moved.sum() for a in (1, 0))
    for centre, shift in ((centre_x, 5e-6), (centre_y, -3e-6)):
        # Half a per cent for what diffraction throws out of the window, more on one side than on the other.
        assert centre == pytest.approx(shift * optics.focal_length_m / depth_m, rel=5e-3)


def test_the_mean_of_a_plate_is_that_of_its_heights_whatever_the_masks_do():
    """Moments are moved between cells but never made: the mean of the far field's values is that of the cells."""
    level = np.full((CELLS, CELLS), 15, np.uint8)
    level[16:-16, 16:-16] = np.random.default_rng(2).integers(0, 16, (CELLS - 32, CELLS - 32))
    errors = Variation(overlay_x_m=(0.3e-6, -0.5e-6, 0.1e-6, 0.7e-6), common_cd_bias_m=0.2e-6)
    surface = made(level, Levels(16, 75e-9), errors)
    seen = np.asarray(surface.transmission, complex).mean()
    assert seen == pytest.approx(mean_transmission(surface)[0], abs=1e-6)
    assert abs(seen - np.exp(2j * np.pi * RATE * height_of(level, Levels(16, 75e-9))).mean()) > 1e-3
