"""Objectives: small functions from PSFs to one number that is minimised.

An objective takes a `PsfSet` and its options and returns a scalar. A built-in one is listed, under its name, in
`doedesign.spec.values.OBJECTIVES`; a user's own is named `module:function` in the spec and has the same signature. A
spec alone never runs code: the function is given to `doedesign.optimize`, or imported by `import_objectives`.

    def dark_centre(psfs: PsfSet, *, power: float = 1.0) -> Array:
        return jnp.mean(jnp.sum(psfs.near, axis=(-2, -1))) ** power

Energies are per unit power incident on the clear aperture, so light that is lost anywhere counts as lost. A term of a
spec may look at some colours and depths only, and at the worst of them instead of their mean (`PsfSet.lowest`).
"""

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.design.patterns import target_image
from doedesign.spec import Spec
from doedesign.spec.models import ObjectiveSpec
from doedesign.spec.values import OBJECTIVES
from fab.errors import InputError
from fab.files import sha256_file
from fab.units import require_kind
from sim.aperture import open_shares
from sim.camera import Camera
from sim.imaging.filtering import filter_errors, photograph_spectrum, transfers
from sim.metrics import disc_radius_m, disc_weights, mean_wavelength_m, participation, spot_radius_m

Objective = Callable[..., Array]
"""Function of a `PsfSet` and options to a number that is minimised."""


class PsfSet(eqx.Module):
    """PSFs of one step, as objectives take them.

    Attributes:
        near: `[w, n, y, x]` PSFs of obstruction depths (none if the scene has none).
        far: `[w, f, y, x]` PSFs of scene depths.
        lens_participation: `[w, n]` sum of squared pixel energies of the plain lens at the same near depths.
        disc_radius_m: `[n]` radius of the blur disc at these depths, metres (`sim.metrics.disc_radius_m`).
        camera: optics and sensor.
        worst: whether the worst colour and depth counts, in place of their mean.
    """

    near: Float[Array, "w n y x"]
    far: Float[Array, "w f y x"]
    lens_participation: Float[Array, "w n"]
    disc_radius_m: Float[Array, " n"]
    camera: Camera = eqx.field(static=True)
    worst: bool = eqx.field(static=True, default=False)

    def lowest(self, values: Float[Array, "*s"]) -> Array:
        """Mean of what should be large, by colour and depth; the lowest of it where the worst counts."""
        return jnp.min(values) if self.worst else jnp.mean(values)

    def highest(self, values: Float[Array, "*s"]) -> Array:
        """Mean of what should be small, by colour and depth; the highest of it where the worst counts."""
        return jnp.max(values) if self.worst else jnp.mean(values)


class Cases(NamedTuple):
    """Colours and depths that a term looks at, as positions in a `PsfSet`; None for all. `worst` as there."""

    colours: tuple[int, ...] | None = None
    near: tuple[int, ...] | None = None
    far: tuple[int, ...] | None = None
    worst: bool = False

    @classmethod
    def of(cls, objective: ObjectiveSpec, spec: Spec) -> "Cases":
        """Cases of an objective of a spec."""
        names, depths_m = [colour.name for colour in spec.optics.colours], objective.depths_m
        colours = tuple(map(names.index, objective.colours)) or None
        sides = (spec.scene.near_m, spec.scene.far_m)
        near, far = (tuple(i for i, d in enumerate(side) if d in depths_m) if depths_m else None for side in sides)
        return cls(colours, near, far, objective.over == "worst")

    def camera(self, camera: Camera) -> Camera:
        """A camera with these colours only."""
        chosen = self.colours
        return camera if chosen is None else replace(camera, colours=tuple(camera.colours[i] for i in chosen))

    def among(self, psfs: PsfSet) -> PsfSet:
        """The PSFs of these cases."""
        if self == Cases():
            return psfs
        every = psfs.near.shape[0], psfs.near.shape[1], psfs.far.shape[1]
        c, n, f = (
            np.arange(count) if some is None else np.array(some, int)
            for some, count in zip(self[:3], every, strict=True)
        )
        near, far, lens = psfs.near[c][:, n], psfs.far[c][:, f], psfs.lens_participation[c][:, n]
        return PsfSet(near, far, lens, psfs.disc_radius_m[n], self.camera(psfs.camera), self.worst)


