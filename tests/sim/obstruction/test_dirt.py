from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fab.errors import InputError
from sim.obstruction import CameraView, Dirt
from sim.obstruction.dirt import SOILS, layer
from sim.obstruction.noise import layered_noise

VIEW = CameraView((192, 256), 7.4e-6, 8e-3)
GREY = np.full((3, 192, 256), 0.5, np.float32)


def clump_width_m(dirt: Dirt, depth_m: float) -> float:
    """Distance at which the mask's correlation has fallen to one half, mean over seeds, on the glass."""
    total = np.zeros(80)
    for seed in range(6):
        drawn = replace(dirt, depth_m=(depth_m, depth_m)).draw(np.random.default_rng(seed), VIEW, GREY)
        mask = np.asarray(drawn.mask) - np.mean(drawn.mask)
        total += [float((mask[:, : 256 - lag] * mask[:, lag:]).mean()) for lag in range(80)]
    return float(np.interp(-0.5, -total / total[0], np.arange(80))) * VIEW.pixel_at_m(depth_m)


def test_clumps_have_a_size_of_their_own():
    dirt = Dirt(clump_m=(3e-3, 3e-3), coverage=(0.3, 0.3), octaves=2)
    near, far = clump_width_m(dirt, 0.06), clump_width_m(dirt, 0.12)
    # Six frames of a few dozen clumps; and on the nearer glass, fewer of them fit into the frame.
    assert near / far == pytest.approx(1.0, abs=0.2)
    assert 0.3e-3 < far < 1e-3
    assert clump_width_m(replace(dirt, clump_m=(1.5e-3, 1.5e-3)), 0.12) / far == pytest.approx(0.5, rel=0.2)


def test_clumps_are_narrower_than_they_are_apart():
    """A straight way through a clump, for the mean point on it, is 0.6 of the width of noise cells."""
    view, dark = CameraView((320, 320), 29.6e-6, 16e-3), np.zeros((3, 320, 320), np.float32)
    longest, clump_m = [], 5e-3
    for seed in range(12):
        drawn = Dirt(clump_m=(clump_m, clump_m)).draw(np.random.default_rng(seed), view, dark)
        rows = np.pad(np.asarray(drawn.mask) >= 0.5, ((0, 0), (1, 1))).astype(int)
        steps = np.diff(rows, axis=1)
        ways = (np.nonzero(steps < 0)[1] - np.nonzero(steps > 0)[1]) * view.pixel_at_m(float(drawn.depth_m))
        longest.append(np.sum(ways**2) / np.sum(ways))
    # Seeds differ by 0.14, their mean by 0.04.
    assert np.mean(longest) / clump_m == pytest.approx(0.6, abs=0.1)


def test_the_threshold_leaves_the_share_asked_for(rng: np.random.Generator):
    field = layered_noise(rng, (200, 300), 40.0)
    for share in (0.05, 0.3, 0.8):
        # Ties apart, a quantile is exact to one pixel.
        assert np.mean(layer(field, share, 2.0) > 0) == pytest.approx(share, abs=1e-3)


def test_a_layer_thickens_inward():
    ramp = np.tile(np.arange(101, dtype=np.float32), (4, 1))
    opacity = layer(ramp, 0.5, 10.0)[0]
    assert np.all(opacity[:50] == 0)
    # The slope is exactly one per pixel here, so the law can be read off.
    np.testing.assert_allclose(opacity[51:], -np.expm1(-np.arange(1, 51) / 10), atol=1e-5)
    # However thin the edge is meant to be, it is no step.
    assert 0 < layer(ramp, 0.5, 0.0)[0, 51] < 1


def test_a_low_pass_removes_ragged_edges():
    def edge_length(blur_m: float) -> float:
        dirt = Dirt(blur_m=(blur_m, blur_m), coverage=(0.3, 0.3), depth_m=(0.1, 0.1))
        mask = np.asarray(dirt.draw(np.random.default_rng(3), VIEW, GREY).mask) > 0
        return float((mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum())

    assert edge_length(0.5e-3) < 0.7 * edge_length(0.0)


def test_soils_are_those_of_the_colour_charts():
    # Luminance of Munsell values 3, 4 and 5, over that of a perfect white (1.0257 times the chart's).
    for colour, y in zip(SOILS.values(), (6.555, 12.0, 19.77), strict=True):
        # Four digits of each colour are kept.
        assert np.dot((0.2126, 0.7152, 0.0722), colour) == pytest.approx(y / 102.57, rel=2e-3)


def test_colour_and_opacity_stay_within_what_was_asked(rng: np.random.Generator):
    dirt = Dirt(opacity=(0.7, 0.7), grain=0.0, light=(1.0, 1.0), colour_jitter=0.01)
    for _ in range(5):
        drawn = dirt.draw(rng, VIEW, GREY)
        # Reached deep inside a clump only.
        assert 0.65 < np.max(drawn.mask) <= np.float32(0.7)
        colour = np.asarray(drawn.radiance)[:, 0, 0]
        assert min(np.abs(colour - soil).max() for soil in SOILS.values()) <= 0.01 + 1e-6
        assert np.ptp(np.asarray(drawn.radiance), axis=(1, 2)).max() == 0


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"depth_m": (0.0, 0.1)}, "depth_m"),
        ({"depth_m": (0.12, 0.05)}, "depth_m"),
        ({"clump_m": (0.0, 1e-3)}, "clump_m"),
        ({"coverage": (0.5, 1.5)}, "coverage"),
        ({"opacity": (-0.1, 0.5)}, "opacity"),
        ({"light": (float("nan"), 1.0)}, "light"),
        ({"octaves": 0}, "octaves"),
        ({"grain": 2.0}, "grain"),
    ],
)
def test_what_cannot_be_meant_is_refused(wrong: dict[str, Any], name: str):
    with pytest.raises(InputError, match=f"dirt: {name}: must"):
        Dirt(**wrong)
