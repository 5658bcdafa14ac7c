"""How pictures tell places in the light of a DOE: as lengths on a sensor, or in degrees where there is none.

Pixels without a sensor are equally wide in the sine of the angle, and so are the axes that they are drawn on; the marks
on these axes stand at round numbers of degrees.
"""

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from fab.figure import bare, length_text, scale_bar
from fab.units import DEGREES, MICROMETRES, PlaceUnit
from sim.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def label_places(axes: "Axes", unit: PlaceUnit, names: str = "xy") -> None:
    """Name the axes of a picture whose pixels lie on them, "x", "y" or both, and mark them in the unit."""
    note = ", even in its sine" if unit.in_degrees else ""
    for name in names:
        axes.set(**{f"{name}label": f"{name} ({unit.name}{note})"})
    if unit.in_degrees:
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(_degree_locator()())
            axis.set_major_formatter(lambda sine, _: f"{DEGREES.of(sine):.4g}")


@cache
def _degree_locator() -> Any:
    from matplotlib.ticker import MaxNLocator

    class DegreeLocator(MaxNLocator):
        """Places of round numbers of degrees on an axis of sines."""

        def tick_values(self, vmin: float, vmax: float) -> Any:
            """Sines between two."""
            low, high = (float(DEGREES.of(end)) for end in (vmin, vmax))
            return np.sin(np.radians(np.clip(super().tick_values(low, high), -90, 90)))

    return lambda: DegreeLocator(nbins=5, steps=[1, 2, 5, 10])


def size_text(in_angles: bool, size_m: float) -> str:
    """A size about the axis in words: a length, or the degrees that a sine spans."""
    return f"{DEGREES.size(size_m):.4g}°" if in_angles else length_text(size_m)


def place_bar(axes: "Axes", camera: Camera, size_m: float) -> None:
    """Replace the numbers of both axes by a bar of a round length, or by how wide the picture is in degrees."""
    if not camera.in_angles:
        scale_bar(axes, size_m)
        return
    bare(axes)
    axes.set_xlabel(f"{size_text(camera.in_angles, size_m)} wide")


def unit_of(camera: Camera) -> PlaceUnit:
    """Unit of the axes of a picture of all pixels."""
    return camera.told_in(MICROMETRES)
