from dataclasses import replace

import numpy as np
import pytest

from bench.reference import make_camera
from sim.imaging.field import FieldOptics, capture_frame, node_weights
from sim.imaging.formation import Optics, capture
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene
from sim.psf_bank import PsfBank, psf

MODELS: tuple[Model, ...] = ("paper", "paper_release", "radiometric", "reciprocal")
SHAPE, PIXEL_M, DEPTH_M = (70, 90), 2e-5, 0.1
AXES_M = tuple(PIXEL_M * np.array(half) for half in ((-40.0, 0.0, 40.0), (-50.0, 50.0)))
TILE = (40, 45)


def optics_of(psf: np.ndarray) -> FieldOptics:
    y, x = AXES_M
    return FieldOptics(psf.astype(np.float32), y, x, Optics(psf[1, 0].astype(np.float32), 4e-3, 4e-3, PIXEL_M))


def psfs(rng: np.random.Generator, window: int = 9) -> np.ndarray:
    psf = rng.uniform(0, 1, (3, 2, 2, 3, window, window))
    return 0.9 * psf / psf.sum(axis=(-2, -1), keepdims=True)


def scene_of(rng: np.random.Generator) -> Scene:
    mask = np.zeros(SHAPE, np.float32)
    mask[20:45, 30:70] = 1.0
    light = rng.uniform(0, 1, (2, 3, *SHAPE)).astype(np.float32)
    return Scene(light[0], np.inf, (Obstruction(mask, light[1], DEPTH_M),))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("border", ["reflect", "edge"])
def test_one_psf_everywhere_is_the_plain_capture(rng, model: Model, border):
    psf = np.broadcast_to(psfs(rng)[:1, :1], (3, 2, 2, 3, 9, 9))
    scene, optics = scene_of(rng), optics_of(psf)
    frame = capture_frame(scene, optics, model, border=border, length=TILE)
    whole = np.asarray(capture(scene, optics.axis, model, border=border))
    # The promise for seams; tiles and weights add rounding only.
    assert np.abs(frame - whole).max() < 1e-5


@pytest.mark.parametrize("model", MODELS)
def test_tiles_leave_no_seams_where_psfs_vary(rng, model: Model):
    scene, optics = scene_of(rng), optics_of(psfs(rng))
    tiled, whole = (capture_frame(scene, optics, model, length=n) for n in (TILE, (200, 200)))
    assert np.abs(tiled - whole).max() < 1e-5


def test_a_point_spreads_by_the_psfs_around_it(rng):
    """By their bilinear shares, a quarter of the way between nodes along y and half along x; on a node along y."""
    psf = psfs(rng)
    for (y, x), shares in (
        ((10.0, 0.0), {(1, 0): 0.375, (1, 1): 0.375, (2, 0): 0.125, (2, 1): 0.125}),
        ((0.0, 0.0), {(1, 0): 0.5, (1, 1): 0.5}),
    ):
        light = np.zeros((3, 71, 91), np.float32)
        row, column = 35 + int(y), 45 + int(x)
        light[:, row, column] = 1.0
        nothing = Obstruction(np.zeros((71, 91), np.float32), 0 * light, DEPTH_M)
        frame = capture_frame(Scene(light, np.inf, (nothing,)), optics_of(psf), "radiometric", length=TILE)
        wanted = sum(share * psf[j, i, 0] for (j, i), share in shares.items())
        np.testing.assert_allclose(frame[:, row - 4 : row + 5, column - 4 : column + 5], wanted, atol=1e-6)
        assert frame.sum() == pytest.approx(2.7, rel=1e-5)  # three colours of energy 0.9


def test_shares_of_the_light_sum_to_one():
    weights = node_weights(np.linspace(-3, 4, 50), np.array([-1.0, 0.5, 2.0]))
    np.testing.assert_allclose(weights.sum(axis=0), 1, atol=1e-6)
    np.testing.assert_array_equal(weights[0, :10], 1)  # beyond the outermost node
    assert weights[2, -1] == 1


def test_from_banks_at_field_angles():
    """Real PSFs: a coarse lens with 5 cm to the obstruction, seen under three angles."""
    camera = make_camera(64, 0.15e-3, 0.5e-3, 4e-6, 15)
    height = np.random.default_rng(3).uniform(0, 3e-7, (64, 64))
    angles = (-0.1, 0.0, 0.1)
    banks = [[psf(height, camera, [np.inf, 0.05], field_rad=(y, x)) for x in angles] for y in angles[1:]]
    optics = FieldOptics.of(banks, camera, (np.inf, 0.05))
    assert optics.psf.shape == (2, 3, 2, 1, 15, 15)
    np.testing.assert_allclose(optics.x_m, 0.5e-3 * np.tan(angles), rtol=1e-12)
    np.testing.assert_array_equal(optics.axis.psf[1], banks[0][1].energy[:, 1])
    light = np.full((1, 40, 50), 0.5, np.float32)
    frame = capture_frame(Scene(light, np.inf, (Obstruction(0 * light[0], light, 0.05),)), optics, "radiometric")
    energies = [bank.energy[0, 0].sum() for row in banks for bank in row]
    # A uniform world is as bright as the PSFs pass light, wherever one looks. Their centroids differ by hundredths of
    # a pixel, which stretches the image between nodes a dozen pixels apart by less than a thousandth.
    assert 0.4995 * min(energies) < frame.min() <= frame.max() < 0.5005 * max(energies)


def test_nodes_lie_where_the_lens_images_their_angles():
    """By the tangent, and 3 % farther out per squared tangent of 0.1: a pincushion."""
    camera = replace(make_camera(64, 0.15e-3, 0.5e-3, 4e-6, 5), mapping="tangent", distortion=(3.0, 0.0))
    dark, angles = np.zeros((1, 1, 5, 5), np.float32), (-0.1, 0.0, 0.2)
    banks = [[PsfBank(dark, ("one",), (np.inf,), 4e-6, (y, x)) for x in angles] for y in angles[:2]]
    optics = FieldOptics.of(banks, camera, (np.inf,))
    t = np.tan(angles)
    np.testing.assert_allclose(optics.x_m, 0.5e-3 * t * (1 + 3 * t**2), rtol=1e-12)
    np.testing.assert_allclose(optics.y_m, optics.x_m[:2], rtol=1e-12)


def test_refusals(rng):
    scene, optics = scene_of(rng), optics_of(psfs(rng))
    with pytest.raises(ValueError, match="'reflect' or 'edge' for a frame"):
        capture_frame(scene, optics, "paper", border="own")
    camera = make_camera(64, 0.15e-3, 0.5e-3, 4e-6, 5)
    bank = PsfBank(np.zeros((1, 1, 5, 5), np.float32), ("one",), (np.inf,), 4e-6, (0.1, 0.0))
    with pytest.raises(ValueError, match="increasing grid of field angles"):
        FieldOptics.of([[bank], [bank]], camera, (np.inf,))
