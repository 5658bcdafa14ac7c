"""The model of a measurement: from errors of the process to the energies in the pixels of every image.

The plate is `sim.surface.as_fabricated`'s, the light goes the far-field way. Every image has three numbers of its
own besides: where its centre lies (a tilt across the pupil, and what cells send by themselves moved with it, so the
model moves by any fraction of a pixel and the data never) and by how much its source lies off its depth (a curvature).

A plate and its images can be differentiated backwards, from a gradient with respect to the pixels to one with respect
to errors and motions; the light of all images goes back through one plate.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, UInt8

from doedesign.calibration.geometry import UPRIGHT, GeometryPrior, displacement_m, room_of
from doedesign.calibration.target import Image
from doedesign.calibration.unknowns import Unknowns
from fab.grid import Grid
from sim.aperture import open_cells
from sim.camera import Camera
from sim.propagation.farfield import FarField, bent, plan_far_field
from sim.propagation.pupil import DoeRows, doe_field
from sim.source import source_waves
from sim.surface import as_fabricated

_LIT = 0.9  # waves across a cell up to which it sends light; at 1 it is dark

# Of an image: shifts along y and x in pixels, defocus in 1/m, and the camera's geometry (`QUANTITIES`).
Motion = Float[np.ndarray, "7"]


# Of the cells and the chrome over them, at the probe's wavelength in every view.
Transmission = Complex[Array, "view cell_y cell_x"]


class _MovedColumns(NamedTuple):
    """A moved source: tilt along y and x in waves per cell, curvature in waves per cell²; places in cells."""

    axis: Float[Array, " x"]
    motion: Float[Array, "3"]

    def waves(self, rows: tuple[Array, Array], height_m: None) -> Float[Array, "row x"]:
        source_waves, y = rows[0], rows[1][:, None]
        tilted = source_waves + self.motion[0] * y + self.motion[1] * self.axis
        return tilted + self.motion[2] * (y * y + self.axis * self.axis)


class _Optic(eqx.Module):
    """One depth: transform to the sensor, wave of the source, and what a motion means in waves per cell."""

    plan: FarField
    source_waves: Float[Array, "y x"]
    axis: Float[Array, " x"]  # cells from the middle
    rates: Float[Array, "3"]  # waves per cell and unit of motion (twice) and per cell² (defocus)
    amplitude: Float[Array, "y x"] | None  # of the light on the cells; None where it is even
    camera: Camera | None = eqx.field(static=True)  # where pixels may lie elsewhere, or None
    factor: float = eqx.field(static=True)  # Fresnel transmission


@eqx.filter_jit
def _energy(optic: _Optic, view: Int[Array, ""], plate: Transmission, motion: Float[Array, "7"]) -> Float[Array, "v u"]:
    plan = optic.plan
    if optic.camera:
        plan = bent(plan, optic.camera, displacement_m(optic.camera, motion[3:], motion[:2]))
    light = plate[view] if optic.amplitude is None else plate[view] * optic.amplitude
    rows = DoeRows(None, None, light, (optic.source_waves, optic.axis))
    energy = plan.energy(doe_field, rows, _MovedColumns(optic.axis, optic.rates * motion[:3]))
    y, x = (_along(motion[k], optic.rates[k], energy.shape[k]) for k in range(2))
    return optic.factor * y[:, None] * x * energy


def _along(shift_px: Float[Array, ""], waves_per_px: Float[Array, ""], pixels: int) -> Float[Array, " pixel"]:
    """Light of a cell moved with its image, over that of one that sends it about the window's middle, along an axis.

    A tilt that every cell takes for even moves what cells do together and not what each sends by itself, sinc² of the
    waves across it. Where that is next to nothing it stays as it is.
    """
    waves = waves_per_px * (jnp.arange(pixels) - (pixels - 1) / 2)
    lit = jnp.clip(waves, -_LIT, _LIT)
    return jnp.where(waves == lit, jnp.sinc(lit - waves_per_px * shift_px) / jnp.sinc(lit), 1.0) ** 2


@dataclass(frozen=True, eq=False)
class ForwardModel:
    """A plate, drawn in levels, in front of a camera of one wavelength; images of point sources at some depths.

    Whatever beam the camera has for its design, these sources light the plate evenly, or as Gaussian beams with radii
    at 1/e² of their irradiance, one for every depth.
    """

    level: UInt8[np.ndarray, "y x"]
    camera: Camera
    unknowns: Unknowns
    depths_m: tuple[float, ...]
    geometry: GeometryPrior = UPRIGHT
    beam_radii_m: tuple[float, ...] = ()
    _optics: dict[Any, _Optic] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Leave the beam out."""
        object.__setattr__(self, "camera", replace(self.camera, beam=None))

    @property
    def wavelength_m(self) -> float:
        """The probe's."""
        return self.camera.colours[0].wavelengths_m[0]

    def _surface(self, values: Any) -> tuple[Transmission, tuple[Grid, tuple[int, ...]]]:
        process, variation = self.unknowns.process, self.unknowns.variation(values)
        wavelength, depths = self.wavelength_m, self.depths_m
        surface = as_fabricated(self.level, self.camera, process, variation, (wavelength,), depths_m=depths)
        views = tuple(surface.view(wavelength, depth) for depth in depths)
        return surface.transmission, (surface.grid, views)

    def plate(self, values: Float[np.ndarray, " p"]) -> "DoeImages":
        """The plate with some errors."""
        plate, seen = self._surface([float(v) for v in values])
        return DoeImages(self, plate, *seen)

    def plate_and_vjp(
        self, values: Float[np.ndarray, " p"]
    ) -> tuple["DoeImages", Callable[[Transmission], Float[np.ndarray, " p"]]]:
        """The plate, and the function that turns a gradient with respect to it into one with respect to the errors."""
        plate, pull, seen = jax.vjp(self._surface, jnp.asarray(values, jnp.float32), has_aux=True)
        return DoeImages(self, plate, *seen), lambda gradient: np.asarray(pull(gradient)[0], np.float64)

    def finer(self, parts: int) -> "ForwardModel":
        """The same plate, every cell drawn as `parts` by `parts` cells."""
        grid = self.camera.grid
        ny, nx = grid.shape
        camera = replace(self.camera, grid=Grid((ny * parts, nx * parts), grid.pitch_m / parts))
        level = np.kron(self.level, np.ones((parts, parts), np.uint8))
        return replace(self, level=level, camera=camera, _optics={})

    def optic(self, index: int, grid: Grid) -> _Optic:
        """Plan and source of an image for a plate of some cells; made once."""
        depth_m, radius_m = self.depths_m[index], self.beam_radii_m[index] if self.beam_radii_m else math.inf
        key = (depth_m, radius_m, grid)
        if key not in self._optics:
            camera, wavelength = replace(self.camera, grid=grid), self.wavelength_m
            scale = grid.pitch_m / wavelength
            shift = scale * camera.pixel_m / camera.sensor_distance_m
            self._optics[key] = _Optic(
                plan_far_field(camera, wavelength, depth_m=depth_m, room=room_of(camera, self.geometry)),
                jnp.asarray(source_waves(camera, wavelength, depth_m)),
                jnp.asarray(grid.axis_m("x") / grid.pitch_m, jnp.float32),
                jnp.asarray([shift, shift, scale * grid.pitch_m / 2], jnp.float32),
                None if math.isinf(radius_m) else _beam(camera, radius_m),
                None if self.geometry.upright else camera,
                camera.transmission(wavelength),
            )
        return self._optics[key]


