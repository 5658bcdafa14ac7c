"""Deconvolution without training: a known blur undone, light kept, noise weighed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.restoration import richardson_lucy as by_scikit_image

from doedesign.capture.images import crop, linear_light, sample_files
from doedesign.recon.baselines import noise_to_signal, noise_variance, richardson_lucy, wiener
from fab.pictures import read_display
from sim.imaging.convolve import convolve, plan_otf
from sim.sensor import Sensor, developed, expose

SENSOR = Sensor(full_well_e=20000, read_noise_e=4.0)


def ring_psf(window: int = 41, spot: float = 0.4, energy: float = 0.85) -> np.ndarray:
    """A sharp spot and a wide ring, as a plate makes them, another one for every colour."""
    y, x = np.mgrid[:window, :window] - window // 2
    radius = np.hypot(y, x)
    found = []
    for c in range(3):
        ring = np.exp(-(((radius - 14 - c) / 1.5) ** 2)) * (1 + 0.3 * x / window)
        found.append(spot * (radius == 0) + (1 - spot) * ring / ring.sum())
    return (energy * np.stack(found)).astype(np.float32)


@jax.jit
def blurred(light, psf):
    return convolve(light, plan_otf(psf, light.shape[-2:], "reflect"))


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    return linear_light(crop(read_display(sample_files()[2], 160), (128, 150), (0.5, 0.5)))


@pytest.fixture(scope="module")
def capture(light: np.ndarray) -> np.ndarray:
    return np.asarray(developed(expose(blurred(light, ring_psf()), SENSOR, jax.random.key(0)), SENSOR))


def psnr(found, light: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((np.clip(found, 0, 1) - light) ** 2)))


def test_the_variance_is_that_of_the_sensor():
    """Over 3 x 60000 draws a variance is known to 0.6 %; five times that."""
    for noise in ("physical", "tseng", "release", "none"):
        sensor = Sensor(full_well_e=5000, read_noise_e=3.0, dark_e=10.0, bits=10, noise=noise)
        # Each sample lies elsewhere between two steps of the converter, as a picture's do.
        light = np.random.default_rng(0).uniform(0.2, 0.3, (3, 200, 300)).astype(np.float32)
        seen = np.asarray(developed(expose(jnp.asarray(light), sensor, jax.random.key(1)), sensor))
        found = noise_variance(seen, sensor)
        np.testing.assert_allclose(found, np.mean((seen - light) ** 2, axis=(1, 2)), rtol=0.03)


def test_the_ratio_is_that_of_the_variances():
    rng = np.random.default_rng(0)
    signal, noise = rng.normal(0.5, 0.2, (3, 100, 100)), rng.normal(0, 0.1, (3, 100, 100))
    found = noise_to_signal((signal + noise).astype(np.float32), np.full(3, 0.01))
    np.testing.assert_allclose(found, 0.25, rtol=0.1)  # four variances of 10000 samples, 1.4 % each
    # A capture darker than its noise: at most all of it.
    np.testing.assert_allclose(noise_to_signal(np.full((1, 9, 9), 0.5, np.float32), np.array([0.01])), 1.0)


def test_of_a_sensor_without_noise_the_ratio_is_that_of_rounding(light: np.ndarray):
    """A PSF that passes nothing at one frequency: nothing is won there, and nothing divided by nothing."""
    quiet = Sensor(noise="none", bits=None)
    capture = np.asarray(light, np.float32)
    ratio = noise_to_signal(capture, noise_variance(capture, quiet))
    assert ratio == pytest.approx(2.0**-46, abs=0)  # the square of the last of 24 bits
    psf = np.zeros((len(capture), 3, 3), np.float32)
    psf[:, 1] = 0.25, 0.5, 0.25  # 0 at half a wave per pixel
    assert np.isfinite(wiener(capture, psf, ratio)).all()


def test_both_undo_a_known_blur(light: np.ndarray, capture: np.ndarray):
    """The transfer function falls to 0.14 and no lower, so nothing is lost.

    An inverse filter then lets noise through at most seven times as strong, and a filter that weighs it no more.
    Richardson-Lucy converges towards the same, slowly: a tenth of the capture's error is asked of it.
    """
    psf, variance = ring_psf(), noise_variance(capture, SENSOR)
    least = float(jnp.abs(jax.jit(lambda p: plan_otf(p, light.shape[-2:], "reflect").transfer)(psf)).min())
    by_wiener = psnr(wiener(capture, psf, noise_to_signal(capture, variance)), light)
    assert by_wiener > -10 * np.log10(variance.mean() / least**2)
    before = psnr(capture, light)
    assert by_wiener > before + 10
    assert psnr(richardson_lucy(capture, psf, noise_variance=variance), light) > before + 10


def test_without_noise_wiener_is_the_inverse(light: np.ndarray):
    """A ratio of 1e-6 against a power of at least (0.85 (2 · 0.6 - 1))² = 0.03 takes 3e-5 of the contrast."""
    psf = ring_psf(21, spot=0.6)
    ring = psf.copy()
    ring[:, 10, 10] = 0
    assert (psf[:, 10, 10] > 1.2 * ring.sum(axis=(1, 2))).all()  # so the transfer function cannot vanish
    # The picture lies in an even surround as wide as the PSF reaches, for its edges' true neighbours are not known.
    wide = np.pad(light, ((0, 0), (60, 60), (60, 60)), constant_values=0.3)
    found = np.asarray(wiener(blurred(wide, psf), psf, 1e-6))
    np.testing.assert_allclose(found[:, 60:-60, 60:-60], light, atol=1e-4)  # and three times that, for rounding


def test_colours_have_their_own_psf_and_ratio(capture: np.ndarray):
    psf, ratio = ring_psf(), np.array([1e-3, 1e-2, 1e-1])
    together = np.asarray(wiener(capture, psf, ratio))
    for c in range(3):
        alone = np.asarray(wiener(capture[c : c + 1], psf[c : c + 1], float(ratio[c])))[0]
        np.testing.assert_allclose(alone, together[c], atol=2e-5)


def test_lucy_stays_positive_and_keeps_the_light(capture: np.ndarray):
    psf = ring_psf()
    dark = capture - 0.05  # noise below black among it
    assert dark.min() < 0
    for iterations in (1, 7):
        found = richardson_lucy(dark, psf, iterations)
        assert np.asarray(found).min() >= 0
        seen = np.maximum(dark, 0).sum(axis=(1, 2), dtype=np.float64)
        again = np.asarray(blurred(found, psf)).sum(axis=(1, 2), dtype=np.float64)
        # Exact but for rounding: two transforms in single precision for each iteration.
        np.testing.assert_allclose(again, seen, rtol=1e-4)


def test_lucy_is_that_of_scikit_image_far_from_edges(capture: np.ndarray):
    """Theirs sees zeros beyond the picture, so both must first meet in its middle: three iterations reach 6 x 10."""
    psf = ring_psf(21)[0, :, :]
    psf = psf / psf.sum()
    frame = np.zeros((161, 161), np.float32)
    frame[70:91, 70:91] = capture[0, 40:61, 40:61]
    ours = np.asarray(richardson_lucy(frame[None], psf[None], 3))[0]
    theirs = by_scikit_image(frame.astype(np.float64), psf.astype(np.float64), num_iter=3, clip=False)
    # Both begin with even light: ours with the mean, theirs with 0.5; one iteration later that is forgotten.
    inner = (slice(40, 121), slice(40, 121))
    np.testing.assert_allclose(ours[inner], theirs[inner], atol=2e-4)


@pytest.mark.slow
def test_lucy_stops_at_the_noise(capture: np.ndarray):
    psf = ring_psf()
    variance = noise_variance(capture, SENSOR)
    few, many = (np.asarray(richardson_lucy(capture, psf, n, variance)) for n in (300, 600))
    np.testing.assert_array_equal(few, many)
    off = np.mean((np.maximum(capture, 0) - np.asarray(blurred(jnp.asarray(few), psf))) ** 2, axis=(1, 2))
    assert (off <= variance).all()
    assert (off > 0.5 * variance).all()  # and not long after
    further = np.asarray(richardson_lucy(capture, psf, 300))
    assert not np.array_equal(further, few)


def test_even_windows_are_refused(capture: np.ndarray):
    for method in (lambda psf: wiener(capture, psf, 0.1), lambda psf: richardson_lucy(capture, psf)):
        with pytest.raises(ValueError, match="odd windows"):
            method(np.ones((3, 4, 5), np.float32))