class Term(NamedTuple):
    """Weighted objective with its options; the loss is the sum of weight times value."""

    name: str
    weight: float
    function: partial[Array]
    cases: Cases = Cases()

    def value(self, psfs: PsfSet) -> Array:
        """Value for the PSFs of all colours and depths of a step.

        Args:
            psfs: the PSFs.

        Raises:
            InputError: an objective of the user's own that returns something else than one real number.
        """
        value = self.function(self.cases.among(psfs))
        number = isinstance(value, jax.Array | np.ndarray | np.generic | int | float)
        if not number or jnp.shape(value) or not jnp.isrealobj(value):
            got = f"{jnp.result_type(value)} of shape {jnp.shape(value)}" if number else type(value).__name__
            cure = "Return a scalar, such as jnp.mean(...) of what it is now."
            raise InputError(f"objective {self.name}", "must return one real number", got, cure)
        return value

    @property
    def target(self) -> Float[np.ndarray, "y x"] | None:
        """Target image of a `target_pattern`: energy per pixel, summing to 1."""
        return self.function.keywords["target"] if self.name == "target_pattern" else None


def disc_radii_m(camera: Camera, near_m: Sequence[float]) -> Float[np.ndarray, " n"]:
    """Radii of the blur discs of near depths, metres, as a `PsfSet` has them."""
    return np.array([disc_radius_m(camera, depth_m) for depth_m in near_m], np.float32)


def spot_weights(camera: Camera) -> Float[np.ndarray, "w y x"]:
    """Share of each pixel inside the far spot of every colour (`sim.metrics.spot_radius_m`)."""
    shape = (camera.window, camera.window)
    return np.stack(
        [disc_weights(shape, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(c))) for c in camera.colours]
    )


def far_spot(psfs: PsfSet) -> Array:
    """Share of the scene's light that misses the sharp spot, 0-1, over colours and far depths."""
    return 1.0 - psfs.lowest(_spots(psfs))


def spot_energy(psfs: PsfSet, *, energy: float) -> Array:
    """Squared distance of the far spot of every colour and depth from a stated `energy`, 0-1.

    A weight w leaves it off by the slope of the other terms with respect to it, over 2w.
    """
    return psfs.highest((_spots(psfs) - _share("spot_energy", "energy", energy)) ** 2)


def equal_colours(psfs: PsfSet) -> Array:
    """Variance of the far spot over the colours, over its squared mean, at every far depth: 0 if all are equal."""
    spots = _spots(psfs)
    return psfs.highest(jnp.var(spots, axis=0) / jnp.mean(spots, axis=0) ** 2)


def near_spread(psfs: PsfSet) -> Array:
    """Concentration of near PSFs relative to the plain lens: sum p² / sum p_lens², 1 for no effect.

    The coherent part of the light cannot tell depths apart, so a design with far-spot energy s keeps at least
    s² + (1 - s)² a of it, a being the part of the window that the lens's disc covers
    (`sim.metrics.MetricInputs.concentration_bound`): with weights 1 for `far_spot` and w for this term the ideal DOE
    has s = (1 / (2w) + a) / (1 + a).
    """
    return psfs.highest(participation(psfs.near) / psfs.lens_participation)


def ring_to_disc(psfs: PsfSet, *, least: float) -> Array:
    """Squared lack of the ring:disc ratio below `least`, over colours and near depths: a constraint.

    The disc is where the plain lens blurs the light of that depth to, the ring is the rest of the window
    (`sim.metrics.ring_to_disc`). It is zero for a design that holds it; with a large weight the other terms decide all
    else.

    Raises:
        InputError: a ratio that is not positive.
    """
    if not isinstance(least, int | float) or isinstance(least, bool) or not least > 0:
        raise InputError("ring_to_disc: least", "must be a ratio above 0", repr(least), "For example 1.5.")
    count = psfs.near.shape[-1]
    places = jnp.arange(count) - (count - 1) / 2  # of an even count the axis lies between pixels
    inside = jax.vmap(partial(open_shares, places, places))(psfs.disc_radius_m / psfs.camera.pixel_m)
    disc = jnp.einsum("wnyx,nyx->wn", psfs.near, inside)
    ring = jnp.sum(psfs.near, axis=(-2, -1)) - disc
    return psfs.highest(jnp.maximum(least - ring / disc, 0.0) ** 2)


