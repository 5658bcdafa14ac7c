"""From a scene in layers to the light on the sensor: three models, all differentiable in PSFs and images.

`radiometric` follows the light (design.md §6). The bundle from a point of the background through the aperture cuts an
obstruction's plane in a disc of diameter D · (1 - z_o / z_b), which is D · (1 - z_o / z_b) · f / (z_o · pixel) pixels
wide (eq. 11). The share of the disc that the obstruction covers is the share of the point's light that is lost,
whatever the DOE does; what is left lands by the far PSF, and the obstruction's own light by the near one:

    I = p_near ∗ (M · I_obs) + p_far ∗ ((1 - d ∗ M) · I_far)

With several obstructions every layer loses to each nearer one by that one's own disc, and the passed shares are
multiplied. That takes shadows in one bundle as independent: exact where they do not meet, and on average otherwise. The
second approximation is that a partly blocked pupil has the PSF of the open one, only weaker. So a uniform world stays
uniform where p_near = p_far ∗ d, as for a lens alone or a plate of straight lines; with others its *energy* does.

`paper` is eq. 10 as printed, with α = p_obs ∗ M for every colour:

    I = α ⊙ (p_obs ∗ I_obs) + (1 - α) ⊙ (p_far ∗ I_far)

α is a share, and the paper's PSFs have unit sum, so it is divided by the energy of p_obs in its window (a cover over
everything must not let the background through); the light itself keeps the PSFs' energies. Eq. 10 passes light that
never reaches the aperture: with the paper's plate half the light of points that are completely hidden. In even light
it is nevertheless exact, by reciprocity: what a dark bar takes is what a bright one would send. `sim.shadow` judges
both, and examples/compare_occlusion.py shows by how much each is off for a plate.

`paper_release` is what the public code does: every PSF scaled to unit sum, α = clamp(1.5 · p_obs ∗ M, 0, 1).

Under both, `outside` says what I_obs holds where there is no obstruction, which eq. 10 leaves open: the scene behind
(the public code for dirt and fences) or nothing (for raindrops). Several obstructions are laid over each other from the
farthest to the nearest. Say which model was used wherever a result is shown; none is a default.
"""

from collections.abc import Sequence
from typing import Literal, Protocol, get_args, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from sim.camera import Camera
from sim.convolve import Border, Otf, Window, convolve, plan_otf, superpose
from sim.disc import disc_window, shadow_disc
from sim.psf import PsfBank
from sim.scene import Depth, Scene

Model = Literal["paper", "paper_release", "radiometric"]
Outside = Literal["scene", "nothing"]
Light = Array | np.ndarray

_RELEASE_GAIN = 1.5  # of alpha, in the public code


class Optics(eqx.Module):
    """What a capture needs to know of a camera.

    Attributes:
        psf: `[layer, c, y, x]` PSFs of the background and then of every obstruction, from the farthest to the nearest,
            in energy per pixel. An odd window keeps the capture registered with the scene (`sim.convolve`).
        aperture_m: diameter of the clear aperture, metres.
        focal_m: distance from the lens to the sensor, metres.
        pixel_m: pixel pitch, metres.
        shadow_px: pixels of the odd window that holds every shadow disc. Only where depths are traced, as in a compiled
            function over many of them; otherwise None, and the depths say it. A traced depth whose disc does not
            fit gives NaN, never a smaller shadow.
    """

    psf: Float[Array, "layer c ky kx"] | Float[np.ndarray, "layer c ky kx"]
    aperture_m: float = eqx.field(static=True)
    focal_m: float = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    shadow_px: int | None = eqx.field(static=True, default=None)

    @classmethod
    def of(cls, bank: PsfBank, camera: Camera, depths_m: Sequence[float], shadow_px: int | None = None) -> "Optics":
        """Optics for layers at given depths, background first, from a bank.

        Between two depths of the bank PSFs are mixed linearly in 1/z, as the width of a blur grows.

        Raises:
            InputError: a depth beyond the bank's.
        """
        psf = np.stack([psf_at(bank, depth) for depth in depths_m])
        return cls(psf, camera.aperture_m, camera.sensor_distance_m, bank.pixel_m, shadow_px)

    @property
    def window(self) -> Window:
        """Samples (y, x) of a PSF."""
        return self.psf.shape[-2], self.psf.shape[-1]

    def disc_px(self, depth_m: Depth, behind_m: Depth) -> Float[Array, ""] | float:
        """Diameter in pixels of the shadow disc of a point at `behind_m` in the plane at `depth_m`.

        Raises:
            ValueError: the plane is not before the point.
        """
        near, far, width = _known(depth_m), _known(behind_m), self.aperture_m * self.focal_m / self.pixel_m
        if near is None or far is None:
            return width * (1 / jnp.asarray(depth_m) - 1 / jnp.asarray(behind_m))
        if not 0 < near < far:
            raise ValueError(f"an obstruction must be nearer than what it covers, but got {near} m before {far} m")
        return width * (1 / near - 1 / far)

    def prepared(self, shape: Window, border: Border = "reflect") -> "Prepared":
        """The same optics with the PSFs' transforms, for many scenes of one shape.

        Args:
            shape: pixels (y, x) of the scenes; with their own margin and the radiometric model, less the margin that
                the shadow discs take.
            border: what lies beyond a scene.
        """
        return Prepared(self, plan_otf(self.psf.swapaxes(0, 1), shape, border))


