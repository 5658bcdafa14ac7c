from math import asin, pi, radians, sin
from typing import Any

import numpy as np
import pytest

from fab.errors import InputError
from sim.obstruction import CameraView, Raindrop
from sim.obstruction.raindrop import Drop, refracted

VIEW = CameraView((256, 256), 7.4e-6, 8e-3)
SQUARE: dict[str, Any] = {"tilt_rad": (0.0, 0.0), "elongation": (1.0, 1.0), "contrast": (1.0, 1.0)}
INDEX = 1.333


def shown(background: np.ndarray, **other: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light in one round drop of 4 mm amid the frame, and coordinates about its middle."""
    wide: dict[str, Any] = {
        "radius_m": (4e-3, 4e-3),
        "depth_m": (0.1, 0.1),
        "contact_rad": (0.6, 0.6),
        "per_m2": (0.0, 0.0),
    }
    wide |= SQUARE | {"depth_m": (0.1, 0.1)} | other
    kind = Raindrop(**wide)
    drawn = kind.draw(np.random.default_rng(4), VIEW, background)
    mask = np.asarray(drawn.mask) > 0.999
    y, x = np.nonzero(mask)
    return np.asarray(drawn.radiance)[:, mask], y - y.mean(), x - x.mean()


def test_without_tilt_the_angle_is_that_of_the_closed_form():
    heights = np.array([[0.0, 0.1, 0.3, 0.5, -0.5]])
    tangents = heights / np.sqrt(1 - heights**2)
    rays = refracted(tangents, np.zeros_like(tangents), 0.0)
    expected = [-(asin(INDEX * s) - asin(s)) for s in heights[0]]
    np.testing.assert_allclose(rays.elevation[0], expected, atol=1e-6)
    np.testing.assert_allclose(rays.azimuth, 0, atol=1e-7)
    sideways = refracted(np.zeros_like(tangents), tangents, 0.0)
    np.testing.assert_allclose(sideways.azimuth[0], expected, atol=1e-6)


def test_a_flat_film_turns_nothing_and_passes_what_fresnel_says():
    flat = np.zeros((1, 1))
    for tilt in (0.0, 0.5):
        rays = refracted(flat, flat, tilt, (0.05, -0.02))
        assert np.tan(rays.elevation[0, 0]) == pytest.approx(0.05, abs=1e-6)
        assert np.tan(rays.azimuth[0, 0]) == pytest.approx(-0.02, abs=1e-6)
    assert refracted(flat, flat, 0.0).passed[0, 0] == pytest.approx(1 - ((INDEX - 1) / (INDEX + 1)) ** 2)


def test_beyond_the_critical_angle_nothing_passes():
    heights = np.array([[0.999 / INDEX, 1.001 / INDEX]])
    rays = refracted(heights / np.sqrt(1 - heights**2), np.zeros((1, 2)), 0.0)
    assert rays.passed[0, 0] > 0.2
    assert rays.passed[0, 1] == 0


def test_glass_that_leans_back_shows_the_region_above():
    drop = Drop(50.0, 50.0, 40.0, 40.0, pi / 2)
    along, across = drop.coordinates((slice(0, 101), slice(0, 101)))
    inside = drop.cover(along, across) > 0.999
    means, shares = [], []
    for tilt in (0.0, 0.8, 1.0):
        rays = refracted(*drop.cap(along, across, 0.6), tilt)
        means.append(np.average(rays.elevation[inside], weights=rays.passed[inside]))
        shares.append(rays.passed[inside].mean())
        assert rays.passed[12, 50] > 0.5
        assert (rays.passed[88, 50] > 0.5) == (tilt == 0)
    assert means[0] == pytest.approx(0, abs=1e-3)
    assert radians(2) < means[1] < means[2]
    assert 0.98 > shares[0] > shares[1] > shares[2] > 0.4


def test_the_image_is_inverted():
    ramp_y = np.broadcast_to(np.linspace(0.1, 0.9, 256, dtype=np.float32)[:, None], (3, 256, 256))
    light, y, x = shown(ramp_y)
    assert light[0, y > 5].mean() < light[0, y < -5].mean() - 0.05
    assert np.corrcoef(light[0], y)[0, 1] < -0.95
    light, y, x = shown(np.ascontiguousarray(ramp_y.swapaxes(1, 2)))
    assert np.corrcoef(light[0], x)[0, 1] < -0.95


def test_the_picture_is_seen_at_the_angle_that_it_stands_for():
    # A bright right half: its edge is straight ahead, wherever the drop is.
    half = np.zeros((3, 256, 256), np.float32)
    half[:, :, 128:] = 0.8
    light, _, x = shown(half, rim=(0.0, 0.0))
    # The drop's own direction is off the axis by up to a few degrees, hence not exactly in its middle.
    assert light[0, x < -20].min() > 0.5
    assert light[0, x > 20].max() < 0.2


def test_in_even_light_a_drop_cannot_be_seen():
    even = np.full((3, 256, 256), 0.4, np.float32)
    light, _, _ = shown(even, rim=(1.0, 1.0), tilt_rad=(0.9, 0.9))
    # What is not passed is reflected: together, all of it.
    np.testing.assert_allclose(light, 0.4, rtol=1e-5)
    dark, _, _ = shown(even, rim=(0.0, 0.0), contact_rad=(1.2, 1.2))
    assert dark.min() == 0
    assert dark.max() == pytest.approx(0.4 * (1 - ((INDEX - 1) / (INDEX + 1)) ** 2), rel=1e-3)


@pytest.mark.parametrize("elongation", [1.0, 1.5])
def test_half_a_disc_and_half_an_ellipse(elongation: float):
    radius = 30.0
    drop = Drop(70.3, 60.6, radius, elongation * radius, 2.0)
    window = (slice(0, 140), slice(0, 120))
    cover = drop.cover(*drop.coordinates(window))
    # First-order distances at an ellipse's edge.
    assert cover.sum() == pytest.approx(pi / 2 * radius**2 * (1 + elongation), rel=2e-3)
    y, x = np.nonzero(cover > 0.5)
    flow = (x - 60.6) * np.cos(2.0) + (y - 70.3) * np.sin(2.0)
    assert flow.max() == pytest.approx(elongation * radius, abs=1)
    assert flow.min() == pytest.approx(-radius, abs=1)


def test_a_drop_of_2_mm_at_5_cm():
    view = CameraView((512, 512), 3.7e-6, 8e-3)
    kind = Raindrop(depth_m=(0.05, 0.05), radius_m=(2e-3, 2e-3), elongation=(1.0, 1.0), per_m2=(0.0, 0.0))
    grey = np.full((3, 512, 512), 0.5, np.float32)
    for seed in range(30):
        mask = np.asarray(kind.draw(np.random.default_rng(seed), view, grey).mask)
        if not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()):
            # 86.49 pixels of radius by eq. 11.
            assert mask.sum() == pytest.approx(pi * 86.49**2, rel=1e-3)
            assert (mask.max(axis=0) > 0.5).sum() == pytest.approx(2 * 86.49, abs=1)
            return
    pytest.fail("no whole drop in thirty frames")


def test_drops_are_as_many_as_their_density_and_do_not_touch():
    kind = Raindrop(radius_m=(0.2e-3, 0.2e-3), elongation=(1.0, 1.0), per_m2=(2e4, 2e4))
    counts = []
    for seed in range(40):
        drops = kind.drops(np.random.default_rng(seed), VIEW, 0.1, pi / 2)
        assert all(not a.touches(b) for i, a in enumerate(drops) for b in drops[:i])
        assert any(drop.centred(VIEW) for drop in drops)
        counts.append(sum(drop.centred(VIEW) for drop in drops))
    area_m2 = (256 * VIEW.pixel_at_m(0.1)) ** 2
    # Some 11 per frame; 40 frames leave 5 % of scatter, and a tenth of the drops give way to others.
    assert np.mean(counts) == pytest.approx(2e4 * area_m2, rel=0.2)


def test_the_cap_meets_the_glass_at_the_contact_angle():
    drop = Drop(0.0, 0.0, 10.0, 15.0, 0.0)
    tangent_y, tangent_x = drop.cap(np.array([[-10.0, 0.0]]), np.array([[0.0, 10.0]]), 0.7)
    assert np.arctan(-tangent_x[0, 0]) == pytest.approx(0.7, rel=1e-5)
    assert np.arctan(tangent_y[0, 1]) == pytest.approx(0.7, rel=1e-5)
    assert sin(0.7) * INDEX < 1


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"depth_m": (0.0, 0.0)}, "depth_m"),
        ({"radius_m": (-1e-3, 1e-3)}, "radius_m"),
        ({"elongation": (0.0, 1.0)}, "elongation"),
        ({"contact_rad": (0.5, 2.0)}, "contact_rad"),
        ({"tilt_rad": (0.0, 1.6)}, "tilt_rad"),
        ({"rim": (-1.0, 0.0)}, "rim"),
        ({"surroundings_rad": 0.0}, "surroundings_rad"),
    ],
)
def test_what_cannot_be_meant_is_refused(wrong: dict[str, Any], name: str):
    with pytest.raises(InputError, match=f"raindrop: {name}: must"):
        Raindrop(**wrong)


@pytest.mark.parametrize("seed", range(12))
def test_drops_do_not_touch(seed: int):
    """Sparse ones, too, of which one is put into the frame when none lies there."""
    for many in (5e3, 4e5):
        kind = Raindrop(per_m2=(many, many), radius_m=(0.2e-3, 0.9e-3))
        found = kind.drops(np.random.default_rng(seed), VIEW, 0.1, 0.0)
        assert any(drop.centred(VIEW) for drop in found)
        for k, drop in enumerate(found):
            assert not any(drop.touches(other) for other in found[k + 1 :])


def test_a_drop_that_is_put_into_the_frame_takes_the_place_of_those_that_it_touches():
    """Large drops about a frame in which none is centred: of many draws some have such neighbours."""
    kind, kept = Raindrop(per_m2=(2e3, 2e3), radius_m=(4e-3, 7e-3)), 0
    for seed in range(400):
        found = kind.drops(np.random.default_rng(seed), VIEW, 0.1, 0.0)
        if sum(drop.centred(VIEW) for drop in found) == 1:
            kept += len(found) > 1
        for k, drop in enumerate(found):
            assert not any(drop.touches(other) for other in found[k + 1 :])
    assert kept > 20
