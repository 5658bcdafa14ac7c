"""Weighted Gerchberg-Saxton for spots, with the levels in the loop.

A DOE that sends light into M directions is the phase of a sum of M plane waves (L. A. Romero and F. M. Dickey, J. Opt.
Soc. Am. A 24, 2280, 2007): all that is free are their M amplitudes and phases. A step takes the phase of that sum,
rounds it to the nearest level that the process makes, looks at the light of every spot, takes over the phases that came
out, and gives more weight to spots that are too dark (R. Di Leonardo et al., Opt. Express 15, 1913, 2007). Because the
rounded plate is what is looked at, its errors are made up for, too. Where the phases of spots are given, those of the
plane waves go on against what is missing.

Of several colours each has plane waves of its own, and a cell takes the level that suits their sums best, the one where
the real part of sum times conjugate light, added up over the colours, is largest. For one colour that is the level
nearest to the phase.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, UInt8

from doedesign.spots.shared_levels import best_levels
from doedesign.spots.spots import Spots
from fab.levels import nearest_around

GAIN = 0.7  # of a weight, per relative error of its spot's amplitude
# The same, and of a phase per error of its spot's, where phases are given: more, and both disturb each other.
GAIN_OF_GIVEN = 0.1


class SpotLight(NamedTuple):
    """Light of spots: its sum, and how unequal it is.

    Attributes:
        efficiency: share of the light on all spots, the mean of several colours; where their phases are given, in the
            wave that they make together.
        uniformity_error: (max - min) / (max + min) of their light over their shares; that of the worst colour, each by
            itself, for every colour has a source of its own.
    """

    efficiency: float
    uniformity_error: float

    def merit(self, uniformity: float) -> float:
        """Efficiency less `uniformity` times the uniformity error."""
        return self.efficiency - uniformity * self.uniformity_error


def spot_light(efficiencies: Float[np.ndarray, " m"], shares: Float[np.ndarray, " m"], colours: int = 1) -> SpotLight:
    """Sum and uniformity error of the light of spots that should have these shares; of several colours, see `Spots`."""
    over = (efficiencies / shares).reshape(colours, -1)
    most, least = over.max(axis=1), over.min(axis=1)
    return SpotLight(float(efficiencies.sum()), float(((most - least) / np.maximum(most + least, 1e-300)).max()))


def judged(light: Complex[np.ndarray, " m"], spots: Spots) -> SpotLight:
    """Light of spots of these amplitudes, whose squares are efficiencies."""
    found = spot_light(np.abs(light) ** 2, spots.shares, spots.colours)
    return found if spots.phases is None else found._replace(efficiency=spots.in_wave(light))


class WaveSet(NamedTuple):
    """Plane waves whose sum has the phase of a DOE: weights and phases (radians) of their amplitudes `[..., spot]`."""

    weights: Float[np.ndarray, "*start m"]
    phases: Float[np.ndarray, "*start m"]

    @property
    def amplitudes(self) -> Complex[np.ndarray, "*start m"]:
        """Complex amplitudes."""
        return self.weights * np.exp(1j * self.phases)

    def improved(self, light: Complex[np.ndarray, "*start m"], spots: Spots) -> "WaveSet":
        """The next weights and phases, from the amplitudes of the spots that these ones gave."""
        gain = GAIN if spots.phases is None else GAIN_OF_GIVEN
        # Every colour by itself: `[..., colour, spot]`.
        by_colour = (*light.shape[:-1], spots.colours, -1)
        shares = (spots.colours * spots.shares).reshape(spots.colours, -1)
        size = np.abs(light).reshape(by_colour)
        size = np.maximum(size, 1e-9 * size.max(axis=-1, keepdims=True))
        wanted = np.sqrt(shares * np.sum(size**2, axis=-1, keepdims=True))
        weights = self.weights.reshape(by_colour) * (wanted / size) ** gain
        weights = weights / (np.linalg.norm(weights, axis=-1, keepdims=True) * np.sqrt(spots.colours))
        phases = np.angle(light) if spots.phases is None else self.phases - gain * spots.phase_errors(light)
        return WaveSet(weights.reshape(light.shape), phases)


class Staircase(NamedTuple):
    """Levels as light sees them, and which of them is nearest to a phase (`fab.levels.nearest_around`).

    Attributes:
        light: `[level]` transmission.
        edges: `[level]` phases, radians from 0 to 2 pi, where the nearest level changes.
        nearest: `[level + 1]` the nearest level before the first edge, between edges, and behind the last.
    """

    light: Complex[np.ndarray, " level"]
    edges: Float[np.ndarray, " level"]
    nearest: UInt8[np.ndarray, " level_1"]

    @classmethod
    def of(cls, phases: Float[np.ndarray, " level"]) -> "Staircase":
        """Levels of these phases, radians."""
        return cls(np.exp(1j * phases).astype(np.complex64), *nearest_around(phases, 2 * np.pi))

    def level(self, field: Complex[np.ndarray, "*s"]) -> UInt8[np.ndarray, "*s"]:
        """The level nearest to the phase of a field."""
        phase = np.angle(field)
        phase = np.where(phase < 0, phase + np.float32(2 * np.pi), phase)
        return self.nearest[np.searchsorted(self.edges, phase, side="right")]


def shared_level(
    fields: Sequence[Complex[np.ndarray, "*s"]], staircases: Sequence[Staircase]
) -> UInt8[np.ndarray, "*s"]:
    """The level that suits the fields of all colours best; of one colour that nearest to the phase.

    Args:
        fields: of every colour.
        staircases: the levels as light of every colour sees them.
    """
    if len(fields) == 1:
        return staircases[0].level(fields[0])
    every = np.stack([np.asarray(field, np.complex64).ravel() for field in fields])
    lights: Complex[np.ndarray, "colour level"] = np.stack([one.light for one in staircases])
    found = best_levels(every, np.real(lights).copy(), np.imag(lights).copy())
    return found.reshape(fields[0].shape)