def _known(depth_m: Depth) -> float | None:
    """A depth as a number; None while it is traced."""
    try:
        return float(depth_m)
    except jax.errors.ConcretizationTypeError:
        return None


class Prepared(eqx.Module):
    """Optics with the transforms of their PSFs; `Optics.prepared` makes one.

    Attributes:
        optics: what they were made from.
        otf: `[c, layer, fx, fy]` transforms.
    """

    optics: Optics
    otf: Otf


def psf_at(bank: PsfBank, depth_m: float) -> Float[np.ndarray, "c y x"]:
    """PSFs of every colour at a depth, mixed linearly in 1/z from the two nearest of a bank.

    Raises:
        InputError: a depth beyond the bank's.
    """
    order = np.argsort([1 / depth for depth in bank.depths_m])
    curvatures = np.array([1 / bank.depths_m[d] for d in order])
    # The slack lets a depth through that was rounded on its way; it is far below any change of a PSF.
    wanted, slack = 1 / depth_m, 1e-6 * curvatures[-1]
    if not curvatures[0] - slack <= wanted <= curvatures[-1] + slack:
        depths = sorted(bank.depths_m)
        rule = f"must lie within the depths of the PSF bank, {depths[0]:g} to {depths[-1]:g} m"
        raise InputError("depth", rule, f"{depth_m:g} m", "Compute the bank for this depth too.")
    place = float(np.interp(wanted, curvatures, np.arange(len(order))))
    low = min(int(place), len(order) - 1)
    share = np.float32(place - low)
    lower = bank.energy[:, order[low]]
    return lower if share == 0 else (1 - share) * lower + share * bank.energy[:, order[low + 1]]


class Layers(eqx.Module):
    """A scene in one colour.

    Attributes:
        background: `[y, x]` light.
        masks: `[y, x]` of every obstruction, from the farthest to the nearest.
        radiances: `[y, x]` likewise.
    """

    background: Light
    masks: tuple[Light, ...]
    radiances: tuple[Light, ...]


@runtime_checkable
class Imaging(Protocol):
    """How light of one colour gets onto the sensor; the models need no more of a camera."""

    def one(self, layer: int, light: Light, unit: bool) -> Light:
        """Light `[y, x]` of one layer through its PSF; `unit` scales that to unit sum."""
        ...

    def total(self, lights: Sequence[Light]) -> Light:
        """Light `[y, x]` of every layer through its PSF, added up."""
        ...


def radiometric(layers: Layers, kept: Sequence[Light], imaging: Imaging) -> Light:
    """Light on the sensor by the model `radiometric`.

    Args:
        layers: the scene in one colour.
        kept: for every obstruction, the share `[behind, y, x]` of its light that each layer behind it keeps, perhaps
            without a margin of the scene.
        imaging: the camera.
    """
    lights = [layers.background, *(m * light for m, light in zip(layers.masks, layers.radiances, strict=True))]
    lights = [_cut(light, kept[0].shape) if kept else light for light in lights]
    for shares in kept:
        for behind, share in enumerate(shares):
            lights[behind] = share * lights[behind]
    return imaging.total(lights)


def eq_10(layers: Layers, imaging: Imaging, release: bool, outside: Outside) -> Light:
    """Light on the sensor by the model `paper`, or `paper_release`."""
    image, sharp = imaging.one(0, layers.background, unit=release), layers.background
    for layer, (mask, radiance) in enumerate(zip(layers.masks, layers.radiances, strict=True), start=1):
        alpha = imaging.one(layer, mask, unit=True)
        if release:
            alpha = (_RELEASE_GAIN * alpha).clip(0.0, 1.0)
        covered = mask * radiance
        sharp = covered + (1 - mask) * sharp
        landed = imaging.one(layer, sharp if outside == "scene" else covered, unit=release)
        image = alpha * landed + (1 - alpha) * image
    return image


def compose(layers: Layers, kept: Sequence[Light], imaging: Imaging, model: Model, outside: Outside) -> Light:
    """Light on the sensor by the model of that name; see `radiometric` and `eq_10`."""
    if model == "radiometric":
        return radiometric(layers, kept, imaging)
    return eq_10(layers, imaging, model == "paper_release", outside)


