"""The optics inside a training step: from a plate's parameters to the developed capture, differentiable throughout.

A plate says what a source looks like through it. Three kinds serve the same two calls, `source` on the host (once per
scene, in double precision) and `psf` in a compiled step:

* `LivePlate`: a height map that is being learnt, quantised as the spec says, with a factor for the errors of a process
  if there is one;
* `RingPlate`: the same for a profile of rings;
* `StoredPlate`: a plate at rest, from a bank of PSFs over 1/z, which costs next to nothing.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Key

from doedesign.capture.camera import CaptureModel
from doedesign.design.optimize import Free
from doedesign.design.parametrize import LevelParametrization
from doedesign.design.problem import WavelengthPlan
from sim.camera import Camera
from sim.imaging.scene import Scene
from sim.propagation.hankel import Hankel, ring_source_waves
from sim.psf_bank import PsfBank
from sim.source import Source, SourceColumns, SourceRows, source_at, source_pupil


class LivePlate(eqx.Module):
    """A height map on a grid.

    Attributes:
        lines: propagation of every wavelength.
        coverage: `[y, x]` open share of every cell.
        errors: `[line, y, x]` what a plate as fabricated does to light beside its heights; None for one as drawn.
        parametrization: parameters to heights.
        camera: optics and sensor.
        wavelengths_m: of the lines.
    """

    lines: tuple[WavelengthPlan, ...]
    coverage: Float[Array, "y x"]
    errors: Complex[Array, "line y x"] | None
    parametrization: LevelParametrization = eqx.field(static=True)
    camera: Camera = eqx.field(static=True)
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)

    def source(self, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)) -> Source:
        """What `psf` has to know of a source."""
        return source_at(self.camera, self.wavelengths_m, depth_m, field_rad)

    def psf(self, free: Free, softness: Array, source: Source) -> Float[Array, "c y x"]:
        """PSF of every colour, energy per pixel."""
        height = _height_m(self.parametrization, free, softness)
        grid = self.camera.grid
        y_m, x_m = (jnp.asarray(grid.axis_m(axis), jnp.float32) for axis in ("y", "x"))

        def energy(number: int, line: WavelengthPlan) -> Array:
            errors = None if self.errors is None else self.errors[number]
            rows = SourceRows(height, self.coverage, y_m, jnp.asarray(source.waves_y)[number], errors)
            columns = SourceColumns(
                x_m,
                jnp.asarray(source.waves_x)[number],
                jnp.asarray(source.curvature),
                jnp.asarray(source.sines),
                jnp.asarray(source.rates)[number],
                jnp.asarray(source.inverse_wavelengths)[number],
            )
            assert not isinstance(line.plan, Hankel)  # rings have a plate of their own
            return line.factor * line.plan.energy(source_pupil, rows, columns)

        return _by_colour(self.lines, [energy(k, line) for k, line in enumerate(self.lines)])


class RingPlate(eqx.Module):
    """A profile of rings; see `LivePlate`. Sources lie on the axis."""

    lines: tuple[WavelengthPlan, ...]
    parametrization: LevelParametrization = eqx.field(static=True)
    camera: Camera = eqx.field(static=True)
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)

    def source(self, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)) -> Float[np.ndarray, "line ring"]:
        """What `psf` has to know of a source.

        Raises:
            ValueError: a source off the axis.
        """
        if any(field_rad):
            raise ValueError(f"`field_rad` must be (0, 0) for rings, but got {field_rad}")
        return np.stack([ring_source_waves(self.camera, depth_m, line) for line in self.wavelengths_m])

    def psf(self, free: Free, softness: Array, source: Float[Array, "line ring"]) -> Float[Array, "c y x"]:
        """PSF of every colour, energy per pixel."""
        profile = _height_m(self.parametrization, free, softness)
        images = []
        for line, waves in zip(self.lines, source, strict=True):
            assert isinstance(line.plan, Hankel)
            images.append(line.factor * line.plan.energy(profile, waves, line.rate))
        return _by_colour(self.lines, images)


class StoredPlate(eqx.Module):
    """A plate at rest: PSFs that were computed at some depths, mixed linearly in 1/z between them.

    Attributes:
        energy: `[depth, c, y, x]` PSFs, the farthest first.
        inverse_depths: `[depth]` rising.
    """

    energy: Float[Array, "d c y x"]
    inverse_depths: Float[Array, " d"]

    @classmethod
    def of(cls, bank: PsfBank) -> "StoredPlate":
        """The plate of a bank."""
        order = np.argsort([1 / depth for depth in bank.depths_m])
        inverse = np.array([1 / bank.depths_m[k] for k in order], np.float32)
        return cls(jnp.asarray(bank.energy[:, order].swapaxes(0, 1)), jnp.asarray(inverse))

    def source(self, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)) -> Float[np.ndarray, ""]:
        """What `psf` has to know of a source; its field angle makes no difference."""
        return np.asarray(1 / depth_m, np.float32)

    def psf(self, free: None, softness: Array, source: Float[Array, ""]) -> Float[Array, "c y x"]:
        """PSF of every colour, energy per pixel; at depths beyond the bank's that of the last one."""
        place = jnp.interp(source, self.inverse_depths, jnp.arange(len(self.inverse_depths), dtype=jnp.float32))
        low = jnp.clip(place.astype(jnp.int32), 0, len(self.inverse_depths) - 2)
        share = place - low
        return (1 - share) * self.energy[low] + share * self.energy[low + 1]


