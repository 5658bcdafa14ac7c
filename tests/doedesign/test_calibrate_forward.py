"""The model of a measurement by closed forms: how motions move images, what cells and faces let through."""

from dataclasses import replace

import numpy as np
import pytest

from doedesign.calibration.forward_model import ForwardModel
from doedesign.calibration.geometry import REACH, GeometryPrior, places, room_of
from doedesign.calibration.unknowns import unknowns_of
from sim.camera import Colour
from sim.illumination import EvenBeam
from sim.material import refractive_index
from tests.doedesign.calibration_fakes import PROBE_M, plate_drawn, usual_process
from tests.doedesign.foreign_bench import foreign_light

NEAR_M = 6e-3
CELLS, WINDOW = 48, 24
ASKEW = (0.05, 0.02, -0.03, 0.4)


def model_of(
    level: np.ndarray | None = None, geometry: tuple[float, ...] | None = None, depths_m: tuple[float, ...] = (NEAR_M,)
) -> ForwardModel:
    """The model of a plate of four levels; that of the fakes by default."""
    design = plate_drawn(CELLS, 4, window=WINDOW)
    camera = replace(design.camera, colours=(Colour("probe", (PROBE_M,), (1.0,)),))
    unknowns = unknowns_of(usual_process(design), ["common_depth_scale"])
    drawn = design.level_map.level if level is None else level
    prior = GeometryPrior() if geometry is None else GeometryPrior((*geometry,))  # pyright: ignore[reportArgumentType]
    return ForwardModel(drawn, camera, unknowns, depths_m, prior)


def image(model: ForwardModel, *motion: float, geometry: tuple[float, ...] = (0, 0, 0, 0)) -> np.ndarray:
    """The first image of the plate as drawn, moved by (y, x, defocus)."""
    return model.plate(np.zeros(1)).image(0, np.array([*motion, *geometry], np.float64))


def missed(found: np.ndarray, expected: np.ndarray) -> float:
    """Root mean square of a difference over that of what is expected."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(("depth_m", "most"), [(np.inf, 3e-3), (NEAR_M, 8e-3)])
def test_an_image_moves_as_a_whole(depth_m: float, most: float):
    """What cells send to the window's rim moves, too, or 5 % were missed there.

    The transform promises 2e-3 of either image; of a near source cells look into many directions, which moves a little
    more of their light than this.
    """
    model = model_of(depths_m=(depth_m,))
    still, moved = image(model, 0, 0, 0), image(model, 1, -2, 0)
    assert missed(moved[1:, :-2], still[:-1, 2:]) < most


def test_an_image_off_its_place_is_that_of_another_simulator():
    """Of a plate whose hard rim there and grey one here differ by 1.2 % of the light, wherever the image lies."""
    model, design = model_of(depths_m=(np.inf,)), plate_drawn(CELLS, 4, window=WINDOW)
    faces, off = model.camera.transmission(PROBE_M), []
    for place in ((0.0, 0.0), (1.0, -1.0)):
        (light,) = foreign_light(design, model.unknowns.process, {}, (np.inf,), PROBE_M, shift_px=place, margin=0)
        off.append(missed(image(model, *place, 0) / faces, light))
    assert off[0] < 0.02
    assert off[1] < 1.1 * off[0]  # 2.1 times as much if cells went on sending light where they did


def test_a_defocus_is_the_curvature_of_a_nearer_source():
    """A source of 1/z + c is as one at 1 / (1/z + c), but for how obliquely it lights the cells."""
    near = image(model_of(depths_m=(5e-3,)), 0, 0, 0)
    assert missed(image(model_of(), 0, 0, 1 / 5e-3 - 1 / NEAR_M), near) < 5e-3
    assert missed(image(model_of(), 0, 0, 0), near) > 0.05


def test_a_camera_is_turned_stretched_and_bent_about_the_chief_ray():
    """Light that misses the window's middle by whole pixels looks as light that does not."""
    model = model_of(geometry=ASKEW)
    middle, moved = image(model, 0, 0, 0, geometry=ASKEW), image(model, 3, -2, 0, geometry=ASKEW)
    assert missed(moved[3:, :-2], middle[:-3, 2:]) < 0.012  # as above, of three pixels
    assert missed(middle, image(model_of(), 0, 0, 0)) > 0.05


