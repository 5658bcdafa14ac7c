from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import fftconvolve

from bench.reference import make_camera
from fab.errors import InputError
from sim.imaging.disc import shadow_disc
from sim.imaging.formation import Optics, capture, lost_share, own_margin_px, shadow_px
from sim.imaging.occlusion import Model, follows_light
from sim.imaging.scene import Obstruction, Scene
from sim.psf_bank import PsfBank

MODELS: tuple[Model, ...] = ("paper", "paper_release", "radiometric", "reciprocal")
SHAPE = (24, 30)
# A disc of 8.9 pixels at 0.1 m before infinity, in a window of 17.
APERTURE_M, FOCAL_M, PIXEL_M = 4e-3, 4e-3, 1.8e-5


def optics_of(psf: np.ndarray) -> Optics:
    return Optics(psf.astype(np.float32), APERTURE_M, FOCAL_M, PIXEL_M)


def blurs(rng: np.random.Generator, layers: int = 2, window: int = 7, energy: float = 0.8) -> np.ndarray:
    psf = rng.uniform(0, 1, (layers, 3, window, window))
    return energy * psf / psf.sum(axis=(-2, -1), keepdims=True)


def points(layers: int = 2) -> np.ndarray:
    psf = np.zeros((layers, 3, 5, 5))
    psf[..., 2, 2] = 1
    return psf


def scene_of(rng: np.random.Generator, depths: tuple[float, ...] = (0.1,), shape: tuple[int, int] = SHAPE) -> Scene:
    near = []
    for depth in depths:
        mask = np.zeros(shape, np.float32)
        y, x = rng.integers(4, 12, 2)
        mask[y : y + 8, x : x + 9] = 1.0
        near.append(Obstruction(mask, rng.uniform(0, 1, (3, *shape)).astype(np.float32), depth))
    return Scene(rng.uniform(0, 1, (3, *shape)).astype(np.float32), np.inf, tuple(near))


@pytest.mark.parametrize("model", MODELS)
def test_a_point_images_an_open_scene_as_it_is(rng, model: Model):
    scene = eqx.tree_at(lambda s: s.obstructions[0].mask, scene_of(rng), np.zeros(SHAPE, np.float32))
    # Rounding of float32 transforms.
    np.testing.assert_allclose(capture(scene, optics_of(points()), model), scene.background, atol=2e-6)


