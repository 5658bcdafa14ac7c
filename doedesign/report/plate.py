"""The picture of a plate as fabricated: what was meant, what came, and where the difference comes from."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from doedesign.report.canvas import (
    DPI,
    LIGHT,
    colour_label,
    length_text,
    note,
    picture,
    place,
    scale_bar,
    shrunk,
    spread,
    wrapped,
)
from sim.camera import Camera

if TYPE_CHECKING:
    from sim.leakage import SplitPsf
    from sim.psf_bank import PsfBank

_SIDE, _GAP, _LEFT, _MOST_ROWS = 2.2, 0.08, 0.35, 4


def draw_split(
    path: str | Path,
    camera: Camera,
    nominal: "PsfBank",
    splits: Mapping[tuple[int, int], "SplitPsf"],
    depth: int,
    orders: Sequence[tuple[float, float]],
) -> None:
    """Draw the PSF of one depth as designed, as fabricated, and its leaked and diffracted light; a row per colour.

    Args:
        path: the PNG file.
        camera: the camera.
        nominal: PSFs of the plate exactly as drawn.
        splits: PSFs of the plate by (colour, depth), positions in the bank.
        depth: which depth of the bank is shown.
        orders: per colour the 0th order (share of light) of the plate as drawn and as fabricated.

    Raises:
        InputError: the system refuses the path.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    colours = spread(len(camera.colours), _MOST_ROWS)
    top = max(float(splits[c, depth].total.max()) for c in colours)
    norm = LogNorm(1e-4 * top, top, clip=True)
    width = _LEFT + 4 * (_SIDE + _GAP) + 0.15
    z_m = nominal.depths_m[depth]
    words = wrapped(
        f"Source at {length_text(z_m)}. Leaked: what the mean of the plate's transmission, its 0th order, images as if "
        "the plate were flat. Diffracted: the rest. In each pixel the two also interfere, so the pictures do not "
        "simply add.",
        width - 0.3,
    )
    below = 0.75 + 0.15 * (words.count("\n") + 1)
    with picture(path, (width, below + len(colours) * (_SIDE + _GAP) + 0.3)) as figure:
        for row, c in enumerate(colours):
            split = splits[c, depth]
            images = (nominal.energy[c, depth], split.total, split.leaked, split.diffracted)
            drawn, made = (f"{100 * share:.2g} %" for share in orders[c])
            labels = (f"0th order {drawn}", f"0th order {made}", "", "")
            for column, (image, label) in enumerate(zip(images, labels, strict=True)):
                bottom = below + (len(colours) - 1 - row) * (_SIDE + _GAP)
                axes = place(figure, _LEFT + column * (_SIDE + _GAP), bottom, _SIDE, _SIDE)
                dots = shrunk(np.maximum(image, 1e-9 * top), round(DPI * _SIDE))
                half = image.shape[0] * camera.pixel_m / 2
                axes.imshow(dots, norm=norm, cmap=LIGHT, origin="lower", extent=(-half, half, -half, half))
                axes.set_xticks([])
                axes.set_yticks([])
                axes.text(0.03, 0.97, label, color="white", va="top", transform=axes.transAxes, fontsize=8)
                if row == 0:
                    axes.set_title(("as designed", "as fabricated", "leaked", "diffracted")[column])
                if column == 0:
                    axes.set_ylabel(colour_label(camera.colours[c]))
                if (row, column) == (len(colours) - 1, 3):
                    scale_bar(axes, 2 * half)
        axes = place(figure, _LEFT, below - 0.22, 3.0, 0.1)
        bar = figure.colorbar(ScalarMappable(norm, LIGHT), cax=axes, orientation="horizontal")
        bar.set_label("share of light per pixel", labelpad=1)
        bar.ax.minorticks_off()
        note(figure, 0.15, 0.08, words)
