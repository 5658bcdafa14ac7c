"""The picture of a pattern: the target beside what the plate draws."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import DPI, LIGHT, picture, place, shrunk
from fab.units import UM
from sim.camera import Camera

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
    dots = round(_SIDE * DPI)
    images = [shrunk(image, dots) for image in (target, achieved)]
    # Speckle has rare pixels many times brighter than the rest, which would darken an even target.
    top = max(float(images[0].max()), float(np.quantile(images[1], 0.9995)), np.finfo(np.float32).tiny)
    norm = PowerNorm(0.5, 0.0, top, clip=True)
    ends = [sign * size * camera.pixel_m / UM / 2 for size in reversed(target.shape) for sign in (-1, 1)]
    with picture(path, (8.3, 4.0)) as figure:
        for image, title, left in zip(
            images,
            ("target", f"achieved: efficiency {100 * efficiency:.1f} %, uniformity {100 * uniformity:.1f} %"),
            (0.75, 4.05),
            strict=True,
        ):
            axes = place(figure, left, 0.5, _SIDE, _SIDE)
            shown = axes.imshow(image, origin="lower", extent=ends, norm=norm, cmap=LIGHT, interpolation="auto")
            axes.set_title(title)
            axes.set_xlabel("x (µm)", labelpad=2)
            axes.tick_params(labelleft=left < 1, length=2.5)
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            if left < 1:
                axes.set_ylabel("y (µm)", labelpad=2)
        above = "max" if float(images[1].max()) > top else "neither"
        bar = figure.colorbar(shown, cax=place(figure, 7.35, 0.5, 0.12, _SIDE), extend=above, format="{x:.2g}")
        bar.set_label("share of light per pixel")
