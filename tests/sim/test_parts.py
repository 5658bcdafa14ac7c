"""Light by parts of the aperture: against the whole PSF, closed forms, and the wave optics of a shadowed aperture."""

from dataclasses import replace

import numpy as np
import pytest

from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.imaging.parts import CoarseMask, aperture_parts, passed_shares, spread_by_disc, through_parts
from sim.imaging.shadow import shadowed_psf
from sim.optic import HeightOptic
from sim.psf_bank import psf

GREEN = 550e-9
# f/2 and 3 waves of defocus for a star: a blur of 12 um, 6 pixels.
COLOURS = (Colour("green", (GREEN,), (1.0,)),)
CAMERA = Camera(Grid((192, 192), 20e-6), 3.84e-3, "fused_silica", COLOURS, 8e-3, 2e-6, 41, defocus_m=24e-6)
LENS = HeightOptic.of(CAMERA)


@pytest.fixture(scope="module")
def parts():
    return aperture_parts(LENS, np.inf, 8)


def test_parts_add_up_to_the_psf(parts):
    whole = np.asarray(psf(LENS, depths=np.inf).energy[:, 0])
    # Pixels are integrated by sums of eight points here and exactly there.
    assert np.linalg.norm(parts.whole - whole) < 0.01 * np.linalg.norm(whole)


def test_parts_are_the_psf_exactly_however_little_is_open_in_them():
    """Single cells, and cells on the rim of which a few per cent are open."""
    camera = Camera(Grid((16, 16), 240e-6), 3.84e-3, "fused_silica", COLOURS, 8e-3, 2e-6, 41)
    lens = HeightOptic.of(camera)
    cut = aperture_parts(lens, np.inf, 16)
    assert len(cut.psf) == np.count_nonzero(np.asarray(lens.coverage))
    assert np.sum(cut.side_m**2) == pytest.approx(np.pi / 4 * camera.aperture_m**2, rel=1e-5)
    whole = np.asarray(psf(lens, depths=np.inf).energy[:, 0])
    # Pixels are integrated by sums of eight points here.
    assert np.linalg.norm(cut.whole - whole) < 0.01 * np.linalg.norm(whole)


def test_pixels_as_wide_as_many_specks_are_summed_finely():
    """Pixels of ten times wavelength x distance / aperture, in the light of a rough plate."""
    camera = Camera(Grid((24, 24), 20e-6), 0.48e-3, "fused_silica", COLOURS, 8e-3, 90e-6, 3)
    optic = HeightOptic.of(camera, np.random.default_rng(3).uniform(0, 1.1e-6, (24, 24)))
    whole = np.asarray(psf(optic, depths=np.inf).energy[:, 0])
    assert np.linalg.norm(aperture_parts(optic, np.inf, 2).whole - whole) < 0.002 * np.linalg.norm(whole)


def test_a_ray_to_a_part_meets_an_obstruction_as_triangles_say(parts):
    """From a point on the axis at 0.4 m a ray is three quarters as far off the axis at 0.1 m as at the aperture."""
    near = replace(parts, depth_m=0.4)
    pixels_per_m = CAMERA.sensor_distance_m / 0.1 / CAMERA.pixel_m  # of the view, for lengths at 0.1 m
    np.testing.assert_allclose(near.shift_px(0.1), -0.75 * parts.centre_m * pixels_per_m, rtol=1e-12)
    np.testing.assert_allclose(near.side_px(0.1), 0.75 * parts.side_m * pixels_per_m, rtol=1e-12)


def test_every_part_holds_the_energy_that_passes_it(parts):
    share = parts.side_m**2 / np.sum(parts.side_m**2)
    energy = parts.psf[:, 0].sum(axis=(1, 2)) / CAMERA.transmission(GREEN)
    # A few per cent of the light leave a window of 41 pixels.
    assert energy == pytest.approx(share, abs=0.002)
    assert np.sum(parts.side_m**2) == pytest.approx(np.pi / 4 * CAMERA.aperture_m**2, rel=1e-3)


