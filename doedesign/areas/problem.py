"""Light of a phase on the lattice of an area: two matrix products, exact for square cells, and its gradient.

All that lies off the lattice is left free. What is asked of a design is its merit: the share of light on the area, less
so many times its contrast, to which a border in the wrong place is added. Of several areas, each in a colour and a
plane of its own, the worst counts most.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from doedesign.areas.target import AreaTarget
from sim.camera import Camera
from sim.optic import CellOptic, HeightOptic

# By how much light on the edges of an area may differ from what is wanted without harm, over that inside.
_LEEWAY = 0.1
# How much more a worse area counts: by e where its merit is less by one over this.
_SHARPNESS = 12.0


class AreaLight(NamedTuple):
    """Light of an area.

    Attributes:
        efficiency: share of the incident light on it, Fresnel loss left out; where its phase is given, share of the
            incident light in the wave that is asked for.
        contrast: root of the mean square of light over the light wanted less 1, where it should be flat; of a picture,
            of the difference from what is wanted, over its mean. Where the phase is given, root of the light on the
            area, and on a frame that should be dark, that is not in the wave over the light that is.
        misplaced: root of the mean square by which the light on the border is not half of that inside, and of what
            edges differ from the wanted ones beyond a leeway.
    """

    efficiency: Float[Array, ""]
    contrast: Float[Array, ""]
    misplaced: Float[Array, ""]

    def loss(self, uniformity: float | Float[Array, ""]) -> Float[Array, ""]:
        """One less the merit."""
        return 1.0 - self.efficiency + uniformity * jnp.sqrt(self.contrast**2 + self.misplaced**2)


class AreaScore(eqx.Module):
    """How light on a lattice is judged.

    Attributes:
        wanted: `[v, u]` light wanted, its mean over the flat part 1.
        lit: where light counts as that of the area.
        even: `[v, u]` weights of squared differences in the contrast.
        edge: `[v, u]` weights of squared differences beyond the leeway on edges.
        border: `[place, v]` and `[place, u]` weights for the light at places on the border.
        wave: `[v, u]` field wanted, of unit power; None where its phase is free.
    """

    wanted: Float[Array, "v u"]
    lit: Bool[Array, "v u"]
    even: Float[Array, "v u"]
    edge: Float[Array, "v u"]
    border: tuple[Float[Array, "n v"], Float[Array, "n u"]]
    wave: Complex[Array, "v u"] | None = None

    @classmethod
    def of(cls, target: AreaTarget) -> "AreaScore":
        """The score of a target."""
        flat, even, wave = target.flat, target.flat | target.dark, target.wave
        return cls(
            jnp.asarray(target.wanted / target.wanted[flat].mean(), jnp.float32),
            jnp.asarray(target.lit),
            jnp.asarray(even / flat.sum(), jnp.float32),
            jnp.asarray((target.lit & ~even) / flat.sum(), jnp.float32),
            (jnp.asarray(target.border[0], jnp.float32), jnp.asarray(target.border[1], jnp.float32)),
            None if wave is None else jnp.asarray(wave, jnp.complex64),
        )

    def inside(self, light: Float[Array, "v u"]) -> Float[Array, ""]:
        """Light inside: what the wanted light is to be multiplied by to fit best."""
        weights = self.even * self.wanted
        return jnp.sum(weights * light) / jnp.sum(weights * self.wanted)

    def judge(self, light: Float[Array, "v u"]) -> AreaLight:
        """Efficiency, contrast and misplaced light of shares of the incident light."""
        efficiency = jnp.sum(jnp.where(self.lit, light, 0.0))
        over = light / jnp.maximum(self.inside(light), 1e-30)
        missed = jnp.sum(self.even * (over - self.wanted) ** 2)
        rows, columns = self.border
        misplaced = jnp.sum((jnp.sum(rows @ over * columns, axis=1) - 0.5) ** 2) / max(1, len(rows))
        misplaced += jnp.sum(self.edge * jnp.maximum(jnp.abs(over - self.wanted) - _LEEWAY, 0.0) ** 2)
        return AreaLight(efficiency, jnp.sqrt(missed + 1e-12), jnp.sqrt(misplaced + 1e-12))

    def judge_field(self, field: Complex[Array, "v u"]) -> AreaLight:
        """The same of a field whose phase is given; ValueError where it is free."""
        if self.wave is None:
            raise ValueError("the phase of this area is free")
        inside = _power(jnp.sum(self.wave.conj() * field))
        counts = self.lit | (self.even > 0)  # and a frame that should be dark
        rest = jnp.sum(jnp.where(counts, _power(field), 0.0)) - inside
        return AreaLight(inside, jnp.sqrt(jnp.maximum(rest, 0.0) / (inside + 1e-30) + 1e-12), jnp.zeros(()))


class AreaProblem(eqx.Module):
    """A DOE to be designed for an area.

    Attributes:
        amplitudes: `[mode, y, x]` field behind the bare opening (`mode_fields`).
        along_y: `[v, y]` factors of the rows, exp(-2 pi i u y) with the cell's sinc, for the rows of the lattice.
        along_x: `[u, x]` the same of the columns.
        score: how the light on the lattice is judged.
        turn: phase of its wavelength over that of the first, for the same height.
    """

    amplitudes: Complex[Array, "mode y x"]
    along_y: Complex[Array, "v y"]
    along_x: Complex[Array, "u x"]
    score: AreaScore
    turn: float = eqx.field(static=True, default=1.0)

    @classmethod
    def of(cls, target: AreaTarget, camera: Camera, turn: float = 1.0) -> "AreaProblem":
        """The problem of a target for the first wavelength of a camera; for `turn` see above."""
        rows, columns = lattice_factors(target, camera)
        bare = mode_fields(HeightOptic.of(camera))
        fields, along_y, along_x = (jnp.asarray(part, jnp.complex64) for part in (bare, rows, columns))
        return cls(fields, along_y, along_x, AreaScore.of(target), turn)

    def light(self, phase: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """Share of the incident light on every sample of the lattice; `phase` is that of the first wavelength."""
        turned = self._turned(phase)
        return jnp.sum(jax.lax.map(lambda one: _power(self._field(one * turned)), self.amplitudes), axis=0)

    def _turned(self, phase: Float[Array, "y x"]) -> Complex[Array, "y x"]:
        """Factor of the field for a phase of the first wavelength."""
        return jnp.exp(1j * phase if self.turn == 1 else 1j * self.turn * phase)

    def _field(self, behind: Complex[Array, "y x"]) -> Complex[Array, "v u"]:
        """Field on the lattice of one behind the DOE."""
        return self.along_y @ behind @ self.along_x.T

    def judge(self, phase: Float[Array, "y x"]) -> AreaLight:
        """Efficiency, contrast and misplaced light of a phase."""
        if self.score.wave is None:
            return self.score.judge(self.light(phase))
        return self.score.judge_field(self._field(self.amplitudes[0] * self._turned(phase)))

    def loss(self, phase: Float[Array, "y x"], uniformity: float | Float[Array, ""]) -> Float[Array, ""]:
        """One less the merit."""
        return self.judge(phase).loss(uniformity)


def _power(field: Array) -> Array:
    return field.real**2 + field.imag**2


class AreaSet(eqx.Module):
    """A DOE to be designed for one area or several.

    Attributes:
        problems: those of its areas.
        span: phase of the first wavelength over the whole height of the staircase, radians, after which heights begin
            again; None where all areas have the first colour, whose phase repeats after 2 pi.
    """

    problems: tuple[AreaProblem, ...]
    span: float | None = eqx.field(static=True, default=None)

    def judge(self, phase: Float[Array, "y x"]) -> tuple[AreaLight, ...]:
        """Efficiency, contrast and misplaced light of every area."""
        return tuple(problem.judge(self._within(phase)) for problem in self.problems)

    def loss(self, phase: Float[Array, "y x"], weights: Float[Array, " area"]) -> Float[Array, ""]:
        """One less the merit, for the `uniformity` of every area; of several areas a smooth maximum."""
        phase = self._within(phase)
        losses = [problem.loss(phase, weight) for problem, weight in zip(self.problems, weights, strict=True)]
        if len(losses) == 1:
            return losses[0]
        return jax.scipy.special.logsumexp(_SHARPNESS * jnp.stack(losses), b=1 / len(losses)) / _SHARPNESS

    def _within(self, phase: Float[Array, "y x"]) -> Float[Array, "y x"]:
        return phase if self.span is None else jnp.mod(phase, self.span)


def mode_fields(doe: CellOptic, colour: int = 0) -> Complex[np.ndarray, "mode y x"]:
    """Field behind a DOE for a colour's first wavelength, by mode of the beam; its squares sum to what passes."""
    camera = doe.camera
    power = camera.grid.pitch_m**2 / camera.opening.area_m2
    lines = [line for line in camera.lines if line.colour == colour]
    modes = zip(camera.shares, lines, strict=False)  # those of the first wavelength come first
    return np.stack([np.float32(np.sqrt(share * power)) * np.asarray(doe.field(line)) for share, line in modes])


def lattice_factors(
    target: AreaTarget, camera: Camera
) -> tuple[Complex[np.ndarray, "v y"], Complex[np.ndarray, "u x"]]:
    """Factors of rows and columns from cells to the lattice; the square of a sum of unit power is a share of light."""
    found, wavelength, pitch = [], camera.lines[0].wavelength_m, camera.grid.pitch_m
    moved_y, moved_x = camera.moved_sines()  # light counts from the direction in which a tilted beam arrives
    for axis, sines in (("y", target.sines_y - moved_y), ("x", target.sines_x - moved_x)):
        turns = np.outer(sines / wavelength, camera.grid.axis_m(axis))  # pyright: ignore[reportArgumentType]
        # A cell sends |sinc|² pitch² into the square of sines (wavelength)²; a sample stands for a step of sines.
        share = np.sqrt(pitch * (sines[1] - sines[0]) / wavelength) * np.sinc(sines * pitch / wavelength)
        found.append(share[:, None] * np.exp(-2j * np.pi * (turns - np.rint(turns))))
    return found[0], found[1]
