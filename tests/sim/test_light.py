import jax
import jax.numpy as jnp
import numpy as np

from sim.light import linear_from_srgb, srgb_from_linear


def test_values_of_the_standard():
    """IEC 61966-2-1: the bend, mid grey and white; 0.21404 is the usual figure for a display value of one half."""
    display = np.array([0.0, 0.04045, 0.5, 1.0])
    np.testing.assert_allclose(linear_from_srgb(display), [0.0, 0.0031308, 0.2140411, 1.0], atol=1e-7)


def test_there_and_back(rng: np.random.Generator):
    display = rng.uniform(-0.1, 1.2, (3, 20, 20)).astype(np.float32)
    back = srgb_from_linear(linear_from_srgb(display))
    assert back.dtype == np.float32
    np.testing.assert_allclose(back, display, atol=1e-6)  # a few units in the last place


def test_numpy_and_jax_agree(rng: np.random.Generator):
    display = rng.uniform(0, 1, 1000).astype(np.float32)
    linear = linear_from_srgb(jnp.asarray(display))
    assert isinstance(linear, jax.Array)
    np.testing.assert_allclose(linear, linear_from_srgb(display), rtol=1e-5, atol=1e-7)


def test_gradients_are_finite_at_black():
    """Only the straight part is seen there; the power alone would give infinity."""
    for curve, slope in ((linear_from_srgb, 1 / 12.92), (srgb_from_linear, 12.92)):
        gradient = jax.vmap(jax.grad(curve))(jnp.array([0.0, -0.01, 0.5]))
        np.testing.assert_allclose(gradient[:2], slope, rtol=1e-6)
        assert np.isfinite(gradient).all()