@pytest.mark.parametrize("place", [0.0, 1e-3, 2e-3])
def test_a_shadowed_aperture_sends_what_wave_optics_says(parts, place: float):
    """Beside a bar of 1.5 mm at 8 cm, as wide as a third of the aperture: the blur loses one of its sides."""
    near_m, count = 0.08, 601
    at = (np.arange(count) - count // 2) * CAMERA.pixel_m * near_m / CAMERA.focal_length_m
    mask = np.repeat((np.abs(at - place) <= 0.75e-3)[None], count, axis=0).astype(float)
    height = np.zeros(CAMERA.grid.shape)
    true = shadowed_psf(CAMERA, height, mask, near_m, np.inf, (count // 2, count // 2))
    passed = passed_shares(parts, CoarseMask(mask, 1.0), near_m, (1, 1))[:, 0, 0]
    found = np.einsum("k,kcyx->cyx", passed, parts.psf)
    even = parts.whole * (passed @ parts.side_m**2 / np.sum(parts.side_m**2))
    assert found.sum() == pytest.approx(true.sum(), rel=0.02)
    error, other = (np.linalg.norm(image - true) / np.linalg.norm(true) for image in (found, even))
    # Fringes within the blur are left out, 27 % where the bar takes its middle (a Fresnel number of 7 for the bar); the
    # open aperture's PSF, made weaker, is off by far more.
    assert error < 0.3
    assert other > 2 * error


@pytest.mark.slow
@pytest.mark.parametrize(("aperture_m", "passes"), [(4.44e-3, 0.037), (11.4e-3, 0.562)])
def test_a_wide_aperture_sees_around_a_bar(aperture_m: float, passes: float):
    """Of a disc of diameter D behind a bar of width b, 1 - 2/pi (asin s + s sqrt(1 - s²)) is free, s = b/D.

    0.03 for a stop of 4.44 mm behind 4 mm, 0.55 for f/1.4 of 16 mm: the cause of all that `wide_aperture.py` measures.
    """
    ratio = 4e-3 / aperture_m
    free = 1 - 2 / np.pi * (np.arcsin(ratio) + ratio * np.sqrt(1 - ratio**2))
    assert free == pytest.approx(passes, abs=1e-3)
    camera = Camera(Grid((190, 190), aperture_m / 190), aperture_m, "fused_silica", COLOURS, 16e-3, 3.7e-6, 1)
    cut = aperture_parts(HeightOptic.of(camera), np.inf, 19)
    near_m = 0.08
    at = (np.arange(1201) - 600) * camera.pixel_m * near_m / camera.focal_length_m
    mask = CoarseMask(np.repeat((np.abs(at) <= 2e-3)[None], 1201, axis=0).astype(float), 1.0)
    shares = passed_shares(cut, mask, near_m, (1, 1))[:, 0, 0]
    # Squares at the rim stand for their open part.
    assert shares @ cut.side_m**2 / np.sum(cut.side_m**2) == pytest.approx(free, abs=0.01)


def test_means_over_squares_are_those_of_the_mask():
    rng = np.random.default_rng(0)
    fine = rng.uniform(size=(30, 30))
    mask = CoarseMask(fine, 4.0)
    found = mask.mean_over(np.array([-10.0, 6.0]), np.array([2.0]), 24.0)
    whole = np.kron(fine, np.ones((4, 4)))
    # The middle of the view is the middle of 120 pixels.
    for row, y in enumerate((-10, 6)):
        block = whole[60 + y - 12 : 60 + y + 12, 60 + 2 - 12 : 60 + 2 + 12]
        assert found[row, 0] == pytest.approx(block.mean(), rel=1e-12)


def test_shares_between_places_are_linear(parts):
    y, x = np.mgrid[:60, :60]
    mask = CoarseMask(((x - 25) ** 2 + (y - 31) ** 2 < 60).astype(float), 8.0)
    every, some = (passed_shares(parts, mask, 0.1, (33, 30), step) for step in (1, 4))
    assert some.shape == every.shape == (len(parts.psf), 33, 30)
    assert some[:, ::4, ::4] == pytest.approx(every[:, ::4, ::4], abs=1e-6)
    # A share bends where an edge enters a part: by at most a quarter of 4 pixels over a part's 19.
    whole = parts.side_m > 0.9 * parts.side_m.max()
    assert np.abs(some - every)[whole].max() < 4 / 4 / 19 * 2


def test_a_scene_without_an_obstruction_has_the_whole_psf(parts):
    scene = np.random.default_rng(1).uniform(size=(1, 72, 72)).astype(np.float32)
    open_shares = np.ones((len(parts.psf), 72, 72), np.float32)
    found = np.asarray(through_parts(scene, open_shares, parts.otfs((72, 72))))
    from scipy.signal import fftconvolve

    assert found[0] == pytest.approx(fftconvolve(scene[0], parts.whole[0], mode="valid"), abs=1e-4)


def test_an_even_layer_stays_even_and_a_small_one_keeps_its_light():
    assert spread_by_disc(np.ones((40, 40)), 90.0, 8.0, (16, 24)) == pytest.approx(np.ones((16, 24)), rel=1e-5)
    layer = np.zeros((41, 41))
    layer[20, 20] = 1.0
    # A pixel of 8 x 8 within a disc of 160: the middle has the ratio of their areas.
    found = spread_by_disc(layer, 160.0, 8.0, (3, 3))
    assert found[1, 1] == pytest.approx(64 / (np.pi / 4 * 160**2), rel=0.02)


def test_a_disc_far_smaller_than_a_pixel_leaves_its_light_there():
    """It lies between the points that stand for a pixel's area: light of the obstruction was NaN."""
    layer = np.zeros((5, 5))
    layer[2, 2] = 1.0
    found = spread_by_disc(layer, 0.5, 8.0, (1, 1))
    assert found == pytest.approx(1.0, rel=1e-6)  # a sum by transforms in double precision, rounded to single


def test_a_window_without_a_middle_is_refused():
    from dataclasses import replace

    with pytest.raises(ValueError, match="window odd"):
        aperture_parts(LENS.with_camera(replace(CAMERA, window=40)), np.inf, 4)
