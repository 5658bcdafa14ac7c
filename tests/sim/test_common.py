"""The common part of far PSFs, on apertures of which it is known what their parts send where."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import fftconvolve

from sim.imaging.common import common_psf, with_common
from sim.imaging.disc import shadow_disc

DISC = np.asarray(shadow_disc(9.4, 11), np.float64)
WINDOW = 63


def spots(*places: tuple[int, int], window: tuple[int, int] = (WINDOW, WINDOW)) -> np.ndarray:
    """Equal spots (y, x) from the middle, all together 0.9."""
    psf = np.zeros(window)
    for y, x in places:
        psf[(window[0] - 1) // 2 + y, (window[1] - 1) // 2 + x] += 0.9 / len(places)
    return psf


def blurred(psf: np.ndarray, by: np.ndarray = DISC) -> np.ndarray:
    return fftconvolve(psf, by, mode="same")


def common(far: np.ndarray, near: np.ndarray, disc: np.ndarray = DISC) -> np.ndarray:
    arrays = (jnp.asarray(array, jnp.float32) for array in (far, near, disc))
    return np.asarray(common_psf(*arrays), np.float64)


@pytest.mark.parametrize("places", [[(0, 0)], [(3, 15)], [(0, 0), (-12, 7), (12, -7)]])
@pytest.mark.parametrize("window", [(63, 63), (60, 71)])
def test_all_is_common_where_every_part_sends_alike(places, window):
    """A lens, and gratings without a central order and with one: the near PSF is the far one blurred by the disc."""
    far = spots(*places, window=window)
    # Float32 transforms of light up to 0.9, times 100 for the slowest waves.
    np.testing.assert_allclose(common(far, blurred(far)), far, atol=3e-5)


def halves() -> tuple[np.ndarray, np.ndarray]:
    """Far and near PSF of an aperture whose halves send to 12 pixels on either side."""
    x = np.arange(11) - 5
    left = DISC * np.where(x < 0, 1.0, np.where(x == 0, 0.5, 0.0))
    sides = [spots((0, 12)), spots((0, -12))]
    # The rays of a near point that pass the aperture at x land x aside.
    near = sum(blurred(spot, part) for spot, part in zip(sides, (left, left[:, ::-1]), strict=True))
    return 0.5 * (sides[0] + sides[1]), np.asarray(near)


def test_a_shadow_over_everything_leaves_nothing():
    """far - d * near = common - d * d * common: what a hidden point leaves on the sensor is nothing."""
    far, near = halves()
    found = common(far, near)
    left = far - blurred(near) - found + blurred(blurred(found))
    whole = blurred(blurred(far)) - blurred(near)  # were all of it common
    # But for the slowest waves, which count as common: a seventh was found.
    assert np.linalg.norm(left) < 0.2 * np.linalg.norm(whole)


def test_parts_that_send_to_one_place_at_both_depths():
    """A near PSF like the far one: far = common + d * common, by hand."""
    far = spots((0, 0))
    found = common(far, far)
    # The slowest waves again, 6e-4 of a spot of 0.9.
    np.testing.assert_allclose(found + blurred(found), far, atol=1e-3)


def test_layers_for_every_obstruction():
    psf = np.random.default_rng(0).uniform(0.5, 1.5, (2, 3, 21, 24)).astype(np.float32)
    discs = [np.stack([shadow_disc(width, 11)] * (k + 1)) for k, width in enumerate((4.0, 9.4))]
    found = np.asarray(with_common(psf, discs))
    assert found.shape == (2, 7, 21, 24)
    np.testing.assert_array_equal(found[:, :3], psf)
    # Sums of 500 pixels in single precision.
    np.testing.assert_allclose(found[:, 5:].sum((2, 3)), psf[:, :1].sum((2, 3)) * [1, 1], rtol=1e-5)
    ratio = found[:, 5:] / psf[:, 1:]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[..., :1, :1], ratio.shape), rtol=1e-5)
    for k, disc in enumerate(discs):
        one = common(psf[:, 0], found[:, 5 + k], disc[0])
        np.testing.assert_allclose(found[:, 3 + k], one, atol=1e-5)


def test_a_layer_without_light_stays_dark():
    psf = np.ones((2, 15, 15), np.float32)
    psf[1] = 0
    found = np.asarray(with_common(psf, [DISC[None].astype(np.float32)]))
    assert not found[3].any()
    assert np.isfinite(found).all()


def test_nothing_in_the_way_needs_no_common_part():
    psf = np.ones((1, 5, 5), np.float32)
    np.testing.assert_array_equal(with_common(psf, []), psf)


def test_a_disc_wider_than_the_window():
    far = spots((0, 0), window=(7, 7))
    near = fftconvolve(far, DISC, mode="full")[5:12, 5:12]
    assert np.isfinite(common(far, near)).all()
