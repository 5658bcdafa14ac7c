"""Cells of two heights that repeat and can be printed: lines and spaces made of strokes of square brushes.

What is etched is a line, what is left a space, as in `check`. Where every line is covered by squares as wide as the
narrowest one, within it, and every space likewise, no run along x or y is too short. That asks a little more than the
rule does: of a diagonal staircase, too.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from fab.grid import fewest_pixels
from fab.rules.check import Rules

_ROUNDS = 400  # of changes before a cell is given up
_LEAST = 1e-3  # weight of a pixel on the very wall


class Strokes(NamedTuple):
    """Brushes of lines and spaces.

    Attributes:
        line: side of the brush of what is etched, pixels.
        space: side of the brush of what is left, pixels.
        corners: whether pixels of one kind may touch at a corner alone.
    """

    line: int
    space: int
    corners: bool

    @classmethod
    def of(cls, rules: Rules, pitch_m: float) -> "Strokes":
        """The brushes of a process; where it prints any width, it prints corners."""
        line, space = (fewest_pixels(width, pitch_m) for width in (rules.minimum_line_m, rules.minimum_space_m))
        return cls(line, space, not (rules.minimum_line_m or rules.minimum_space_m))

    def side(self, glass: bool) -> int:
        """Side of the brush of a kind."""
        return self.space if glass else self.line

    def follows(self, glass: Bool[np.ndarray, "y x"]) -> bool:
        """Whether a cell that repeats is made of strokes.

        Args:
            glass: whether a pixel is left as it is.
        """
        whole = np.array_equal(glass, _painted(glass, self.space)) and np.array_equal(
            ~glass, _painted(~glass, self.line)
        )
        return whole and (self.corners or not _kissing(glass).any())

    def nearest(self, outline: Float[np.ndarray, "y x"]) -> Bool[np.ndarray, "y x"] | None:
        """Find a cell of strokes near to where a number is positive; None where none is found.

        Args:
            outline: positive where glass is to be left; a pixel matters by its size.
        """
        cell, weight = outline > 0, abs(outline) + _LEAST
        mean = weight.mean()
        for _ in range(_ROUNDS):
            closed, opened = ~_painted(~cell, self.line), _painted(cell, self.space)
            first, second = _painted(closed, self.space), ~_painted(~opened, self.line)
            cell = first if (weight * (first != cell)).sum() <= (weight * (second != cell)).sum() else second
            wrong = cell != _painted(cell, self.space)
            wrong |= ~cell & ~_painted(~cell, self.line)
            if wrong.any():
                at, kinds = int(np.argmax(np.where(wrong, weight, -1))), (True, False)
            elif self.corners or not (wrong := _kissing(cell)).any():
                return cell
            else:
                at = int(np.argmin(np.where(wrong, weight, np.inf)))
                kinds = (not cell.flat[at],)
            # What covers the pixel and changes least.
            y, x = np.unravel_index(at, cell.shape)
            strokes = [(self.stroke(cell.shape, int(y) - j, int(x) - i, kind), kind)
                       for kind in kinds for j in range(self.side(kind)) for i in range(self.side(kind))]  # fmt: skip
            costs = [(weight.flat[own] * (cell.flat[own] != kind)).sum() for own, kind in strokes]
            own, kind = strokes[int(np.argmin(np.where(np.array(costs) > 0, costs, np.inf)))]
            cell.flat[own] = kind
            weight.flat[own] = 1.5 * weight.flat[own] + 0.02 * mean
        return None

    def stroke(self, shape: tuple[int, int], y: int, x: int, glass: bool) -> Int[np.ndarray, " pixel"]:
        """Numbers of the pixels of a stroke, across the cell's rim if need be.

        Args:
            shape: of the cell.
            y: its first row.
            x: its first column.
            glass: its kind.
        """
        ny, nx = shape
        side = np.arange(self.side(glass))
        return np.unique(((y + side) % ny)[:, None] * nx + (x + side) % nx)


def _painted(cell: np.ndarray, side: int) -> np.ndarray:
    """Part of a cell that squares within it cover; across the cell's rim they go on."""
    inside = cell
    for axis in (0, 1):
        inside = np.all([np.roll(inside, -step, axis) for step in range(side)], 0)
    for axis in (0, 1):
        inside = np.any([np.roll(inside, step, axis) for step in range(side)], 0)
    return inside


def _kissing(cell: np.ndarray) -> np.ndarray:
    """Pixels that touch one of their kind at a corner alone."""
    right, up, both = np.roll(cell, -1, 1), np.roll(cell, -1, 0), np.roll(cell, (-1, -1), (0, 1))
    found = (cell == both) & (right == up) & (cell != right)
    return found | np.roll(found, 1, 0) | np.roll(found, 1, 1) | np.roll(found, (1, 1), (0, 1))
