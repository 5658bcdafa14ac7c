"""Tables of the light of walls: those of the stock process lie beside this file, all others are computed once and kept.

The stock process is fused silica with 16 levels of 75 nm under the lines of the examples. A table that fits no request
exactly is not used: material, wavelength, highest wall and polarisation are its key. `python -m
sim.rigorous.width_tables` writes the shipped file anew.
"""

import json
from functools import cache, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fab.files import write_atomic
from sim.material import refractive_index
from sim.rigorous.edge_widths import EdgeTable, computed_table

_FILE = Path(__file__).with_name("stock_widths.json")
HEADROOM = 1.25  # of the highest wall as fabricated over that as drawn
_NODE_M = 25e-9  # highest walls are rounded up to
_STOCK_LINES_M, _STOCK_ETCHES_M = (656e-9, 589e-9, 532e-9, 486e-9), (75e-9, 150e-9, 300e-9, 600e-9)


class WidthKey(NamedTuple):
    """Walls and light of one table.

    Attributes:
        highest_m: height of the highest wall.
        wavelength_m: in vacuum.
        glass: refractive index.
        way: of the electric field: "across" the wall (TM), "along" it (TE), or "unpolarised".
    """

    highest_m: float
    wavelength_m: float
    glass: float
    way: str

    def computed(self) -> EdgeTable:
        """The table, from rigorous solutions."""
        polarisation = {"across": "x", "along": "y"}.get(self.way, self.way)
        return computed_table(self.highest_m, self.wavelength_m, self.glass, polarisation, "x")


def highest_wall(range_m: float) -> float:
    """Height of the highest wall of a table for a range of heights, so that plates much alike share one."""
    return _NODE_M * max(1, int(np.ceil(range_m / _NODE_M - 1e-3)))


def two_waves(wavelength_m: float, index: float) -> float:
    """Range of heights that delays light by two waves: for heights that are not known yet."""
    return 2 * wavelength_m / (index - 1)


@lru_cache(maxsize=64)
def edge_table(highest_m: float, wavelength_m: float, index: float, polarisation: str, axis: str) -> EdgeTable:
    """Light of all walls up to a highest (`sim.rigorous.edge_widths.computed_table`), shipped or computed once.

    Args:
        highest_m: metres, positive.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "x", "y" or "unpolarised".
        axis: "x" or "y", across which the walls stand.
    """
    way = polarisation if polarisation == "unpolarised" else ("across" if polarisation == axis else "along")
    key = WidthKey(highest_m, wavelength_m, index, way)
    shipped = shipped_tables().get(key)
    return key.computed() if shipped is None else shipped


@cache
def shipped_tables() -> MappingProxyType[WidthKey, EdgeTable]:
    """Tables of the stock process, as they are shipped."""
    return MappingProxyType(
        {
            WidthKey(*one["key"]): EdgeTable(*(np.array([1, 1j]) @ one[name] for name in EdgeTable._fields))
            for one in json.loads(_FILE.read_text())
        }
    )


def stock_keys() -> list[WidthKey]:
    """Keys of the tables of the stock process: plates as drawn, as fabricated, and of heights that are still sought."""
    drawn = sum(_STOCK_ETCHES_M)
    keys = []
    for line in _STOCK_LINES_M:
        index = refractive_index("fused_silica", line)
        for highest in (highest_wall(drawn), HEADROOM * drawn, highest_wall(two_waves(line, index))):
            keys += [WidthKey(highest, line, index, way) for way in ("across", "along", "unpolarised")]
    return keys


if __name__ == "__main__":
    found = []
    for key in stock_keys():
        table = {name: [np.real(of).tolist(), np.imag(of).tolist()] for name, of in key.computed()._asdict().items()}
        found.append({"key": key} | table)
    write_atomic(_FILE, (json.dumps(found, indent=1) + "\n").encode())
