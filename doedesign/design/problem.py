"""The optimisation problem of a spec: from parameters to the loss of one step, ready to differentiate."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design.objectives import PsfSet, Term, terms_from_spec
from doedesign.design.parametrize import LevelParametrization
from doedesign.spec import Spec
from fab.levels import Levels
from sim.aperture import circle_coverage
from sim.camera import Camera, source_path_m, wrapped_waves
from sim.metrics import participation
from sim.propagation.farfield import FarField, displaced, plan_far_field
from sim.propagation.fresnel import DirectPath, plan_direct
from sim.propagation.hankel import Hankel, plan_hankel, ring_source_waves
from sim.propagation.pupil import PhaseRows, phase_pupil
from sim.psf_bank import psf_bank


class WavelengthPlan(eqx.Module):
    """One wavelength of one colour.

    Attributes:
        plan: propagation operators.
        rate: waves per metre of height.
        factor: weight in its colour times the substrate's transmission.
        colour: index of the colour.
    """

    plan: FarField | DirectPath | Hankel
    rate: Float[Array, ""]
    factor: float = eqx.field(static=True)
    colour: int = eqx.field(static=True)


class StepSources(NamedTuple):
    """What one evaluation of the loss looks at.

    Attributes:
        near: `[line][depth]` source waves of near depths.
        far: `[line][depth]` source waves of far depths.
        lens: `[w, n]` participation of the plain lens at the near depths.
        offset_m: displacement (y, x) of the image on the sensor, or None to leave it on the axis.
    """

    near: tuple[tuple[Array, ...], ...]
    far: tuple[tuple[Array, ...], ...]
    lens: Float[Array, "w n"]
    offset_m: Float[Array, "2"] | None


class Problem(eqx.Module):
    """What stays the same from step to step.

    Attributes:
        camera: optics and sensor.
        parametrization: parameters to heights.
        terms: weighted objectives.
        lines: one entry per wavelength.
        coverage: open share of every cell; None for a radial problem, whose rings end at the aperture.
    """

    camera: Camera = eqx.field(static=True)
    parametrization: LevelParametrization = eqx.field(static=True)
    terms: tuple[Term, ...] = eqx.field(static=True)
    lines: tuple[WavelengthPlan, ...]
    coverage: Float[Array, "y x"] | None

    @property
    def radial(self) -> bool:
        """Whether the parameters are a profile over rings."""
        return self.coverage is None


class SourceSet(NamedTuple):
    """Everything a step may look at: source waves of every line and depth, and the plain lens.

    Attributes:
        near: `[line][depth]` near sources.
        far: `[line][depth]` far sources.
        lens: `[w, n]` participation of the plain lens.
        displacement_m: largest displacement of the image, 0 to leave it on the axis.
    """

    near: tuple[tuple[Array, ...], ...]
    far: tuple[tuple[Array, ...], ...]
    lens: Float[np.ndarray, "w n"]
    displacement_m: float

    def look(self, seed: int, step: int) -> StepSources:
        """What step number `step` looks at; depends on the two numbers alone, so a resumed run repeats it.

        Depths come in shuffled rounds, so each is seen equally often.
        """

        def pick(count: int, salt: int) -> list[int]:
            if count == 0:
                return []
            order = np.random.default_rng((seed, salt, step // count)).permutation(count)
            return [int(order[step % count])]

        near, far = pick(len(self.near[0]), 0), pick(len(self.far[0]), 1)
        offset = None
        if self.displacement_m > 0:
            shift = np.random.default_rng((seed, 2, step)).uniform(-1.0, 1.0, 2) * self.displacement_m
            offset = jnp.asarray(shift, jnp.float32)
        return StepSources(
            tuple(tuple(line[i] for i in near) for line in self.near),
            tuple(tuple(line[i] for i in far) for line in self.far),
            jnp.asarray(self.lens[:, near]),
            offset,
        )

    def first_look(self) -> StepSources:
        """The first near and far depth, with the image on the axis."""
        near, far = (tuple(line[:1] for line in lines) for lines in (self.near, self.far))
        return StepSources(near, far, jnp.asarray(self.lens[:, :1]), None)


def problem_of(spec: Spec, files: Mapping[str, Path]) -> tuple[Problem, SourceSet]:
    """Prepare plans, sources and objectives of a spec.

    Raises:
        InputError: objectives that cannot be read, or a direct path that eq. 6 forbids.
    """
    problem = plans_of(spec, files)
    camera, radial = problem.camera, problem.radial
    wavelengths = [wavelength for colour in camera.colours for wavelength in colour.wavelengths_m]
    near, far = (
        tuple(_sources(camera, depths, wavelength, radial) for wavelength in wavelengths)
        for depths in (spec.scene.near_m, spec.scene.far_m)
    )
    lens = lens_participation(camera, spec.scene.near_m)
    return problem, SourceSet(near, far, lens, camera.pixel_m / 2 if _is_sparse(spec) else 0.0)


def _is_sparse(spec: Spec) -> bool:
    """Whether a step takes one sample of intensity per lambda d / D."""
    optimize = spec.optimize
    transformed = optimize.parametrization != "radial" and spec.optics.propagation != "fresnel"
    return optimize.sampling == "sparse" and transformed


def plans_of(spec: Spec, files: Mapping[str, Path]) -> Problem:
    """Prepare plans and objectives alone, for those who bring sources of their own; see `problem_of`."""
    camera, process = camera_from_spec(spec), spec.process
    # Depths that are to be chosen begin at 2^k steps.
    levels = levels_from_spec(process, Levels(process.levels, process.level_step_m))
    radial = spec.optimize.parametrization == "radial"
    direct = spec.optics.propagation == "fresnel"
    sparse = _is_sparse(spec)
    terms = terms_from_spec(spec, camera, files)
    lines = []
    for index, colour in enumerate(camera.colours):
        for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
            if radial:
                plan = plan_hankel(camera, wavelength)
            elif direct:
                plan = plan_direct(camera, wavelength, "fresnel")
            else:
                plan = plan_far_field(camera, wavelength, sampling=1.0 if sparse else None)
            rate = jnp.float32(camera.waves_per_metre(wavelength))
            lines.append(WavelengthPlan(plan, rate, weight * camera.transmission(wavelength), index))
    return Problem(
        camera=camera,
        parametrization=LevelParametrization.at(camera.material, spec.optics.design_wavelength_m, levels),
        terms=terms,
        lines=tuple(lines),
        coverage=None if radial else jnp.asarray(circle_coverage(camera.grid, camera.aperture_m)),
    )


def _sources(camera: Camera, depths_m: tuple[float, ...], wavelength_m: float, radial: bool) -> tuple[Array, ...]:
    if radial:
        return tuple(jnp.asarray(ring_source_waves(camera, z, wavelength_m)) for z in depths_m)
    return tuple(jnp.asarray(wrapped_waves(source_path_m(camera, z), wavelength_m)) for z in depths_m)


def lens_participation(camera: Camera, near_m: tuple[float, ...]) -> Float[np.ndarray, "w n"]:
    """Sum of squared pixel energies of the lens behind a flat plate, per colour and near depth."""
    bank = psf_bank(camera, np.zeros(camera.grid.shape), near_m)
    return np.asarray(participation(jnp.asarray(bank.energy)))


def _line_energy(
    problem: Problem, line: WavelengthPlan, height_m: Array, source: Array, offset_m: Array | None
) -> Array:
    plan = line.plan
    if isinstance(plan, Hankel):
        return line.factor * plan.energy(height_m, source, line.rate)
    if offset_m is not None and isinstance(plan, FarField):
        plan = displaced(plan, offset_m)
    assert problem.coverage is not None  # only rings go without
    return line.factor * plan.energy(phase_pupil, PhaseRows(height_m, source, problem.coverage), line.rate)


def view_of(problem: Problem, height_m: Array, look: StepSources) -> PsfSet:
    """PSFs of a height map (or profile) for the sources of a look, as objectives see them."""
    size = problem.camera.window

    def bank(sources: tuple[tuple[Array, ...], ...]) -> Array:
        colours: list[list[Array]] = [[] for _ in problem.camera.colours]
        for line, waves in zip(problem.lines, sources, strict=True):
            images = [_line_energy(problem, line, height_m, source, look.offset_m) for source in waves]
            colours[line.colour].append(jnp.stack(images) if images else jnp.zeros((0, size, size)))
        return jnp.stack([jnp.sum(jnp.stack(parts), axis=0) for parts in colours])

    return PsfSet(bank(look.near), bank(look.far), look.lens, problem.camera)


def losses(problem: Problem, view: PsfSet) -> tuple[Array, Array]:
    """The loss, and the value of every term."""
    values = jnp.stack([term.value(view) for term in problem.terms])
    return jnp.dot(jnp.asarray([term.weight for term in problem.terms]), values), values


@eqx.filter_jit
def _judge(problem: Problem, height_m: Array, look: StepSources) -> Array:
    return losses(problem, view_of(problem, height_m, look))[0]


def judge_height(problem: Problem, scene: SourceSet, height_m: Float[np.ndarray, "*s"]) -> float:
    """Loss of given heights at the first near and far depth, without gradient (for searches over few parameters)."""
    return float(_judge(problem, jnp.asarray(height_m, jnp.float32), scene.first_look()))
