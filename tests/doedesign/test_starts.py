"""Baseline designs: each has a closed form to meet."""

from dataclasses import replace

import numpy as np
import pytest

from doedesign.design.starts import (
    BUILT_IN,
    Ridge,
    RingLens,
    StartSetup,
    balanced_ridge,
    flat,
    grating,
    lens,
    random,
    ring_period_m,
    start_heights,
    zeroth_orders,
)
from doedesign.spec.values import STARTS
from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.material import full_wave_height_m
from sim.metrics import energy_within, radius_map_m, spot_radius_m, zeroth_order
from sim.optic import HeightOptic
from sim.propagation.hankel import ring_count
from sim.psf_bank import psf

GREEN = 550e-9
CAMERA = Camera(Grid((400, 400), 2e-6), 0.8e-3, "fused_silica", (Colour("green", (GREEN,), (1.0,)),), 4e-3, 4e-6, 201)
SETUP = StartSetup(CAMERA, False, GREEN, 3)


@pytest.mark.parametrize("far_energy", [0.0, 0.25, 0.6, 1.0])
def test_ring_keeps_the_asked_share_in_the_0th_order(far_energy: float) -> None:
    height = grating(SETUP, balanced_ridge(SETUP, far_energy), 16e-6)
    # Eight cells per period: the raster's area shares differ from one half by about 1 %.
    assert zeroth_order(HeightOptic.of(CAMERA, height))[0] == pytest.approx(far_energy, abs=0.01)


def of_lines(*waves_nm: float) -> StartSetup:
    colours = tuple(Colour(f"{wave:g}", (wave * 1e-9,), (1.0,)) for wave in waves_nm)
    return SETUP._replace(camera=replace(CAMERA, colours=colours))


@pytest.mark.parametrize(
    ("waves_nm", "far_energy", "spread"),
    [
        ((656, 486), 0.3, 1e-4),  # two unknowns for two colours
        ((656, 486), 0.6, 1e-4),
        ((656, 589, 486), 0.3, 0.025),
        ((656, 589, 486), 0.6, 0.025),
        ((650, 600, 550, 500, 450), 0.3, 0.06),
    ],
)
def test_ring_is_equally_bright_in_all_colours(waves_nm: tuple[float, ...], far_energy: float, spread: float) -> None:
    """As a plate has it, and as no grid of heights and duties betters."""
    setup = of_lines(*waves_nm)
    ridge = balanced_ridge(setup, far_energy)
    orders = zeroth_orders(setup, ridge)
    assert np.abs(orders - far_energy).max() < spread
    height = grating(setup, ridge, 15.3e-6)
    # Of 26 rings the ridges, each on the inner side, cover p (1 - p) / 26 less than their duty p.
    np.testing.assert_allclose(zeroth_order(HeightOptic.of(setup.camera, height)), orders, atol=0.02)
    tried = [
        np.sum((zeroth_orders(setup, Ridge(share * setup.wave_m, duty)) - far_energy) ** 2)
        for share in np.linspace(0, 1, 41)
        for duty in np.linspace(0, 0.5, 26)
    ]
    assert np.sum((orders - far_energy) ** 2) <= min(tried)


def test_a_ring_of_given_height_and_duty() -> None:
    """Half a wave in the middle of the band, where the order hardly depends on the colour."""
    setup = of_lines(656, 589, 486)
    found = start_heights("ring", {"height": "605 nm", "duty": 0.245, "roughness": 0.0, "period": "80 um"}, setup)
    floor, top = np.unique(found)
    assert top - floor == pytest.approx(605e-9, rel=1e-6)
    np.testing.assert_allclose(zeroth_orders(setup, Ridge(605e-9, 0.245)), (0.305, 0.266, 0.302), atol=1e-3)


@pytest.mark.parametrize(("count", "floor"), [(2, 0), (4, 1), (5, 1), (16, 4), (64, 16)])
def test_ring_stands_on_a_level(count: int, floor: int) -> None:
    """Roughness moves no cell of its floor to another level by chance, however few there are."""
    step_m = SETUP.wave_m / count
    found = start_heights("ring", {"roughness": 0.0}, SETUP._replace(level_step_m=step_m))
    assert found.min() / step_m == pytest.approx(floor, abs=1e-9)


def test_ring_has_the_radius_of_its_grating_order() -> None:
    period = 16e-6
    height = grating(SETUP, balanced_ridge(SETUP, 0.0), period)
    image = psf(height, CAMERA, [np.inf]).energy[0, 0]
    radius = radius_map_m(image.shape, CAMERA.pixel_m)
    profile = [image[(radius >= r) & (radius < r + 4e-6)].sum() for r in np.arange(0, 240e-6, 4e-6)]
    # lambda f / period = 137.5 um; bins of one pixel.
    assert np.arange(0, 240e-6, 4e-6)[int(np.argmax(profile))] == pytest.approx(GREEN * 4e-3 / period, abs=6e-6)


def test_ring_period_fits_every_colour_in_the_window() -> None:
    reach = CAMERA.window * CAMERA.pixel_m / 2
    assert GREEN * CAMERA.focal_length_m / ring_period_m(CAMERA) < reach


