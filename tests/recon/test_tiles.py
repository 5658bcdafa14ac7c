"""Tiles: one shape, shares that add up to one, no seams, sizes of every kind."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.recon.conv import convolution
from doedesign.recon.network import NetworkShape
from doedesign.recon.tiles import plan_tiles, reconstruct_tiled
from sim.light import srgb_from_linear
from tests.recon.drawn_networks import drawn

PSF = np.ones((3, 1, 1), np.float32)
# Weights are squares of sines in single precision; sums of 25 products of order 1 round at a few 1e-7.
ROUNDING = 1e-6


def blurring(reach: int):
    """A network that looks `reach` pixels far, the same everywhere, and mirrors what lies beyond its tile."""
    kernel = np.random.default_rng(1).uniform(0, 1, (2 * reach + 1, 2 * reach + 1, 1, 1)).astype(np.float32)
    kernel /= kernel.sum()

    def call(capture, far, near):
        b, c, y, x = capture.shape
        return convolution(capture.reshape(b * c, y, x, 1), jnp.asarray(kernel), 1).reshape(b, c, y, x)

    return call


def picture(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (3, *shape)).astype(np.float32)


@pytest.mark.parametrize("shape", [(200, 331), (65, 64), (64, 190), (129, 97), (16, 400)])
def test_a_network_of_small_reach_shows_no_seam(shape: tuple[int, int]):
    # A quarter of the overlap is what a tile does not use at its edges.
    network, image, plan = blurring(4), picture(*shape), plan_tiles(shape, 64, 16, 4)
    beyond = [(n - 1) * (t - 16) + t - s for s, t, n in zip(shape, plan.tile, plan.counts, strict=True)]
    covered = np.pad(image, [(0, 0), *((0, more) for more in beyond)], mode="reflect")
    whole = np.asarray(jax.jit(network)(covered[None], None, None))[0, :, : shape[0], : shape[1]]
    found = reconstruct_tiled(network, image, PSF, PSF, tile=64, overlap=16, multiple=4)
    assert found.shape == image.shape
    np.testing.assert_allclose(found, whole, atol=ROUNDING)


def test_a_reach_beyond_the_overlap_does_show():
    """The check above can fail."""
    network, image = blurring(12), picture(100, 200)
    whole = np.asarray(jax.jit(network)(image[None], None, None))[0]
    found = reconstruct_tiled(network, image, PSF, PSF, tile=64, overlap=16, multiple=4)
    assert np.abs(found - whole).max() > 1e-3


def test_what_a_tile_has_as_a_whole_never_jumps():
    """Tiles that differ in brightness blend: no step between neighbours above that of the raised cosine."""

    def levelled(capture, far, near):
        return jnp.broadcast_to(jnp.mean(capture, axis=(2, 3), keepdims=True), capture.shape)

    image = np.repeat((np.arange(300) > 150).astype(np.float32)[None, None], 3, 0) * np.ones((1, 70, 1), np.float32)
    found = reconstruct_tiled(levelled, image, PSF, PSF, tile=96, overlap=32, multiple=4)
    # Half of the overlap, 16 pixels, from one level to the next; the cosine is pi / 2 times as steep in its middle.
    assert np.abs(np.diff(found, axis=2)).max() <= np.pi / 2 / 16 * np.ptp(found) + ROUNDING
    assert np.ptp(found) > 0.9
    assert np.ptp(found, axis=1).max() <= ROUNDING


@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (30, 16), (31, 2)])
def test_a_picture_smaller_than_a_tile_goes_through_as_one(shape: tuple[int, int]):
    seen = []

    def network(capture, far, near):
        seen.append(capture.shape)
        return 2 * capture

    image = picture(*shape)
    np.testing.assert_array_equal(reconstruct_tiled(network, image, PSF, PSF, tile=32, overlap=16), 2 * image)
    assert seen == [(1, 3, *(-(-side // 16) * 16 for side in shape))]


def test_beyond_the_picture_lies_its_mirror_image():
    seen = []

    def network(capture, far, near):
        jax.debug.callback(lambda tile: seen.append(np.asarray(tile)), capture)
        return capture

    image = picture(20, 16)
    reconstruct_tiled(network, image, PSF, PSF, tile=32, overlap=16)
    jax.effects_barrier()
    np.testing.assert_array_equal(seen[0][0, :, 20:], image[:, 18:6:-1])


def test_all_tiles_have_one_shape_and_are_counted():
    shapes, told = [], []

    def network(capture, far, near):
        shapes.append(capture.shape)  # once for each compilation
        assert far.shape == (1, 3, 5, 5)
        return capture

    far = np.zeros((3, 5, 5), np.float32)
    plan = plan_tiles((150, 230), 64, 16, 8)
    reconstruct_tiled(network, picture(150, 230), far, PSF, tile=64, overlap=16, multiple=8, on_tile=told.append)
    assert shapes == [(1, 3, *plan.tile)]
    assert told == list(range(1, plan.total + 1))
    assert plan.counts == (3, 5)


def test_plans_cover_and_fit():
    rng = np.random.default_rng(2)
    for _ in range(300):
        multiple = int(2 ** rng.integers(1, 5))
        overlap = multiple * int(rng.integers(1, 6))
        tile = 2 * overlap + multiple * int(rng.integers(0, 9))
        samples = int(rng.integers(1, 600))
        plan = plan_tiles((samples, samples), tile, overlap, multiple)
        side, count = plan.tile[0], plan.counts[0]
        assert side <= tile
        assert side % multiple == 0
        assert (count - 1) * (side - overlap) + side >= samples  # reaches the end
        assert (count - 1) * (side - overlap) < samples  # and every tile begins before it
        assert count == 1 or side >= 2 * overlap  # so that no three tiles meet along an axis
        found = (
            reconstruct_tiled(
                lambda capture, far, near: jnp.ones(capture.shape),
                np.zeros((3, samples, 1), np.float32),
                PSF,
                PSF,
                tile=tile,
                overlap=overlap,
                multiple=multiple,
            )
            if rng.random() < 0.05
            else np.ones(1)
        )
        np.testing.assert_allclose(found, 1.0, atol=3e-7)  # shares add up to one; two of them round


def test_plans_that_cannot_be_are_refused():
    for tile, overlap, message in ((60, 16, "`tile`"), (64, 8, "`overlap`"), (64, 0, "`overlap`"), (64, 48, "half")):
        with pytest.raises(ValueError, match=message):
            plan_tiles((100, 100), tile, overlap, 16)


@pytest.mark.slow
def test_a_real_network_takes_tiles():
    """One tile is the network's own result; several agree with it but for what a tile has as a whole."""
    layout = NetworkShape(width=3, depth=1)
    network = drawn(layout, 0.02)
    far, near = np.random.default_rng(3).dirichlet(np.ones(25), (2, 3)).reshape(2, 3, 5, 5).astype(np.float32)
    image = picture(64, 160)
    whole = np.asarray(eqx.filter_jit(network)(*(jnp.asarray(given[None]) for given in (image, far, near))))[0]
    one, several = (
        reconstruct_tiled(network, image, far, near, tile=tile, overlap=16, multiple=layout.multiple)
        for tile in (160, 64)
    )
    np.testing.assert_allclose(one, whole, atol=1e-5)  # compiled twice, so sums may be ordered anew
    # Edges of the picture blend with those across it, of the tile or of the whole; they are left out.
    inner = (slice(None), slice(12, -12), slice(12, -12))
    corrected, apart = ((found - whole)[inner].std() for found in (srgb_from_linear(image), several))
    assert 1e-4 * corrected < apart < 0.1 * corrected
