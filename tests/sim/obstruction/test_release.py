from math import pi

import numpy as np
import pytest

from fab.errors import InputError
from sim.imaging.scene import Obstruction
from sim.light import linear_from_srgb, srgb_from_linear
from sim.obstruction import CameraView, ReleaseDirt, ReleaseFence, ReleaseRaindrop

AUTOMOTIVE = CameraView((512, 512), 3.7e-6, 8e-3)
DSLR = CameraView((256, 256), 25.8e-6, 50e-3)
GREY = np.full((3, 512, 512), 0.5, np.float32)


@pytest.mark.parametrize("kind", [ReleaseDirt(), ReleaseRaindrop()])
def test_masks_are_zeros_and_ones(kind: ReleaseDirt | ReleaseRaindrop, rng: np.random.Generator):
    assert set(np.unique(np.asarray(kind.draw(rng, AUTOMOTIVE, GREY).mask))) == {0, 1}


def test_fence_masks_are_zeros_and_ones(rng: np.random.Generator):
    drawn = ReleaseFence().draw(rng, DSLR, np.full((3, 256, 256), 0.5, np.float32))
    assert set(np.unique(np.asarray(drawn.mask))) == {0, 1}


def test_dirt_is_dark_brown_and_in_the_middle():
    total = np.zeros((512, 512))
    for seed in range(12):
        drawn = ReleaseDirt().draw(np.random.default_rng(seed), AUTOMOTIVE, GREY)
        mask = np.asarray(drawn.mask) > 0
        display = 255 * srgb_from_linear(np.asarray(drawn.radiance))[:, mask]
        # At most 2.5 times (30, 20, 10), and 5 more.
        assert np.all(display.max(axis=1) <= np.array([80, 55, 30]) + 0.01)
        assert display[0].max() > display[2].max()
        total += mask
    assert total[:80, :80].mean() < 0.3 * total[180:330, 180:330].mean()


def test_drops_are_cut_short_at_5_cm():
    near = ReleaseRaindrop(depth_m=(0.05, 0.05))
    for seed in range(4):
        mask = np.asarray(near.draw(np.random.default_rng(seed), AUTOMOTIVE, GREY).mask)
        # Two drops of 25 pixels, with an upper half at most 1.5 times as high; a row cuts 49 pixels of each.
        assert 0 < mask.sum() <= 2 * pi / 2 * 25**2 * 2.5 * 1.01
        assert (mask.sum(axis=0) > 0).sum() <= 2 * 49


def test_drops_are_upright_and_raise_the_contrast():
    ramp = np.ascontiguousarray(np.broadcast_to(np.linspace(0.15, 0.3, 512, dtype=np.float32), (3, 512, 512)))
    drawn = ReleaseRaindrop(depth_m=(0.05, 0.05)).draw(np.random.default_rng(2), AUTOMOTIVE, ramp)
    mask = np.asarray(drawn.mask) > 0
    rows, columns = np.nonzero(mask)
    one = columns < columns.min() + 49
    light = srgb_from_linear(np.asarray(drawn.radiance))[0, rows[one], columns[one]]
    assert np.corrcoef(light, columns[one])[0, 1] > 0.9
    middle = srgb_from_linear(ramp)[0, 0, int(columns[one].mean())]
    assert light.mean() == pytest.approx(0.6 + 1.5 * (float(middle) - 0.5), abs=0.02)


def test_fences_have_wires_of_5_to_15_mm():
    # A thin and a thick wire, measured by area over length where one crosses the frame alone.
    for wire_m in (5e-3, 15e-3):
        kind = ReleaseFence(depth_m=(0.8, 0.8), wire_m=(wire_m, wire_m))
        shares = [
            np.asarray(kind.draw(np.random.default_rng(s), DSLR, np.full((3, 256, 256), 0.5, np.float32)).mask).mean()
            for s in range(12)
        ]
        # Meshes of 8 to 14 wires cover about 2/11 whatever the wire; frames narrower than a mesh scatter widely.
        assert 0.08 < np.mean(shares) < 0.4


def test_the_contrast_of_a_fence_changes_about_its_mean(monkeypatch: pytest.MonkeyPatch):
    """Display values on the wires keep their mean, and their distances from it change by one factor."""
    mask = np.zeros((256, 256), np.float32)
    mask[:, 100:140] = 1
    display = np.broadcast_to(np.linspace(0.3, 0.6, 256, dtype=np.float32), (3, 256, 256))
    plain = Obstruction(mask, linear_from_srgb(np.ascontiguousarray(display)), 0.6)
    monkeypatch.setattr("sim.obstruction.release.Fence.draw", lambda *_: plain)
    factors = []
    for seed in range(8):
        drawn = ReleaseFence().draw(np.random.default_rng(seed), DSLR, GREY[:, :256, :256])
        before, after = (srgb_from_linear(np.asarray(one.radiance))[:, mask > 0] for one in (plain, drawn))
        assert after.mean() == pytest.approx(before.mean(), abs=1e-4)
        factor = after.std() / before.std()
        np.testing.assert_allclose(after - after.mean(), factor * (before - before.mean()), atol=1e-4)
        factors.append(float(factor))
    assert 0.8 <= min(factors) < 0.95
    assert 1.05 < max(factors) <= 1.2


@pytest.mark.parametrize("kind", [ReleaseDirt, ReleaseRaindrop, ReleaseFence])
def test_what_cannot_be_meant_is_refused(kind: type[ReleaseDirt]):
    with pytest.raises(InputError, match=f"{kind.name}: depth_m: must"):
        kind(depth_m=(0.0, 0.1))


@pytest.mark.parametrize("edge", [0, 1])
def test_a_release_fence_of_any_wire_can_be_drawn(rng: np.random.Generator, edge: int):
    """At both limits, whatever mesh it gets: 60 of them come near to both ends."""
    view, wire_m = CameraView((16, 16), 3.7e-6, 8e-3), ReleaseFence.limits["wire_m"][edge]
    background = np.zeros((3, 16, 16), np.float32)
    for _ in range(60):
        assert ReleaseFence(wire_m=(wire_m, wire_m)).draw(rng, view, background).mask.shape == (16, 16)


def test_release_dirt_is_not_finer_than_the_pixels(rng: np.random.Generator):
    """Far away its tile would not fit into memory."""
    view = CameraView((64, 64), 3.7e-6, 8e-3)
    background = np.zeros((3, 64, 64), np.float32)
    with pytest.raises(InputError, match="release_dirt: depth_m: must be so near"):
        ReleaseDirt(depth_m=(50.0, 50.0)).draw(rng, view, background)
