"""Closed forms of plates as fabricated: gratings, overlay, roughness, and derivatives against finite differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fab.grid import Grid
from fab.levels import Levels
from fab.masks import levels_of, planes
from fab.process import ERRORS, Process, Variation, error_names, variation_of
from sim.camera import Camera, Colour
from sim.leakage import split_psf, strehl, zeroth_order
from sim.metrics import energy_within
from sim.psf import surface_bank
from sim.surface import as_fabricated

N, PITCH, WAVE = 64, 1.85e-6, 552e-9
LEVELS = Levels(16, 75e-9)
PROCESS = Process(LEVELS)


def camera(cells=N, wavelength=WAVE, window=96):
    grid = Grid((cells, cells), PITCH)
    return Camera(
        grid, 0.98 * cells * PITCH, "fused_silica", (Colour("green", (wavelength,), (1.0,)),), 1e-3, 1.85e-6, window
    )


def wave_height(cam):
    """Levels whose full height is exactly one wave, so that the closed forms hold."""
    return Levels(16, 1 / cam.waves_per_metre(WAVE) / 16)


def noise_map(cells=N, smooth=2.0, seed=0):
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(cells, cells)), smooth, mode="wrap")
    return np.mod(np.rint(noise / noise.std() * 8), 16).astype(np.uint8)


def order_powers(transmission, period):
    """Power in every order of a grating along x, from the exact cell field (cells carry their sinc)."""
    line = transmission[0, :, : N - N % period].mean(axis=0)
    spectrum = np.fft.fft(line) / len(line)
    step = len(line) // period
    orders = np.fft.fftfreq(len(line), 1 / len(line))[::step] / step
    return dict(zip(orders.astype(int).tolist(), np.abs(spectrum[::step]) ** 2, strict=True))


@pytest.mark.parametrize("depth", [0.9, 0.97, 1.0, 1.0645, 1.1])
def test_blazed_grating_orders_with_a_depth_error(depth):
    cam = camera()
    levels = wave_height(cam)
    level = np.tile(np.arange(16, dtype=np.uint8), (N, N // 16))
    plate = as_fabricated(level, cam, Process(levels), Variation(common_depth_scale=depth - 1))
    found = order_powers(np.asarray(plate.transmission), 16)
    for m in (-1, 0, 1, 2):
        steps = 16 * np.sin(np.pi * (depth - m) / 16)
        # The sum over 16 cells; the share of the cell itself, sinc^2(m / 16), is the transform's (`sim.farfield`).
        expected = 1.0 if abs(steps) < 1e-9 else (np.sin(np.pi * (depth - m)) / steps) ** 2
        # Single precision of sixteen phases.
        assert found[m] == pytest.approx(expected, abs=2e-6)


def test_the_first_order_of_a_blazed_grating_falls_on_the_sensor_with_its_power():
    cam = camera(cells=256, window=128)
    levels = wave_height(cam)
    level = np.tile(np.arange(16, dtype=np.uint8), (256, 16))
    airy = WAVE * cam.focal_length_m / cam.aperture_m
    flat = as_fabricated(np.full((256, 256), 15, np.uint8), cam, Process(levels), Variation())
    spot = energy(cam, flat, 6 * airy)
    for depth in (1.0, 1.1):
        plate = as_fabricated(level, cam, Process(levels), Variation(common_depth_scale=depth - 1))
        psf = surface_bank(cam, plate, (np.inf,)).energy[0, 0]
        x = WAVE * cam.focal_length_m / (16 * PITCH)
        axis = cam.axis_m()
        around = np.hypot(axis[:, None], axis[None, :] - x) < 6 * airy
        steps = 16 * np.sin(np.pi * (depth - 1) / 16)
        ratio = 1.0 if steps == 0 else (np.sin(np.pi * (depth - 1)) / steps) ** 2
        # The same circle about the axis holds as much of the bare lens's light, to the pixels on its edge.
        assert psf[around].sum() == pytest.approx(np.sinc(1 / 16) ** 2 * ratio * spot, rel=0.01)


@pytest.mark.parametrize("depth_waves", [0.5, 0.4, 0.25, 0.0])
def test_binary_grating_zeroth_order(depth_waves):
    cam = camera()
    levels = Levels(2, depth_waves / cam.waves_per_metre(WAVE) if depth_waves else 1e-12)
    level = np.tile(np.array([0, 0, 1, 1], np.uint8), (N, N // 4))
    plate = as_fabricated(level, cam, Process(levels), Variation(chrome_diameter_m=1e-3))
    # Half the area is delayed: |1 + exp(i phi)|^2 / 4.
    # The surface's sine is good to 4e-6.
    assert zeroth_order(plate)[0] == pytest.approx(np.cos(np.pi * depth_waves) ** 2, abs=1e-5)


@pytest.mark.parametrize("bias_m", [0.2e-6, -0.3e-6])
def test_binary_grating_zeroth_order_with_a_line_width_error(bias_m):
    cam = camera()
    levels = Levels(2, 0.5 / cam.waves_per_metre(WAVE))
    level = np.tile(np.array([0, 0, 1, 1], np.uint8), (N, N // 4))
    plate = as_fabricated(level, cam, Process(levels), Variation(common_cd_bias_m=bias_m))
    inner = np.asarray(plate.transmission)[0, 20:44, 20:44].mean()
    share = 0.5 + 2 * bias_m / (4 * PITCH)
    # |1 - 2 share|^2 at half a wave.
    assert abs(inner) ** 2 == pytest.approx((1 - 2 * share) ** 2, abs=2e-4)


@pytest.mark.parametrize("mask", range(4))
@pytest.mark.parametrize("smooth", [2.0, 5.0])
def test_overlay_strehl_law(mask, smooth):
    cam = camera(128)
    levels = wave_height(cam)
    level = noise_map(128, smooth)
    shift = 0.25e-6
    overlay = tuple(shift if k == mask else 0.0 for k in range(4))
    process = Process(levels)
    nominal = as_fabricated(level, cam, process, Variation())
    found = strehl(as_fabricated(level, cam, process, Variation(overlay_x_m=overlay)), nominal)[0]
    plane = planes(level, levels)[mask]
    # Share of the area in which the shifted mask differs: strips at every edge across x.
    strips = np.mean(plane != np.roll(plane, 1, axis=1)) * shift / PITCH
    law = 1 - 2 * strips * (1 - np.cos(2 * np.pi * 2**mask / 16))
    # The law is the first order in the strips' area; 0.03 is asked for.
    assert found == pytest.approx(law, abs=0.03)


@pytest.mark.parametrize("shift", [(0, 1), (1, 0), (-2, 1)])
def test_overlay_by_whole_pixels_shifts_one_plane(shift):
    cam = camera()
    level = np.full((N, N), 15, np.uint8)
    level[8:-8, 8:-8] = noise_map()[8:-8, 8:-8]
    split = planes(level, LEVELS)
    split[2] = np.roll(split[2], shift, axis=(0, 1))
    moved = levels_of(split, LEVELS)
    off = variation_of(4, {"overlay_y_m[2]": shift[0] * PITCH, "overlay_x_m[2]": shift[1] * PITCH})
    one = as_fabricated(level, cam, PROCESS, off)
    other = as_fabricated(moved, cam, PROCESS, Variation())
    # 1.85 um is no float32; 1e-7 of a cell is left, and the sine is good to 4e-6.
    assert np.abs(np.asarray(one.transmission) - np.asarray(other.transmission)).max() < 2e-5


def test_roughness_scatters_the_share_of_a_gaussian_surface():
    cam = camera(128)
    level = np.full((128, 128), 15, np.uint8)
    rms = 30e-9
    for length in (0.2e-6, 4e-6):
        plate = as_fabricated(level, cam, PROCESS, Variation(roughness_m=rms, correlation_m=length, seed=3))
        phase = 2 * np.pi * rms * cam.waves_per_metre(WAVE)
        # 128 x 128 cells hold hundreds of hills of 4 um; their mean strays by a few per cent.
        assert zeroth_order(plate)[0] == pytest.approx(np.exp(-(phase**2)), rel=0.03)


def test_leaked_and_diffracted_light_make_up_the_psf():
    cam = camera()
    plate = as_fabricated(noise_map(), cam, PROCESS, Variation(overlay_x_m=(0.0, 3e-7, -2e-7, 1e-7)))
    split = split_psf(cam, plate, cam.colours[0], 6e-3)
    total = surface_bank(cam, plate, (6e-3,)).energy[0, 0]
    assert np.array_equal(split.total, total)
    assert split.excess() < 1e-3
    flat = as_fabricated(np.full((N, N), 15, np.uint8), cam, PROCESS, Variation())
    bare = surface_bank(cam, flat, (6e-3,)).energy[0, 0]
    # The 0th order images like the bare lens.
    assert np.allclose(split.leaked, zeroth_order(plate)[0] * bare, atol=1e-5 * bare.max())


def test_an_offset_chrome_opening_moves_no_power_and_a_wider_one_adds_its_area():
    cam = camera()
    flat = np.full((N, N), 15, np.uint8)
    base = energy(cam, as_fabricated(flat, cam, PROCESS, Variation()))
    wide = energy(cam, as_fabricated(flat, cam, PROCESS, Variation(chrome_diameter_m=1e-6)))
    moved = energy(cam, as_fabricated(flat, cam, PROCESS, Variation(chrome_x_m=0.5e-6)))
    assert moved == pytest.approx(base, rel=2e-3)
    # The light of the plate's rim that misses the window changes with it.
    assert wide / base == pytest.approx(((cam.aperture_m + 1e-6) / cam.aperture_m) ** 2, rel=2e-3)


def energy(cam, plate, radius_m=74e-6):
    psf = surface_bank(cam, plate, (np.inf,)).energy[0, 0]
    return energy_within(psf, cam.pixel_m, radius_m)


# Steps of central differences: large enough for single precision, small enough for the curvature.
STEPS = {"m": 8e-9, "rad": 2e-4, "1": 5e-4}


@pytest.mark.slow
def test_every_error_has_the_derivative_of_finite_differences():
    cam = camera(N, window=32)
    level = noise_map()
    off = np.array([0.03, 0.33, -0.21, 0.45]) * 1e-6
    at = variation_of(4, dict.fromkeys(error_names(4), 0.0))
    # A generic point: where edges of two masks coincide, derivatives are one-sided.
    at = replace(
        at,
        overlay_x_m=tuple(off),
        overlay_y_m=tuple(off[::-1] * 0.87),
        cd_bias_m=(1e-8, 2.3e-8, -3e-8, 1.7e-8),
        common_cd_bias_m=9e-8,
        sidewall_rad=0.08,
        etch_lag=0.05,
        roughness_m=5e-9,
        correlation_m=2e-6,
        corner_radius_m=1e-9,
        chrome_x_m=3e-7,
        chrome_y_m=-2e-7,
    )
    process = replace(PROCESS, die_m=(0.0, 2e-3))
    rng = np.random.default_rng(1)
    weights = jnp.asarray(rng.normal(size=(2, N, N)) / N, jnp.float32)

    @jax.jit
    def functional(variation):
        plate = as_fabricated(level, cam, process, variation)
        field = plate.transmission[0] * plate.coverage
        return jnp.sum(weights[0] * field.real + weights[1] * field.imag)

    gradient = jax.jit(jax.grad(functional))(at)
    values = {name: at.value(name) for name in error_names(4)}
    for name in error_names(4):
        key, _, mask = name.partition("[")
        step = STEPS[ERRORS[key].unit]
        if key in ("rotation_rad", "magnification"):
            step = 4e-6  # 2 mm from the wafer's centre this is 8 nm
        if key == "corner_radius_m":
            step, values[name] = 0.5e-9, 1e-9  # so small that no other edge passes a corner
        ends = [float(functional(variation_of(4, values | {name: values[name] + s}))) for s in (-step, step)]
        slope = (ends[1] - ends[0]) / (2 * step)
        found = getattr(gradient, key)
        found = float(found if not mask else found[int(mask[0])])
        # The functional is a sum of 8192 numbers of order 1 / 64 in single precision, good to about 3e-6.
        assert found == pytest.approx(slope, rel=0.03, abs=3e-6 / step), name
