"""What all kinds of obstruction share: ranges that a value is drawn from, their checks, and the way to draw."""

import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from sim.imaging.scene import Obstruction
from sim.obstruction.view import CameraView

__all__ = ["ObstructionKind", "Range", "draw_from", "require_depth", "require_number", "require_range"]

# A value is drawn uniformly from here to there; twice the same number is that number.
Range = tuple[float, float]

_FARTHEST_M = 100.0


@runtime_checkable
class ObstructionKind(Protocol):
    """A kind of obstruction: its parameters, and a way to draw one."""

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one obstruction.

        Args:
            rng: where the randomness comes from; the same state gives the same bytes.
            view: the frame.
            background: `[c, y, x]` linear light, red, green and blue, behind it.

        Returns:
            A sharp picture of it, float32.
        """
        ...


def draw_from(rng: np.random.Generator, given: Range) -> float:
    """Draw a number from a range."""
    return float(rng.uniform(*given))


def require_range(where: str, given: Range, low: float, high: float) -> None:
    """Check a range that a user gave.

    Args:
        where: "kind: parameter".
        given: the range.
        low: the smallest value that can be meant.
        high: the largest.

    Raises:
        InputError: the range runs backwards or leaves what can be meant.
    """
    if len(given) != 2 or not all(math.isfinite(value) for value in given) or not low <= given[0] <= given[1] <= high:
        rule = f"must be two numbers, the smaller first, from {low:g} to {high:g}"
        raise InputError(where, rule, given, "Give the same number twice for a fixed value.")


def require_number(where: str, given: float, low: float, high: float) -> None:
    """Check a number that a user gave.

    Args:
        where: "kind: parameter".
        given: the number.
        low: the smallest value that can be meant.
        high: the largest.

    Raises:
        InputError: the number leaves what can be meant.
    """
    if not low <= given <= high:
        raise InputError(where, f"must lie from {low:g} to {high:g}", given, "Give a number within.")


def require_depth(kind: str, depth_m: Range) -> None:
    """Check the range of an obstruction's distance.

    Raises:
        InputError: it is not in front of the lens.
    """
    require_range(f"{kind}: depth_m", depth_m, 1e-3, _FARTHEST_M)
