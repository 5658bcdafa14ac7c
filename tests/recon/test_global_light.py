"""The low-resolution branch for veil and gain: how far it sees, what it undoes, and that it begins near nothing."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.recon.global_light import GlobalLight, described, enlarged, smooth_light, unveiled
from doedesign.recon.network import Network, NetworkShape
from doedesign.recon.tiles import reconstruct_tiled
from doedesign.recon.weights import read_network, write_network
from fab.archive import read_archive
from sim.light import srgb_from_linear
from tests.recon.drawn_networks import count_parameters, drawn

PLAIN = NetworkShape(width=3, depth=2)
WITH = replace(PLAIN, global_light=True)
CALL = eqx.filter_jit(Network.__call__)
POINT = jnp.zeros((1, 3, 9, 9)).at[..., 4, 4].set(1.0)


def capture(*shape: int) -> jax.Array:
    """A capture in linear light."""
    return jax.random.uniform(jax.random.key(5), (1, 3, *shape), minval=0.05)


def branch(*, of_mean: bool = True) -> GlobalLight:
    """A branch with weights large enough to see what they do; without the means if they are to be left out."""
    made = GlobalLight.make(np.random.default_rng(0), 3)
    made = eqx.tree_at(lambda b: b.last, made, 30 * made.last)
    if of_mean:
        return made
    return eqx.tree_at(lambda b: [layer.of_mean for layer in b.layers], made, [0 * x.of_mean for x in made.layers])


@pytest.mark.parametrize("of_mean", [True, False])
def test_it_sees_the_whole_picture(of_mean: bool) -> None:
    """A corner of a training picture hears of the opposite one, 16 cells away; by its convolutions alone, too."""
    made = branch(of_mean=of_mean)

    @jax.jit
    @jax.grad
    def slope(light: jax.Array) -> jax.Array:
        found = made(light, 4)
        return found.log_gain[0, -1, -1, 0] + found.veil[0, -1, -1, 0]

    seen = slope(capture(64, 64).transpose(0, 2, 3, 1))
    assert float(jnp.abs(seen[0, :4, :4]).max()) > 0


def test_it_undoes_a_veil_that_it_knows() -> None:
    """Brightness and gain of a veil of eq. 10 with a smooth alpha give the light behind it back."""
    y = jnp.linspace(0, 1, 24)[None, :, None, None]
    scene = 0.5 + 0.2 * jnp.sin(40 * y + jnp.arange(24)[None, None, :, None] + jnp.arange(3))
    mean = jnp.full(scene.shape, 0.5)
    alpha, own = 0.2 + 0.6 * y, jnp.array([0.2, 0.1, 0.05])
    seen, middle = ((1 - alpha) * light + alpha * own for light in (scene, mean))
    log_gain = jnp.broadcast_to(-jnp.log(1 - alpha), (1, 24, 24, 1))
    found = smooth_light(middle, log_gain, jnp.log(mean / middle))
    np.testing.assert_allclose(found.veil, jnp.broadcast_to(alpha * own, scene.shape), atol=1e-6)
    np.testing.assert_allclose(unveiled(seen, found), scene, atol=1e-5)
    # A gain alone leaves the mean of the light where it is.
    lifted = unveiled(middle, smooth_light(middle, log_gain, jnp.zeros(scene.shape)))
    np.testing.assert_allclose(lifted, middle, atol=1e-6)


def test_cells_are_described_and_enlarged() -> None:
    light = jnp.tile(jnp.array([[0.2, 0.6], [0.2, 0.6]]), (4, 4))[None, :, :, None]
    found = described(light, 4)
    assert found.shape == (1, 2, 2, 3)
    # Mean 0.4 and least 0.2 as display values; the spread is 0.2.
    np.testing.assert_allclose(
        found[0, 0, 0], [0.4 ** (1 / 2.2), 0.2 ** (1 / 2.2), (np.log(0.2) + 3.5) / 1.2], rtol=1e-4
    )
    ramp = jnp.broadcast_to(jnp.arange(8.0)[None, None, :, None], (1, 8, 8, 1))
    large = enlarged(ramp, (32, 32))[0, 5, :, 0]
    # A pixel k of the large one lies at (k + 1/2) / 4 - 1/2 cells; beyond the outermost middles it is that cell.
    np.testing.assert_allclose(large, np.clip((np.arange(32) + 0.5) / 4 - 0.5, 0, 7), atol=1e-5)


def test_it_begins_near_nothing() -> None:
    made = GlobalLight.make(np.random.default_rng(1), 3)
    light = capture(32, 32).transpose(0, 2, 3, 1)
    # Its last layer begins with a hundredth of the usual weights, and logarithms are 2.5 times that.
    assert 0 < float(jnp.abs(unveiled(light, made(light, 4)) - light).max()) < 0.1
    # 3 numbers of every colour; five layers; a gain and 3 brightnesses.
    w = 32
    assert count_parameters(made) == 9 * w + w + 5 * (10 * w * w + w) + 4 * w
    with_it, plain = (Network.make(layout, 1) for layout in (WITH, PLAIN))
    # The features see the clearer capture, too.
    assert count_parameters(with_it) == count_parameters(plain) + count_parameters(made) + 49 * 3 * 3


@pytest.mark.slow
def test_gradients_reach_every_weight() -> None:
    network = drawn(WITH, 0.2)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(net: Network) -> jax.Array:
        return jnp.mean(jnp.abs(net(capture(32, 32), POINT, POINT) - srgb_from_linear(capture(32, 32))))

    for leaf in jax.tree.leaves(slope(network).light):
        assert bool(jnp.all(jnp.isfinite(leaf)))
        assert float(jnp.abs(leaf).max()) > 0


def test_files_of_networks_without_it_stay_what_they_were(tmp_path) -> None:
    for layout in (PLAIN, WITH):
        network = drawn(layout)
        write_network(tmp_path / "network.npz", network, {})
        said = read_archive(tmp_path / "network.npz", "network file", "")[0]["layout"]
        assert ("global_light" in said) == layout.global_light
        found, _ = read_network(tmp_path / "network.npz")
        assert found.layout == layout
        assert jax.tree.structure(found) == jax.tree.structure(network)


@pytest.mark.slow
def test_tiles_agree_but_for_what_a_tile_has_as_a_whole() -> None:
    """Three tiles beside one: within a tenth of what the network changes, as without the branch."""
    layout = replace(WITH, depth=1)
    network = drawn(layout, 0.02)
    image = np.asarray(capture(64, 160))[0]
    psf = np.asarray(POINT)[0]
    one, several = (
        reconstruct_tiled(network, image, psf, psf, tile=tile, overlap=16, multiple=layout.multiple)
        for tile in (160, 64)
    )
    inner = (slice(None), slice(12, -12), slice(12, -12))
    corrected, apart = ((found - one)[inner].std() for found in (srgb_from_linear(image), several))
    assert 1e-5 * corrected < apart < 0.1 * corrected
