"""Contact sheets: what the camera sees, item by item, beside what it should and what stands in the way."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.sheet import SheetRow, draw_sheet, reduced

_SIDE = 1.75  # inches
_MOST_ROWS = 12


class ContactRow(NamedTuple):
    """One item.

    Attributes:
        label: what stands above it.
        clean: `[c, y, x]` linear light, red, green and blue, without an obstruction.
        conventional: what the camera records without a plate.
        doe: what it records with it.
        mask: `[y, x]` sharp mask of the obstruction.
        alpha: `[y, x]` share of the background's light that is lost with the plate.
    """

    label: str
    clean: Float[np.ndarray, "3 y x"]
    conventional: Float[np.ndarray, "3 y x"]
    doe: Float[np.ndarray, "3 y x"]
    mask: Float[np.ndarray, "y x"]
    alpha: Float[np.ndarray, "y x"]


def draw_contact(path: str | Path, rows: Sequence[ContactRow], title: str, words: str) -> None:
    """Draw items one below the other: clean, conventional camera, camera with the plate, mask, alpha.

    Args:
        path: the PNG file.
        rows: the items; beyond twelve, the first.
        title: what stands above.
        words: what it was made with, for the foot.

    Raises:
        InputError: the system refuses the path.
    """
    heads = ("clean", "conventional camera", "camera with the plate", "mask", "alpha, with the plate")
    draw_sheet(path, heads, [_row(row) for row in rows[:_MOST_ROWS]], _SIDE, title, words)


def _row(row: ContactRow) -> SheetRow:
    light = [_displayed(image) for image in (row.clean, row.conventional, row.doe)]
    greys = [reduced(image[None], _SIDE)[0] for image in (row.mask, row.alpha)]
    return SheetRow(row.label, (*light, *greys))


def _displayed(light: Float[np.ndarray, "3 y x"]) -> np.ndarray:
    """Display values of linear light, `[y, x, c]`; averaged in linear light, cut at white."""
    from sim.light import srgb_from_linear

    return np.clip(srgb_from_linear(reduced(light, _SIDE)), 0, 1).transpose(1, 2, 0)
