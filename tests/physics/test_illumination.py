"""Beams behind a lens against the closed forms of Gaussian optics (A. E. Siegman, Lasers, 1986, chapters 17 and 20)."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from fab.aperture import RectangularAperture, aperture_from
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, Variation
from sim.camera import Camera, Colour
from sim.illumination import EvenBeam, GaussianBeam, MeasuredBeam
from sim.metrics import energy_budget, zeroth_order
from sim.optic import HeightOptic, RingOptic
from sim.propagation.hankel import ring_count
from sim.psf_bank import psf
from sim.surface import as_fabricated

WAVE = 532e-9
WAIST = 0.4e-3
# Four times the waist: the rim cuts off exp(-32) of the light.
CAMERA = Camera(
    grid=Grid((256, 256), 12.5e-6),
    aperture=3.2e-3,
    material="fused_silica",
    colours=(Colour("green", (WAVE,), (1.0,)),),
    focal_length_m=0.2,
    pixel_m=4e-6,
    window=256,
    beam=GaussianBeam((WAIST, WAIST)),
)
FOCUS = WAVE * 0.2 / (np.pi * WAIST)  # radius of the focus, 85 um


def radii(camera: Camera, **options: object) -> tuple[np.ndarray, float]:
    """Radii (y, x) of the image, twice the root of its second moments, and its energy over what passes the glass."""
    image = np.asarray(psf(HeightOptic.of(camera), **options).energy[0, 0], np.float64)  # pyright: ignore
    total, at = image.sum(), camera.axis_m()
    # A pixel adds its own second moment.
    second = np.array([(image.sum(axis) * at**2).sum() / total for axis in (1, 0)]) - camera.pixel_m**2 / 12
    return 2 * np.sqrt(second), total / camera.transmission(WAVE)


def radius_at(beam: GaussianBeam, defocus_m: float, axis: int = 0) -> float:
    """Radius behind a lens at the DOE, from the complex beam parameter and the ray matrix."""
    embedded = beam.radius_m[axis] / np.sqrt(beam.m_squared[axis])
    q = beam.waist_distance_m + 1j * np.pi * embedded**2 / WAVE
    f = CAMERA.focal_length_m
    at = 1 / (1 / q - 1 / f) + f + defocus_m
    return np.sqrt(beam.m_squared[axis] * WAVE / (np.pi * -np.imag(1 / at)))


@pytest.mark.parametrize(
    ("beam", "defocus_m"),
    [
        (GaussianBeam((WAIST, WAIST)), 0.0),
        (GaussianBeam((WAIST, 0.6 * WAIST)), 0.0),
        (GaussianBeam((WAIST, WAIST), waist_distance_m=0.8), 0.02),
        (GaussianBeam((WAIST, WAIST), waist_distance_m=-0.8), 0.02),
        (GaussianBeam((WAIST, 0.7 * WAIST), waist_distance_m=0.5, m_squared=(1.4, 1.0)), -0.01),
    ],
)
def test_the_image_of_a_beam_has_the_radius_of_gaussian_optics(beam: GaussianBeam, defocus_m: float):
    found, energy = radii(replace(CAMERA, beam=beam, defocus_m=defocus_m))
    expected = [radius_at(beam, defocus_m, axis) for axis in (0, 1)]
    # Second moments feel the thousandth of the light that is left out of several modes; its share of them is larger.
    quality = max(beam.m_squared)
    np.testing.assert_allclose(found, expected, rtol=2e-3 if quality == 1 else 1e-2)
    assert energy == pytest.approx(1, abs=1e-3)


def test_encircled_energy_is_that_of_a_gaussian():
    bank = psf(HeightOptic.of(CAMERA))
    within = np.asarray(bank.encircled_energy([FOCUS / 2, FOCUS, 2 * FOCUS]))[0, 0]
    # Pixels cut a circle of 21 of them to 0.2 %.
    np.testing.assert_allclose(within / CAMERA.transmission(WAVE), 1 - np.exp([-0.5, -2, -8]), atol=2e-3)


@pytest.mark.parametrize("radius_m", [1.6e-3, 0.8e-3])
def test_light_beyond_the_opening_is_counted_as_blocked(radius_m: float):
    camera = replace(CAMERA, beam=GaussianBeam((radius_m, radius_m)))
    optic = HeightOptic.of(camera)
    budget = energy_budget(optic, np.asarray(psf(optic).energy[0, 0]), np.inf, camera.colours[0])
    assert budget.blocked == pytest.approx(np.exp(-2 * (1.6e-3 / radius_m) ** 2), abs=1e-4)
    assert sum(budget) == pytest.approx(1, abs=1e-6)
    assert abs(budget.uncollected) < 0.02


def test_a_beam_beside_the_middle_is_blocked_on_one_side():
    # On the rim, half of a narrow beam passes: less a term of its radius over that of the opening.
    narrow = GaussianBeam((0.1e-3, 0.1e-3), centre_m=(0.0, 1.6e-3))
    optic = HeightOptic.of(replace(CAMERA, beam=narrow))
    budget = energy_budget(optic, np.asarray(psf(optic).energy[0, 0]), np.inf, CAMERA.colours[0])
    at = np.linspace(-0.5e-3, 0.5e-3, 2001)
    y, x = at[:, None], at[None, :]
    light = np.exp(-2 * (x**2 + y**2) / 0.1e-3**2)
    expected = light[np.hypot(y, x + 1.6e-3) > 1.6e-3].sum() / light.sum()
    assert budget.blocked == pytest.approx(expected, abs=5e-3)  # cells of an eighth of the beam


def test_modes_of_a_beam_add_up_to_its_quality():
    beam = GaussianBeam((WAIST, WAIST), m_squared=(2.0, 1.5))
    assert sum(beam.shares) == pytest.approx(1, abs=1e-12)
    assert len(beam.shares) > 20
    fine = Grid((801, 801), 5e-6)
    modes = (np.abs(beam.amplitude_per_m(fine, CAMERA.opening, WAVE, mode)) ** 2 for mode in range(len(beam.shares)))
    light = sum(share * mode for share, mode in zip(beam.shares, modes, strict=True))
    at, cell = fine.axis_m("x"), fine.pitch_m**2
    assert np.sum(light) * cell == pytest.approx(1, abs=2e-4)
    for axis in (0, 1):
        second = np.sum(np.sum(light, axis=1 - axis) * at**2) * cell
        assert 2 * np.sqrt(second) == pytest.approx(WAIST, rel=1e-2)  # as above


def test_a_picture_of_a_beam_lights_like_the_beam():
    at = (np.arange(401) - 200) * 10e-6
    picture = np.exp(-2 * (at[:, None] ** 2 + at**2) / WAIST**2)
    camera = replace(CAMERA, beam=MeasuredBeam(picture, 10e-6))
    same = replace(CAMERA, beam=MeasuredBeam(picture.copy(), 10e-6))
    assert camera == same
    assert hash(camera) == hash(same)
    assert camera != replace(CAMERA, beam=MeasuredBeam(picture + 0.1, 10e-6))
    found, energy = radii(camera)
    np.testing.assert_allclose(found, FOCUS, rtol=2e-3)
    assert energy == pytest.approx(1, abs=1e-3)


def test_the_zeroth_order_weighs_cells_by_the_beam():
    # Half a wave where the beam is and none where it is not.
    height = np.zeros(CAMERA.grid.shape)
    half = 0.5 / CAMERA.waves_per_metre(WAVE)
    y, x = CAMERA.grid.axis_m("y")[:, None], CAMERA.grid.axis_m("x")
    inside = np.hypot(y, x) < WAIST
    height[inside] = half
    found = zeroth_order(HeightOptic.of(CAMERA, height))[0]
    share = 1 - np.exp(-2)  # of the power within the radius
    assert found == pytest.approx((1 - 2 * share) ** 2, abs=0.01)  # the edge of the disc cuts cells of a 32nd of it


@pytest.mark.slow
def test_a_plate_as_fabricated_is_lit_by_the_beam():
    levels = Levels(4, 290e-9)
    level = np.random.default_rng(3).integers(0, 4, CAMERA.grid.shape).astype(np.uint8)
    level[~CAMERA.grid.inside_circle(CAMERA.aperture_m)] = 3
    process = Process(levels)
    drawn = as_fabricated(level, CAMERA, process, Variation())
    moved = as_fabricated(level, CAMERA, process, Variation(overlay_x_m=(1e-9, 0.0), overlay_y_m=(0.0, 0.0)))
    images = [np.asarray(psf(doe).energy[0, 0]) for doe in (drawn, moved)]
    assert np.abs(images[0] - images[1]).sum() < 2e-3 * images[0].sum()
    plain = psf(as_fabricated(level, replace(CAMERA, beam=None), process, Variation())).energy[0, 0]
    assert np.abs(images[0] - np.asarray(plain)).sum() > 0.1 * images[0].sum()


def test_light_with_edges_has_the_beam():
    camera = replace(CAMERA, light="edges")
    flat, energy = radii(camera)
    np.testing.assert_allclose(flat, FOCUS, rtol=2e-3)
    assert energy == pytest.approx(1, abs=1e-3)


def test_a_tilted_beam_lands_where_its_axis_goes():
    """The window follows the chief ray: its footprint is longer by 1 / cos, so the image is shorter by cos."""
    camera = replace(CAMERA, beam=GaussianBeam((WAIST, WAIST), angle_rad=(0.0, 0.05)))
    tilted, straight = (np.asarray(psf(HeightOptic.of(one)).energy[0, 0]) for one in (camera, CAMERA))
    axis = CAMERA.axis_m()
    tall, wide = ((tilted * axis2).sum() / (straight * axis2).sum() for axis2 in (axis[:, None] ** 2, axis**2))
    assert tall == pytest.approx(1, abs=1e-4)
    assert wide == pytest.approx(np.cos(0.05) ** 2, abs=2e-4)
    assert tilted.sum() == pytest.approx(straight.sum(), rel=1e-4)
    grating = np.zeros(CAMERA.grid.shape) + 1e-6 * (np.arange(256) % 2)
    tilted, straight = (zeroth_order(HeightOptic.of(one, grating))[0] for one in (camera, CAMERA))
    waves = 1e-6 * (np.sqrt(1.4607**2 - 0.05**2) - np.sqrt(1 - 0.05**2)) / WAVE
    assert tilted == pytest.approx(np.cos(np.pi * waves) ** 2, abs=2e-3)
    assert tilted != pytest.approx(straight, abs=1e-4)


def test_a_beam_of_many_modes_has_all_its_power():
    shares = GaussianBeam((WAIST, WAIST), m_squared=(60.0, 1.0)).shares
    assert sum(shares) == pytest.approx(1, abs=1e-12)
    with pytest.raises(ValueError, match="must be at least 1"):
        GaussianBeam((WAIST, WAIST), m_squared=(0.9, 1.0))


def test_rings_are_not_lit_by_a_beam():
    with pytest.raises(ValueError, match="must be lit evenly for rings"):
        psf(RingOptic(CAMERA, jnp.zeros(ring_count(CAMERA))))


def test_an_aslant_beam_is_that_of_its_own_plane():
    """Far behind its waist a beam is light from a point; its power is the same on any plane that it crosses."""
    grid, point, angle = Grid((128, 128), 2e-6), 20e-3, (0.2, 0.35)
    aperture = aperture_from(256e-6)
    waist = 5e-6  # Rayleigh length 0.15 mm
    beam = GaussianBeam(
        (waist, waist), waist_distance_m=point * np.sqrt(1 + np.sum(np.tan(angle) ** 2)), angle_rad=angle
    )
    even = EvenBeam(point, angle)
    found, known = (one.amplitude_per_m(grid, aperture, WAVE, 0) for one in (beam, even))
    phase = np.angle(found * known.conj() / (found[64, 64] * known[64, 64].conj()))
    assert np.abs(phase).max() < 0.02  # of 20 waves at the corners; a beam at normal incidence is off by half of one
    wide = Grid((256, 256), 4e-6)
    for tilt in ((0.0, 0.0), (0.0, 0.9), (0.5, 0.5)):
        light = GaussianBeam((0.1e-3, 0.15e-3), tilt_rad=tilt).amplitude_per_m(wide, aperture, WAVE, 0)
        assert (np.abs(light) ** 2).sum() * wide.pitch_m**2 == pytest.approx(1, abs=2e-3)


def test_beams_that_are_none_are_refused():
    with pytest.raises(ValueError, match="two positive lengths"):
        GaussianBeam((0.0, 1e-3))
    with pytest.raises(ValueError, match="must be positive"):
        EvenBeam(0.0)
    with pytest.raises(ValueError, match="somewhere positive"):
        MeasuredBeam(np.zeros((4, 4)), 1e-6)
    point = replace(CAMERA, beam=EvenBeam(0.02))
    with pytest.raises(InputError, match="a beam from a point has an angle of its own"):
        psf(HeightOptic.of(point), field_rad=(0.0, 0.1))
    aslant = replace(CAMERA, beam=EvenBeam(angle_rad=(0.0, 1.0), tilt_rad=(0.0, 1.0)))
    with pytest.raises(InputError, match="within 90 degrees of its axis"):
        psf(HeightOptic.of(aslant))


def test_a_picture_of_a_beam_ends_with_its_pixels():
    """Even over a square as large as the opening: all of its power goes through."""
    beam = MeasuredBeam(np.ones((10, 10)), 25.6e-6)
    square = replace(CAMERA, grid=Grid((128, 128), 2e-6), aperture=RectangularAperture((256e-6, 256e-6)), beam=beam)
    irradiance = square.irradiance(WAVE)
    assert irradiance is not None
    assert irradiance.sum() * 2e-6**2 == pytest.approx(square.opening.area_m2, rel=1e-6)
