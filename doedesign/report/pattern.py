"""The picture of a pattern: the target beside what the plate draws."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import DPI, LIGHT, picture, place, shrunk
from fab.units import UM
from sim.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.image import AxesImage

_SIDE = 3.2


def draw_pattern(
    path: str | Path,
    camera: Camera,
    target: Float[np.ndarray, "y x"],
    achieved: Float[np.ndarray, "y x"],
    *,
    efficiency: float,
    uniformity: float,
) -> None:
    """Draw a target pattern and the PSF that should equal it, on one colour scale.

    Colours follow the square root of the energy, so that ghosts of one per cent show.

    Args:
        path: the PNG file.
        camera: pixel pitch of both.
        target: `[y, x]` wanted share of the incident light per pixel.
        achieved: `[y, x]` achieved share.
        efficiency: share of the incident light that lies on the target, written above the picture.
        uniformity: evenness of the light on the target, 1 for perfect, written above the picture.

    Raises:
        ValueError: the two differ in shape.
        InputError: the system refuses the path.
    """
    from matplotlib.colors import PowerNorm
    from matplotlib.ticker import MaxNLocator

    if target.shape != achieved.shape:
        raise ValueError(f"`achieved` must have the target's shape {target.shape}, but got {achieved.shape}")
    images = [shrunk(image, round(_SIDE * DPI)) for image in (target, achieved)]
    # Speckle has rare pixels many times brighter than the rest, which would darken an even target.
    top = max(float(images[0].max()), float(np.quantile(images[1], 0.9995)), 1e-30)
    norm = PowerNorm(0.5, 0.0, top, clip=True)
    with picture(path, (8.3, 4.0)) as figure:
        wanted = place(figure, 0.75, 0.5, _SIDE, _SIDE)
        _draw(wanted, images[0], target.shape, camera.pixel_m, norm)
        wanted.set_title("target")
        wanted.set_ylabel("y (µm)", labelpad=2)
        made = place(figure, 4.05, 0.5, _SIDE, _SIDE)
        shown = _draw(made, images[1], achieved.shape, camera.pixel_m, norm)
        made.set_title(f"achieved: efficiency {100 * efficiency:.1f} %, uniformity {100 * uniformity:.1f} %")
        made.tick_params(labelleft=False)
        above = "max" if float(images[1].max()) > top else "neither"
        bar = figure.colorbar(shown, cax=place(figure, 7.35, 0.5, 0.12, _SIDE), extend=above, format="{x:.2g}")
        bar.locator = MaxNLocator(4)
        bar.update_ticks()
        bar.set_label("share of light per pixel")


def _draw(
    axes: "Axes", image: Float[np.ndarray, "v u"], shape: tuple[int, ...], pixel_m: float, norm: "Normalize"
) -> "AxesImage":
    """Draw a picture of a window of `shape` pixels with axes in micrometres from its centre."""
    from matplotlib.ticker import MaxNLocator

    up, right = (size * pixel_m / UM / 2 for size in shape)
    shown = axes.imshow(
        image, origin="lower", extent=(-right, right, -up, up), norm=norm, cmap=LIGHT, interpolation="auto"
    )
    axes.set_xlabel("x (µm)", labelpad=2)
    axes.tick_params(length=2.5)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    return shown
