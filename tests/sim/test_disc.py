import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim.imaging.disc import disc_window, shadow_disc


@pytest.mark.parametrize("diameter", [0.3, 1.0, 3.7, 20.0, 61.3])
def test_unit_sum_and_even_light(diameter: float):
    window = disc_window(diameter)
    disc = shadow_disc(diameter, window)
    assert disc.sum() == pytest.approx(1, abs=1e-6)
    if diameter > 4:
        assert disc.max() == pytest.approx(4 / (np.pi * diameter**2), rel=1e-3)  # the area, by 64 strips
    np.testing.assert_array_equal(disc, disc[::-1, ::-1])


def test_the_window_just_holds_the_disc():
    assert [disc_window(d) for d in (0.5, 1.0, 1.1, 3.0, 3.1, 192.0)] == [1, 1, 3, 3, 5, 193]


def test_traced_and_known_diameters_agree():
    """A traced circle is straight within a pixel; its bow has a sagitta of 1 / (4 D) pixels over a pixel's width."""
    draw = jax.jit(lambda diameter: shadow_disc(diameter, 65))
    for diameter in (6.4, 17.3, 60.0):
        known, traced = shadow_disc(diameter, 65), np.asarray(draw(diameter))
        assert np.abs(traced - known).max() < known.max() * 0.25 / diameter


def test_a_disc_that_is_kept_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        np.asarray(shadow_disc(4.2, 7))[3, 3] = 1.0


def test_gradient_by_the_diameter():
    ramp = jnp.abs(jnp.arange(41) - 20.0)

    def spread(diameter):
        return jnp.sum(shadow_disc(diameter, 41) * ramp)

    # Mean |x| over a disc is 2 D / (3 pi); pixels change it by parts of a thousand.
    slope = jax.jit(jax.grad(spread))
    assert float(slope(24.3)) == pytest.approx(2 / (3 * np.pi), rel=0.01)
    assert np.isfinite(slope(1.0))


def test_refusals():
    with pytest.raises(ValueError, match="must be odd"):
        shadow_disc(3.0, 4)
    with pytest.raises(ValueError, match="must hold the disc"):
        shadow_disc(5.1, 5)
    assert np.isnan(jax.jit(lambda diameter: shadow_disc(diameter, 5))(5.1)).all()
