"""The picture of a DOE as fabricated: the intended light, the actual light, and where the difference comes from."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fab.figure import DPI, LIGHT, SMALL, bare, evenly_spaced, extent_of, length_text, panels, shrunk
from sim.camera import Camera
from sim.plots.colours import colour_label
from sim.plots.places import place_bar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    import sim.psf_bank
    import sim.surface.leakage

_SIDE, _MOST_ROWS = 2.2, 4


def plot_split(
    nominal: "sim.psf_bank.PsfBank",
    splits: Mapping[tuple[int, int], "sim.surface.leakage.SplitPsf"],
    camera: Camera,
    depth: int,
    orders: Sequence[tuple[float, float]],
    ax: "Axes | None" = None,
) -> "FigureBase":
    """Draw the PSF of one depth as designed, as fabricated, and its leaked and diffracted light; a row per colour.

    `splits` are PSFs of the DOE as fabricated by (colour, depth), positions in the bank; `orders` per colour the 0th
    order of the DOE as designed and as fabricated.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    colours = evenly_spaced(len(camera.colours), _MOST_ROWS)
    top = max(float(splits[c, depth].total.max()) for c in colours)
    norm = LogNorm(1e-4 * top, top, clip=True)
    note = (
        f"Source at {length_text(nominal.depths_m[depth])}. Leaked: what the mean of the plate's transmission, its 0th "
        "order, images as if the plate were flat. Diffracted: the rest. In each pixel the two also interfere, so the "
        "pictures do not simply add. Colours are logarithmic, one scale for all."
    )
    size = (4 * (_SIDE + 0.1) + 0.4, len(colours) * (_SIDE + 0.1) + 1.3)
    with panels(ax, (size[0], size[1] + 0.35), "Leaked and diffracted light", note, layout="compressed") as figure:
        panes = figure.subplots(len(colours), 4, squeeze=False)
        for row, c in zip(panes, colours, strict=True):
            split = splits[c, depth]
            images = (np.asarray(nominal.energy)[c, depth], split.total, split.leaked, split.diffracted)
            for axes, image in zip(row, images, strict=True):
                dots = shrunk(np.maximum(image, 1e-9 * top), round(DPI * _SIDE))
                axes.imshow(dots, norm=norm, cmap=LIGHT, origin="lower", extent=extent_of(image.shape, camera.pixel_m))
                bare(axes)
            for axes, share in zip(row, orders[c], strict=False):
                words = f"0th order {100 * share:.2g} %"
                axes.text(0.03, 0.97, words, color="white", va="top", transform=axes.transAxes, fontsize=SMALL)
            row[0].set_ylabel(colour_label(camera.colours[c]))
        for axes, words in zip(panes[0], ("as designed", "as fabricated", "leaked", "diffracted"), strict=True):
            axes.set_title(words)
        place_bar(panes[-1, -1], camera, camera.window * camera.pixel_m)
        scale = ScalarMappable(norm, LIGHT)
        bar = figure.colorbar(scale, ax=panes.ravel().tolist(), location="bottom", anchor=(0, 0), shrink=0.4)
        bar.set_label("share of light per pixel")
        bar.ax.minorticks_off()
    return figure
