"""From a scene in layers to the light on the sensor, differentiable in PSFs and images.

How an obstruction takes light from what is behind it is the choice of a model by name (`sim.imaging.occlusion`).
"""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from fab.units import number_of, require_kind
from sim.camera import Camera
from sim.imaging.common import with_common
from sim.imaging.convolve import Border, Otf, Window, convolve, plan_otf, superpose
from sim.imaging.disc import disc_window, shadow_disc
from sim.imaging.occlusion import (
    Layers,
    Light,
    Model,
    Outside,
    check_names,
    compose,
    eq_10_alpha,
    follows_light,
)
from sim.imaging.scene import Depth, Scene
from sim.psf_bank import PsfBank
from sim.tracing import stacked


class Optics(eqx.Module):
    """PSFs and lengths of a camera, for captures.

    Attributes:
        psf: `[layer, c, y, x]` PSFs of the background and then of every obstruction, from the farthest to the nearest,
            in energy per pixel. An odd window keeps the capture registered with the scene (`sim.imaging.convolve`).
        aperture_m: diameter of the clear aperture, metres.
        focal_m: distance from the lens to the sensor, metres.
        pixel_m: pixel pitch, metres.
        shadow_px: pixels of the odd window that holds every shadow disc, where depths are traced; otherwise the depths
            say it. A traced depth whose disc does not fit gives NaN, never a smaller shadow.
        otf: transforms of the PSFs, once they are `prepared`.
        otf_depths_m: depths of all layers for which `reciprocal` is prepared, the background's first, metres; or empty.
    """

    psf: Float[Array, "layer c ky kx"] | Float[np.ndarray, "layer c ky kx"]
    aperture_m: float = eqx.field(static=True)
    focal_m: float = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    shadow_px: int | None = eqx.field(static=True, default=None)
    otf: Otf | None = None
    otf_depths_m: tuple[float, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(cls, bank: PsfBank, camera: Camera, depths_m: Sequence[float]) -> "Optics":
        """Optics for layers at depths (background first) within a bank's, its PSFs mixed linearly in 1/z.

        `reciprocal` compares near PSFs with shadow discs and wants them of the very depth: mixed at 10 mm from 6 and
        15 mm they cost it 1 to 4 % (a lens, a grating and an optimised plate of the scale of examples/quick.toml).
        """
        psf = stacked([bank.at(depth) for depth in depths_m])
        return cls(psf, camera.aperture_m, camera.sensor_distance_m, bank.pixel_m)

    def disc_px(self, depth_m: Depth, behind_m: Depth) -> Float[Array, ""] | float:
        """Diameter in pixels of the shadow disc in the plane at `depth_m` of a point at `behind_m`, farther away."""
        near, far, width = _known(depth_m), _known(behind_m), self.aperture_m * self.focal_m / self.pixel_m
        if near is None or far is None:
            return width * (1 / jnp.asarray(depth_m) - 1 / jnp.asarray(behind_m))
        if not 0 < near < far:
            raise ValueError(f"an obstruction must be nearer than what it covers, but got {near} m before {far} m")
        return width * (1 / near - 1 / far)

    def prepared(self, shape: Window, border: Border = "reflect", depths_m: Sequence[float] = ()) -> "Optics":
        """The same optics with the PSFs' transforms, for many scenes of one shape.

        Args:
            shape: pixels (y, x) of the scenes; with their own margin and a model that follows the light, less the
                margin that the shadow discs take (`capture`).
            border: what lies beyond a scene.
            depths_m: depths of all layers of the scenes, the background's first, metres. `reciprocal` needs them.
        """
        kernels = jnp.swapaxes(jnp.asarray(self.psf), 0, 1)
        if depths_m:
            kernels = with_common(kernels, _discs(depths_m, self, self.shadow_px or _disc_px(depths_m, self)))
        return replace(self, otf=plan_otf(kernels, shape, border), otf_depths_m=tuple(map(float, depths_m)))


def _known(depth_m: Depth) -> float | None:
    """A depth as a number; None while it is traced."""
    try:
        return float(depth_m)
    except jax.errors.ConcretizationTypeError:
        return None


def capture(
    scene: Scene, optics: Optics, model: Model, *, border: Border = "reflect", outside: Outside = "scene"
) -> Float[Array, "c v u"]:
    """Light on the sensor, relative to a white scene through a lossless lens of the same aperture; no noise.

    Compiled once per shape, model and window of the shadow discs, whatever the depths.

    Args:
        scene: background and obstructions, linear light.
        optics: PSFs of every layer of the scene.
        model: how layers are put together (`sim.imaging.occlusion`).
        border: what lies beyond the scene (`sim.imaging.convolve`). With `own` the capture is smaller than the scene,
            by the PSF's window and, where the model follows the light, that of the shadow discs, which `reciprocal`
            needs twice.
        outside: what I_obs holds where there is no obstruction; for the paper's models.

    Returns:
        `[c, y, x]`, differentiable in PSFs and images. Where nothing lands, rounding may leave -1e-7 of the brightest.

    Raises:
        InputError: no scene or optics, or a length of the optics that is not positive.
        ValueError: PSFs or layers of another number or shape, an obstruction that is not before the background, or an
            unknown name.
    """
    require_kind("scene", scene, Scene, "For example sim.Scene(background, 5.0).")
    require_kind("optics", optics, Optics, "For example sim.Optics.of(bank, camera, depths_m).")
    for name in ("aperture_m", "focal_m", "pixel_m"):
        if not 0 < number_of(value := getattr(optics, name)) < np.inf:
            rule = "must be a positive number of metres"
            raise InputError(f"optics: {name}", rule, repr(value), "For example 5e-3 for 5 mm.")
    check_names(model, outside)
    check_layers(scene, *optics.psf.shape[:2])
    window = shadow_px(scene, optics) if follows_light(model) else 1
    y, x = scene.background.shape[1:]
    margin = own_margin_px(1, window, model) if border == "own" else 0
    lit = (y - margin, x - margin)
    if optics.otf is not None and (optics.otf.shape, optics.otf.border) != (lit, border):
        wanted, got = f"{lit} and {border!r}", f"{optics.otf.shape} and {optics.otf.border!r}"
        raise ValueError(f"`optics` must be prepared for the shape and border {wanted}, but got {got}")
    if optics.otf is not None and model == "reciprocal":
        depths = tuple(_known(depth) for depth in _depths(scene))
        if depths != optics.otf_depths_m:
            wanted, got = f"the depths {depths}", f"{optics.otf_depths_m}"
            raise ValueError(f"`optics` must be prepared for {wanted} of the scene, but got {got}")
    discs = shadow_discs(scene, optics, window) if follows_light(model) else ()
    kernels = optics.otf
    if kernels is None:
        kernels = jnp.swapaxes(jnp.asarray(optics.psf), 0, 1)
        kernels = with_common(kernels, discs) if model == "reciprocal" else kernels
    layers = Layers(
        scene.background, tuple(o.mask for o in scene.obstructions), tuple(o.radiance for o in scene.obstructions)
    )
    return _formed(layers, discs, kernels, model, outside, lit, border)


def own_margin_px(psf_px: int, shadow_px: int, model: Model) -> int:
    """Pixels per axis by which a scene that brings its margin along (`border="own"`) is larger than its capture.

    The paper's models cast no shadow, `reciprocal` casts it twice; the windows are those of the PSFs and the shadow
    discs.
    """
    shadows = 2 if model == "reciprocal" else int(follows_light(model))
    return psf_px - 1 + shadows * (shadow_px - 1)


def lost_share(scene: Scene, optics: Optics, model: Model) -> Float[Array, "c v u"]:
    """Share of the background's light that a model takes away behind one obstruction; the view is mirrored beyond it.

    `[1, y, x]` d * M where the model follows the light, `[c, y, x]` alpha of eq. 10 otherwise, 0 to 1.
    """
    check_names(model, "scene")
    if len(scene.obstructions) != 1:
        raise ValueError(f"`scene` must have one obstruction, but got {len(scene.obstructions)}")
    mask, shape = scene.obstructions[0].mask, (scene.background.shape[1], scene.background.shape[2])
    if follows_light(model):
        (disc,) = shadow_discs(scene, optics, shadow_px(scene, optics))
        share = convolve(mask[None], plan_otf(disc, shape, "reflect"))
    else:
        otf = plan_otf(jnp.swapaxes(jnp.asarray(optics.psf), 0, 1), shape, "reflect")
        colours = (_Patch(_layer(otf, colour)) for colour in range(scene.background.shape[0]))
        release = model == "paper_release"
        share = jnp.stack([jnp.asarray(eq_10_alpha(mask, 1, imaging, release)) for imaging in colours])
    return jnp.clip(share, 0.0, 1.0)


@eqx.filter_jit
def _formed(
    layers: Layers,
    discs: tuple[Array, ...],
    kernels: Otf | Array,
    model: Model,
    outside: Outside,
    lit: Window,
    border: Border,
) -> Array:
    """`capture` in arrays, colour by colour.

    The arrays between its transforms then stay below the 32 MB from which the C library takes fresh memory from the
    system at every call, which costs as much as the transforms.
    """
    shape = (layers.background.shape[1], layers.background.shape[2])
    shadows = [plan_otf(disc, shape, border) for disc in discs]
    kept = [1 - convolve(mask[None], otf) for mask, otf in zip(layers.masks, shadows, strict=bool(shadows))]

    def shaded(number: int, light: Light) -> Array:
        planned = light.shape == shape
        otf = shadows[number] if planned else plan_otf(discs[number], (light.shape[0], light.shape[1]), border)
        return convolve(light, _layer(otf, 0))

    def colour(given: tuple[Array, tuple[Array, ...], Array]) -> Array:
        background, radiances, kernel = given
        otf = (
            eqx.tree_at(lambda o: o.transfer, kernels, kernel)
            if isinstance(kernels, Otf)
            else plan_otf(kernel, lit, border)
        )
        one = Layers(background, layers.masks, radiances)
        return jnp.asarray(compose(one, kept, shaded, _Patch(otf), model, outside))

    light = jax.tree.map(jnp.asarray, (layers.background, layers.radiances))
    return jax.lax.map(colour, (*light, kernels.transfer if isinstance(kernels, Otf) else kernels))


def check_layers(scene: Scene, layers: int, colours: int) -> None:
    """Raise a ValueError unless PSFs and layers match."""
    wanted = (1 + len(scene.obstructions), scene.background.shape[0])
    if (layers, colours) != wanted:
        raise ValueError(f"PSFs must have (layers, colours) = {wanted} as the scene, but got {(layers, colours)}")
    shape = scene.background.shape
    for near in scene.obstructions:
        if near.mask.shape != shape[1:] or near.radiance.shape != shape:
            got = f"a mask {near.mask.shape} and light {near.radiance.shape}"
            raise ValueError(f"every layer must have the background's shape {shape}, but got {got}")


def shadow_px(scene: Scene, optics: Optics) -> int:
    """Pixels of the odd window that holds every shadow disc of a scene, one more than a multiple of 16.

    A ValueError where depths are traced and `Optics.shadow_px` is not given.
    """
    if optics.shadow_px is not None:
        return optics.shadow_px
    depths = _depths(scene)
    if any(_known(depth) is None for depth in depths):
        raise ValueError("`Optics.shadow_px` must be given where depths are traced, but got None")
    return _disc_px(depths, optics)


def _depths(scene: Scene) -> list[Depth]:
    """Depths of all layers, the background first."""
    return [scene.background_depth_m, *(near.depth_m for near in scene.obstructions)]


def _disc_px(depths: Sequence[Depth], optics: Optics) -> int:
    widths = [optics.disc_px(near, behind) for k, near in enumerate(depths) for behind in depths[:k]]
    largest = max((disc_window(float(width)) for width in widths), default=1)
    return 16 * ((largest + 14) // 16) + 1


def shadow_discs(scene: Scene, optics: Optics, window: int) -> tuple[Array, ...]:
    """For every obstruction, the shadow disc `[behind, y, x]` of points of each layer behind it."""
    return _discs(_depths(scene), optics, window)


def _discs(depths: Sequence[Depth], optics: Optics, window: int) -> tuple[Array, ...]:
    return tuple(
        jnp.stack([jnp.asarray(shadow_disc(optics.disc_px(near, behind), window)) for behind in depths[:count]])
        for count, near in enumerate(depths[1:], start=1)
    )


def _layer(otf: Otf, which: int | slice) -> Otf:
    """The transforms of one entry of the first axis, a layer or colour, or of some."""
    return eqx.tree_at(lambda o: o.transfer, otf, otf.transfer[which])


class _Patch(eqx.Module):
    """`Imaging` by transforms `[layer, fx, fy]` of one colour's PSFs, with one transform per image."""

    otf: Otf

    def one(self, layer: int, light: Light, unit: bool) -> Array:
        otf = _layer(self.otf, layer)
        landed = convolve(light, otf)
        return landed / otf.energy if unit else landed

    def total(self, lights: Sequence[Light]) -> Array:
        return superpose(lights, _layer(self.otf, slice(len(lights))))
