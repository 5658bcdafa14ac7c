"""Where the light of an obstructed scene goes, against closed forms."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from sim.imaging.disc import shadow_disc
from sim.imaging.formation import Optics, capture, shadow_px
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene

# The paper's automotive camera with pixels of 3.7 um: the disc of a point at 5 cm is 192 pixels wide.
APERTURE_M, FOCAL_M, PIXEL_M, DEPTH_M = 4.44e-3, 8e-3, 3.7e-6, 0.05
# A camera whose discs are small, for whole scenes: 25.6 pixels at 5 cm.
SMALL = (3.2e-3, 8e-3, 2e-5)  # aperture, focal length, pixel


def optics_of(*psf: np.ndarray) -> Optics:
    """The same PSF for all colours."""
    return Optics(np.stack([np.stack([p] * 3) for p in psf]).astype(np.float32), *SMALL)


def ring(energy: float) -> np.ndarray:
    """A near PSF as the paper's plate draws it, 31 pixels wide."""
    shape = np.exp(-((radii() - 12) ** 2))
    return energy * shape / shape.sum()


def spot(energy: float) -> np.ndarray:
    """A far PSF in the same window."""
    shape = np.exp(-(radii() ** 2) / 2)
    return energy * shape / shape.sum()


def radii() -> np.ndarray:
    axis = np.arange(31) - 15
    return np.hypot(axis[:, None], axis)


def even(value: float, shape: tuple[int, int] = (96, 100)) -> np.ndarray:
    return np.full((3, *shape), value, np.float32)


def patch(shape: tuple[int, int] = (96, 100)) -> np.ndarray:
    mask = np.zeros(shape, np.float32)
    mask[40:60, 45:55] = 1.0
    return mask


def share_cut(width_px: float, diameter_px: float) -> float:
    """Share of a disc covered by a strip through its middle: two circular segments are left."""
    half = min(width_px / diameter_px, 1.0)
    return 2 / np.pi * (np.arcsin(half) + half * np.sqrt(1 - half**2))


def test_the_disc_in_pixels_by_hand():
    """Eq. 11 for the aperture: 4.44 mm · 8 mm / (5 cm · 3.7 um); three quarters of that before a wall at 20 cm."""
    optics = Optics(np.zeros((2, 3, 1, 1), np.float32), APERTURE_M, FOCAL_M, PIXEL_M)
    assert optics.disc_px(DEPTH_M, np.inf) == pytest.approx(192.0, rel=1e-12)
    assert optics.disc_px(DEPTH_M, 0.2) == pytest.approx(144.0, rel=1e-12)


@pytest.mark.parametrize("width_m", [1e-3, 2e-3, 4e-3, 6e-3])
def test_a_strip_hides_as_much_as_it_covers_of_the_bundle(width_m: float):
    """On the axis two circular segments of the bundle pass the strip, and nothing passes a strip wider than it."""
    optics = Optics(np.ones((2, 1, 1, 1), np.float32), APERTURE_M, FOCAL_M, PIXEL_M)
    width = width_m * FOCAL_M / (DEPTH_M * PIXEL_M)
    x = np.abs(np.arange(401) - 200)
    mask = np.broadcast_to(np.clip(width / 2 + 0.5 - x, 0, 1), (201, 401)).astype(np.float32)
    light = np.ones((1, 201, 401), np.float32)
    scene = Scene(light, np.inf, (Obstruction(mask, 0 * light, DEPTH_M),))
    passed = float(capture(scene, optics, "radiometric")[0, 100, 200])
    # Float32 transforms, and a mask whose edge pixel is grey where the strip's is sharp.
    assert passed == pytest.approx(1 - share_cut(width, 192.0), abs=2e-4)


