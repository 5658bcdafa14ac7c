"""How an obstruction takes light from what is behind it: four models, written for one colour of one scene.

`radiometric` follows the light. The bundle from a point of the background through the aperture cuts an
obstruction's plane in a disc of diameter D · (1 - z_o / z_b), which is D · (1 - z_o / z_b) · f / (z_o · pixel) pixels
wide (eq. 11). The share of the disc that the obstruction covers is the share of the point's light that is lost,
whatever the DOE does; what is left lands by the far PSF, and the obstruction's own light by the near one:

    I = p_near ∗ (M · I_obs) + p_far ∗ ((1 - d ∗ M) · I_far)

With several obstructions every layer loses to each nearer one by that one's own disc, and the passed shares are
multiplied, as if shadows in one bundle were independent: exact where they do not meet, and on average otherwise. The
second approximation is that a partly blocked pupil has the PSF of the open one, only weaker. So a uniform world stays
uniform where p_near = p_far ∗ d, as for a lens alone or a plate of straight lines; with others its *energy* does.

`reciprocal` lets a shadow change the shape of the PSF, as far as both PSFs tell how. In even light the picture is known
exactly, by reciprocity: what a dark bar takes is what a bright one would send, p_near ∗ M. Every part of the
obstruction stands before a disc of the background, d ∗ I_far in the mean, so that it takes T = M · (d ∗ I_far), and

    I = p_far ∗ I_far + p_near ∗ (M · I_obs - T) + p_common ∗ (d ∗ T - (d ∗ M) · I_far),

where p_common is the part of p_far that every part of the aperture sends alike (`sim.imaging.common`): all of it for a
lens, a straight grating or a diffuser, for which the model is `radiometric` again. As much light is lost as there; a
uniform world stays uniform for every plate, and hidden points leave next to nothing. T lands scaled to the energy of
p_far in its window, so that an even light behind a cover is gone. Light may fall slightly below zero.

`paper` is eq. 10 as printed, with α = p_obs ∗ M for every colour:

    I = α ⊙ (p_obs ∗ I_obs) + (1 - α) ⊙ (p_far ∗ I_far)

α is a share and is divided by the energy of p_obs in its window; the light itself keeps the PSFs' energies. Eq. 10
passes light that never reaches the aperture: with the paper's plate half the light of points that are completely
hidden. In even light it is exact, too.

`paper_release` is what the public code does: every PSF scaled to unit sum, α = clamp(1.5 · p_obs ∗ M, 0, 1).

Under both, `outside` says what I_obs holds where there is no obstruction, which eq. 10 leaves open: the scene behind
(the public code for dirt and fences) or nothing (for raindrops). Several obstructions are laid over each other from the
farthest to the nearest. Say which model was used wherever a result is shown; none is a default.

examples/occlusion_table.py judges them by wave optics, for six kinds of plates and four obstructions, and
examples/compare_occlusion.py for the plate of a run. What none of them knows is the changed interference of a partly
shaded aperture, whose spots are wider: it matters for single bright points.
"""

from collections.abc import Callable, Sequence
from typing import Literal, Protocol, get_args, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Array

Model = Literal["paper", "paper_release", "radiometric", "reciprocal"]
Outside = Literal["scene", "nothing"]
Light = Array | np.ndarray

_RELEASE_GAIN = 1.5  # of alpha, in the public code


class Layers(eqx.Module):
    """A scene in one colour, `[y, x]` each; obstructions from the farthest to the nearest."""

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

    For every obstruction, `kept` is the share `[behind, y, x]` of its light that each layer behind it keeps, perhaps
    without a margin of the scene.
    """
    lights = [layers.background, *(m * light for m, light in zip(layers.masks, layers.radiances, strict=True))]
    lights = [_cut(light, kept[0].shape) if kept else light for light in lights]
    for shares in kept:
        for behind, share in enumerate(shares):
            lights[behind] = share * lights[behind]
    return imaging.total(lights)


def reciprocal(layers: Layers, kept: Sequence[Light], shaded: Callable[[int, Light], Light], imaging: Imaging) -> Light:
    """Light on the sensor by the model `reciprocal`; `imaging` has the layers of `sim.imaging.common.with_common`.

    Among each other obstructions take light as in `radiometric`; what several of them take from the background is
    counted once, for the farthest. `shaded` blurs the background's light by the shadow disc of the obstruction of that
    number.
    """
    taken, opened = [], 1.0
    for number, mask in enumerate(layers.masks):
        behind = shaded(number, layers.background)
        taken.append(_cut(mask * opened, behind.shape) * behind)
        opened = opened * (1 - mask)
    back = [shaded(number, light) for number, light in enumerate(taken)]

    def cut(light: Light) -> Light:
        return _cut(light, back[0].shape) if back else light

    background, passed = cut(layers.background), 1.0
    own, moved = [], []
    for number, (mask, radiance) in enumerate(zip(layers.masks, layers.radiances, strict=True)):
        light = cut(mask * radiance)
        for nearer in kept[number + 1 :]:
            light = cut(nearer[number + 1]) * light
        own.append(light)
        left = passed * cut(kept[number][0])
        moved.append(back[number] + (left - passed) * background)
        passed = left
    return imaging.total([background, *own, *moved, *(-cut(light) for light in taken)])


def eq_10(layers: Layers, imaging: Imaging, release: bool, outside: Outside) -> Light:
    """Light on the sensor by the model `paper`, or `paper_release`."""
    image, sharp = imaging.one(0, layers.background, unit=release), layers.background
    for layer, (mask, radiance) in enumerate(zip(layers.masks, layers.radiances, strict=True), start=1):
        alpha = eq_10_alpha(mask, layer, imaging, release)
        covered = mask * radiance
        sharp = covered + (1 - mask) * sharp
        landed = imaging.one(layer, sharp if outside == "scene" else covered, unit=release)
        image = alpha * landed + (1 - alpha) * image
    return image


def eq_10_alpha(mask: Light, layer: int, imaging: Imaging, release: bool) -> Light:
    """Share of the light behind an obstruction that eq. 10 takes away, `[y, x]`; that of the public code is clamped."""
    alpha = imaging.one(layer, mask, unit=True)
    return (_RELEASE_GAIN * alpha).clip(0.0, 1.0) if release else alpha


def compose(
    layers: Layers,
    kept: Sequence[Light],
    shaded: Callable[[int, Light], Light],
    imaging: Imaging,
    model: Model,
    outside: Outside,
) -> Light:
    """Light on the sensor by the model of that name; see `radiometric`, `reciprocal` and `eq_10`."""
    if model == "radiometric":
        return radiometric(layers, kept, imaging)
    if model == "reciprocal":
        return reciprocal(layers, kept, shaded, imaging)
    return eq_10(layers, imaging, model == "paper_release", outside)


def follows_light(model: Model) -> bool:
    """Whether a model knows shadow discs."""
    return model in ("radiometric", "reciprocal")


def check_names(model: str, outside: str) -> None:
    """Raise a ValueError for an unknown name of a model or of a filling."""
    for name, value, known in (("model", model, get_args(Model)), ("outside", outside, get_args(Outside))):
        if value not in known:
            raise ValueError(f"`{name}` must be one of {', '.join(known)}, but got {value!r}")


def _cut(light: Light, shape: tuple[int, ...]) -> Light:
    """The middle of a layer in the shape (y, x) that ends `shape`."""
    y, x = ((n - m) // 2 for n, m in zip(light.shape, shape[-2:], strict=True))
    return light[y : y + shape[-2], x : x + shape[-1]]
