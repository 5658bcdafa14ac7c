"""Places of spots in a grid, in hexagonal rings and on a circle."""

import numpy as np
from jaxtyping import Float, Int


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