def test_behind_a_long_edge():
    """Distance by distance the passed share is that of a circular segment."""
    optics = Optics(np.ones((2, 1, 1, 1), np.float32), APERTURE_M, FOCAL_M, PIXEL_M)
    mask = np.zeros((33, 401), np.float32)
    mask[:, 201:] = 1.0  # the edge lies at 200.5
    light = np.ones((1, 33, 401), np.float32)
    scene = Scene(light, np.inf, (Obstruction(mask, 0 * light, DEPTH_M),))
    row = np.asarray(capture(scene, optics, "radiometric"))[0, 16]
    t = np.clip((200.5 - np.arange(401)) / 96, -1, 1)
    wanted = 0.5 + (np.arcsin(t) + t * np.sqrt(1 - t**2)) / np.pi
    np.testing.assert_allclose(row, wanted, atol=1e-4)  # strips of a 64th pixel in the disc, float32


def test_energy_is_conserved():
    """All light that is not cut off arrives with the far PSF's energy, the obstruction's with the near one's."""
    far, near = 0.9, 0.7
    optics = optics_of(spot(far), ring(near))
    mask, background = patch((160, 160)), even(0.0, (160, 160))
    background[:, 60:100, 60:100] = 0.8
    scene = Scene(background, np.inf, (Obstruction(mask, even(0.3, (160, 160)), DEPTH_M),))
    arrived = np.asarray(capture(scene, optics, "radiometric"), np.float64).sum(axis=(1, 2))
    disc = shadow_disc(25.6, 27)
    cut = (fftconvolve(mask, disc, mode="same") * background[0]).sum()
    wanted = far * (background[0].sum(dtype=np.float64) - cut) + near * 0.3 * mask.sum()
    # Everything lands within the frame; float32 sums of 25 600 pixels.
    np.testing.assert_allclose(arrived, wanted, rtol=2e-5)


def test_a_uniform_world_keeps_its_energy_behind_a_plate():
    """Obstruction and background equally bright, equal energies: what one takes, the other gives."""
    energy, level = 0.85, 0.6
    scene = Scene(even(level), np.inf, (Obstruction(patch(), even(level), DEPTH_M),))
    image = np.asarray(capture(scene, optics_of(spot(energy), ring(energy)), "radiometric"), np.float64)
    np.testing.assert_allclose(image.mean(axis=(1, 2)), energy * level, rtol=1e-6)


def test_a_uniform_world_looks_uniform_through_a_lens():
    """A lens alone images a near point as the very disc that it shades the background with."""
    energy, level = 0.93, 0.6
    disc = shadow_disc(25.6, 27)
    lens = fftconvolve(spot(energy), disc)
    optics = optics_of(np.pad(spot(energy), 13), lens)
    scene = Scene(even(level), np.inf, (Obstruction(patch(), even(level), DEPTH_M),))
    image = np.asarray(capture(scene, optics, "radiometric"))
    np.testing.assert_allclose(image, energy * level, atol=2e-6)


@pytest.mark.parametrize("model", ["paper", "reciprocal"])
def test_a_uniform_world_looks_uniform_through_any_plate_of_one_energy(model: Model):
    """Under eq. 10 and by reciprocity, whatever the PSFs; so what a dark obstruction takes is p_near * M."""
    energy, level = 0.93, 0.6
    optics = optics_of(spot(energy), ring(energy))
    bright = Scene(even(level), np.inf, (Obstruction(patch(), even(level), DEPTH_M),))
    np.testing.assert_allclose(capture(bright, optics, model), energy * level, atol=2e-6)
    dark = Scene(even(level), np.inf, (Obstruction(patch(), even(0.0), DEPTH_M),))
    taken = level * fftconvolve(np.pad(patch(), 15), ring(energy), mode="valid")
    image = capture(dark, optics, model, outside="nothing")
    np.testing.assert_allclose(image, np.broadcast_to(energy * level - taken, image.shape), atol=2e-6)


def test_a_lens_alone_is_the_same_to_both_models_that_follow_light(rng: np.random.Generator):
    """Then the near PSF is the far one blurred by the shadow disc, and there is no halo to differ about."""
    lens = fftconvolve(spot(0.93), shadow_disc(25.6, 27))
    optics = optics_of(np.pad(spot(0.93), 13), lens)
    light = [rng.uniform(0, 1, (3, 96, 100)).astype(np.float32) for _ in range(2)]
    scene = Scene(light[0], np.inf, (Obstruction(patch(), light[1], DEPTH_M),))
    one, other = (capture(scene, optics, model) for model in ("radiometric", "reciprocal"))
    # The spot is cut at six of its sigmas, which leaves 1e-8 of it; the rest is float32 in four transforms.
    np.testing.assert_allclose(one, other, atol=3e-6)


