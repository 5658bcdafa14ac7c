"""What a design is judged by: small functions from PSFs to one number that is minimised.

An objective takes a `PsfSet` and its options and returns a scalar. A user's own is named `module:function` in the
spec and has the same signature:

    def dark_centre(view: View, *, power: float = 1.0) -> Array:
        return jnp.mean(jnp.sum(view.near, axis=(-2, -1))) ** power

Energies are per unit power incident on the clear aperture, so light that is lost anywhere counts as lost.
"""

import importlib
import inspect
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.design.patterns import target_pattern_image
from doedesign.spec import Spec
from fab.errors import InputError
from sim.camera import Camera
from sim.metrics import disc_weights, mean_wavelength_m, participation, spot_radius_m


class PsfSet(eqx.Module):
    """What an objective sees in one step.

    Attributes:
        near: `[w, n, y, x]` PSFs of obstruction depths (none if the scene has none).
        far: `[w, f, y, x]` PSFs of scene depths.
        lens_participation: `[w, n]` sum of squared pixel energies of the plain lens at the same near depths.
        camera: optics and sensor.
    """

    near: Float[Array, "w n y x"]
    far: Float[Array, "w f y x"]
    lens_participation: Float[Array, "w n"]
    camera: Camera = eqx.field(static=True)


Objective = Callable[[PsfSet], Array]


class Term(NamedTuple):
    """One weighted objective; the loss is the sum of weight times value."""

    name: str
    weight: float
    value: Objective


def spot_weights(camera: Camera) -> Float[np.ndarray, "w y x"]:
    """For every colour, the share of each pixel inside the far spot (`sim.metrics.spot_radius_m`)."""
    shape = (camera.window, camera.window)
    return np.stack(
        [disc_weights(shape, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(c))) for c in camera.colours]
    )


def far_spot(view: PsfSet) -> Array:
    """Share of the scene's light that misses the sharp spot, 0-1, averaged over colours and far depths."""
    inside = jnp.einsum("wfyx,wyx->wf", view.far, spot_weights(view.camera))
    return 1.0 - jnp.mean(inside)


def near_spread(view: PsfSet) -> Array:
    """Concentration of near PSFs relative to the plain lens: sum p² / sum p_lens², 1 for no effect.

    The coherent part of the light cannot tell depths apart, so a design with far-spot energy s keeps at least s² of
    it (design.md §4): with weights 1 for `far_spot` and w for this term the ideal plate has s = 1 / (2w).
    """
    return jnp.mean(participation(view.near) / view.lens_participation)


def window_loss(view: PsfSet) -> Array:
    """Share of the light that misses the sensor window, 0-1, averaged over colours and depths.

    Without it `near_spread` and `far_spot` agree on sending unwanted light to angles beyond the window, where it
    becomes stray light on the rest of the sensor.
    """
    images = jnp.concatenate([view.near, view.far], axis=1)
    return 1.0 - jnp.mean(jnp.sum(images, axis=(-2, -1)))


def handcrafted(view: PsfSet, *, near_weight: float = 1.0) -> Array:
    """The paper's hand-crafted variant (§4): far PSF towards a point, near PSF towards an even window.

    Squared distances, each relative to its target's: |p_far - delta|² where delta is all light in the far spot,
    and |p_near - u|² / |u|² where u spreads all light evenly over the window.
    """
    if not isinstance(near_weight, int | float):
        raise InputError("handcrafted: near_weight", "must be a number", repr(near_weight), "For example 1.0.")
    spots = spot_weights(view.camera)
    even = 1.0 / view.camera.window**2
    delta = spots / spots.sum(axis=(1, 2), keepdims=True)
    far = jnp.sum((view.far - delta[:, None]) ** 2, axis=(-2, -1)) / np.sum(delta**2, axis=(1, 2))[:, None]
    near = jnp.sum((view.near - even) ** 2, axis=(-2, -1)) / (even**2 * view.camera.window**2)
    return jnp.mean(far) + near_weight * jnp.mean(jnp.log1p(near))


def target_pattern(view: PsfSet, *, target: Float[np.ndarray, "y x"]) -> Array:
    """Squared distance of every far PSF from a target that holds all light, relative to the target's own square."""
    return jnp.mean(jnp.sum((view.far - target) ** 2, axis=(-2, -1))) / float(np.sum(target**2))


_BUILT_IN: dict[str, Callable[..., Array]] = {
    "far_spot": far_spot,
    "near_spread": near_spread,
    "window_loss": window_loss,
    "handcrafted": handcrafted,
    "target_pattern": target_pattern,
}


def _imported(name: str, where: str) -> Callable[..., Array]:
    """A user's objective from "module:function"."""
    module_name, function_name = name.split(":")
    try:
        function = getattr(importlib.import_module(module_name), function_name)
    except (ImportError, AttributeError) as error:
        raise InputError(
            where,
            "a user's objective must be an importable module:function",
            f'"{name}" ({error})',
            "Put the module on PYTHONPATH and check both names.",
        ) from error
    if not callable(function):
        raise InputError(where, "a user's objective must be a function", f'"{name}"', "Name a function.")
    return cast("Callable[..., Array]", function)


def terms_of(spec: Spec, camera: Camera, files: Mapping[str, Path]) -> tuple[Term, ...]:
    """The spec's objectives, with options bound and images read.

    Args:
        spec: the spec.
        camera: its camera.
        files: input files of the spec by dotted key (`doedesign.spec.input_files`).

    Raises:
        InputError: a function that cannot be imported, an option it does not take, or an image that cannot be read.
    """
    terms = []
    for i, objective in enumerate(spec.objectives):
        where = f"objective[{i}] {objective.name}"
        options: dict[str, Any] = dict(objective.options)
        if objective.name == "target_pattern":
            options = {
                "target": target_pattern_image(camera, options, files.get(f"objective[{i}].options.image"), where)
            }
        function = _BUILT_IN[objective.name] if objective.name in _BUILT_IN else _imported(objective.name, where)
        bound = partial(function, **options)
        _require_options(bound, where)
        terms.append(Term(objective.name, objective.weight, bound))
    return tuple(terms)


def _require_options(function: partial[Array], where: str) -> None:
    """Check before a long run that the function takes one view and the given options."""
    try:
        inspect.signature(function.func).bind(None, **function.keywords)
    except TypeError as error:
        raise InputError(
            f"{where}: options",
            f"must be options of {function.func.__name__}{inspect.signature(function.func)}",
            str(error).removeprefix("got "),
            "Correct or remove the option.",
        ) from error
