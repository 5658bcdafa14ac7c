"""Parameters of obstructions: ranges that a value is drawn from, their limits, and the way to draw."""

import math
from collections.abc import Mapping
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
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
    """

    name: ClassVar[str]
    limits: ClassVar[Mapping[str, Range]]

    def __post_init__(self) -> None:
        """Check every parameter, and raise an InputError for one that leaves its limits."""
        for parameter, (low, high) in self.limits.items():
            given, where = getattr(self, parameter), f"{self.name}: {parameter}"
            if np.ndim(given):
                finite = len(given) == 2 and all(math.isfinite(value) for value in given)
                if not finite or not low <= given[0] <= given[1] <= high:
                    rule = f"must be two numbers, the smaller first, from {low:g} to {high:g}"
                    raise InputError(where, rule, given, "Give the same number twice for a fixed value.")
            elif given is not None and not low <= given <= high:
                raise InputError(where, f"must lie from {low:g} to {high:g}", given, "Give a number within.")
