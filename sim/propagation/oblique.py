"""How oblique light is: wave numbers of the light to the sensor's pixels and from near sources, per DOE cell."""

from collections.abc import Sequence
from typing import NamedTuple

from sim.camera import Camera


class ObliqueWaves(NamedTuple):
    """Highest wave numbers of light, waves per DOE cell.

    Seen from a cell at the share x of the way from the axis to the aperture's rim, light to a pixel has a wave number,
    less that of the light on the cell, between -seen - x high and seen - x low.

    Attributes:
        seen: of light to a pixel on the window's edge.
        low: of the light of the farthest source on a cell on the aperture's rim, toward the rim.
        high: the same of the nearest.
    """

    seen: float
    low: float
    high: float

    def over(self, parts: int) -> "ObliqueWaves":
        """The same in waves per part of a cell."""
        return ObliqueWaves(self.seen / parts, self.low / parts, self.high / parts)


def oblique_waves(camera: Camera, wavelength_m: float, depths_m: Sequence[float]) -> ObliqueWaves:
    """Wave numbers of sources at some depths (metres, `inf` allowed) and of the window."""
    seen = float(camera.sines_of(0.0, (camera.window / 2 + 1) * camera.pixel_m)[1])
    seen += max(map(abs, camera.moved_sines()))
    common = camera.curvature_per_m() + camera.beam_curvature_per_m(wavelength_m)
    lit = [camera.opening.widest_m / 2 * (1 / depth_m + common) for depth_m in depths_m]
    cells = camera.grid.pitch_m / wavelength_m
    return ObliqueWaves(seen * cells, min(lit) * cells, max(lit) * cells)