Plate = LivePlate | RingPlate | StoredPlate


def _height_m(parametrization: LevelParametrization, free: Free, softness: Array) -> Array:
    if isinstance(free, tuple):
        radians, log_depth_ratio = free
        return parametrization.height_m(radians, softness, parametrization.depths_m(log_depth_ratio))
    return parametrization.height_m(free, softness)


def _by_colour(lines: tuple[WavelengthPlan, ...], images: list[Array]) -> Array:
    """Sum the lines of every colour."""
    count = 1 + max(line.colour for line in lines)
    colours = [[image for line, image in zip(lines, images, strict=True) if line.colour == c] for c in range(count)]
    return jnp.stack([sum(parts[1:], start=parts[0]) for parts in colours])


class TrainingScene(NamedTuple):
    """One scene as the training sees it.

    Attributes:
        scene: one obstruction before a background, colours those of the camera, depths in single precision.
        far: source in the background, as the plate wants it.
        near: source in the obstruction.
    """

    scene: Scene
    far: Any
    near: Any


class Capture(NamedTuple):
    """A developed capture and the PSFs behind it.

    Attributes:
        capture: `[c, y, x]` linear light with noise, white 1.
        far: `[c, y, x]` PSFs of the background.
        near: `[c, y, x]` PSFs of the obstruction.
    """

    capture: Float[Array, "c y x"]
    far: Float[Array, "c y x"]
    near: Float[Array, "c y x"]


def shot(
    seen: TrainingScene, plate: Plate, free: Free | None, softness: Array, bench: CaptureModel, key: Key[Array, ""]
) -> Capture:
    """Photograph a scene through a plate.

    Args:
        seen: the scene.
        plate: the plate.
        free: its parameters; None for one at rest.
        softness: of the quantisation (`doedesign.design.parametrize.softness_at`).
        bench: the rest of the camera.
        key: key of the noise.
    """
    call: Any = plate.psf
    far, near = (call(free, softness, source) for source in (seen.far, seen.near))
    return Capture(bench.developed(jax.tree.map(jnp.asarray, seen.scene), far, near, key), far, near)


def shots(
    seen: TrainingScene, plate: Plate, free: Free | None, softness: Array, bench: CaptureModel, keys: Key[Array, " b"]
) -> Capture:
    """Photograph a batch, one scene after the other: every array of `seen`, and `keys`, has a first axis for it."""
    if len(keys) == 1:
        one = shot(jax.tree.map(lambda leaf: leaf[0], seen), plate, free, softness, bench, keys[0])
        return jax.tree.map(lambda leaf: leaf[None], one)
    return jax.lax.map(lambda given: shot(given[0], plate, free, softness, bench, given[1]), (seen, keys))
