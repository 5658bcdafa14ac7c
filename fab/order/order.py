"""A mask order in numbers, before it becomes files: what is drawn, for whom, and what everything is called."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.compensation import edge_moves
from fab.layout.geometry import Chrome, pixel_edges
from fab.layout.part import Photomask, photomasks_of
from fab.layout.split import Split, splits_of
from fab.layout.wafer import Wafer
from fab.levels import Levels
from fab.manifest.records import map_digest
from fab.process import Process
from fab.rules.check import Rules, RulesReport, check
from fab.solids.patch import Patch
from fab.units import NM

__all__ = ["Order", "order_id"]

# What is left of 32 characters beside "DOE_" and the longest ending, "_M6_B5_1234P5NM".
_LONGEST_ID = 13


@dataclass(frozen=True, eq=False)
class Order:
    """A mask order in numbers, before it becomes files.

    Attributes:
        name: the name its owner gave it.
        level_map: level numbers ``[y, x]``, blank outside the clear aperture.
        levels: the staircase.
        grid: the raster.
        aperture_m: diameter of the clear aperture, metres.
        chrome: how the chrome is drawn.
        source: where the height map came from.
        process: in which order the masks are etched, and what their polygons are on the plates.
        wafer: what the masks are filled with.
        patch: a window that is wanted as a solid at full resolution, if any.
    """

    name: str
    level_map: NDArray[np.uint8]
    levels: Levels
    grid: Grid
    aperture_m: float
    chrome: Chrome
    source: Mapping[str, Any]
    process: Process
    wafer: Wafer
    patch: Patch | None = None

    @property
    def plates(self) -> tuple[Photomask, ...]:
        """The masks in the order in which they are used."""
        process, wafer = self.process, self.wafer
        return photomasks_of(self.levels, process.order, process.tone, wafer.chrome, wafer.zero_layer)

    @cached_property
    def rules(self) -> RulesReport:
        """Check every etch mask against what the process prints."""
        return check(self.level_map, self.levels, self.grid, self.aperture_m, Rules.of(self.process))

    def edge_moves(self) -> tuple[int, ...]:
        """How far the edges of every mask are moved outward against the bias of the process, database units."""
        if not self.wafer.compensate:
            return (0,) * self.levels.bits
        usual = self.process.expected()
        own = usual.cd_bias_m or (0.0,) * self.levels.bits
        return edge_moves([float(usual.common_cd_bias_m + bias) for bias in own], pixel_edges(self.grid).dbu_m)

    @property
    def splits(self) -> tuple[Split, ...]:
        """How the dies draw the DOE, the plate as ordered first."""
        return splits_of(self.wafer, self.levels, self.edge_moves(), pixel_edges(self.grid).dbu_m)

    def plate_stem(self, plate: Photomask) -> str:
        """Return the name of a mask's file (without suffix) and top cell."""
        if plate.bit is not None:
            return self.mask_stem(plate.bit)
        return f"{self.stem}_{'ZERO' if plate.makes == 'zero layer' else 'CHROME'}"

    @property
    def stem(self) -> str:
        """What all file names begin with."""
        return f"DOE_{order_id(self.name, map_digest(self.level_map))}"

    def mask_stem(self, bit: int) -> str:
        """Return the name of an etch mask's file (without suffix) and cell."""
        depth = f"{self.levels.etch_depth_m(bit) / NM:.1f}".removesuffix(".0").replace(".", "P")
        return f"{self.stem}_M{bit + 1}_B{bit}_{depth}NM"


def order_id(name: str, digest: str) -> str:
    """Turn a name into what mask shops accept in file and cell names.

    Args:
        name: any text.
        digest: SHA-256 of the level map, which keeps shortened names apart.

    Returns:
        The name in capitals, with _ for everything that is not a letter or digit; if that is longer
        than 13 characters, its first 8 and 4 of the digest.

    Raises:
        InputError: nothing of the name is left.
    """
    plain = re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_")
    if not plain:
        raise InputError("mask order name", "must hold a letter A-Z or a digit", repr(name), "Choose another name.")
    return plain if len(plain) <= _LONGEST_ID else f"{plain[:8].rstrip('_')}_{digest[:4].upper()}"