def test_a_hidden_point_leaves_no_light():
    """A point in full shadow sends nothing, whatever the plate: half of it to a spot, half to a ring, as here."""
    far = 0.5 * spot(1.0) + 0.5 * ring(1.0)
    near = 0.5 * fftconvolve(spot(1.0), shadow_disc(25.6, 27), mode="same") + 0.5 * ring(1.0)
    mask = np.zeros((96, 100), np.float32)
    mask[28:68, 30:70] = 1.0
    point = even(0.0)
    point[:, 48, 50] = 1.0
    scene = Scene(point, np.inf, (Obstruction(mask, even(0.0), DEPTH_M),))
    image = np.asarray(capture(scene, optics_of(far, near), "reciprocal"))
    # Float32 transforms; and of single pixels, what counts as common because it is slow: 1.1e-4 of a point of 1.
    np.testing.assert_allclose(image.sum(axis=(1, 2)), 0.0, atol=1e-5)
    np.testing.assert_allclose(image, 0.0, atol=2e-4)


@pytest.mark.parametrize("model", ["paper", "paper_release", "radiometric", "reciprocal"])
def test_a_cover_over_everything_is_all_there_is_to_see(model: Model, rng: np.random.Generator):
    """Whatever lies behind it, and with the near PSF's energy (which the release scales to 1)."""
    near, radiance = 0.7, rng.uniform(0, 1, (3, 64, 70)).astype(np.float32)
    optics = optics_of(spot(0.9), ring(near))
    cover = Obstruction(np.ones((64, 70), np.float32), radiance, DEPTH_M)
    image = np.asarray(capture(Scene(even(5.0, (64, 70)), np.inf, (cover,)), optics, model))
    kernel = ring(1.0 if model == "paper_release" else near)
    blurred = fftconvolve(np.pad(radiance, [(0, 0), (15, 15), (15, 15)], mode="reflect"), kernel[None], mode="valid")
    np.testing.assert_allclose(image, blurred, atol=5e-6)  # five times a float32 transform's rounding, for the 5.0


def test_two_obstructions_cut_independently_and_the_nearer_covers_the_farther():
    """Half-transparent covers at 10 and 5 cm, light behind each by hand."""
    shape = (64, 64)
    optics = optics_of(*[spot(1.0)] * 3)
    far = Obstruction(np.full(shape, 0.5, np.float32), even(1.0, shape), 0.1)
    near = Obstruction(np.full(shape, 0.25, np.float32), even(2.0, shape), DEPTH_M)
    image = capture(Scene(even(4.0, shape), np.inf, (far, near)), optics, "radiometric")
    np.testing.assert_allclose(image, 4.0 * 0.5 * 0.75 + 0.5 * 1.0 * 0.75 + 0.25 * 2.0, rtol=1e-5)


def test_the_nearer_shades_the_farther_by_its_own_disc():
    """A bright wall at 10 cm behind an edge at 5 cm: half the disc of a point at infinity."""
    shape = (64, 100)
    mask = np.zeros(shape, np.float32)
    mask[:, 50:] = 1.0
    wall = Obstruction(np.ones(shape, np.float32), even(1.0, shape), 0.1)
    edge = Obstruction(mask, even(0.0, shape), DEPTH_M)
    point = np.zeros((3, 3))
    point[1, 1] = 1
    scene = Scene(even(9.0, shape), np.inf, (wall, edge))
    assert shadow_px(scene, optics_of(point)) == 33
    row = np.asarray(capture(scene, optics_of(point, point, point), "radiometric"))[0, 32]
    t = np.clip((49.5 - np.arange(100)) / (25.6 / 4), -1, 1)
    wanted = 0.5 + (np.arcsin(t) + t * np.sqrt(1 - t**2)) / np.pi
    # A disc of 13 pixels across, summed on whole pixels: the edge pixels' light lies up to a sixth of a pixel off.
    np.testing.assert_allclose(row, wanted, atol=4e-3)
