"""Files of a mask order by what their names end with."""

from pathlib import Path

# Options of `doedesign masks` for GDS that every program opens.
GDS_TOO = ("--plates", "gds", "--combined-gds")


def named(folder: Path, ending: str) -> Path:
    """The one file whose name ends so."""
    (path,) = folder.glob(f"*_{ending}")
    return path