def _beam(camera: Camera, radius_m: float) -> Float[Array, "y x"]:
    """Amplitude of a Gaussian beam on the cells, whose power on the clear aperture is that of even light."""
    y, x = camera.grid.axis_m("y")[:, None], camera.grid.axis_m("x")
    irradiance, coverage = np.exp(-2 * (y**2 + x**2) / radius_m**2), open_cells(camera.grid, camera.opening)
    return jnp.asarray(np.sqrt(irradiance * coverage.sum() / (irradiance * coverage).sum()), jnp.float32)


@dataclass(frozen=True, eq=False)
class DoeImages:
    """A plate and the images of it."""

    model: ForwardModel
    plate: Transmission
    grid: Grid
    views: tuple[int, ...]  # which of the plate's transmissions every image sees

    @property
    def parts(self) -> int:
        """Cells of the plate along either side of a cell of the drawing."""
        return self.grid.shape[0] // len(self.model.level)

    def image(self, index: int, motion: Motion) -> Image:
        """Energy in every pixel of an image, per unit power on the clear aperture, Fresnel loss included."""
        optic, view = self.model.optic(index, self.grid), jnp.int32(self.views[index])
        return np.asarray(_energy(optic, view, self.plate, jnp.asarray(motion, jnp.float32)), np.float64)

    def image_and_vjp(self, index: int, motion: Motion) -> tuple[Image, Callable[[Image], tuple[Transmission, Motion]]]:
        """The image, and the function that turns a gradient with respect to it into those of plate and motion."""
        energy = partial(_energy, self.model.optic(index, self.grid), jnp.int32(self.views[index]))
        image, pull = jax.vjp(energy, self.plate, jnp.asarray(motion, jnp.float32))

        def back(gradient: Image) -> tuple[Transmission, Motion]:
            to_plate, to_motion = pull(jnp.asarray(gradient, jnp.float32))
            return to_plate, np.asarray(to_motion, np.float64)

        return np.asarray(image, np.float64), back

    def zeroth_order(self) -> float:
        """Share of the light that passes as if the plate were flat."""
        light = np.asarray(jnp.sum(self.plate[0], axis=1), np.complex128).sum()
        mean = complex(light) / self.model.camera.opening.area_in(self.grid.pitch_m)
        return float(abs(mean) ** 2)