def capture(
    scene: Scene,
    optics: Optics | Prepared,
    model: Model,
    *,
    border: Border = "reflect",
    outside: Outside = "scene",
) -> Float[Array, "c v u"]:
    """Light on the sensor, relative to a white scene through a lossless lens of the same aperture; no noise.

    Compiled once per shape, model and window of the shadow discs, whatever the depths.

    Args:
        scene: background and obstructions, linear light.
        optics: PSFs of every layer of the scene.
        model: how layers are put together; see above.
        border: what lies beyond the scene (`sim.convolve`). With `own` the capture is smaller than the scene, by the
            PSF's window and, for `radiometric`, that of the shadow discs (`shadow_px`).
        outside: what I_obs holds where there is no obstruction; without influence on `radiometric`.

    Returns:
        `[c, y, x]`, differentiable in PSFs and images. Where nothing lands, rounding of the transforms may leave
        values of about -1e-7 of the brightest.

    Raises:
        ValueError: PSFs of another number of layers or colours, layers of another shape, an obstruction that is not
            before the background, or an unknown name.
    """
    check_names(model, outside)
    plain = optics.optics if isinstance(optics, Prepared) else optics
    check_layers(scene, *plain.psf.shape[:2])
    window = shadow_px(scene, plain) if model == "radiometric" else 1
    y, x = scene.background.shape[1:]
    lit = (y - window + 1, x - window + 1) if border == "own" else (y, x)
    if isinstance(optics, Prepared) and (optics.otf.shape, optics.otf.border) != (lit, border):
        wanted, got = f"{lit} and {border!r}", f"{optics.otf.shape} and {optics.otf.border!r}"
        raise ValueError(f"`optics` must be prepared for the shape and border {wanted}, but got {got}")
    discs = shadow_discs(scene, plain, window) if model == "radiometric" else ()
    kernels = optics.otf if isinstance(optics, Prepared) else jnp.swapaxes(jnp.asarray(plain.psf), 0, 1)
    layers = Layers(
        scene.background, tuple(o.mask for o in scene.obstructions), tuple(o.radiance for o in scene.obstructions)
    )
    return _formed(layers, discs, kernels, model, outside, lit, border)


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
    """`capture` in arrays.

    One colour after the other: the arrays between its transforms then stay below the 32 MB from which the C library
    takes fresh memory from the system at every call, which costs as much as the transforms.
    """
    shape = (layers.background.shape[1], layers.background.shape[2])
    kept = [
        1 - convolve(mask[None], plan_otf(disc, shape, border))
        for mask, disc in zip(layers.masks, discs, strict=bool(discs))
    ]

    def colour(given: tuple[Array, tuple[Array, ...], Array]) -> Array:
        background, radiances, kernel = given
        otf = (
            eqx.tree_at(lambda o: o.transfer, kernels, kernel)
            if isinstance(kernels, Otf)
            else plan_otf(kernel, lit, border)
        )
        return jnp.asarray(compose(Layers(background, layers.masks, radiances), kept, _Patch(otf), model, outside))

    light = jax.tree.map(jnp.asarray, (layers.background, layers.radiances))
    return jax.lax.map(colour, (*light, kernels.transfer if isinstance(kernels, Otf) else kernels))


def check_names(model: str, outside: str) -> None:
    """Check the names of a model and of a filling.

    Raises:
        ValueError: an unknown one.
    """
    for name, value, known in (("model", model, get_args(Model)), ("outside", outside, get_args(Outside))):
        if value not in known:
            raise ValueError(f"`{name}` must be one of {', '.join(known)}, but got {value!r}")


def check_layers(scene: Scene, layers: int, colours: int) -> None:
    """Check that PSFs and layers match.

    Raises:
        ValueError: they do not.
    """
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

    Raises:
        ValueError: depths are traced and `Optics.shadow_px` is not given.
    """
    if optics.shadow_px is not None:
        return optics.shadow_px
    depths = [scene.background_depth_m, *(near.depth_m for near in scene.obstructions)]
    if any(_known(depth) is None for depth in depths):
        raise ValueError("`Optics.shadow_px` must be given where depths are traced, but got None")
    widths = [optics.disc_px(near, behind) for k, near in enumerate(depths) for behind in depths[:k]]
    largest = max((disc_window(float(width)) for width in widths), default=1)
    return 16 * ((largest + 14) // 16) + 1


def shadow_discs(scene: Scene, optics: Optics, window: int) -> tuple[Array, ...]:
    """For every obstruction, the shadow disc `[behind, y, x]` of points of each layer behind it."""
    depths = [scene.background_depth_m, *(near.depth_m for near in scene.obstructions)]
    return tuple(
        jnp.stack([jnp.asarray(shadow_disc(optics.disc_px(near.depth_m, behind), window)) for behind in depths[:count]])
        for count, near in enumerate(scene.obstructions, start=1)
    )


def _cut(light: Light, shape: tuple[int, ...]) -> Light:
    """The middle of a layer in the shape (y, x) that ends `shape`."""
    y, x = ((n - m) // 2 for n, m in zip(light.shape, shape[-2:], strict=True))
    return light[y : y + shape[-2], x : x + shape[-1]]


class _Patch(eqx.Module):
    """`Imaging` by one set of PSFs, with one transform per image.

    Attributes:
        otf: `[layer, fx, fy]` transforms of the PSFs of one colour.
    """

    otf: Otf

    def one(self, layer: int, light: Light, unit: bool) -> Array:
        otf = eqx.tree_at(lambda o: o.transfer, self.otf, self.otf.transfer[layer])
        landed = convolve(light, otf)
        return landed / otf.energy if unit else landed

    def total(self, lights: Sequence[Light]) -> Array:
        return superpose(lights, self.otf)
