"""A DOE whose walls are part of its light: thin cells, a line of light along every wall between them, and corners.

Light that passes near a wall is not that of a thin element (`sim.rigorous.edge_widths`). The lines of light lie on the
borders of cells, where the transform has no sample: they are spread over the cells to either side, by weights whose far
field is that of a line up to the highest wave number on the sensor, the obliquity of a near source included. So a PSF
with edges takes the same transform as one without; where the light of a near source or that to the window's edge is too
oblique for the cells, every cell is first split into smaller ones. Points of light at corners
(`sim.rigorous.corner_light`) are spread like lines, along both axes.

The wall between two cells side by side along x is crossed by light polarised along x (TM), and lies along light
polarised along y (TE). The mean image of unpolarised light is that of mean widths: the square of half the difference
between TE and TM, which is left out, is 0.1 % of a PSF at most.
"""

# Abstract fields become fields, or properties, of subclasses.
# pyright: reportIncompatibleVariableOverride=false

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import permutations
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Inexact

from fab.aperture import Aperture, RoundAperture
from fab.grid import Grid
from fab.units import distances_from, require_kind
from sim.aperture import open_cells
from sim.camera import Camera
from sim.material import refractive_index
from sim.optic import HeightOptic, ViewedOptic, heights_on
from sim.propagation.oblique import oblique_waves
from sim.rigorous.cells_and_walls import light_of_cells_and_walls
from sim.rigorous.corner_light import corner_unit
from sim.rigorous.walls import Corners, Walls
from sim.rigorous.width_tables import edge_table, highest_wall, two_waves
from sim.source import SeparableSource, SourceMap, View
from sim.tracing import is_traced

# Root mean square error of a line's far field that is good enough, and the largest that is borne before cells are
# split; lines are about a tenth of the light.
_GOOD, _WORST, _MOST_TAPS = 0.003, 0.03, 10
_GOOD_POINT = 0.05  # of points at corners, which are a hundredth of the light
_GOOD_DIPOLE = 0.08  # of dipoles, over their own
_WIDEST_LIGHT = 0.2  # waves per cell from a far to a near source's light on the rim, for which dipoles of one view do
_SHARES = 33  # of the way from the axis to the rim, for which weights are fitted


