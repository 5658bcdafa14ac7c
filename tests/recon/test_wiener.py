"""Wiener blocks: they invert a known blur, keep their gain at every scale, and do not ring from the edges."""

import jax.numpy as jnp
import numpy as np
import pytest
from skimage.data import astronaut

from doedesign.recon.wiener import blur_at, deblurred, sharing, sharpened, tapered


def gaussian(window: int, sigma: float, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A Gaussian PSF of unit sum."""
    y, x = (np.arange(window) - window // 2 - s for s in shift)
    psf = np.exp(-(y[:, None] ** 2 + x[None, :] ** 2) / (2 * sigma**2))
    return (psf / psf.sum()).astype(np.float32)


def picture(side: int) -> np.ndarray:
    """A picture `[1, y, x, 3]`, 0 to 1."""
    return (astronaut()[:side, 100 : 100 + side] / 255).astype(np.float32)[None]


def blurred(image: np.ndarray, psf: np.ndarray) -> np.ndarray:
    """Periodic convolution of `[1, y, x, c]` with one PSF, in double precision."""
    kernel = np.zeros(image.shape[1:3])
    kernel[: psf.shape[0], : psf.shape[1]] = psf
    kernel = np.roll(kernel, (-(psf.shape[0] // 2), -(psf.shape[1] // 2)), (0, 1))
    return np.fft.ifft2(np.fft.fft2(image, axes=(1, 2)) * np.fft.fft2(kernel)[None, :, :, None], axes=(1, 2)).real


def test_a_known_blur_is_inverted() -> None:
    image, psf = picture(128), gaussian(31, 0.9, (1.5, -2.0))
    seen = jnp.asarray(blurred(image, psf), jnp.float32)
    blur = blur_at(jnp.asarray(np.broadcast_to(psf, (1, 3, 31, 31))), (128, 128))
    found = deblurred(seen, blur, jnp.full(3, np.log(1e-6)), taper=False)
    before, after = (np.sqrt(np.mean((np.asarray(i) - image) ** 2)) for i in (seen, found))
    # A Gaussian of 0.9 pixels passes 2 % at the highest frequency of an axis, and 3e-4 in the corners.
    assert after < before / 10


def test_the_filter_is_the_formula() -> None:
    image, psf = picture(32), gaussian(15, 2.0)
    blur = blur_at(jnp.asarray(np.broadcast_to(psf, (1, 3, 15, 15))), (32, 32))
    found = deblurred(jnp.asarray(image), blur, jnp.full(3, np.log(0.01)), taper=False)
    kernel = np.roll(np.pad(psf, ((0, 17), (0, 17))), (-7, -7), (0, 1))
    h = np.fft.fft2(kernel)[None, :, :, None]
    wanted = np.fft.ifft2(np.fft.fft2(image, axes=(1, 2)) * np.conj(h) / (abs(h) ** 2 + 0.01), axes=(1, 2)).real
    # Transforms in single precision.
    np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.mark.parametrize(("scale", "window"), [(1, 33), (2, 65), (4, 129), (8, 257)])
def test_every_sample_of_a_psf_is_shared_out_once(scale: int, window: int) -> None:
    share = sharing(window, 40, scale)
    assert np.all(share.sum(axis=0) == 1)
    assert np.all(share >= 0)
    middle = share[:, window // 2]
    assert middle[0] == 1
    assert middle.sum() == 1


@pytest.mark.parametrize("scale", [1, 2, 4, 8])
def test_scales_keep_the_gain_at_one(scale: int) -> None:
    psf = jnp.asarray(0.7 * np.broadcast_to(gaussian(65, 6.0), (1, 1, 65, 65)))
    blur = blur_at(psf, (32, 32), scale)
    np.testing.assert_allclose(blur.transfer[0, 0, 0, 0], 1.0, atol=1e-6)
    even = jnp.ones((1, 32, 32, 1))
    # Even light comes out even: 1 / (1 + e^r).
    np.testing.assert_allclose(deblurred(even, blur, jnp.full(1, np.log(1e-3))), 1 / 1.001, atol=1e-5)
    whole = blur_at(psf, (64, 64), unit=False)
    np.testing.assert_allclose(whole.transfer[0, 0, 0, 0], 0.7, atol=1e-5)


def test_a_coarse_psf_is_that_of_the_fine_one() -> None:
    # Blurred by a Gaussian much wider than the scale, then looked at every fourth pixel.
    fine, scale = gaussian(129, 12.0), 4
    coarse = blur_at(jnp.asarray(fine[None, None]), (32, 32), scale)
    wanted = blur_at(jnp.asarray(gaussian(33, 3.0)[None, None]), (32, 32))
    # Sums over four samples widen it by their own variance, (4² + 2) / 12 in fine pixels: 1 % of 12².
    np.testing.assert_allclose(coarse.transfer, wanted.transfer, atol=0.01)


@pytest.mark.slow
def test_one_transfer_function_per_colour_serves_all_features() -> None:
    rng = np.random.default_rng(0)
    psf = np.stack([gaussian(9, s) for s in (0.5, 1.0, 2.0)])[None]
    features = jnp.asarray(rng.random((1, 16, 16, 12), np.float32))
    blur = blur_at(jnp.asarray(psf), (16, 16))
    together = deblurred(features, blur, jnp.full(12, np.log(0.1)))
    for k in (0, 4, 11):
        one = blur_at(jnp.asarray(psf[:, k % 3][:, None]), (16, 16))
        alone = deblurred(features[..., k : k + 1], one, jnp.full(1, np.log(0.1)))
        np.testing.assert_allclose(together[..., k : k + 1], alone, atol=1e-5)


def test_tapered_edges_meet() -> None:
    blur = blur_at(jnp.asarray(gaussian(33, 3.0)[None, None]), (64, 64))
    ramp = jnp.asarray(np.linspace(0, 1, 64, dtype=np.float32)[:, None] + np.zeros((64, 64), np.float32))
    found = np.asarray(tapered(ramp[None, None, None], blur))[0, 0, 0]
    # The step from the last row to the first is no larger than those around it were made.
    assert abs(found[0, 5] - found[-1, 5]) < 0.1 < abs(float(ramp[0, 5] - ramp[-1, 5]))
    np.testing.assert_allclose(found[32], np.asarray(ramp)[32], atol=0.01)  # the middle stays


def test_the_taper_keeps_edges_from_ringing() -> None:
    # The true blur sees beyond the edges; the filter thinks that they meet.
    large, psf = picture(192), gaussian(33, 3.0)
    seen = jnp.asarray(blurred(large, psf)[:, 32:160, 32:160], jnp.float32)
    scene = large[:, 32:160, 32:160]
    blur = blur_at(jnp.asarray(np.broadcast_to(psf, (1, 3, 33, 33))), (128, 128))
    errors = {
        taper: np.sqrt(
            np.mean((np.asarray(deblurred(seen, blur, jnp.full(3, np.log(1e-3)), taper=taper)) - scene) ** 2)
        )
        for taper in (False, True)
    }
    assert errors[True] < 0.7 * errors[False]


def haze(window: int, share: float) -> np.ndarray:
    """A PSF that keeps `share` of its light in a spot and spreads the rest evenly over a disc."""
    offset = np.arange(window) - window // 2
    disc = (offset[:, None] ** 2 + offset[None, :] ** 2 <= offset[-1] ** 2).astype(np.float32)
    psf = (1 - share) * disc / disc.sum()
    psf[window // 2, window // 2] += share
    return psf


def test_light_spread_across_a_whole_picture_comes_back() -> None:
    """A third of it in the spot, the rest over half of the picture: hopeless with tapered edges."""
    scene, psf = picture(128), 0.8 * haze(71, 1 / 3)
    round_about = np.concatenate([scene, scene[:, ::-1]], axis=1)
    round_about = np.concatenate([round_about, round_about[:, :, ::-1]], axis=2)
    seen = jnp.asarray(blurred(round_about, psf)[:, :128, :128], jnp.float32)
    psf = jnp.asarray(np.broadcast_to(psf, (1, 3, 71, 71)))
    mirrored = sharpened(seen, psf, jnp.full(3, np.log(1e-6)))
    faded = deblurred(seen, blur_at(psf, (128, 128), unit=False), jnp.full(3, np.log(1e-6)))
    # What is left is the regulariser beside |H|², 0.04 where the disc's transform is most negative, and rounding.
    np.testing.assert_allclose(mirrored, scene, atol=1e-3)
    assert np.sqrt(np.mean((np.asarray(faded) - scene) ** 2)) > 0.03  # of white


def test_an_even_window_is_refused() -> None:
    with pytest.raises(ValueError, match="must be odd"):
        blur_at(jnp.ones((1, 1, 4, 4)), (8, 8))
