"""The picture of a pattern: the target beside the achieved light."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from fab.figure import DPI, LIGHT, extent_of, panels, shrunk
from sim.camera import Camera
from sim.plots.places import label_places, unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

_SIDE = 3.2


def plot_pattern(
    target: Float[np.ndarray, "y x"],
    achieved: Float[np.ndarray, "v u"],
    camera: Camera,
    *,
    efficiency: float,
    uniformity: float,
    title: str = "",
    ax: "Axes | None" = None,
) -> "FigureBase":
    """Draw a target pattern and the PSF that should equal it (shares of the light per pixel) on one colour scale.

    Colours follow the square root of the energy, so that ghosts of one per cent show. Efficiency and uniformity (1 for
    perfect) are written above, and a `title` above the target.
    """
    from matplotlib.colors import PowerNorm
    from matplotlib.ticker import MaxNLocator

    if target.shape != achieved.shape:
        raise ValueError(f"`achieved` must have the target's shape {target.shape}, but got {achieved.shape}")
    images = [shrunk(image, round(_SIDE * DPI)) for image in (target, achieved)]
    # Speckle has rare pixels many times brighter than the rest, which would darken an even target.
    top = max(float(images[0].max()), float(np.quantile(images[1], 0.9995)), 1e-30)
    titles = (
        f"target {title}".strip(),
        f"achieved: efficiency {100 * efficiency:.1f} %, uniformity {100 * uniformity:.1f} %",
    )
    note = "one scale for both, the square root of the light, so that ghosts of one per cent show"
    with panels(ax, (8.3, 4.5), "Target and achieved light", note, layout="compressed") as figure:
        panes = figure.subplots(1, 2, sharex=True, sharey=True)
        norm, box = PowerNorm(0.5, 0.0, top, clip=True), extent_of(target.shape, camera.pixel_m, unit_of(camera).scale)
        for axes, image, title in zip(panes, images, titles, strict=True):
            axes.imshow(image, origin="lower", extent=box, norm=norm, cmap=LIGHT, interpolation="auto")
            axes.set_title(title)
            label_places(axes, unit_of(camera), "x")
        label_places(panes[0], unit_of(camera), "y")
        panes[0].locator_params(nbins=5, steps=[1, 2, 5, 10])
        above = "max" if float(images[1].max()) > top else "neither"
        bar = figure.colorbar(panes[0].images[0], ax=list(panes), extend=above, format="{x:.2g}", ticks=MaxNLocator(4))
        bar.set_label("share of light per pixel")
    return figure