def window_loss(psfs: PsfSet) -> Array:
    """Share of the light that misses the sensor window, 0-1, over colours and depths.

    Without it `near_spread` and `far_spot` agree on sending unwanted light to angles beyond the window, where it
    becomes stray light on the rest of the sensor.
    """
    return 1.0 - psfs.lowest(_in_window(psfs))


def window_share(psfs: PsfSet, *, least: float) -> Array:
    """Squared lack of light in the sensor window below `least`, 0-1, over colours and depths: a constraint.

    It is zero, and costs nothing, for a design that holds it; with a large weight the other terms decide all else.
    """
    return psfs.highest(jnp.maximum(_share("window_share", "least", least) - _in_window(psfs), 0.0) ** 2)


def handcrafted(psfs: PsfSet, *, near_weight: float = 1.0) -> Array:
    """The paper's hand-crafted variant (§4): far PSF towards a point, near PSF towards an even window.

    Squared distances, each relative to its target's: |p_far - delta|² / |delta|² where delta is all light in the far
    spot, and log(1 + |p_near - u|² / |u|²) where u spreads all light evenly over the window.

    Args:
        psfs: PSFs of a step.
        near_weight: weight of the near PSF.

    Raises:
        InputError: a weight that is no number.
    """
    if not isinstance(near_weight, int | float) or isinstance(near_weight, bool):
        raise InputError("handcrafted: near_weight", "must be a number", repr(near_weight), "For example 1.0.")
    spots = spot_weights(psfs.camera)
    even = 1.0 / psfs.camera.window**2
    delta = spots / spots.sum(axis=(1, 2), keepdims=True)
    far = jnp.sum((psfs.far - delta[:, None]) ** 2, axis=(-2, -1)) / np.sum(delta**2, axis=(1, 2))[:, None]
    near = jnp.sum((psfs.near - even) ** 2, axis=(-2, -1)) / (even**2 * psfs.camera.window**2)
    return psfs.highest(far) + near_weight * psfs.highest(jnp.log1p(near))


def target_pattern(psfs: PsfSet, *, target: Float[np.ndarray, "y x"]) -> Array:
    """Squared distance of every far PSF from a target that holds all light, relative to the target's own square."""
    return psfs.highest(jnp.sum((psfs.far - target) ** 2, axis=(-2, -1))) / float(np.sum(target**2))


def filtered_error(psfs: PsfSet, *, noise: float = 0.01, contrast: float = 0.25, known: bool = False) -> Array:
    """Mean squared error of the picture after the best linear filter, as a share of the scene's variance, 0-1.

    One filter serves all far depths (`sim.imaging.filtering`), as a network does that is not told the depth: PSFs that
    are alike count, not sharp ones. Light that leaves the window is lost.

    Args:
        psfs: PSFs of a step.
        noise: standard deviation of a pixel's noise, white being 1.
        contrast: standard deviation of the scene's light, white being 1.
        known: whether every depth has a filter of its own.

    Raises:
        InputError: a number that is not positive, or a `known` that is neither true nor false.
    """
    if not isinstance(known, bool):
        raise InputError("filtered_error: known", "must be true or false", repr(known), "For example known = true.")
    for name, value in (("noise", noise), ("contrast", contrast)):
        if not isinstance(value, int | float) or isinstance(value, bool) or not value > 0:
            raise InputError(f"filtered_error: {name}", "must be above 0, white being 1", repr(value), "Try 0.01.")
    side = psfs.far.shape[-1]
    signal = photograph_spectrum(side, float(contrast) ** 2)
    return psfs.highest(filter_errors(transfers(psfs.far), signal, float(noise) ** 2 / side**2, known))


def _spots(psfs: PsfSet) -> Float[Array, "w f"]:
    """Light in the far spot of every colour and far depth."""
    return jnp.einsum("wfyx,wyx->wf", psfs.far, spot_weights(psfs.camera))


def _in_window(psfs: PsfSet) -> Float[Array, "w d"]:
    """Light in the window, of every colour and depth."""
    return jnp.sum(jnp.concatenate([psfs.near, psfs.far], axis=1), axis=(-2, -1))