def test_light_is_that_on_the_aperture_less_what_the_faces_reflect():
    """A flat plate far away: nearly all that passes two faces of silica lands within 24 pixels."""
    model = model_of(np.full((CELLS, CELLS), 3, np.uint8), depths_m=(np.inf,))
    seen, index = image(model, 0, 0, 0).sum(), refractive_index("fused_silica", PROBE_M)
    faces = (1 - ((index - 1) / (index + 1)) ** 2) ** 2
    # Beyond r of the pattern of an aperture D lies 2 wavelength f / (pi² D r) of the light.
    camera = model.camera
    beyond = 2 * PROBE_M * camera.focal_length_m / (np.pi**2 * camera.aperture_m * WINDOW / 2 * camera.pixel_m)
    # Cells on the rim that are open in part take 1 %; the faces 7 %.
    assert seen == pytest.approx(faces * (1 - beyond), rel=0.015)


def test_the_beam_of_a_design_lights_no_measurement():
    model = model_of()
    lit = replace(model, camera=replace(model.camera, beam=EvenBeam(0.05, tilt_rad=(0.0, 0.01))), _optics={})
    np.testing.assert_array_equal(image(lit, 0, 0, 0), image(model, 0, 0, 0))


def test_the_zeroth_order_of_a_chequered_plate_is_that_of_two_phases():
    """Half of it one level down: cos²(phi / 2), and no less when a cell is drawn as four."""
    rows, columns = np.indices((CELLS, CELLS))
    model = model_of(((rows + columns) % 2).astype(np.uint8))
    step_m = model.unknowns.process.levels.step_m
    phase = 2 * np.pi * (refractive_index("fused_silica", PROBE_M) - 1) * step_m / PROBE_M
    for one in (model, model.finer(2)):
        # Cells on the rim are open in part, not all by the same share: 150 of 1300 cells.
        assert one.plate(np.zeros(1)).zeroth_order() == pytest.approx(np.cos(phase / 2) ** 2, abs=2e-3)


def test_finer_cells_are_the_same_plate():
    model = model_of()
    coarse, fine = image(model, 0.3, -0.2, 0), image(model.finer(2), 0.3, -0.2, 0)
    # The round rim of cells that are open in part.
    assert np.linalg.norm(fine - coarse) < 0.01 * np.linalg.norm(coarse)


@pytest.mark.parametrize("kind", range(4))
def test_room_is_made_for_the_farthest_that_a_camera_may_stand(kind: int):
    """How far places of neighbouring pixels move apart at the window's corner, with one thing off as far as it may."""
    mean, sigma = np.zeros(4), np.zeros(4)
    mean[kind], sigma[kind] = -0.01, 0.005
    camera = model_of().camera
    room = room_of(camera, GeometryPrior(tuple(mean), tuple(sigma)))  # pyright: ignore[reportArgumentType]
    place = places(np.where(mean, 0.01 + REACH * 0.005, 0.0), (0.0, 0.0), camera.sensor_distance_m / camera.pixel_m)
    corner, step = WINDOW / 2, 0.5
    ends = [[np.array(place(corner + s * dy, corner + s * dx), float) for s in (-1, 1)] for dy, dx in step * np.eye(2)]
    slopes = np.stack([(end - start) / (2 * step) for start, end in ends], axis=1)
    farthest = np.linalg.norm(slopes - np.eye(2), 2)
    # Single precision of places of 20 pixels; an angle is a little more than its chord.
    assert room == pytest.approx(farthest, rel=1e-3, abs=2e-6)


def test_room_is_none_where_the_camera_is_upright():
    assert room_of(model_of().camera, GeometryPrior()) == 0.0
