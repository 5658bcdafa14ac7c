"""Aperture: the outline of what is open, or of what has relief, about the centre of a raster; round and rectangular."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import SLACK, Grid
from fab.units import format_length, number_of, numbers_of


class Aperture(ABC):
    """An outline about the origin."""

    @property
    @abstractmethod
    def extent_m(self) -> tuple[float, float]:
        """Height and width ``(y, x)`` of the smallest box about the origin that holds it, metres."""

    @property
    @abstractmethod
    def reach_m(self) -> float:
        """Distance of its farthest point from the origin, metres."""

    @abstractmethod
    def area_in(self, pitch_m: float, times: int = 1) -> float:
        """Area in squares of an edge, metres; of so many of them."""

    @abstractmethod
    def contains(self, y_m: NDArray[np.floating], x_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether points, broadcast against each other, lie inside or on the rim."""

    @abstractmethod
    def inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Return ``[y, x]`` true where a pixel's centre lies inside or on the rim."""

    @abstractmethod
    def count_inside(self, grid: Grid) -> int:
        """Return the number of pixels that are `inside`, without drawing them."""

    @abstractmethod
    def shrunk(self, by_m: float) -> "Aperture":
        """The same with its rim moved inward, metres."""

    @abstractmethod
    def outlines_m(self, corners: int) -> list[NDArray[np.float64]]:
        """Return the corners x, y ``(n, 2)`` of its outlines, metres, what is open on their left; so many if round."""

    @property
    @abstractmethod
    def sizes_m(self) -> tuple[float, ...]:
        """Lengths by which people call it, metres: its diameter, or width and height."""

    def record(self, unit_m: float = 1.0, digits: int | None = None) -> Any:
        """Return it as a value of JSON, in multiples of a unit, rounded to some digits; `aperture_from` reads it."""
        return self.sizes(unit_m, digits)

    def sizes(self, unit_m: float, digits: int | None = None) -> Any:
        """Return `sizes_m` in multiples of a unit, rounded to some digits: a number, or a list of two."""
        lengths = [size if unit_m == 1.0 else size / unit_m for size in self.sizes_m]
        lengths = lengths if digits is None else [round(length, digits) for length in lengths]
        return lengths if len(lengths) > 1 else lengths[0]

    def __str__(self) -> str:
        """Return "4.44 mm", or "2 mm x 1 mm" with the width first."""
        return " x ".join(map(format_length, self.sizes_m))

    @property
    def area_m2(self) -> float:
        """Area, square metres."""
        return self.area_in(1.0)

    @property
    def centroid_m(self) -> tuple[float, float]:
        """Centre of its area ``(y, x)``, metres."""
        return 0.0, 0.0

    @property
    def disc_m(self) -> float:
        """Diameter of a disc of the same area, metres; its own, if it is one."""
        return 2 * math.sqrt(self.area_m2 / math.pi)

    @property
    def widest_m(self) -> float:
        """Longer side of the box around it with the origin in its middle, metres; the diameter of a round one."""
        return max(self.extent_m)

    @property
    def narrowest_m(self) -> float:
        """Shorter side of the box around it with the origin in its middle, metres; the diameter of a round one."""
        return min(self.extent_m)


@dataclass(frozen=True)
class RoundAperture(Aperture):
    """A disc.

    Attributes:
        diameter_m: diameter, metres; an infinite one is all of a raster, as of a piece that was cut out of a DOE.

    Raises:
        InputError: something other than a number.
    """

    diameter_m: float

    def __post_init__(self) -> None:
        if math.isnan(number_of(self.diameter_m)):
            cure = "For example 1e-3 for 1 mm."
            raise InputError("aperture: diameter_m", "must be a number of metres", repr(self.diameter_m), cure)

    @property
    def extent_m(self) -> tuple[float, float]:
        """The diameter, twice."""
        return self.diameter_m, self.diameter_m

    @property
    def reach_m(self) -> float:
        """The radius."""
        return self.diameter_m / 2

    @property
    def disc_m(self) -> float:
        """The diameter."""
        return self.diameter_m

    def area_in(self, pitch_m: float, times: int = 1) -> float:
        """Area of the disc."""
        return times * np.pi * (self.diameter_m / pitch_m) ** 2 / 4

    def contains(self, y_m: NDArray[np.floating], x_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """By the distance from the middle."""
        return y_m**2 + x_m**2 <= (self.diameter_m / 2) ** 2 * (1 + SLACK)

    def inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Pixels of the disc."""
        return grid.inside_circle(self.diameter_m)

    def count_inside(self, grid: Grid) -> int:
        """Number of pixels of the disc."""
        return grid.count_inside_circle(self.diameter_m)

    def shrunk(self, by_m: float) -> "RoundAperture":
        """A disc whose diameter is smaller by twice as much."""
        return RoundAperture(self.diameter_m - 2 * by_m)

    def outlines_m(self, corners: int) -> list[NDArray[np.float64]]:
        """A regular polygon with its corners on the circle."""
        angle = (np.arange(corners) + 0.5) * 2 * np.pi / corners
        return [self.diameter_m / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)]

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """The diameter."""
        return (self.diameter_m,)


@dataclass(frozen=True)
class RectangularAperture(Aperture):
    """A rectangle.

    Attributes:
        size_m: height and width ``(y, x)``, metres; a list becomes a tuple.

    Raises:
        InputError: something other than two numbers.
    """

    size_m: tuple[float, float]

    def __post_init__(self) -> None:
        sides = numbers_of(self.size_m)
        if len(sides) != 2 or any(map(math.isnan, sides)):
            rule = "must be two numbers (y, x), height and width in metres"
            raise InputError("aperture: size_m", rule, repr(self.size_m), "For example (1e-3, 2e-3).")
        object.__setattr__(self, "size_m", sides)

    @property
    def extent_m(self) -> tuple[float, float]:
        """Its sides."""
        return self.size_m

    @property
    def reach_m(self) -> float:
        """Half the diagonal."""
        return math.hypot(*self.size_m) / 2

    def area_in(self, pitch_m: float, times: int = 1) -> float:
        """Product of the sides."""
        return times * (self.size_m[0] / pitch_m) * (self.size_m[1] / pitch_m)

    def contains(self, y_m: NDArray[np.floating], x_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """By the distances from the axes."""
        half_y, half_x = (side / 2 * (1 + SLACK) for side in self.size_m)
        return (np.abs(y_m) <= half_y) & (np.abs(x_m) <= half_x)

    def inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Pixels of the rectangle."""
        return self.contains(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])

    def count_inside(self, grid: Grid) -> int:
        """Number of pixels of the rectangle."""
        rows = self.contains(grid.axis_m("y"), np.zeros(1))
        columns = self.contains(np.zeros(1), grid.axis_m("x"))
        return int(np.count_nonzero(rows)) * int(np.count_nonzero(columns))

    def shrunk(self, by_m: float) -> "RectangularAperture":
        """A rectangle whose sides are smaller by twice as much."""
        return RectangularAperture((self.size_m[0] - 2 * by_m, self.size_m[1] - 2 * by_m))

    def outlines_m(self, corners: int) -> list[NDArray[np.float64]]:
        """Its four corners, counter-clockwise from the lowest."""
        half_y, half_x = (side / 2 for side in self.size_m)
        return [np.array([(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)])]

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """Width and height."""
        return self.size_m[::-1]