def test_lens_moves_the_focus() -> None:
    # A plate of power 1/z images a source at depth z onto the sensor: its near PSF is then the far PSF of a flat one.
    depth = 0.2
    height = lens(SETUP, 1 / depth)
    passed = CAMERA.transmission(GREEN)
    spot = spot_radius_m(CAMERA, GREEN)
    sharp = energy_within(psf(height, CAMERA, [depth]).energy[0, 0], CAMERA.pixel_m, spot)
    ideal = energy_within(psf(flat(SETUP, {}), CAMERA, [np.inf]).energy[0, 0], CAMERA.pixel_m, spot)
    # The plate is continuous, so only the curvature beyond the paraxial sphere and the cells' sinc² cost light.
    assert sharp / passed > 0.97 * ideal / passed


def test_random_is_seeded_and_uniform_over_one_wave() -> None:
    height = random(SETUP, {"feature": "4 um"})
    assert np.array_equal(height, random(SETUP, {"feature": "4 um"}))
    assert np.array_equal(height[::2, ::2], height[1::2, 1::2])
    wave = full_wave_height_m("fused_silica", GREEN)
    # 40 000 independent squares: the mean of a uniform distribution is known to 0.3 / sqrt(40000) = 0.15 %.
    assert height.mean() / wave == pytest.approx(0.5, abs=0.006)


@pytest.mark.slow
def test_fresnel_finds_the_depth_that_is_asked_for() -> None:
    depth = 0.2

    def loss(height: np.ndarray) -> float:
        image = psf(height, CAMERA, [depth], sampling=1.0).energy[0, 0]
        return -float(energy_within(image, CAMERA.pixel_m, spot_radius_m(CAMERA, GREEN)))

    found = start_heights("fresnel", {"evaluations": 45}, SETUP._replace(loss=loss))
    ideal = lens(SETUP, 1 / depth)
    # Half of the best possible spot energy is inside the main lobe of the search landscape.
    assert loss(found) < 0.9 * loss(ideal) < 0


@pytest.mark.parametrize("algorithm", ["crs", "mlsl", "isres"])
def test_nlopt_finds_the_grating_behind_a_loss(algorithm: str) -> None:
    """The loss is the distance from a hidden plate of rings, in a smooth measure: the light of the first orders."""
    small = replace(CAMERA, grid=Grid((60, 60), 2e-6), aperture=120e-6)
    setup = SETUP._replace(camera=small)
    rows = np.exp(-2j * np.pi * np.outer(np.fft.fftfreq(60)[:30:2], np.arange(60)))

    def spectrum(heights: np.ndarray) -> np.ndarray:
        return np.abs(rows @ np.exp(2j * np.pi * heights / setup.wave_m) @ rows.T) ** 2 / 60**4

    wanted = spectrum(RingLens(0.3, 0.2, 0.4, 0.4, 0.0).heights(setup))
    seen = []

    def loss(heights: np.ndarray) -> float:
        seen.append(float(np.sum((spectrum(heights) - wanted) ** 2)))
        return seen[-1]

    options = {"algorithm": algorithm, "evaluations": 200, "roughness": 0.0}
    found = start_heights("nlopt", options, setup._replace(loss=loss))
    assert len(seen) <= 200
    # The start is the best of them, on a floor that changes no light; flat glass is a hundred times further off.
    assert loss(found) == pytest.approx(min(seen), rel=1e-6)
    assert min(seen) < 0.1 * loss(flat(setup, {}))
    again = start_heights("nlopt", options, setup._replace(loss=loss))
    assert np.array_equal(found, again)


def test_lens_and_rings_stand_side_by_side() -> None:
    """Without ridges the family is the Fresnel lens, and without power the grating."""
    bare = RingLens(0.0, 0.0, 0.5, 0.5, 0.0)
    assert np.array_equal(bare.heights(SETUP), grating(SETUP, Ridge(SETUP.wave_m / 2, 0.5), ring_period_m(CAMERA)))
    # A phase of 5 waves at the rim, r² power / (2 lambda): the third root of 5 / 40.
    power_per_m = 5 * 2 * GREEN / 0.4e-3**2
    alone = bare._replace(height=0.0, power=(5 / 40) ** (1 / 3)).heights(SETUP)
    # Where the phase wraps, the last digits decide on which side.
    assert np.mean(np.isclose(alone, lens(SETUP, power_per_m), atol=1e-12)) > 0.999


@pytest.mark.slow
def test_the_starts_are_those_of_the_spec() -> None:
    assert BUILT_IN.keys() == STARTS.keys()
    for name, options in STARTS.items():
        for option in options:
            with pytest.raises(InputError, match=f"start_options.{option}: must be"):
                start_heights(name, {option: "much"}, SETUP)


@pytest.mark.parametrize("name", ["flat", "random", "ring", "nlopt"])
def test_radial_starts_are_profiles(name: str) -> None:
    found = start_heights(name, {}, SETUP._replace(radial=True))
    assert found.shape == (ring_count(CAMERA),)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("flat", {"period": "5 um"}, "none"),
        ("ring", {"far_energy": 1.5}, "from 0 to 1"),
        ("ring", {"period": "five"}, "must be a length"),
        ("random", {"feature": "-1 um"}, "must be positive"),
        ("nlopt", {"algorithm": "direct"}, "must be one of crs, mlsl, isres"),
        ("nlopt", {"evaluations": 5}, "from 20 to 100000"),
    ],
)
def test_wrong_options_are_named(name: str, options: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        start_heights(name, options, SETUP)