class EdgeOptic(ViewedOptic):
    """A DOE with the light of its walls.

    Attributes:
        drawn: lens, sensor, substrate, and the grid of the DOE.
        height_m: `[y, x]` height of every cell of the DOE.
        camera: the same with the grid of the cells here: those of the DOE, or a whole number of parts of them.
        coverage: `[y, x]` open share of every cell.
        transmission: `[view, y, x]` values of the cells whose far field is that of cells and walls.
        views: wavelength and depths of sources for which each transmission holds.
        wavelengths_m: different vacuum wavelengths.
        depths_m: nearest and farthest depth of sources for which that holds, metres; from others, it is a little off.
        source_kind: how sources are described.
    """

    drawn: Camera = eqx.field(static=True)
    height_m: Float[Array, "v u"]
    camera: Camera = eqx.field(static=True)
    coverage: Float[Array, "y x"]
    transmission: Complex[Array, "view y x"]
    views: tuple[View, ...] = eqx.field(static=True)
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)
    depths_m: tuple[float, float] = eqx.field(static=True)
    source_kind: type[SourceMap] | type[SeparableSource] = eqx.field(static=True, default=SourceMap)

    @property
    def drawn_m(self) -> Float[Array, "v u"]:
        """The heights."""
        return self.height_m

    @property
    def means(self) -> Complex[Array, "w y x"]:
        """The transmission from afar: weights of a line sum to its light."""
        return self.from_afar(self.wavelengths_m)

    def with_camera(self, camera: Camera) -> "EdgeOptic":
        """The same DOE before another lens or sensor; a ValueError for another aperture, substrate or kind of light."""
        own = super().with_camera(replace(camera, grid=self.drawn.grid)).camera
        drawn = replace(own, grid=self.drawn.grid)
        return self if drawn == self.drawn else self._prepared(self.height_m, drawn, self.depths_m)

    def prepared_for(self, depths_m: Sequence[float]) -> "EdgeOptic":
        """The same for sources at other depths, metres."""
        least, most = self.depths_m
        enough = least <= min(depths_m) and max(depths_m) <= most
        return self if enough else self._prepared(self.height_m, self.drawn, (*self.depths_m, *depths_m))

    def with_heights(self, height_m: Float[Array, "y x"]) -> "EdgeOptic":
        """The same with other heights; they may be traced."""
        return self._prepared(height_m, self.drawn, self.depths_m)

    def _prepared(self, height_m: Any, camera: Camera, depths_m: Sequence[float]) -> "EdgeOptic":
        own = None if camera.lines != self.drawn.lines else self.wavelengths_m
        found = with_edges(height_m, camera, depths_m=depths_m, wavelengths_m=own)
        return replace(found, source_kind=self.source_kind)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the heights."""
        return self.drawn.grid.shape

    def raster(self, height_m: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
        """Heights of the cells."""
        return height_m

    def heights_of(self, map_m: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"] | None:
        """The heights that `with_heights` takes of a map on the grid."""
        return map_m


def with_edges(
    height_m: Any,
    camera: Camera,
    *,
    depths_m: Sequence[float] = (np.inf,),
    wavelengths_m: Sequence[float] | None = None,
) -> EdgeOptic:
    """A DOE of upright walls, with their light.

    Args:
        height_m: `[y, x]` height of every cell of `camera.grid`, metres; numpy, or jax, or a map of `fab`. Traced
            heights must not differ by more than two waves from one cell to the next.
        camera: DOE grid, aperture, substrate, lens and sensor, and the polarisation of the light.
        depths_m: nearest and farthest depth of the sources that will be looked at, metres, and any between.
        wavelengths_m: vacuum wavelengths; those of the camera's lines by default.

    Returns:
        the DOE, lit from the side of its relief; a function of the heights for `jax.grad`, not for `jax.jvp`.

    Raises:
        ValueError: heights of another shape than the grid's.
        InputError: no camera, depths that are not positive, or heights that `sim.optic.heights_on` refuses.
    """
    require_kind("camera", camera, Camera, "A design has one: design.camera.")
    depths_m = distances_from(depths_m, "depths_m") or (np.inf,)
    drawn, height = camera, heights_on(camera, height_m)
    range_m = None if is_traced(height) else float(jnp.ptp(height))
    wavelengths = tuple(dict.fromkeys(wavelengths_m or (line.wavelength_m for line in camera.lines)))
    depths = min(depths_m), max(depths_m)
    drawn_m, parts = height, 1
    while not all(_is_seen(camera, wavelength, (depth,), parts) for wavelength in wavelengths for depth in depths):
        parts += 1
    views = [view for wavelength in wavelengths for view in _views(camera, wavelength, depths, parts)]
    if parts > 1:
        height = jnp.repeat(jnp.repeat(height, parts, axis=0), parts, axis=1)
        grid = Grid((camera.grid.shape[0] * parts, camera.grid.shape[1] * parts), camera.grid.pitch_m / parts)
        camera = replace(camera, grid=grid)
    found = []
    for view in views:
        wavelength = view.wavelength_m
        index = refractive_index(camera.material, wavelength)
        highest = highest_wall(two_waves(wavelength, index) if range_m is None else range_m)
        waves = oblique_waves(camera, wavelength, (view.nearest_m, view.farthest_m))
        taps = line_weights(*waves, camera.opening)[0], dipole_weights(*waves, camera.opening)
        walls = []
        for axis in ("y", "x"):
            table = edge_table(highest, wavelength, index, camera.polarisation, axis)
            own = _at_borders(taps[0], camera, axis), _at_borders(taps[1], camera, axis)
            walls.append(Walls.of(table, highest, index / wavelength, own, camera.grid.pitch_m))
        rate = camera.waves_per_metre(wavelength)
        points = _at_borders(line_weights(*waves, camera.opening, _GOOD_POINT)[0], camera, "x")
        corners = Corners.of(corner_unit(wavelength, index) / camera.grid.pitch_m**2, points)
        found.append(light_of_cells_and_walls(height, rate, corners, *walls))
    coverage = jnp.asarray(open_cells(camera.grid, camera.opening))
    return EdgeOptic(drawn, drawn_m, camera, coverage, jnp.stack(found), tuple(views), wavelengths, depths)


def _is_seen(camera: Camera, wavelength_m: float, depths_m: Sequence[float], parts: int) -> bool:
    """Whether weights on parts of cells do for the light of walls, from all these depths alike."""
    waves = oblique_waves(camera, wavelength_m, depths_m)
    return waves.high - waves.low <= _WIDEST_LIGHT and line_weights(*waves.over(parts), camera.opening)[1] <= _WORST


def _views(camera: Camera, wavelength_m: float, depths_m: tuple[float, float], parts: int) -> list[View]:
    """As few views as do for the light of walls."""
    count = 1
    while True:
        views = View.several(wavelength_m, depths_m, count)
        if all(_is_seen(camera, wavelength_m, (view.nearest_m, view.farthest_m), parts) for view in views):
            return views
        count += 1


def optic_as_drawn(
    camera: Camera, height_m: Any = None, *, depths_m: Sequence[float] = (np.inf,)
) -> HeightOptic | EdgeOptic:
    """The optic of a DOE exactly as drawn, in the light that the camera asks for.

    Args:
        camera: DOE grid, lens and sensor; its `light` says whether walls add theirs.
        height_m: `[y, x]` heights of the cells, metres; None for the bare lens.
        depths_m: nearest and farthest depth of the sources that will be looked at, metres, and any between.
    """
    if height_m is None or camera.light == "scalar":
        return HeightOptic.of(camera, height_m)
    return with_edges(height_m, camera, depths_m=depths_m)


@lru_cache(maxsize=64)
def line_weights(
    seen: float, low: float, high: float, aperture: Aperture, good: float = _GOOD
) -> tuple[Inexact[np.ndarray, "node tap"], float]:
    """Weights on the cells to either side of a line whose far field is that of the line.

    A cell's far field is sinc(u). The sum of weights on cells at k + 1/2 from the line, times exp(-2 pi i u (k + 1/2)),
    is fitted to 1 / sinc(u) by least squares, exact on the axis. Here u is the wave number of light to a pixel less
    that of the light on the cell: between -seen - x high and seen - x low on a cell at the share x of the way from the
    axis to the rim. Any band narrower than 1 can be fitted, wherever it lies.

    Args:
        seen: highest wave number of a pixel, waves per cell.
        low: wave number of the light of the farthest source on a cell at the rim.
        high: the same of the nearest.
        aperture: the clear aperture, whose lines are as long as it is where they lie.
        good: error that may be left.

    Returns:
        the weights for shares from 0 to 1, and the root mean square of their error over DOE and window. As few as leave
        that error, ten on either side at most. Real ones for distant sources.
    """
    share = np.linspace(0, 1, _SHARES)
    waves = np.linspace(-seen - share * high, seen - share * low, 300)  # [wave, node]
    weights, error = np.zeros((_SHARES, 2), complex), np.inf
    for reach in range(1, _MOST_TAPS + 1):
        weights, error = _fitted(waves.T, np.ones_like(waves.T), reach, np.ones(_SHARES), aperture)
        if error <= good:
            break
    return (np.real(weights) if low == high == 0 else weights), error


@lru_cache(maxsize=64)
def dipole_weights(seen: float, low: float, high: float, aperture: Aperture) -> Inexact[np.ndarray, "node tap"]:
    """Weights on the cells to either side of a wall whose far field is that of its dipole.

    Arguments as of `line_weights`. The far field is 2 pi i times the sum of the wave number of light to a pixel and
    that of the light on the cell: where that is oblique, what stands higher is seen to the side. Of sources at several
    depths the middle counts. Dipoles are a fiftieth of the light, and a tenth of them may be missed.
    """
    share = np.linspace(0, 1, _SHARES)
    waves = np.linspace(-seen - share * high, seen - share * low, 300)
    onto = share * (low + high) / 2
    wanted, weights = 2j * np.pi * (waves + 2 * onto).T, np.zeros((_SHARES, 2), complex)
    scale = np.sqrt(np.mean(np.abs(wanted) ** 2))
    for reach in range(1, _MOST_TAPS + 1):
        weights, error = _fitted(waves.T, wanted, reach, 4j * np.pi * onto, aperture)
        if error <= _GOOD_DIPOLE * scale:
            break
    return np.real(weights) if low == high == 0 else weights


def _fitted(
    waves: Float[np.ndarray, "node wave"],
    wanted: Inexact[np.ndarray, "node wave"],
    reach: int,
    on_axis: Inexact[np.ndarray, " node"],
    aperture: Aperture,
) -> tuple[Complex[np.ndarray, "node tap"], float]:
    """Weights on `reach` cells to either side for a far field, and their error, the root mean square over all lines."""
    places = np.arange(-reach, reach) + 0.5
    field = np.exp(-2j * np.pi * waves[:, :, None] * places) * np.sinc(waves)[:, :, None]
    axis = np.full((len(waves), 1, 2 * reach), 1e3)  # as good as exact
    matrix = np.concatenate([field, axis], 1)
    aim = np.concatenate([wanted, 1e3 * on_axis[:, None]], 1)
    weights = (np.linalg.pinv(matrix) @ aim[:, :, None])[..., 0]
    missed = np.abs((field @ weights[:, :, None])[..., 0] - wanted) ** 2
    lengths = _lengths_at(np.linspace(0, 1, len(waves)), aperture)
    return weights, float(np.sqrt(missed.mean(1) @ lengths / lengths.sum()))


def _lengths_at(share: Float[np.ndarray, " node"], aperture: Aperture) -> Float[np.ndarray, " node"]:
    """How long lines along both axes are together, at shares of the way to the rim of the longer side; in any unit."""
    if isinstance(aperture, RoundAperture):
        return np.sqrt(1 - share**2)
    half = share * aperture.widest_m
    return sum((np.where(half <= side, other, 0.0) for side, other in permutations(aperture.extent_m)), np.zeros(1))


def _at_borders(
    weights: Inexact[np.ndarray, "node tap"], camera: Camera, axis: Literal["x", "y"]
) -> Inexact[np.ndarray, "tap border"]:
    """Weights for every border between two cells along an axis."""
    at = camera.grid.axis_m(axis)
    share = (at[1:] + at[:-1]) / camera.opening.widest_m
    place = np.minimum(np.abs(share), 1.0) * (len(weights) - 1)
    below = np.minimum(place.astype(int), len(weights) - 2)
    part = (place - below)[:, None]
    found = weights[below] * (1 - part) + weights[below + 1] * part
    # On the other side light is oblique the other way.
    return np.where(share[:, None] < 0, found.conj(), found).T