def test_a_scene_without_obstruction_is_one_convolution(rng):
    psf = blurs(rng, layers=1)
    scene = Scene(scene_of(rng).background, np.inf)
    each = [np.asarray(capture(scene, optics_of(psf), model)) for model in ("paper", "radiometric")]
    np.testing.assert_allclose(each[0], each[1], atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_an_open_scene_with_its_own_margin_loses_the_window_of_the_psf_alone(rng, model: Model):
    from scipy.signal import convolve2d

    psf, scene = blurs(rng, layers=1), Scene(scene_of(rng).background, np.inf)
    image = np.asarray(capture(scene, optics_of(psf), model, border="own"))
    scale = psf.sum(axis=(2, 3)) if model == "paper_release" else np.ones((1, 3))
    wanted = [convolve2d(scene.background[c], psf[0, c] / scale[0, c], mode="valid") for c in range(3)]
    np.testing.assert_allclose(image, wanted, atol=2e-6)  # rounding of float32 transforms


def test_what_a_model_takes_away_is_told_of_one_obstruction(rng):
    optics = optics_of(points(3))
    scene = scene_of(rng)
    share = np.asarray(lost_share(scene, optics_of(points()), "paper"))
    # Points as PSFs make it the mask itself.
    np.testing.assert_allclose(share, np.broadcast_to(scene.obstructions[0].mask, share.shape), atol=2e-6)
    disc = shadow_disc(APERTURE_M * FOCAL_M / PIXEL_M / 0.1, 17)
    covered = fftconvolve(np.pad(scene.obstructions[0].mask, 8, mode="reflect"), disc, mode="valid")
    for model in ("radiometric", "reciprocal"):
        np.testing.assert_allclose(lost_share(scene, optics_of(points()), model)[0], covered, atol=2e-6)
    with pytest.raises(ValueError, match="one obstruction, but got 2"):
        lost_share(scene_of(rng, (0.2, 0.1)), optics, "radiometric")


def test_eq_10_as_printed(rng):
    """Points as PSFs make alpha the mask itself, so the obstruction simply replaces the scene."""
    scene = scene_of(rng)
    near = scene.obstructions[0]
    for outside in ("scene", "nothing"):
        image = capture(scene, optics_of(points()), "paper", outside=outside)
        np.testing.assert_allclose(image, np.where(near.mask, near.radiance, scene.background), atol=3e-6)


def test_eq_10_term_by_term(rng):
    """Each convolution by hand; alpha is a share, so it is relative to the energy of the near PSF."""
    from scipy.signal import convolve2d

    scene, psf = scene_of(rng), blurs(rng)
    near = scene.obstructions[0]

    def blur(image, kernel):
        return convolve2d(np.pad(image.astype(float), 3, mode="reflect"), kernel, mode="valid")

    for outside in ("scene", "nothing"):
        for model, gain in zip(MODELS, (1.0, 1.5), strict=False):
            image = np.asarray(capture(scene, optics_of(psf), model, outside=outside))
            for c in range(3):
                far, close = psf[0, c], psf[1, c]
                alpha = np.clip(gain * blur(near.mask, close / close.sum()), 0, 1)
                if model == "paper_release":
                    far, close = far / far.sum(), close / close.sum()
                shown = near.mask * near.radiance[c]
                shown = shown + (1 - near.mask) * scene.background[c] if outside == "scene" else shown
                wanted = alpha * blur(shown, close) + (1 - alpha) * blur(scene.background[c], far)
                np.testing.assert_allclose(image[c], wanted, atol=5e-6)


@pytest.mark.parametrize("model", MODELS)
def test_prepared_optics_give_the_same(rng, model: Model):
    scene, optics = scene_of(rng), optics_of(blurs(rng))
    prepared = optics.prepared(SHAPE, depths_m=(np.inf, 0.1))
    np.testing.assert_allclose(capture(scene, prepared, model), capture(scene, optics, model), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_gradients_are_finite_differences(rng, model: Model):
    """Along a random direction in everything at once: PSFs, images and mask."""
    scene, optics = scene_of(rng, (0.2, 0.1)), optics_of(blurs(rng, layers=3))
    weights = rng.standard_normal((3, *SHAPE)).astype(np.float32)
    near = scene.obstructions
    start = (optics.psf, scene.background, tuple(o.radiance for o in near), tuple(0.1 + 0.8 * o.mask for o in near))
    start = jax.tree.map(jnp.asarray, start)
    way = jax.tree.map(
        lambda leaf: jnp.asarray(rng.standard_normal(leaf.shape) * float(leaf.mean()), jnp.float32), start
    )

    def loss(given):
        psf, background, radiances, masks = given
        layers = zip(masks, radiances, (0.2, 0.1), strict=True)
        moved = Scene(background, np.inf, tuple(Obstruction(*layer) for layer in layers))
        return jnp.sum(weights * capture(moved, replace(optics, psf=psf), model))

    gradient = jax.jit(jax.grad(loss))(start)
    slope = sum(float(jnp.sum(g * w)) for g, w in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True))
    step = 0.005  # the clamp of the release's alpha bends a few pixels; everything else is smooth

    plain = jax.jit(loss)

    def at(t: float) -> float:
        return float(plain(jax.tree.map(lambda leaf, w: leaf + t * w, start, way)))

    tolerance = 0.03 if model == "paper_release" else 3e-3
    assert (at(step) - at(-step)) / (2 * step) == pytest.approx(slope, rel=tolerance)


@pytest.mark.parametrize("model", MODELS)
def test_a_batch_is_its_scenes(rng, model: Model):
    """By vmap, depths and all; shared optics say how large a shadow may be."""
    scenes = [scene_of(rng, (depth,)) for depth in (0.1, 0.08, 0.15)]
    optics = replace(optics_of(blurs(rng)), shadow_px=17)
    batch = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, jnp.float32) for leaf in leaves]), *scenes)
    images = jax.jit(jax.vmap(lambda scene: capture(scene, optics, model)))(batch)
    for image, scene in zip(images, scenes, strict=True):
        # Traced discs are straight within a pixel, known ones are not: 1e-4 of the light.
        np.testing.assert_allclose(image, capture(scene, optics, model), atol=1e-3 if follows_light(model) else 2e-6)


