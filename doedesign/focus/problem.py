"""Light of rings on the axis and beside it, and what is asked of it.

The merit is the mean logarithm of the light on the axis over that of an ideal lens there, so that no distance is
forgotten; light at half the width that is wanted, and beyond, counts against it where it is more than `_HALF` of that
on the axis.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from doedesign.focus.foci import Foci
from sim.camera import Camera
from sim.optic import HeightOptic
from sim.propagation.near_axis import Octant

BESIDE = (0.5, 0.625, 0.75, 0.875, 1.0)  # places beside the axis, shares of the width wanted
_HALF, _SHARP = 0.42, 5000.0  # less than half, so that levels keep it
_FAINT = 1e-9
FINER = 3  # rings per cell


class FocusLight(NamedTuple):
    """Light of all foci.

    Attributes:
        strength: geometric mean of the light on the axis over that of an ideal lens.
        blur: root mean square of what is too much beside the axis, over the light on the axis.
    """

    strength: Float[Array, "*any"]
    blur: Float[Array, "*any"]

    @property
    def loss(self) -> Float[Array, "*any"]:
        """Number that a design makes as small as it can."""
        return -jnp.log(self.strength) + _SHARP * self.blur**2


def focus_light(light: Float[Array, "focus place *choice"], weight: Float[Array, " focus"]) -> FocusLight:
    """Strength and blur of the light of foci, of several choices at once.

    Args:
        light: light on the axis and then beside it, over that of an ideal lens on the axis.
        weight: share of every focus in the merit.
    """
    axis, weight = light[:, :1], weight.reshape(-1, *(1,) * (light.ndim - 2))
    strength = jnp.exp(jnp.sum(weight * jnp.log(axis[:, 0] + _FAINT), axis=0))
    excess = jnp.maximum(light[:, 1:] / (axis + _FAINT) - _HALF, 0.0)
    # Where there is hardly any light on the axis, more beside it says no more.
    blur = jnp.sqrt(jnp.sum(weight * jnp.mean(jnp.minimum(excess, 3.0) ** 2, axis=1), axis=0) + 1e-12)
    return FocusLight(strength, blur)


class FocusProblem(eqx.Module):
    """A DOE of rings to be designed for foci. A focus has a part for every line of its colour.

    Attributes:
        kernel: `[part, place, ring]` amplitude of every ring over that of an ideal lens on the axis, as reports have it
            (`sim.propagation.near_axis.profiles`), times the root of the line's share of the colour. Lines of a colour
            count by what rings in step would make of each.
        rate: `[part]` waves per metre of height.
        focus: `[part]` focus that it belongs to, increasing.
        weight: `[focus]` share of the merit.
    """

    kernel: Complex[Array, "part place ring"]
    rate: Float[Array, " part"]
    focus: Int[Array, " part"]
    weight: Float[Array, " focus"]

    @classmethod
    def of(cls, foci: Foci, camera: Camera) -> "FocusProblem":
        """The problem of foci for a camera without a lens."""
        bare, pitch, count = HeightOptic.of(camera), camera.grid.pitch_m, ring_count(camera)
        cells = [Octant.of(camera, np.asarray(bare.field(line)), line, pitch / FINER) for line in camera.lines]
        kernels, rates, owners = [], [], []
        for number in range(len(foci.distance_m)):
            places, distance = np.array((0.0, *BESIDE)) * foci.width_m[number], float(foci.distance_m[number])
            own = [k for k, line in enumerate(camera.lines) if line.colour == foci.colour[number]]
            lines = [camera.lines[k] for k in own]
            shares = np.array([line.factor for line in lines]) / sum(line.factor for line in lines)
            found = [cells[k].kernel(places, distance, camera.lines[k], pitch, count) for k in own]
            ideal = np.array([cells[k].ideal(distance, camera.lines[k], pitch) for k in own])
            most = np.array([np.abs(kernel[0]).sum() for kernel in found])  # of rings in step
            kept = np.sqrt(shares @ most**2 / (shares @ ideal**2))
            for line, kernel, scale in zip(lines, found, kept * np.sqrt(shares) / most, strict=True):
                kernels.append((kernel * scale).astype(np.complex64))
                rates.append(camera.waves_per_metre(line.wavelength_m))
                owners.append(number)
        return cls(
            jnp.asarray(np.stack(kernels)),
            jnp.asarray(np.array(rates), jnp.float32),
            jnp.asarray(np.array(owners)),
            jnp.asarray(foci.weight, jnp.float32),
        )

    def waves(self, height_m: Float[Array, "*s"]) -> Complex[Array, "part *s"]:
        """Transmission of heights for every part."""
        turns = self.rate.reshape(-1, *(1,) * jnp.ndim(height_m)) * height_m
        return jnp.exp(2j * jnp.pi * (turns - jnp.round(turns)))

    def field(self, height_m: Float[Array, " ring"]) -> Complex[Array, "part place"]:
        """Amplitudes of a profile of heights."""
        return jnp.einsum("pnr,pr->pn", self.kernel, self.waves(height_m), precision="highest")

    def judge(self, field: Complex[Array, "part place *choice"]) -> FocusLight:
        """Strength and blur of amplitudes, of several choices at once."""
        light = jax.ops.segment_sum(field.real**2 + field.imag**2, self.focus, len(self.weight))
        return focus_light(light, self.weight)

    def loss(self, field: Complex[Array, "part place *choice"]) -> Float[Array, "*choice"]:
        """Number that a design makes as small as it can."""
        return self.judge(field).loss


def ring_count(camera: Camera) -> int:
    """Number of rings out to the rim of the clear aperture and a cell beyond, for cells that it cuts."""
    return int(np.ceil((camera.aperture_m / 2 / camera.grid.pitch_m + 1) * FINER))


def ring_numbers(camera: Camera) -> Int[np.ndarray, "y x"]:
    """Number of the ring in which the middle of every cell lies, from 0 at the axis; beyond the last that of the last.

    Rings are finer than cells: each takes those cells whose middle it holds.
    """
    grid = camera.grid
    radius = np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])
    return np.minimum((radius / (grid.pitch_m / FINER)).astype(int), ring_count(camera) - 1)
