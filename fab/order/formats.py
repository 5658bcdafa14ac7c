"""In which formats an order is written."""

from dataclasses import dataclass
from typing import Literal, get_args

from fab.errors import InputError
from fab.units import require_kind

PlateFormat = Literal["gds.gz", "gds"]
_MOST_CELLS = 1000


@dataclass(frozen=True)
class Formats:
    """In which formats an order is written: small enough to mail, unless more is asked for.

    Attributes:
        plates: of the file of every photomask, which is its ending, too: GDSII packed by gzip, which KLayout opens as
            it is and any mask shop unpacks, or plain.
        combined_gds: whether the layout of all layers comes as GDSII, too, and not only as OASIS.
        mesh_cells: most columns of the relief's mesh along x and along y; a larger map is averaged in blocks.

    Raises:
        InputError: a format that there is not, or a number of columns out of range.
    """

    plates: PlateFormat = "gds.gz"
    combined_gds: bool = False
    mesh_cells: int = 200

    def __post_init__(self) -> None:
        known = get_args(PlateFormat)
        if not isinstance(self.plates, str) or self.plates not in known:
            rule = f"must be one of {', '.join(known)}"
            raise InputError("formats: plates", rule, repr(self.plates), "Choose one of them.")
        require_kind("formats: combined_gds", self.combined_gds, bool, "Give True or False.")
        if not (isinstance(self.mesh_cells, int) and 1 <= self.mesh_cells <= _MOST_CELLS):
            rule = f"must be a whole number from 1 to {_MOST_CELLS}; beyond that viewers give up"
            raise InputError("formats: mesh_cells", rule, repr(self.mesh_cells), "Choose fewer, or mesh a window.")
