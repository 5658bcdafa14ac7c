"""Parameters of obstructions: ranges that a value is drawn from, their limits, and the way to draw."""

import sys
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from fab.units import format_angle, format_length
from sim.imaging.scene import Obstruction
from sim.obstruction.view import CameraView

# A value is drawn uniformly from here to there; twice the same number is that number.
Range = tuple[float, float]

DEPTHS_M: Range = (1e-3, 100.0)  # before the lens


@runtime_checkable
class ObstructionKind(Protocol):
    """A kind of obstruction: its parameters, and a way to draw one."""

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one: a sharp picture of it, float32.

        Args:
            rng: where the randomness comes from; the same state gives the same bytes.
            view: the frame.
            background: `[c, y, x]` linear light, red, green and blue, behind it.
        """
        ...


def draw_from(rng: np.random.Generator, given: Range) -> float:
    """A number from a range."""
    return float(rng.uniform(*given))


class WithLimits:
    """Parameters that are checked when they are given.

    `limits` are the smallest and largest value that can be meant, by parameter; a range lies within and runs upward.
    A parameter is what its usual value is: a range, a whole number, or a number.
    """

    name: ClassVar[str]
    limits: ClassVar[Mapping[str, Range]]

    def __post_init__(self) -> None:
        """Check every parameter, and raise an InputError for one of another kind, or that leaves its limits."""
        for parameter, (low, high) in self.limits.items():
            given, usual = getattr(self, parameter), getattr(type(self), parameter, None)
            left_out = all(value is None for value in (given, usual))
            whole, where = isinstance(usual, int), f"{self.name}: {parameter}"
            least, most, got = (_told(parameter, value) for value in (low, high, given))
            if isinstance(usual, tuple):
                two = isinstance(given, tuple | list) and len(given) == 2 and all(map(is_number, given))
                if not two or not low <= given[0] <= given[1] <= high:
                    rule = f"must be two numbers, the smaller first, from {least} to {most}"
                    raise InputError(where, rule, got, "Give the same number twice for a fixed value.")
            elif not left_out and not (is_number(given, Integral if whole else Real) and low <= given <= high):
                rule = f"must be a {'whole ' if whole else ''}number from {least} to {most}"
                raise InputError(where, rule, got, "Give a number within.")


def _told(parameter: str, value: Any) -> str:
    """A value as messages say it: a length or an angle, as the ending of the parameter's name says, with its unit."""
    if isinstance(value, tuple | list) and value and all(map(is_number, value)):
        return " and ".join(_told(parameter, each) for each in value)
    if not (isinstance(value, Real) and is_number(value)):
        return repr(value)
    if parameter.endswith("_m"):
        return format_length(float(value))
    return format_angle(float(value)) if parameter.endswith("_rad") else f"{value:g}"


def is_number(value: Any, kind: type = Real) -> bool:
    """Whether a value is a finite number of a kind, which a float holds; true and false are none."""
    return isinstance(value, kind) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
