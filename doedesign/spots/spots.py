"""Where spots lie and how much light each should have."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots as plane waves that leave a DOE.

    Attributes:
        waves_per_m: `[spot, (y, x)]` direction sines over the wavelength, waves per metre.
        shares: `[spot]` light of every spot over that of all, summing to 1.
        orders: `[spot, (y, x)]` whole numbers of every spot on a lattice of directions, or None where there is none.
        lattice_per_m: distance (y, x) of that lattice, waves per metre, or None.
    """

    waves_per_m: Float[np.ndarray, "m 2"]
    shares: Float[np.ndarray, " m"]
    orders: Int[np.ndarray, "m 2"] | None = None
    lattice_per_m: tuple[float, float] | None = None

    @property
    def count(self) -> int:
        """Number of spots."""
        return len(self.shares)


def grid_orders(count: tuple[int, int]) -> Int[np.ndarray, "m 2"]:
    """Orders (y, x) of a centred grid of `count` = (columns, rows) spots, row by row from the lowest.

    An even count has no middle: its orders are the odd ones, between which every other one is to stay dark.
    """

    def along(n: int) -> np.ndarray:
        middle = np.arange(n) - (n - 1) / 2
        return np.rint(middle * (1 if n % 2 else 2)).astype(int)

    x, y = (along(n) for n in count)
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


def hexagonal_places(rings: int, spacing: float) -> Float[np.ndarray, "m 2"]:
    """Places (y, x) of a spot and so many hexagonal rings around it, `spacing` between neighbours."""
    places = []
    for row in range(-rings, rings + 1):
        columns = 2 * rings + 1 - abs(row)
        places += [(row * np.sqrt(3) / 2, column - (columns - 1) / 2) for column in range(columns)]
    return np.array(places) * spacing


def ring_places(count: int, radius: float) -> Float[np.ndarray, "m 2"]:
    """Places (y, x) of spots equally spaced on a circle, the first on the positive x axis."""
    angle = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def shares_of(weights: Sequence[float], count: int) -> Float[np.ndarray, " m"]:
    """Shares of spots from weights, equal ones if none are given."""
    given = np.asarray(weights if len(weights) else np.ones(count), float)
    return given / given.sum()
