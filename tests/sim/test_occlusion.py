"""Occlusion models on numbers that can be computed by hand: imaging that moves no light."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sim.imaging.occlusion import Layers, eq_10, eq_10_alpha, follows_light, radiometric, reciprocal
from sim.imaging.occlusion import check_names as check

SHAPE = (3, 4)
GAIN = 1.5  # what the public code multiplies alpha with


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


def test_radiometric_light_is_what_every_layer_sends_and_nearer_ones_let_through():
    # The far obstruction lets 0.6 of the background pass; the near one 0.7 of it and 0.9 of the far one's own light.
    kept = [jnp.stack([flat(0.6)]), jnp.stack([flat(0.7), flat(0.9)])]
    wanted = 0.9 * 0.8 * 0.6 * 0.7 + 0.8 * (0.5 * 0.2) * 0.9 + 0.7 * (0.25 * 0.4)
    assert mean(radiometric(LAYERS, kept, Plain(0.9, 0.8, 0.7))) == pytest.approx(wanted, rel=1e-6)
    bare = Layers(flat(0.8), (), ())
    assert mean(radiometric(bare, [], Plain(0.9))) == pytest.approx(0.72, rel=1e-6)


def test_reciprocal_light_by_hand():
    """What each obstruction takes from the background, counted once, is missing; the common part lands elsewhere."""
    layers = Layers(flat(0.8), (flat(0.7), flat(0.25)), (flat(0.2), flat(0.4)))
    kept = [jnp.stack([flat(0.6)]), jnp.stack([flat(0.7), flat(0.9)])]
    energies = (0.9, 0.8, 0.7, 0.3, 0.2, 0.5, 0.4)
    far, near = 0.7 * 0.8, 0.25 * 0.3 * 0.8  # taken by the far obstruction, and by the near one of what is left
    moved = 0.3 * (far - 0.4 * 0.8) + 0.2 * (near - 0.6 * 0.3 * 0.8)
    wanted = 0.9 * 0.8 + 0.8 * 0.7 * 0.2 * 0.9 + 0.7 * 0.25 * 0.4 + moved - 0.5 * far - 0.4 * near
    found = reciprocal(layers, kept, lambda _, light: light, Plain(*energies))
    assert mean(found) == pytest.approx(wanted, rel=1e-6)


def test_what_a_third_obstruction_takes_is_what_two_others_leave():
    masks = flat(0.7), flat(0.25), flat(0.5)
    layers = Layers(flat(0.8), masks, (flat(0.0),) * 3)
    kept = [jnp.ones((number + 1, *SHAPE)) for number in range(3)]
    only_taken_by_the_third = Plain(*[0.0] * 9, 1.0)
    found = reciprocal(layers, kept, lambda _, light: light, only_taken_by_the_third)
    assert mean(found) == pytest.approx(-0.5 * 0.75 * 0.3 * 0.8, rel=1e-6)


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
