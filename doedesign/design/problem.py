"""The optimisation problem of a spec: from parameters to the loss of one step, ready to differentiate."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, partial, reduce
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design.levels.parametrize import LevelParametrization
from doedesign.design.objectives import Objective, PsfSet, Term, disc_radii_m, terms_from_spec
from doedesign.runtime.compiling import compiled_step
from doedesign.spec import Spec
from fab.errors import InputError
from fab.levels import Levels
from sim.camera import Camera, SpectralLine
from sim.metrics import participation
from sim.optic import HeightOptic, RingOptic
from sim.propagation.farfield import displaced
from sim.propagation.hankel import ring_count
from sim.psf_bank import psf
from sim.rigorous.edge_optic import EdgeOptic, optic_as_drawn
from sim.threads import at_once


class SeenSource(NamedTuple):
    """A source that steps look at.

    Attributes:
        wave: what an optic takes for it.
        plan: operators for its depth; None where those of its line serve all depths (`Problem.plans`).
    """

    wave: Any
    plan: Any = None


class StepSources(NamedTuple):
    """Those of a `SourceSet` that one evaluation of the loss looks at, and where the image lies.

    Attributes:
        near: `[line][depth]` sources at near depths.
        far: `[line][depth]` sources at far depths.
        lens: `[w, n]` participation of the plain lens at the near depths.
        disc_radius_m: `[n]` radius of the plain lens's blur disc at them, metres.
        offset_m: displacement (y, x) of the image on the sensor, or None to leave it on the axis.
        colour: number of the one colour that is looked at, or None for all.
    """

    near: tuple[tuple[SeenSource, ...], ...]
    far: tuple[tuple[SeenSource, ...], ...]
    lens: Float[Array, "w n"]
    disc_radius_m: Float[Array, " n"]
    offset_m: Float[Array, "2"] | None
    colour: int | None = None


class Problem(eqx.Module):
    """All that stays the same from step to step: the objectives, and propagation of every line of the camera.

    The optic is a DOE of cells or rings whose heights are still those of the bare lens.
    """

    parametrization: LevelParametrization = eqx.field(static=True)
    terms: tuple[Term, ...] = eqx.field(static=True)
    plans: tuple[Any, ...]
    optic: HeightOptic | EdgeOptic | RingOptic

    @property
    def camera(self) -> Camera:
        """Optics, sensor, and the grid of the DOE; light of walls may be computed on parts of its cells."""
        return self.optic.drawn if isinstance(self.optic, EdgeOptic) else self.optic.camera


class SourceSet(NamedTuple):
    """Everything a step may look at, as in `StepSources`.

    Attributes:
        near: as in `StepSources`.
        far: as there.
        lens: as there.
        disc_radius_m: as there.
        displacement_m: largest displacement of the image, metres or 0.
        whole: whether every step looks at all depths.
        in_turn: whether a step looks at one colour, the next step at the next.
    """

    near: tuple[tuple[SeenSource, ...], ...]
    far: tuple[tuple[SeenSource, ...], ...]
    lens: Float[np.ndarray, "w n"]
    disc_radius_m: Float[np.ndarray, " n"]
    displacement_m: float
    whole: bool = False
    in_turn: bool = False

    def look(self, seed: int, step: int) -> StepSources:
        """Sources of a step: depths in shuffled rounds, so that each is seen equally often, or all of them.

        They depend on the two numbers alone, so a resumed run repeats them.
        """
        offset = None
        if self.displacement_m > 0:
            shift = np.random.default_rng((seed, 2, step)).uniform(-1.0, 1.0, 2) * self.displacement_m
            offset = jnp.asarray(shift, jnp.float32)
        colour = step % len(self.lens) if self.in_turn else None
        return self._chosen(*self.chosen_depths(seed, step), offset, colour)

    def chosen_depths(self, seed: int, step: int) -> tuple[list[int], list[int]]:
        """Numbers of the near and of the far depths that a step looks at."""

        def pick(count: int, salt: int) -> list[int]:
            if count == 0 or self.whole:
                return list(range(count))
            order = np.random.default_rng((seed, salt, step // count)).permutation(count)
            return [int(order[step % count])]

        return pick(len(self.near[0]), 0), pick(len(self.far[0]), 1)

    def first_look(self) -> StepSources:
        """The first near and far depth, or all of them, with the image on the axis."""
        near, far = (list(range(len(side[0])))[: None if self.whole else 1] for side in (self.near, self.far))
        return self._chosen(near, far, None)

    def _chosen(
        self, near: list[int], far: list[int], offset_m: Array | None, colour: int | None = None
    ) -> StepSources:
        near_sources, far_sources = (
            tuple(tuple(line[i] for i in chosen) for line in sources)
            for sources, chosen in ((self.near, near), (self.far, far))
        )
        lens, disc_radius_m = jnp.asarray(self.lens[:, near]), jnp.asarray(self.disc_radius_m[near])
        return StepSources(near_sources, far_sources, lens, disc_radius_m, offset_m, colour)


def problem_of(
    spec: Spec, files: Mapping[str, Path], functions: Mapping[str, Objective] | None = None
) -> tuple[Problem, SourceSet]:
    """Prepare plans, sources and objectives of a spec; for the arguments see `terms_from_spec`."""
    terms = terms_from_spec(spec, camera_from_spec(spec), files, functions)
    problem = replace(plans_of(spec), terms=terms)
    camera, optic = problem.camera, problem.optic
    exact = _is_transformed(spec) and not _is_sparse(spec)

    def seen(line: SpectralLine, depth_m: float) -> SeenSource:
        wave: Any = optic.source(line, depth_m)
        return SeenSource(wave, optic.plan(line, depth_m) if exact else None)

    near, far = (
        tuple(tuple(seen(line, depth) for depth in depths_m) for line in optic.lines)
        for depths_m in (spec.scene.near_m, spec.scene.far_m)
    )
    lens = np.zeros((len(camera.colours), 0), np.float32)
    if spec.scene.near_m:
        bank = psf(HeightOptic.of(camera), depths=spec.scene.near_m)
        lens = np.asarray(participation(jnp.asarray(bank.energy)))
    disc_radius_m = disc_radii_m(camera, spec.scene.near_m)
    whole = any(objective.compares for objective in spec.objectives)
    in_turn = spec.optimize.colours == "in_turn"
    displacement_m = camera.pixel_m / 2 if _is_sparse(spec) else 0.0
    return problem, SourceSet(near, far, lens, disc_radius_m, displacement_m, whole, in_turn)


def _is_sparse(spec: Spec) -> bool:
    """Whether a step takes one sample of intensity per lambda d / D."""
    return spec.optimize.sampling == "sparse" and _is_transformed(spec)


def _is_transformed(spec: Spec) -> bool:
    """Whether light of cells gets to the sensor by the transform of the far field."""
    far = camera_from_spec(spec).propagation == "far_field" and spec.optics.propagation != "fresnel"
    return spec.optimize.parametrization != "radial" and far


def plans_of(spec: Spec) -> Problem:
    """Prepare plans alone, for those who bring sources and objectives of their own; see `problem_of`."""
    camera, process = camera_from_spec(spec), spec.process
    # Depths that are to be chosen begin at 2^k steps.
    levels = levels_from_spec(process, Levels(process.levels, process.level_step_m))
    optimize, radial = spec.optimize, spec.optimize.parametrization == "radial"
    depths_m = (*spec.scene.near_m, *spec.scene.far_m)
    flat = optic_as_drawn(camera, np.zeros(camera.grid.shape), depths_m=depths_m)
    optic = RingOptic(camera, jnp.zeros(ring_count(camera))) if radial else flat
    propagation = "far_field" if radial else spec.propagation
    sampling = 1.0 if _is_sparse(spec) else None
    far_field = radial or _is_transformed(spec)
    return Problem(
        parametrization=LevelParametrization.at(
            camera.material,
            spec.optics.design_wavelength_m,
            levels,
            optimize.quantisation,
            round((optimize.drawn_pixel_m or spec.doe.pitch_m) / spec.doe.pitch_m),
        ),
        terms=(),
        plans=tuple(
            # On the direct path, samples enough for the nearest source are enough for all.
            optic.plan(line, np.inf if far_field else min(depths_m, default=np.inf), propagation, sampling)
            for line in optic.lines
        ),
        optic=optic,
    )


Images = tuple[tuple[tuple[Array, ...], ...], tuple[tuple[Array, ...], ...]]
"""Energies `[y, x]` at near depths and at far ones: `[line][depth]`, of the lines that a step looks at."""


class _Asked(NamedTuple):
    """An image that a step looks at."""

    line: SpectralLine
    plan: Any
    source: Any


def _asked(problem: Problem, look: StepSources) -> list[list[list[_Asked]]]:
    """The images of a step: `[near or far][line][depth]`."""
    seen: list[tuple[int, SpectralLine, Any]] = []
    plans = problem.plans
    for number, line in enumerate(problem.optic.lines):
        if look.colour in (None, line.colour):
            # Only far-field plans are displaced: see `_is_sparse`.
            plan = plans[number] if look.offset_m is None else displaced(plans[number], look.offset_m)
            seen.append((number, line, plan))

    def asked(line: SpectralLine, plan: Any, one: SeenSource) -> _Asked:
        return _Asked(line, plan if one.plan is None else one.plan, one.wave)

    return [[[asked(line, plan, one) for one in side[n]] for n, line, plan in seen] for side in (look.near, look.far)]


def _energy(optic: Any, asked: _Asked) -> Float[Array, "y x"]:
    return asked.line.factor * optic.energy(*asked)


def _view(images: Images, camera: Camera, look: StepSources) -> PsfSet:
    """Images as objectives see them."""
    lines, lens = [line for line in camera.lines if look.colour in (None, line.colour)], look.lens
    if look.colour is not None:
        camera, lens = replace(camera, colours=(camera.colours[look.colour],)), lens[look.colour : look.colour + 1]

    def bank(side: tuple[tuple[Array, ...], ...]) -> Float[Array, "w d y x"]:
        depths = []
        for energies in zip(*side, strict=True):
            colours: dict[int, list[Array]] = {line.colour: [] for line in lines}
            for line, energy in zip(lines, energies, strict=True):
                colours[line.colour].append(energy)
            depths.append(jnp.stack([jnp.sum(jnp.stack(parts), axis=0) for parts in colours.values()]))
        return jnp.stack(depths, 1) if depths else jnp.zeros((len(camera.colours), 0, camera.window, camera.window))

    near, far = images
    return PsfSet(bank(near), bank(far), lens, look.disc_radius_m, camera)


def view_of(problem: Problem, height_m: Array, look: StepSources) -> PsfSet:
    """PSFs of a height map (or profile) for the sources of a step, as objectives see them; may be traced."""
    optic = problem.optic.with_heights(height_m)
    near, far = (
        tuple(tuple(_energy(optic, one) for one in depths) for depths in side) for side in _asked(problem, look)
    )
    return _view((near, far), problem.camera, look)


def finite_loss(loss: Array, step: int, cure: str) -> float:
    """Return the loss of a step as a number.

    Args:
        loss: a scalar.
        step: number of the step, for messages.
        cure: what a user can do.

    Raises:
        InputError: a loss that is not finite.
    """
    if not isfinite(value := float(loss)):
        raise InputError(f"optimize, step {step}", "the loss must stay finite", value, cure)
    return value


def losses(terms: tuple[Term, ...], view: PsfSet) -> tuple[Array, Array]:
    """The loss, and the value of every term."""
    values = jnp.stack([term.value(view) for term in terms])
    return jnp.dot(jnp.asarray([term.weight for term in terms]), values), values


@eqx.filter_jit
def _judge(problem: Problem, height_m: Array, look: StepSources) -> Array:
    return losses(problem.terms, view_of(problem, height_m, look))[0]


def judge_height(problem: Problem, scene: SourceSet, height_m: Float[np.ndarray, "*s"]) -> float:
    """Loss of given heights at the first near and far depth, without gradient (for searches over few parameters)."""
    return float(_judge(problem, jnp.asarray(height_m, jnp.float32), scene.first_look()))


def value_and_slope(
    problem: Problem, drawn_m: Float[Array, "*s"], look: StepSources
) -> tuple[Float[Array, ""], Float[Array, " term"], Float[Array, "*s"]]:
    """Loss of heights (metres) of the pixels that are drawn, its terms, and its derivative with respect to them.

    Images are computed side by side (`sim.threads`), there and back; those with light of walls by one program, for they
    share it. It compiles its parts itself, and cannot be part of a trace.
    """
    if isinstance(problem.optic, EdgeOptic):
        return _by_one_program()((problem, drawn_m, look), ())
    asked = _asked(problem, look)

    def there(one: _Asked) -> tuple[Array, Any]:
        return jax.block_until_ready(_there(problem.optic, problem.parametrization, drawn_m, one))

    def back(each: tuple[Any, Array]) -> Array:
        return jax.block_until_ready(_back(*each))

    energies, ways_back = zip(*at_once(there, _flat(asked)), strict=True)
    (loss, terms), slopes = _judged(problem.terms, problem.camera, _nested(asked, energies), look)
    ways = list(zip(ways_back, jax.tree.leaves(slopes), strict=True))
    return loss, terms, reduce(_sum, at_once(back, ways))


@cache
def _by_one_program() -> Callable[[Any, tuple[()]], Any]:
    """`value_and_slope` of all images together."""

    def judged(given: tuple[Problem, Array, StepSources], _: tuple[()]) -> Any:
        problem, drawn_m, look = given

        def loss_of(drawn_m: Array) -> tuple[Array, Array]:
            return losses(problem.terms, view_of(problem, problem.parametrization.cells(drawn_m), look))

        (loss, terms), slope = jax.value_and_grad(loss_of, has_aux=True)(drawn_m)
        return loss, terms, slope

    return compiled_step(judged)


def _flat(asked: list[list[list[_Asked]]]) -> list[_Asked]:
    return [one for side in asked for depths in side for one in depths]


def _nested(asked: list[list[list[_Asked]]], energies: Iterable[Array]) -> Images:
    """Images of a list as `_flat` makes it."""
    images = iter(energies)
    near, far = (tuple(tuple(next(images) for _ in depths) for depths in side) for side in asked)
    return near, far


@eqx.filter_jit
def _there(optic: Any, parametrization: LevelParametrization, drawn_m: Array, asked: _Asked) -> tuple[Array, Any]:
    """An image, and the function that takes a derivative with respect to it to one with respect to the heights."""
    return jax.vjp(lambda drawn_m: _energy(optic.with_heights(parametrization.cells(drawn_m)), asked), drawn_m)


@eqx.filter_jit
def _back(way: Any, slope: Array) -> Array:
    return way(slope)[0]


@eqx.filter_jit
def _judged(terms: tuple[Term, ...], camera: Camera, images: Images, look: StepSources) -> Any:
    return jax.value_and_grad(lambda images: losses(terms, _view(images, camera, look)), has_aux=True)(images)


@partial(jax.jit, donate_argnums=0)
def _sum(one: Array, other: Array) -> Array:
    return one + other
