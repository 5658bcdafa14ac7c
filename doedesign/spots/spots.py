"""Where spots lie, how much light each should have, and in which phase if that is given."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float, Int


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots as plane waves that leave a DOE.

    Attributes:
        waves_per_m: `[spot, (y, x)]` direction sines over the wavelength, waves per metre.
        shares: `[spot]` light of every spot over that of all, summing to 1.
        orders: `[spot, (y, x)]` whole numbers of every spot on a lattice of directions, or None where there is none.
        lattice_per_m: distance (y, x) of that lattice, waves per metre, or None.
        phases: `[spot]` phase that each plane wave should have in the middle of the DOE, radians, but for one that all
            have in common; None where phases are free.
        colours: how many colours have spots; those of each follow those of the one before, equally many.
    """

    waves_per_m: Float[np.ndarray, "m 2"]
    shares: Float[np.ndarray, " m"]
    orders: Int[np.ndarray, "m 2"] | None = None
    lattice_per_m: tuple[float, float] | None = None
    phases: Float[np.ndarray, " m"] | None = None
    colours: int = 1

    @classmethod
    def joined(cls, parts: "Sequence[Spots]") -> "Spots":
        """Spots of several colours, each colour with the same light. Their phases are free.

        Args:
            parts: those of every colour, equally many.
        """
        first, count = parts[0], len(parts)
        waves = np.concatenate([one.waves_per_m for one in parts])
        named = [one.orders for one in parts if one.orders is not None]
        orders = np.concatenate(named) if len(named) == count else None
        # Orders of a unit cell have one lattice for all colours, places on a sensor do not.
        alike = all(one.lattice_per_m == first.lattice_per_m for one in parts)
        shares = np.concatenate([one.shares for one in parts]) / count
        return cls(waves, shares, orders, first.lattice_per_m if alike else None, colours=count)

    @property
    def parts(self) -> "tuple[Spots, ...]":
        """The spots of every colour alone."""
        if self.colours == 1:
            return (self,)
        orders = [None if self.orders is None else self.orders[own] for own in self.of_colours]
        return tuple(
            Spots(self.waves_per_m[own], self.colours * self.shares[own], named, self.lattice_per_m)
            for own, named in zip(self.of_colours, orders, strict=True)
        )

    @property
    def of_colours(self) -> tuple[slice, ...]:
        """Which spots those of every colour are."""
        count = self.count // self.colours
        return tuple(slice(at, at + count) for at in range(0, self.count, count))

    @property
    def count(self) -> int:
        """Number of spots, those of all colours together."""
        return len(self.shares)

    def about(self, place_m: tuple[float, float]) -> "Spots":
        """The same spots with phases as they are at a place (y, x) instead of the middle of the DOE."""
        if self.phases is None:
            return self
        return replace(self, phases=self.phases + 2 * np.pi * self.waves_per_m @ np.asarray(place_m))

    @property
    def wave(self) -> Complex[np.ndarray, " m"]:
        """Amplitudes of unit power together, in the phases that are given. ValueError where these are free."""
        if self.phases is None:
            raise ValueError("the phases of these spots are free")
        return np.sqrt(self.shares) * np.exp(1j * self.phases)

    def phase_errors(self, light: Complex[np.ndarray, "*start m"]) -> Float[np.ndarray, "*start m"]:
        """Phases of amplitudes less those that are given, radians, after the common phase that fits best.

        Brighter spots count more in that, as they do in `in_wave`. ValueError where phases are free.
        """
        off = light * self.wave.conj()
        return np.angle(off * off.sum(axis=-1, keepdims=True).conj())

    def in_wave(self, light: Complex[np.ndarray, " m"]) -> float:
        """Share of the incident light in the wave whose amplitudes and phases are given, from the spots' amplitudes.

        It is that of all spots where both are as wanted. ValueError where phases are free.
        """
        return float(np.abs(np.vdot(self.wave, light)) ** 2)


def shares_of(weights: Sequence[float], count: int) -> Float[np.ndarray, " m"]:
    """Shares of spots from weights, equal ones if none are given."""
    given = np.asarray(weights if len(weights) else np.ones(count), float)
    return given / given.sum()
