"""Contact sheets: what the camera sees, item by item, beside what it should and what stands in the way."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import DPI, SMALL, note, picture, place, wrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIDE, _GAP = 1.75, 0.08  # inches
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
    shown = rows[:_MOST_ROWS]
    heads = ("clean", "conventional camera", "camera with the plate", "mask", "alpha, with the plate")
    across = len(heads) * (_SIDE + _GAP) + 0.16
    highs = [_SIDE * row.mask.shape[0] / row.mask.shape[1] + 0.2 for row in shown]
    text = wrapped(words, across - 0.3)
    foot = 0.2 + 0.15 * (text.count("\n") + 1)
    with picture(path, (across, foot + sum(highs) + 0.65), title) as figure:
        top = foot + sum(highs)
        for k, head in enumerate(heads):
            at = ((0.12 + k * (_SIDE + _GAP)) / across, (top + 0.1) / figure.get_figheight())
            figure.text(*at, head, fontsize=SMALL, va="baseline")
        for row, high in zip(shown, highs, strict=True):
            top -= high
            _draw_row(figure, row, top, high - 0.2)
        note(figure, 0.12, 0.1, text)


def _draw_row(figure: "Figure", row: ContactRow, bottom: float, high: float) -> None:
    light = [_displayed(image) for image in (row.clean, row.conventional, row.doe)]
    greys = [_reduced(image[None])[0] for image in (row.mask, row.alpha)]
    for k, image in enumerate((*light, *greys)):
        axes = place(figure, 0.12 + k * (_SIDE + _GAP), bottom, _SIDE, high)
        axes.imshow(image, origin="lower", cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
        axes.set_axis_off()
    note(figure, 0.12, bottom + high + 0.02, row.label)


def _displayed(light: Float[np.ndarray, "3 y x"]) -> np.ndarray:
    """Display values of linear light, `[y, x, c]`; averaged in linear light, cut at white."""
    from sim.light import srgb_from_linear

    return np.clip(srgb_from_linear(_reduced(light)), 0, 1).transpose(1, 2, 0)


def _reduced(values: Float[np.ndarray, "c y x"]) -> np.ndarray:
    """Blocks of pixels averaged, to no more than the picture can show."""
    factor = max(1, -(-max(values.shape[1:]) // round(_SIDE * DPI)))
    c, y, x = values.shape[0], values.shape[1] // factor, values.shape[2] // factor
    return values[:, : y * factor, : x * factor].reshape(c, y, factor, x, factor).mean(axis=(2, 4))
