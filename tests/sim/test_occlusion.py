"""Occlusion models on numbers that can be computed by hand: imaging that moves no light."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sim.imaging.occlusion import Layers, eq_10, eq_10_alpha, follows_light, radiometric, reciprocal, with_spot
from sim.imaging.occlusion import check_names as check

SHAPE = (3, 4)
SPOT, GAIN = 6, 1.5  # pixels of the sharp spot; what the public code multiplies alpha with


class Plain:
    """Every layer lands where it is, times the share that its PSF holds; unit sum takes all of it."""

    def __init__(self, *energies: float) -> None:
        self.energies = energies

    def one(self, layer: int, light: Any, unit: bool) -> Any:
        return light * (1.0 if unit else self.energies[layer])

    def total(self, lights: Sequence) -> Any:
        return sum(energy * light for energy, light in zip(self.energies, lights, strict=True))


def flat(value: float) -> jnp.ndarray:
    return jnp.full(SHAPE, value, jnp.float32)


def mean(light) -> float:
    assert np.ptp(light) < 1e-6
    return float(np.mean(light))


LAYERS = Layers(flat(0.8), (flat(0.5), flat(0.25)), (flat(0.2), flat(0.4)))


@pytest.mark.parametrize("shape", [(21, 24), (24, 21)])
@pytest.mark.parametrize("library", [np, jnp])
def test_the_spot_is_the_middle_of_the_background_and_layers_have_its_energy(shape: tuple[int, int], library):
    psf = np.random.default_rng(0).uniform(0.5, 1.5, (2, 3, *shape)).astype(np.float32)
    found = np.asarray(with_spot(library.asarray(psf)))
    assert found.shape == (2, 6, *shape)
    np.testing.assert_array_equal(found[:, :3], psf)
    kept = found[:, 3] != 0
    # A disc about the middle, between four pixels where there is an even number.
    y, x = np.indices(shape)
    distance = np.hypot(y - (shape[0] - 1) / 2, x - (shape[1] - 1) / 2)
    np.testing.assert_array_equal(kept, np.broadcast_to(distance <= SPOT, kept.shape))
    np.testing.assert_array_equal(found[:, 3][kept], psf[:, 0][kept])
    # Sums of 500 pixels in single precision.
    np.testing.assert_allclose(found[:, 4:].sum((2, 3)), psf[:, :1].sum((2, 3)) * [1, 1], rtol=1e-5)
    ratio = found[:, 4:] / psf[:, 1:]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[..., :1, :1], ratio.shape), rtol=1e-5)


def test_a_layer_without_light_stays_dark():
    psf = np.ones((2, 5, 5), np.float32)
    psf[1] = 0
    assert not with_spot(psf)[3].any()


def test_radiometric_light_is_what_every_layer_sends_and_nearer_ones_let_through():
    # The far obstruction lets 0.6 of the background pass; the near one 0.7 of it and 0.9 of the far one's own light.
    kept = [jnp.stack([flat(0.6)]), jnp.stack([flat(0.7), flat(0.9)])]
    wanted = 0.9 * 0.8 * 0.6 * 0.7 + 0.8 * (0.5 * 0.2) * 0.9 + 0.7 * (0.25 * 0.4)
    assert mean(radiometric(LAYERS, kept, Plain(0.9, 0.8, 0.7))) == pytest.approx(wanted, rel=1e-6)
    bare = Layers(flat(0.8), (), ())
    assert mean(radiometric(bare, [], Plain(0.9))) == pytest.approx(0.72, rel=1e-6)


def test_reciprocal_light_by_hand():
    """What each obstruction takes from the background, counted once, is missing from the spot and from the halo."""
    kept = [jnp.stack([flat(0.6)]), jnp.stack([flat(0.7), flat(0.9)])]
    energies = (0.9, 0.8, 0.7, 0.3, 0.5, 0.4)
    far, near = 0.5 * 0.8, 0.25 * 0.5 * 0.8  # taken by the far obstruction, and by the near one of what is left
    spot = far + near + (0.6 * 0.7 - 1) * 0.8
    wanted = 0.9 * 0.8 + 0.8 * 0.5 * 0.2 * 0.9 + 0.7 * 0.25 * 0.4 + 0.3 * spot - 0.5 * far - 0.4 * near
    found = reciprocal(LAYERS, kept, lambda _, light: light, Plain(*energies))
    assert mean(found) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize(("release", "gain"), [(False, 1.0), (True, GAIN)])
@pytest.mark.parametrize("outside", ["scene", "nothing"])
def test_eq_10_by_hand(release: bool, gain: float, outside):
    layers = Layers(flat(0.8), (flat(0.1), flat(0.2)), (flat(0.2), flat(0.4)))
    energies = (1.0, 1.0, 1.0) if release else (0.9, 0.8, 0.7)
    image, sharp = energies[0] * 0.8, 0.8
    for mask, radiance, energy in ((0.1, 0.2, energies[1]), (0.2, 0.4, energies[2])):
        alpha, covered = min(1.0, gain * mask), mask * radiance
        sharp = covered + (1 - mask) * sharp
        image = alpha * energy * (sharp if outside == "scene" else covered) + (1 - alpha) * image
    assert mean(eq_10(layers, Plain(*energies), release, outside)) == pytest.approx(image, rel=1e-6)
    assert mean(eq_10_alpha(flat(0.1), 1, Plain(*energies), release)) == pytest.approx(gain * 0.1, rel=1e-6)


def test_the_alpha_of_the_public_code_is_clamped():
    assert mean(eq_10_alpha(flat(0.99), 1, Plain(1.0, 1.0), True)) == 1.0
    assert mean(eq_10_alpha(flat(-0.1), 1, Plain(1.0, 1.0), True)) == 0.0


def test_names():
    assert [follows_light(name) for name in ("radiometric", "reciprocal", "paper", "paper_release")] == [1, 1, 0, 0]
    with pytest.raises(ValueError, match="`model` must be one of paper, paper_release"):
        check("real", "scene")
    with pytest.raises(ValueError, match="`outside` must be one of"):
        check("paper", "black")
