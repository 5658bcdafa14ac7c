"""Light that arrives aslant or from a point: images move by the sine of the tilt, a point near by is out of focus."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.areas.shape import light_on
from doedesign.areas.target import AreaTarget
from doedesign.design.accuracy import rim_error
from doedesign.spec.targets.areas import AreaSpec
from fab.aperture import RoundAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, Variation
from sim.camera import Camera
from sim.illumination import EvenBeam, GaussianBeam
from sim.lens import direction_sines
from sim.metrics import energy_budget
from sim.optic import HeightOptic
from sim.propagation.farfield import bent, plan_far_field
from sim.propagation.fresnel import plan_direct
from sim.propagation.places import CUBIC
from sim.propagation.pupil import doe_field
from sim.psf_bank import psf
from sim.rigorous.edge_optic import with_edges
from sim.surface import as_fabricated
from tests.physics.test_angles import CELLS, PITCH, PIXEL, WAVELENGTH, camera_of, summed

APERTURE, FOCAL = CELLS * PITCH, 20e-3


def lens_of(window: int) -> Camera:
    return replace(camera_of(window), focal_length_m=FOCAL, distance_m=None, pixel_m=FOCAL * PIXEL)


def random_heights() -> np.ndarray:
    coarse = np.random.default_rng(3).uniform(0, 1.1e-6, (CELLS // 8, CELLS // 8))
    return np.kron(coarse, np.ones((8, 8))).astype(np.float32)


@pytest.mark.parametrize("camera", [camera_of(40), lens_of(40)], ids=["angles", "lens"])
def test_tilted_light_is_that_of_a_plain_sum(camera: Camera):
    """Random cells lit at 2.1 and -0.8 degrees, on a sensor that stays; cells keep their sinc about the light."""
    tilt = (np.radians(-0.8), np.radians(2.1))
    lit = replace(camera, beam=EvenBeam(tilt_rad=tilt))
    optic = HeightOptic.of(lit, random_heights())
    phase = 2j * np.pi * lit.waves_per_metre(WAVELENGTH) * random_heights().astype(float)
    sines = direction_sines(tilt)
    expected = summed(np.asarray(optic.coverage, float) * np.exp(phase), lit, (float(sines[0]), float(sines[1])))
    image = np.asarray(psf(optic).energy[0, 0])
    assert np.linalg.norm(image - expected) < 3e-3 * np.linalg.norm(expected)


@pytest.mark.slow
def test_tilted_light_on_a_bent_sensor_is_that_of_a_plain_sum():
    """Pixels that lie where they would without a bend; for an axis aslant the bend would have another middle."""
    camera, tilt = lens_of(40), (np.radians(-0.8), np.radians(2.1))
    lit = replace(camera, beam=EvenBeam(tilt_rad=tilt))
    optic = HeightOptic.of(lit, random_heights())
    plan, none = plan_far_field(lit, WAVELENGTH, room=0.02), jnp.zeros((2, len(CUBIC)))
    light = optic.rows(lit.lines[0], optic.source(lit.lines[0], np.inf))
    image = np.asarray(bent(plan, lit, none).energy(doe_field, *light)) * lit.transmission(WAVELENGTH)
    phase = 2j * np.pi * lit.waves_per_metre(WAVELENGTH) * random_heights().astype(float)
    sines = direction_sines(tilt)
    expected = summed(np.asarray(optic.coverage, float) * np.exp(phase), lit, (float(sines[0]), float(sines[1])))
    assert np.linalg.norm(image - expected) < 3e-3 * np.linalg.norm(expected)
    with pytest.raises(ValueError, match="axis"):
        bent(plan, replace(camera, beam=EvenBeam(angle_rad=tilt)), none)


@pytest.mark.parametrize("beam", [EvenBeam(), GaussianBeam((60e-6, 60e-6))], ids=["plane", "gaussian"])
def test_orders_move_by_the_focal_length_times_the_sine(beam: EvenBeam | GaussianBeam):
    camera, pixels = lens_of(64), 7
    saw = np.mod((np.arange(CELLS) + 0.5) / 24, 1.0) / camera.waves_per_metre(WAVELENGTH)
    height = np.broadcast_to(saw, (CELLS, CELLS)).astype(np.float32)
    tilt = (0.0, float(np.arcsin(pixels * PIXEL)))  # 7 pixels are f sin(tilt)
    images = [
        np.asarray(psf(HeightOptic.of(replace(camera, beam=one), height)).energy[0, 0])
        for one in (beam, replace(beam, tilt_rad=tilt))
    ]
    # The plate's phase at 0.7 degrees differs by 5e-5.
    assert np.linalg.norm(images[1][:, pixels:] - images[0][:, :-pixels]) < 3e-3 * np.linalg.norm(images[0])
    followed = replace(beam, angle_rad=tilt)
    image = np.asarray(psf(HeightOptic.of(replace(camera, beam=followed), height)).energy[0, 0])
    assert np.linalg.norm(image - images[0]) < 1e-3 * np.linalg.norm(image)


def test_a_plane_beam_is_light_without_a_beam():
    camera = lens_of(32)
    plain, lit = (
        np.asarray(psf(HeightOptic.of(one, random_heights())).energy[0, 0])
        for one in (camera, replace(camera, beam=EvenBeam()))
    )
    assert lit == pytest.approx(plain, abs=1e-6 * float(plain.max()))
    optic = HeightOptic.of(replace(camera, beam=EvenBeam(tilt_rad=(0.0, 0.01))), random_heights())
    budget = energy_budget(optic, lit, np.inf, camera.colours[0])
    assert budget.blocked == pytest.approx(0.0, abs=1e-6)
    assert sum(budget) == pytest.approx(1.0, abs=1e-5)


def test_an_even_beam_fills_whatever_the_aperture_is():
    camera = replace(lens_of(32), beam=EvenBeam(8e-3))
    for one in (camera, replace(camera, aperture=APERTURE / 2)):
        light = one.incident(one.lines[0])
        assert light is not None
        assert np.abs(light) == pytest.approx(1.0, abs=1e-6)


def test_a_point_is_a_source_at_its_depth():
    """For a lens as for directions, a beam from a point is what a source at that depth is without one."""
    for camera in (lens_of(48), camera_of(48)):
        source = psf(HeightOptic.of(camera, random_heights()), depths=8e-3).energy[0, 0]
        point = psf(HeightOptic.of(replace(camera, beam=EvenBeam(8e-3)), random_heights())).energy[0, 0]
        assert np.linalg.norm(point - source) < 1e-4 * np.linalg.norm(source)


def _of_point(camera: Camera) -> tuple[tuple[Camera, float], tuple[Camera, float]]:
    """A source 3 mm before a DOE, as a depth and as a beam."""
    return (camera, 3e-3), (replace(camera, beam=EvenBeam(3e-3)), np.inf)


@pytest.mark.slow
def test_plates_as_fabricated_and_walls_are_seen_from_a_point_as_from_its_depth():
    levels = Levels(4, 290e-9)
    level = np.random.default_rng(3).integers(0, 4, (CELLS, CELLS)).astype(np.uint8)
    moved = Variation(overlay_x_m=(0.4e-6, -0.3e-6), overlay_y_m=(0.2e-6, 0.5e-6))
    pair = _of_point(lens_of(48))
    plates = [as_fabricated(level, one, Process(levels), moved, depths_m=(depth,)) for one, depth in pair]
    walls = [with_edges(random_heights(), replace(one, light="edges"), depths_m=(depth,)) for one, depth in pair]
    for optics in (plates, walls):
        source, point = (psf(doe, depths=depth).energy[0, 0] for doe, (_, depth) in zip(optics, pair, strict=True))
        assert np.linalg.norm(point - source) < 1e-4 * np.linalg.norm(source)


def test_the_rim_is_as_far_off_for_the_same_light():
    """A DOE 5 mm before a lens sees the sensor as one on a lens of other focal length, 1/f = 1/B - A/B of its rays."""
    camera = replace(lens_of(48), doe_distance_m=5e-3, defocus_m=15e-3)
    distance = camera.sensor_distance_m
    focal = FOCAL * distance / (FOCAL + 15e-3)
    on_lens = replace(camera, doe_distance_m=0.0, focal_length_m=focal, defocus_m=distance - focal)
    for pair in (_of_point(lens_of(48)), ((camera, np.inf), (on_lens, np.inf))):
        source, point = (rim_error(HeightOptic.of(one, random_heights()), one.lines[0], depth) for one, depth in pair)
        assert point == pytest.approx(source, rel=1e-3)  # amplitudes of beams have single precision


def test_a_point_is_sharp_where_its_image_lies():
    """A point z before a lens of focal length f is in focus f² / (z - f) beyond the focal plane."""
    distance = 0.1
    image_m = FOCAL**2 / (distance - FOCAL)
    camera = replace(lens_of(33), pixel_m=lens_of(33).pixel_m * (1 + image_m / FOCAL))
    refocused = replace(camera, defocus_m=image_m, beam=EvenBeam(distance))
    sharp = psf(HeightOptic.of(lens_of(33))).energy[0, 0]
    found = psf(HeightOptic.of(refocused)).energy[0, 0]
    blurred = psf(HeightOptic.of(replace(camera, beam=EvenBeam(8e-3)))).energy[0, 0]
    assert np.linalg.norm(found - sharp) < 5e-3 * np.linalg.norm(sharp)
    assert blurred.max() < 0.8 * sharp.max()


def test_a_point_beside_the_axis_lands_where_its_chief_ray_goes():
    camera, tilt = lens_of(64), (np.radians(0.5), np.radians(-1.2))
    lit = replace(camera, defocus_m=5e-3, beam=EvenBeam(FOCAL * (FOCAL + 5e-3) / 5e-3, tilt_rad=tilt))
    image = np.asarray(psf(HeightOptic.of(lit)).energy[0, 0])
    place = [float((image.sum(1 - axis) * camera.axis_m()).sum() / image.sum()) for axis in (0, 1)]
    assert place == pytest.approx(25e-3 * direction_sines(tilt), abs=0.4 * camera.pixel_m)


def test_light_of_areas_counts_from_where_it_arrives():
    """The lattice of an area holds what the pixels there receive."""
    camera = replace(lens_of(48), beam=EvenBeam(tilt_rad=(0.0, np.radians(1.5))))
    optic = HeightOptic.of(camera, random_heights())
    target = AreaTarget.of(AreaSpec(shape="rectangle", width_m=0.6e-3, offset_m=(0.3e-3, 0.0)), camera)
    light = light_on(optic, target)
    y, x = (camera.image_m(*pair)[k] for k, pair in enumerate(((target.sines_y, 0.0), (0.0, target.sines_x))))
    axis = camera.axis_m()
    image = np.asarray(psf(optic).energy[0, 0]) / camera.transmission(WAVELENGTH)
    seen = image[np.ix_((axis >= y[0]) & (axis <= y[-1]), (axis >= x[0]) & (axis <= x[-1]))].sum()
    assert seen > 0.2
    assert light.sum() == pytest.approx(seen, rel=0.06)  # a row of pixels at the rim


def test_the_direct_path_takes_no_tilt():
    camera = replace(lens_of(32), beam=EvenBeam(tilt_rad=(0.0, 0.01)))
    with pytest.raises(InputError, match="Give its `angle` in place of its `tilt`"):
        plan_direct(camera, WAVELENGTH)


def test_the_cells_of_a_beam_have_its_power():
    grid, opening = Grid((400, 400), 1e-6), RoundAperture(300e-6)
    y, x = np.meshgrid(grid.axis_m("y"), grid.axis_m("x"), indexing="ij")
    light = np.abs(EvenBeam(5e-3, tilt_rad=(0.0, 0.02)).amplitude_per_m(grid, opening, WAVELENGTH, 0)) ** 2
    assert (light * (np.hypot(y, x) < 150e-6)).sum() * 1e-12 == pytest.approx(1.0, abs=2e-3)