def _share(objective: str, option: str, value: object) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value <= 1:
        rule, cure = "must be a share of the light from 0 to 1", "For example 0.3."
        raise InputError(f"{objective}: {option}", rule, repr(value), cure)
    return float(value)


BUILT_IN: dict[str, Objective] = {name: globals()[name] for name in OBJECTIVES}


def terms_from_spec(
    spec: Spec, camera: Camera, files: Mapping[str, Path], functions: Mapping[str, Objective] | None = None
) -> tuple[Term, ...]:
    """Return a spec's objectives, with options bound.

    Args:
        spec: the spec.
        camera: optics and sensor.
        files: images, by key (`doedesign.spec.input_files`).
        functions: objectives of the user's own, by the names that the spec gives them.

    Raises:
        InputError: an objective of the user's own that is not given, or options that are not the function's.
    """
    known, terms = {**(functions or {}), **BUILT_IN}, []
    for i, objective in enumerate(spec.objectives):
        where = f"objective[{i}] {objective.name}"
        options: dict[str, Any] = dict(objective.options)
        cases = Cases.of(objective, spec)
        if objective.name == "target_pattern":
            image = files.get(f"objective[{i}].options.image")
            options = {"target": target_image(cases.camera(camera), options, image, where)}
        if objective.name not in known:
            rule, cure = "a spec runs no code by itself", "Give the function by `objectives`, if you trust it."
            raise InputError(where, rule, "a function of the user's own", cure)
        function = known[objective.name]
        _require_options(function, options, where)
        terms.append(Term(objective.name, objective.weight, partial(function, **options), cases))
    return tuple(terms)


def import_objectives(spec: Spec) -> dict[str, Objective]:
    """Import the objectives of the user's own that a spec names `module:function`: this runs code that it names.

    Raises:
        InputError: no spec, no such module or function, or a module that fails when it is imported.
    """
    require_kind("spec", spec, Spec, 'Read it by dd.load_spec("spec.toml").')
    named = {f"objective[{i}]": one.name for i, one in enumerate(spec.objectives) if one.name not in BUILT_IN}
    return {name: _imported(name, where) for where, name in named.items()}


def source_digests(spec: Spec, functions: Mapping[str, Objective]) -> dict[str, str]:
    """SHA-256 of the files in which a spec's objectives of the user's own are written, by key of the spec.

    Raises:
        InputError: a function that is in no file.
    """
    digests = {}
    for i, objective in enumerate(spec.objectives):
        if objective.name in functions and objective.name not in BUILT_IN:
            try:
                file = Path(inspect.getsourcefile(functions[objective.name]) or "")
            except TypeError:
                file = Path()
            if not file.is_file():
                rule, cure = "must be in a file, which a run records", "Write it into a module of its own."
                raise InputError(f"objectives: {objective.name}", rule, "none", cure)
            digests[f"objective[{i}].name"] = sha256_file(file)
    return digests


def _imported(name: str, where: str) -> Objective:
    module_name, function_name = name.split(":")
    try:
        function = getattr(importlib.import_module(module_name), function_name)
    except (ImportError, AttributeError) as error:
        rule = "a user's objective must be an importable module:function"
        cure = "Put the module on PYTHONPATH and check both names."
        raise InputError(where, rule, f'"{name}" ({error})', cure) from error
    except Exception as error:  # whatever the user's code raises
        rule, got = "the module of a user's objective must run", f'"{name}" ({type(error).__name__}: {error})'
        raise InputError(where, rule, got, f"Correct {module_name}.") from error
    if not callable(function):
        raise InputError(where, "a user's objective must be a function", f'"{name}"', "Name a function.")
    return cast("Objective", function)


def _require_options(function: Objective, options: Mapping[str, Any], where: str) -> None:
    """Check before a long run that the function takes one `PsfSet` and the given options."""
    try:
        signature = inspect.signature(function)
    except ValueError as error:  # some that are not written in Python
        rule, cure = "must be a function that tells its arguments", "Call it in a function of your own."
        raise InputError(where, rule, str(error), cure) from error
    try:
        signature.bind(None, **options)
    except TypeError as error:
        known = ", ".join(list(signature.parameters)[1:]) or "it has none"
        rule, got = f"must be options of {function.__name__} ({known})", str(error).removeprefix("got ")
        raise InputError(f"{where}: options", rule, got, "Correct or remove the option.") from error
