"""Contact sheets: rows of images below each other, each over its caption, in columns with heads."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from fab.figure import DPI, SMALL, panels, shrunk

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

__all__ = ["ContactRow", "ValidationRow", "plot_contact", "plot_validation"]

_CONTACT_SIDE, _VALIDATION_SIDE = 1.75, 1.6  # inches
_MOST_CONTACTS, _MOST_VALIDATIONS = 12, 4


class ContactRow(NamedTuple):
    """One simulated capture under its caption: linear light in red, green and blue, and its obstruction.

    Light without an obstruction, as the camera records it without a DOE, and with it; sharp mask of the obstruction,
    and `alpha`, the share of the background's light that is lost with the DOE.
    """

    label: str
    clean: Float[np.ndarray, "3 y x"]
    conventional: Float[np.ndarray, "3 y x"]
    doe: Float[np.ndarray, "3 y x"]
    mask: Float[np.ndarray, "y x"]
    alpha: Float[np.ndarray, "y x"]


class ValidationRow(NamedTuple):
    """One scene that was not trained on: display values of the capture, the network's output and the scene."""

    label: str
    capture: Float[np.ndarray, "3 y x"]
    reconstruction: Float[np.ndarray, "3 y x"]
    scene: Float[np.ndarray, "3 y x"]


def plot_contact(rows: Sequence[ContactRow], title: str, words: str, ax: "Axes | None" = None) -> "FigureBase":
    """Draw captures one below the other: clean, conventional camera, camera with the DOE, mask, alpha.

    Args:
        rows: the captures; beyond twelve, the first.
        title: a line above all.
        words: how they were made, for the foot.
        ax: axes whose place the sheet takes; a new figure by default.
    """
    from sim.light import srgb_from_linear

    heads = ("clean", "conventional camera", "camera with the plate", "mask", "alpha, with the plate")
    shown = []
    for row in rows[:_MOST_CONTACTS]:
        # Averaged in linear light, cut at white.
        light = [srgb_from_linear(_reduced(image, _CONTACT_SIDE)) for image in (row.clean, row.conventional, row.doe)]
        shown.append((row.label, [*light, *(shrunk(one, round(_CONTACT_SIDE * DPI)) for one in (row.mask, row.alpha))]))
    return _plot_sheet(heads, shown, _CONTACT_SIDE, title, words, ax)


def plot_validation(rows: Sequence[ValidationRow], title: str, words: str, ax: "Axes | None" = None) -> "FigureBase":
    """Draw scenes one below the other: capture, reconstruction, scene; arguments as in `plot_contact`, four rows."""
    shown = [
        (row.label, [_reduced(np.clip(one, 0, 1), _VALIDATION_SIDE) for one in row[1:]])
        for row in rows[:_MOST_VALIDATIONS]
    ]
    return _plot_sheet(("capture", "reconstruction", "scene"), shown, _VALIDATION_SIDE, title, words, ax)


def _reduced(image: Float[np.ndarray, "c y x"], side_in: float) -> Float[np.ndarray, "v u c"]:
    """Colours averaged to no more than a picture of this width can show."""
    return np.stack([shrunk(plane, round(side_in * DPI)) for plane in image], axis=-1)


def _plot_sheet(
    heads: Sequence[str],
    rows: Sequence[tuple[str, Sequence[np.ndarray]]],
    side_in: float,
    title: str,
    words: str,
    ax: "Axes | None",
) -> "FigureBase":
    """Draw rows of a caption and images `[y, x]` or `[y, x, c]`, 0 to 1."""
    heights = [side_in * images[0].shape[0] / images[0].shape[1] + 0.3 for _, images in rows]
    heights[0] += 0.2
    size = (len(heads) * (side_in + 0.12) + 0.1, sum(heights) + 1.0)
    with panels(ax, size, title, words) as figure:
        strips = figure.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0]
        for strip, (label, images) in zip(strips, rows, strict=True):
            strip.supxlabel(label, x=0.01, ha="left", fontsize=SMALL, parse_math=False)
            for axes, image, head in zip(strip.subplots(1, len(heads)), images, heads, strict=True):
                shown = np.clip(image, 0, 1)
                axes.imshow(shown, origin="lower", cmap="gray", vmin=0, vmax=1, interpolation="nearest")
                axes.set_axis_off()
                axes.set_anchor("S")  # next to its caption
                if strip is strips[0]:
                    axes.set_title(head)
    return figure
