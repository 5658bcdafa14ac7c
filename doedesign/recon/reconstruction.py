"""A reconstruction as a value that draws itself."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from doedesign.recon.photos import write_reconstruction
from fab.figure import bare, html_of, length_text, panels
from sim.light import srgb_from_linear

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The picture that a network made of a capture.

    Attributes:
        picture: `[c, y, x]` display values (sRGB), 0 to 1 but for the network's errors; red, green and blue, or one.
        light: `[c, y, x]` linear light of the capture, white 1, in the same colours.
        near_m: distance of the obstruction that the network was given the PSFs of, metres.
        far_m: distance of the scene, metres.
        name: the capture's name.
    """

    picture: Float[np.ndarray, "c y x"]
    light: Float[np.ndarray, "c y x"]
    near_m: float
    far_m: float
    name: str = "capture"

    def save(self, path: str | Path, bits: int | None = 16) -> None:
        """Write the picture; see `doedesign.recon.photos.write_reconstruction`."""
        write_reconstruction(path, self.picture, bits)

    def beside(self) -> Float[np.ndarray, "c y w"]:
        """Display values of the capture and of the reconstruction, side by side with a white gap."""
        _, rows, columns = self.light.shape
        gap = np.ones((len(self.light), rows, max(2, columns // 100)), np.float32)
        return np.concatenate([srgb_from_linear(self.light), gap, self.picture], axis=2).astype(np.float32)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the capture and the reconstruction side by side; return the figure."""
        y, x = self.light.shape[1:]
        words = f"obstruction at {length_text(self.near_m)}, scene at {length_text(self.far_m)}"
        with panels(ax, (7.2, 3.6 * y / x + 1.3), self.name, words, layout="compressed") as figure:
            pictures = {"capture": srgb_from_linear(self.light), "reconstruction": self.picture}
            for axes, (title, picture) in zip(figure.subplots(1, 2), pictures.items(), strict=True):
                shown = np.broadcast_to(np.clip(picture, 0, 1), (3, y, x))
                axes.imshow(shown.transpose(1, 2, 0), origin="lower")
                axes.set_title(title)
                bare(axes)
        return figure

    def _repr_html_(self) -> str:
        y, x = self.light.shape[1:]
        rows = {
            "pixels": f"{x} x {y}",
            "obstruction at": length_text(self.near_m),
            "scene at": length_text(self.far_m),
        }
        return html_of(f"Reconstruction of {self.name}", rows, self.plot())
