import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import make_camera, wrapped_map
from fab.aperture import MaskAperture
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.metrics import (
    MetricInputs,
    airy_radius_m,
    disc_weights,
    encircled_energy,
    energy_budget,
    energy_within,
    in_parts,
    mean_wavelength_m,
    near_and_far,
    participation,
    radius_map_m,
    ring_to_disc,
    spot_radius_m,
    strehl,
    zeroth_order,
)
from sim.metrics.budget import _band_energy
from sim.optic import HeightOptic
from sim.psf_bank import psf

CAMERA = make_camera(256, 0.6e-3, 1.08e-3, 1.85e-6, 64)


@pytest.mark.parametrize("shape", [(40, 40), (41, 40), (41, 41)])
def test_disc_weights_hold_the_discs_area(shape: tuple[int, int]):
    weights = disc_weights(shape, 2e-6, 25e-6)
    # Strips of 1/64 pixel round the rim of a disc 25 pixels wide.
    assert weights.sum() * 4e-12 == pytest.approx(np.pi * 25e-6**2, rel=1e-4)
    assert weights[shape[0] // 2, shape[1] // 2] == 1
    assert weights[0, 0] == 0
    np.testing.assert_array_equal(weights, weights[::-1, ::-1])


def test_radii_are_measured_from_the_middle_of_the_window():
    assert radius_map_m((3, 3), 2.0)[1, 1] == 0
    assert radius_map_m((4, 4), 2.0)[1, 2] == pytest.approx(np.sqrt(2))


def test_encircled_energy_grows_to_the_windows_total(rng: np.random.Generator):
    image = rng.uniform(size=(20, 20)).astype(np.float32)
    energies = encircled_energy(image, 1e-6, np.linspace(0, 15e-6, 16))
    assert energies[0] == 0
    assert all(np.diff(energies) >= 0)
    assert energies[-1] == pytest.approx(image.sum(dtype=np.float64), rel=1e-6)  # 15 um reach the corners
    assert energies[7] == energy_within(image, 1e-6, 7e-6)


def test_radii_of_the_far_spot():
    assert airy_radius_m(CAMERA, 550e-9) == pytest.approx(1.22 * 550e-9 * 1.08e-3 / 0.6e-3, rel=1e-3)
    assert spot_radius_m(CAMERA, 550e-9) == airy_radius_m(CAMERA, 550e-9) + 1.85e-6
    assert mean_wavelength_m(Colour("c", (4e-7, 6e-7), (0.25, 0.75))) == pytest.approx(5.5e-7)


def test_ring_and_disc_share_the_window():
    uniform = np.full((64, 64), 1.0, np.float32)
    depth = 0.6e-3 * 1.08e-3 / (40 * 1.85e-6)  # a blur disc 40 pixels wide
    parts = ring_to_disc(uniform, CAMERA, depth)
    assert parts.disc_radius_m == pytest.approx(21 * 1.85e-6)  # widened by one pixel
    assert parts.disc == pytest.approx(np.pi * 21**2, rel=3e-3)  # as in the test of the area
    assert parts.ring + parts.disc == pytest.approx(64**2)
    assert parts.ratio == parts.ring / parts.disc
    dark = np.zeros((64, 64), np.float32)
    dark[0, 0] = 1
    assert ring_to_disc(dark, CAMERA, depth).ratio == np.inf


@pytest.mark.parametrize("light", [0.0, 0.75])
def test_ring_and_disc_of_a_traced_psf_are_those_of_its_numbers(light: float):
    """A corner with a quarter of the light, and the middle with what is left of it; without it there is no disc."""
    image = np.zeros((64, 64), np.float32)
    image[0, 0], image[32, 32] = 0.25, light
    depth = 0.6e-3 * 1.08e-3 / (40 * 1.85e-6)
    traced, known = (np.asarray(found(image, CAMERA, depth)[:3]) for found in (_traced_ring_to_disc, ring_to_disc))
    np.testing.assert_allclose(traced, known, rtol=1e-6)
    assert known[0] == (pytest.approx(1 / 3) if light else np.inf)


def _traced_ring_to_disc(image: np.ndarray, camera: Camera, depth_m: float) -> tuple[jax.Array, ...]:
    return jax.jit(lambda one: tuple(map(jnp.asarray, ring_to_disc(one, camera, depth_m)[:3])))(image)


def test_near_depths_are_those_whose_disc_is_wider_than_the_far_spot():
    """The disc of the aperture's radius R in the focal plane, R f / z, against the spot of the longest wavelength."""
    colours = tuple(Colour(str(wave), (wave,), (1.0,)) for wave in (4e-7, 7e-7, 5e-7))
    camera = dataclasses.replace(CAMERA, colours=colours)
    border = 0.3e-3 * 1.08e-3 / spot_radius_m(camera, 7e-7)
    depths_m = (1.001 * border, 0.999 * border, np.inf, 0.5 * border)
    near, far = near_and_far(camera, depths_m)
    assert near == (0.999 * border, 0.5 * border)
    assert far == (1.001 * border, np.inf)
    bare = dataclasses.replace(camera, focal_length_m=np.inf, distance_m=2e-3)
    assert near_and_far(bare, depths_m) == ((), depths_m)


def test_participation_of_equal_pixels():
    image = jnp.zeros((2, 8, 8)).at[0, 1:3, 1:3].set(0.25).at[1, 0, 0].set(1.0)
    np.testing.assert_allclose(participation(image), [0.25, 1.0])


@pytest.mark.parametrize("cells", [100, 257])
def test_a_flat_plate_is_all_zeroth_order(cells: int):
    camera = make_camera(cells, 0.6e-3, 1.08e-3, 1.85e-6, 16)
    # The clear area in cells is right to 1e-5 at a hundred cells, and `cis` is good to 4e-6.
    assert zeroth_order(HeightOptic.of(camera, np.full((cells, cells), 3e-7)))[0] == pytest.approx(1, abs=3e-5)


def test_zeroth_order_is_a_property_of_the_plate_not_of_the_focus():
    moved = dataclasses.replace(CAMERA, defocus_m=1e-4)
    still, there = (zeroth_order(HeightOptic.of(camera, wrapped_map(256))) for camera in (CAMERA, moved))
    np.testing.assert_array_equal(there, still)


@pytest.mark.parametrize("depth_m", [np.inf, 0.02])
@pytest.mark.parametrize("fill", [1.0, 0.7])
@pytest.mark.parametrize("plate", ["flat", "wrapped", "rough"])
def test_the_budget_sums_to_one(plate: str, fill: float, depth_m: float, rng: np.random.Generator):
    camera = dataclasses.replace(CAMERA, fill=fill)
    height = {"flat": np.zeros((256, 256)), "wrapped": wrapped_map(256), "rough": rng.uniform(0, 1.2e-6, (256, 256))}[
        plate
    ]
    image = psf(height, camera, [depth_m]).energy[0, 0]
    budget = energy_budget(HeightOptic.of(camera, height), image, depth_m, camera.colours[0])
    assert sum(budget) == pytest.approx(1, abs=1e-9)
    assert budget.reflected == pytest.approx(0.0684, abs=1e-3)
    assert budget.far_spot > 0
    assert budget.window_beside_spot > 0
    # Made from two independent transforms, each good to about 1e-4; a negative share would be energy from nowhere.
    assert budget.uncollected > -1e-3
    assert budget.higher_orders > -1e-3
    # White noise of one cell spreads as sinc² x sinc², of which the band |nu| < 1/2 holds (0.774)^2 = 0.599.
    if plate == "rough":
        assert budget.higher_orders == pytest.approx((1 - budget.reflected) * (1 - 0.599), rel=0.05)


@pytest.mark.parametrize("depth_m", [np.inf, 0.02])
def test_the_budget_does_not_depend_on_the_parts_of_a_cell(depth_m: float, rng: np.random.Generator):
    """Cells of half the width, four of the same height in a row, are the same plate."""
    height = rng.uniform(0, 1.2e-6, (256, 256))
    image = psf(height, CAMERA, [depth_m]).energy[0, 0]
    whole = energy_budget(HeightOptic.of(CAMERA, height), image, depth_m, CAMERA.colours[0])
    parted = dataclasses.replace(CAMERA, grid=Grid((512, 512), CAMERA.grid.pitch_m / 2))
    optic = HeightOptic.of(parted, in_parts(height, 2))
    split = energy_budget(optic, image, depth_m, CAMERA.colours[0], pitch_m=CAMERA.grid.pitch_m)
    # The round rim is drawn in other cells.
    np.testing.assert_allclose(split, whole, rtol=0, atol=2e-3)


@pytest.mark.parametrize("shape", [(256, 256), (90, 256), (256, 90)])
def test_the_strehl_ratio_does_not_depend_on_the_parts_of_a_cell(shape: tuple[int, int], rng: np.random.Generator):
    height = rng.uniform(0, 1.2e-6, shape)
    camera = dataclasses.replace(CAMERA, grid=Grid(shape, CAMERA.grid.pitch_m))
    drawn, made = HeightOptic.of(camera, height), HeightOptic.of(camera, 0.9 * height)
    expected = strehl(made, drawn)
    assert expected[0] < 0.99

    def parted(height: np.ndarray, parts: int) -> HeightOptic:
        grid = Grid((shape[0] * parts, shape[1] * parts), CAMERA.grid.pitch_m / parts)
        return HeightOptic.of(dataclasses.replace(CAMERA, grid=grid), in_parts(height, parts))

    for own, other in ((1, 2), (2, 1), (2, 3)):
        found = strehl(parted(0.9 * height, own), parted(height, other))
        # The round rim is drawn in other cells.
        assert found[0] == pytest.approx(expected[0], abs=1e-4)


@pytest.mark.parametrize("prism", [-0.3, 0.0, 0.3])
def test_the_energy_of_the_band_is_that_of_one_sum_per_cell(prism: float):
    """Where the light of the plate's edge is a sixth of the band aslant; `prism` sends it off to one side."""
    cells = 24
    slope, x = 2 / 6 / cells, np.arange(cells) - (cells - 1) / 2
    wave = np.exp(1j * np.pi * (slope * x**2 + 2 * prism * x))
    nu = np.fft.fftfreq(cells)[:, None]
    energy = np.sum(np.abs(np.sinc(nu - slope * x) * np.exp(-2j * np.pi * nu * x) @ wave) ** 2)
    found = _band_energy(np.outer(wave, wave).astype(np.complex64), slope)
    # As its docstring states.
    assert found == pytest.approx(energy**2, rel=1e-3)


def test_the_budget_of_a_colour_is_that_of_its_wavelengths():
    waves, weights = (5e-7, 6e-7), (0.25, 0.75)
    camera = dataclasses.replace(CAMERA, colours=(Colour("mixed", waves, weights),))
    height = wrapped_map(256)
    image = psf(height, camera, [0.02]).energy[0, 0]
    mixed = energy_budget(HeightOptic.of(camera, height), image, 0.02, camera.colours[0])
    parts = [energy_budget(HeightOptic.of(camera, height), image, 0.02, Colour("one", (w,), (1.0,))) for w in waves]
    assert mixed.higher_orders == pytest.approx(np.dot(weights, [p.higher_orders for p in parts]), abs=1e-9)
    assert mixed.reflected == pytest.approx(np.dot(weights, [p.reflected for p in parts]), abs=1e-12)


@pytest.mark.parametrize("size", [16, 17])
def test_encircled_energy_of_an_even_image_is_an_area(size: int):
    images = np.stack([np.ones((size, size)), np.full((size, size), 2.0)]).astype(np.float32)
    radii = np.linspace(0.3, 7.9, 40)
    # Strips of 1/64 pixel round the rim.
    np.testing.assert_allclose(encircled_energy(images, 1.0, radii)[0], np.pi * radii**2, rtol=2e-3)
    np.testing.assert_allclose(encircled_energy(images, 1.0, radii)[1], 2 * np.pi * radii**2, rtol=2e-3)


@pytest.mark.parametrize("traced", [False, True])
def test_concentration_compares_pixels_with_the_lens(traced: bool):
    """Of light spread evenly over 12 pixels where the lens spreads it over 4, a third; whatever the energy."""
    own, lens = np.zeros((1, 1, 8, 8), np.float32), np.zeros((1, 1, 8, 8), np.float32)
    own[0, 0, :3, :4], lens[0, 0, 2:4, 2:4] = 0.5, 0.1

    def concentration(energy):
        return MetricInputs(energy, (0.1,), CAMERA, lens=lens).concentration(0, 0)

    expected = participation(own[0, 0]) / participation(lens[0, 0])
    found = jax.jit(concentration)(own) if traced else concentration(own)
    assert float(found) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_no_even_halo_around_the_lens_disc_is_below_the_bound(share: float):
    """s of the light on the lens's 4 pixels and the rest on the 60 others of the window: s² + (1 - s)² 4 / 60."""
    camera = dataclasses.replace(CAMERA, window=8)
    lens = np.zeros((1, 2, 8, 8), np.float32)
    lens[0, 0, 3:5, 3:5], lens[0, 1, 4, 4] = 0.2, 0.8  # the near disc and the far spot, a fifth lost at the faces
    own = lens * share
    own[0, 0][lens[0, 0] == 0] = 0.8 * (1 - share) / 60
    depths_m = (0.1, np.inf)
    inputs = MetricInputs(own, depths_m, camera, near_m=depths_m[:1], lens=lens)
    kept = inputs.far_spot(0, 1) / 0.8
    assert inputs.concentration_bound(0, 0) == pytest.approx(kept**2 + (1 - kept) ** 2 * 4 / 64, rel=1e-5)
    found = share**2 + (1 - share) ** 2 * 4 / 60
    assert inputs.concentration(0, 0) == pytest.approx(found, rel=1e-5)
    assert inputs.concentration_bound(0, 0) <= found + 1e-6
    assert MetricInputs(own[:, :1], (0.1,), camera, near_m=(0.1,), lens=lens[:, :1]).concentration_bound(0, 0) is None


def test_the_far_spot_of_an_opening_off_the_centre_is_that_of_its_size():
    corner = np.zeros((64, 64), bool)
    corner[:16, :16] = True
    centred = np.roll(corner, (24, 24), (0, 1))
    radii = [
        spot_radius_m(dataclasses.replace(CAMERA, grid=Grid((64, 64), 4e-6), aperture=MaskAperture.of(one, 4e-6)), 5e-7)
        for one in (corner, centred)
    ]
    assert radii[0] == radii[1]


def test_light_that_the_chrome_blocks_is_lost_and_no_higher_order():
    """A flat plate whose opening has 0.64 of the area that it should have."""
    optic = HeightOptic.of(CAMERA)
    narrow = HeightOptic.of(dataclasses.replace(CAMERA, aperture=0.48e-3))
    optic = dataclasses.replace(optic, coverage=narrow.coverage)
    budget = energy_budget(optic, psf(optic).energy[0, 0], np.inf, CAMERA.colours[0])
    assert budget.blocked == pytest.approx(0.36, abs=1e-3)
    assert abs(budget.higher_orders) < 4e-3  # scattered by the rim
    assert sum(budget) == pytest.approx(1, abs=1e-9)


def test_numbers_of_a_bank_are_those_of_its_psfs_alone():
    bank = psf(HeightOptic.of(CAMERA))
    for name in ("zeroth_order", "concentration", "on_target", "sharpness"):
        with pytest.raises(ValueError, match="`name` must be one of throughput"):
            bank.metric(name)