@pytest.mark.parametrize("model", MODELS)
def test_a_scene_with_its_own_margin(rng, model: Model):
    """The middle of a large scene is the same whether the margin is given or invented farther out."""
    scene, optics = scene_of(rng, shape=(60, 70)), optics_of(blurs(rng))
    whole = np.asarray(capture(scene, optics, model))
    own = np.asarray(capture(scene, optics, model, border="own"))
    lost = 6 + 16 * {"radiometric": 1, "reciprocal": 2}.get(model, 0)
    assert own.shape == (3, 60 - lost, 70 - lost)
    half = lost // 2
    np.testing.assert_allclose(own, whole[:, half:-half, half:-half], atol=3e-6)
    prepared = optics.prepared((60 - lost + 6, 70 - lost + 6), "own", (np.inf, 0.1))
    np.testing.assert_allclose(capture(scene, prepared, model, border="own"), own, atol=1e-6)


def test_traced_depths_need_a_window_and_never_shrink_a_shadow(rng):
    scene, optics = scene_of(rng), optics_of(blurs(rng))

    def at(depth, given: Optics):
        return capture(eqx.tree_at(lambda s: s.obstructions[0].depth_m, scene, depth), given, "radiometric")

    with pytest.raises(ValueError, match="must be given where depths are traced"):
        jax.jit(lambda depth: at(depth, optics))(0.1)
    assert shadow_px(scene, optics) == 17
    fits = replace(optics, shadow_px=17)
    assert np.isfinite(jax.jit(lambda depth: at(depth, fits))(0.1)).all()
    assert np.isnan(jax.jit(lambda depth: at(depth, fits))(0.05)).any()


def bank_of(rng, depths: tuple[float, ...]) -> PsfBank:
    energy = rng.uniform(0, 1, (2, len(depths), 5, 5)).astype(np.float32)
    return PsfBank(energy, ("red", "green"), depths, PIXEL_M)


def test_psfs_between_depths_are_mixed_in_dioptres(rng):
    bank = bank_of(rng, (0.05, np.inf, 0.1))
    np.testing.assert_array_equal(bank.at(0.1), bank.energy[:, 2])
    np.testing.assert_array_equal(bank.at(np.inf), bank.energy[:, 1])
    # 1 / 0.0625 = 16 dioptres lies at 0.6 between 10 and 20.
    np.testing.assert_allclose(bank.at(0.0625), 0.4 * bank.energy[:, 2] + 0.6 * bank.energy[:, 0], rtol=1e-5)
    with pytest.raises(InputError, match=r"0\.04 m\. Compute the bank"):
        bank.at(0.04)
    with pytest.raises(InputError, match="within the depths"):
        bank_of(rng, (0.05, 5.0)).at(np.inf)


def test_optics_of_a_bank(rng):
    bank, camera = bank_of(rng, (0.05, np.inf)), make_camera(64, APERTURE_M, FOCAL_M, PIXEL_M, 5)
    optics = Optics.of(bank, camera, (np.inf, 0.05))
    assert isinstance(optics.psf, np.ndarray)
    np.testing.assert_array_equal(optics.psf[1], bank.energy[:, 0])
    assert (optics.aperture_m, optics.focal_m, optics.pixel_m) == (APERTURE_M, FOCAL_M, PIXEL_M)


def test_what_does_not_fit_is_refused(rng):
    scene, optics = scene_of(rng), optics_of(blurs(rng))
    with pytest.raises(ValueError, match=r"PSFs must have \(layers, colours\)"):
        capture(scene, optics_of(blurs(rng, layers=3)), "paper")
    with pytest.raises(ValueError, match="must be nearer than what it covers"):
        capture(eqx.tree_at(lambda s: s.background_depth_m, scene, 0.1), optics, "radiometric")
    with pytest.raises(ValueError, match="must be prepared for the shape"):
        capture(scene, optics.prepared((24, 31)), "paper")
    for depths in ((), (np.inf, 0.2)):
        with pytest.raises(ValueError, match=r"must be prepared for the depths \(inf, 0\.1\)"):
            capture(scene, optics.prepared(SHAPE, depths_m=depths), "reciprocal")
    odd = eqx.tree_at(lambda s: s.obstructions[0].mask, scene, np.zeros((24, 31), np.float32))
    with pytest.raises(ValueError, match="must have the background's shape"):
        capture(odd, optics, "paper")


@pytest.mark.parametrize(("model", "pixels"), [("paper", 8), ("radiometric", 12), ("reciprocal", 16)])
def test_the_margin_is_that_of_the_psf_and_of_every_shadow(model: Model, pixels: int):
    """Windows of 9 and 5 pixels reach 8 and 4 beyond a pixel."""
    assert own_margin_px(9, 5, model) == pixels
