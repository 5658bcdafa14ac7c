"""Sheets of pictures: rows below each other, each under a line of words, in columns with heads."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import DPI, SMALL, note, picture, place, wrapped

_GAP = 0.08  # inches


class SheetRow(NamedTuple):
    """One row.

    Attributes:
        label: what stands above it.
        images: `[y, x]` greys or `[y, x, c]` colours, 0 to 1, row 0 at the bottom; one for each column.
    """

    label: str
    images: tuple[np.ndarray, ...]


def draw_sheet(
    path: str | Path, heads: Sequence[str], rows: Sequence[SheetRow], side_in: float, title: str, words: str
) -> None:
    """Draw rows of pictures.

    Args:
        path: the PNG file.
        heads: what stands above each column.
        rows: the rows; at least one.
        side_in: width of a picture, inches.
        title: what stands above all.
        words: what it was made with, for the foot.

    Raises:
        InputError: the system refuses the path.
    """
    across = len(heads) * (side_in + _GAP) + 0.16
    text = wrapped(words, across - 0.3)
    foot = 0.2 + 0.15 * (text.count("\n") + 1)
    highs = [side_in * row.images[0].shape[0] / row.images[0].shape[1] + 0.2 for row in rows]
    with picture(path, (across, foot + sum(highs) + 0.65), title) as figure:
        top = foot + sum(highs)
        for k, head in enumerate(heads):
            at = ((0.12 + k * (side_in + _GAP)) / across, (top + 0.1) / figure.get_figheight())
            figure.text(*at, head, fontsize=SMALL, va="baseline")
        for row, high in zip(rows, highs, strict=True):
            top -= high
            for k, image in enumerate(row.images):
                axes = place(figure, 0.12 + k * (side_in + _GAP), top, side_in, high - 0.2)
                axes.imshow(image, origin="lower", cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
                axes.set_axis_off()
            note(figure, 0.12, top + high - 0.18, row.label)
        note(figure, 0.12, 0.1, text)


def reduced(values: Float[np.ndarray, "c y x"], side_in: float) -> Float[np.ndarray, "c v u"]:
    """Blocks of pixels averaged, to no more than a picture of this width can show."""
    factor = max(1, -(-max(values.shape[1:]) // round(side_in * DPI)))
    c, y, x = values.shape[0], values.shape[1] // factor, values.shape[2] // factor
    return values[:, : y * factor, : x * factor].reshape(c, y, factor, x, factor).mean(axis=(2, 4))
