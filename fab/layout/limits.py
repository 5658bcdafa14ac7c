"""Limits of a drawing, so that a small file that stands for an immense one is refused while it is read.

Everything is counted, nothing is unfolded: an array of copies is the product of its rows and columns.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fab.errors import InputError

if TYPE_CHECKING:
    from fab.layout.geometry import Cell

# A drawing of this package has about ten cells, five deep, a die per millimetre of the wafer, ten thousand copies of a
# cell in each of 34 ways to draw the DOE at most, and a few hundred polygons that are no rectangles. Rectangles have no
# limit: a file has at least ten bytes for each, or the manifest says how many there are.
MOST: Mapping[str, int] = {
    "cells": 2_000,
    "cells placed one within another": 32,
    "placed copies": 500_000,
    "copies through all levels": 100_000_000,
    "polygons that are no rectangles": 20_000,
}
# Shapes in all cells but those of the DOE.
MOST_AROUND = 100_000
_CURE = "Write the order again, or split the drawing."


@dataclass
class Tally:
    """Counts of what was read of a file so far, by the names in `MOST`, and in `more` for what else is limited."""

    file: str
    more: Mapping[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, what: str, count: int = 1) -> None:
        """Count some more; an InputError if they are too many now."""
        self.counts[what] = self.counts.get(what, 0) + count
        most = self.more.get(what) or MOST[what]
        if self.counts[what] > most:
            rule = f"a drawing may hold at most {most} {what}"
            raise InputError(self.file, rule, f"at least {self.counts[what]}", _CURE)

    def add_places(self, cells: "Iterable[Cell]") -> None:
        """Count depth and copies of all cells, each given after those that it places."""
        depth: dict[str, int] = {}
        copies: dict[str, int] = {}
        for cell in cells:
            depth[cell.name] = 1 + max((depth[at.cell] for at in cell.references), default=0)
            copies[cell.name] = sum(at.columns * at.rows * (1 + copies[at.cell]) for at in cell.references)
        self.add("cells placed one within another", max(depth.values()))
        self.add("copies through all levels", max(copies.values()))
