"""From a level map and the errors of a process to a plate: `as_fabricated`."""

# Abstract fields become fields, or properties, of subclasses.
# pyright: reportIncompatibleVariableOverride=false

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, UInt8

from fab.grid import Grid
from fab.layout.polygons import run_lengths
from fab.level_map import LevelMap
from fab.levels import height_of, planes
from fab.process import MaskDisc, Process, Variation
from fab.units import distances_from, require_kind
from sim.aperture import circle_coverage, displaced_cells, open_cells, outline_of
from sim.camera import Camera, SpectralLine
from sim.metrics import in_parts, zeroth_order
from sim.optic import ViewedOptic, height_transmission
from sim.propagation.pupil import DoeRows, SourceColumns
from sim.rigorous.edge_optic import EdgeOptic, with_edges
from sim.rigorous.width_tables import HEADROOM
from sim.source import SourceMap, View
from sim.surface.lines import wall_numbers
from sim.surface.opening import Opening
from sim.surface.pieces import TILE
from sim.surface.relief import plan_of, relief_of, require_possible, view_weights
from sim.surface.roughness import cell_roughness, cell_share
from sim.surface.tiles import CellMaps, transmission_of
from sim.threads import at_once
from sim.tracing import is_traced, single, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


class FabricatedDoe(ViewedOptic):
    """A DOE as fabricated, with its chrome.

    Attributes:
        camera: lens, sensor and substrate. Its grid is that of the cells here: those of the DOE, or a whole number of
            parts of them where the sensor sees waves too oblique for moments.
        coverage: `[y, x]` open share of every cell.
        transmission: `[view, y, x]` transmission of every cell and of the chrome over it; its far field is the DOE's
            within `sim.surface.cell`'s accuracy.
        views: wavelength and depths of sources for which each transmission holds. Several for a wavelength whose light
            on a near and on a far source's way takes too wide a band.
        means: `[wavelength, y, x]` mean transmission of every cell without the chrome, for overlaps with other DOEs;
            where the plate is not as drawn 0 far under it.
        wavelengths_m: vacuum wavelengths, metres.
        level: `[y, x]` level number of every cell of the DOE as drawn.
        level_m: height of every level, metres, as drawn.
        height_m: `[y, x]` height, metres, of every cell of a DOE exactly as drawn, whose PSFs are those of its height
            map, bit for bit; otherwise None.
        source_kind: how sources are described.
    """

    camera: Camera = eqx.field(static=True)
    coverage: Float[Array, "y x"]
    transmission: Complex[Array, "view y x"]
    views: tuple[View, ...] = eqx.field(static=True)
    means: Complex[Array, "w y x"]
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)
    level: UInt8[Array, "v u"]
    level_m: Float[Array, " level"]
    height_m: Float[Array, "y x"] | None = None
    source_kind: type[SourceMap] = eqx.field(static=True, default=SourceMap)

    @property
    def grid(self) -> Grid:
        """The cells."""
        return self.camera.grid

    @property
    def drawn_m(self) -> Float[Array, "v u"]:
        """Heights as drawn."""
        return self.level_m[self.level]

    def cells(self, line: SpectralLine, source: Any) -> tuple[Array | None, Array | None]:
        """Heights as drawn, or transmission in the source's view."""
        return super().cells(line, source) if self.height_m is None else (self.height_m, None)

    def rows(self, line: SpectralLine, source: Any) -> tuple[DoeRows, SourceColumns]:
        """As of other DOEs; the transmission has the chrome already."""
        rows, columns = super().rows(line, source)
        return (rows if self.height_m is not None else rows._replace(coverage=None)), columns

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw its phase error, and the phase of its middle as drawn and as fabricated (`sim.plots.plate`)."""
        from sim.plots.plate import plot_plate

        return plot_plate(self, ax)

    def _repr_html_(self) -> str:
        """Table and picture for notebooks."""
        from fab.figure import aperture_text, html_of, length_text

        ny, nx = self.grid.shape
        orders = zeroth_order(self)
        rows = {
            "cells": f"{ny} × {nx} of {length_text(self.grid.pitch_m)}",
            "clear aperture": aperture_text(self.camera.opening),
            "substrate": self.camera.material,
            "light": self.camera.light,
            "errors": "none, as drawn" if self.height_m is not None else "as fabricated",
            **{
                f"0th order at {length_text(w)}": f"{100 * n:.3g} %"
                for w, n in zip(self.wavelengths_m, orders, strict=True)
            },
        }
        return html_of("DOE as fabricated", rows, self.plot())

    def with_camera(self, camera: Camera) -> "FabricatedDoe":
        """The same DOE before another lens or sensor; where that sees more oblique light than its own, less exact.

        Raises:
            ValueError: another aperture, substrate or kind of light, or light of walls in another polarisation.
        """
        own = self.camera
        if own.light == camera.light == "edges" and own.polarisation != camera.polarisation:
            wanted, got = own.polarisation, camera.polarisation
            raise ValueError(f"`camera` must have the polarisation that the walls are lit in, {wanted}, but got {got}")
        found = super().with_camera(camera)
        assert isinstance(found, FabricatedDoe)
        return found


def as_fabricated(
    level_map: LevelMap | UInt8[np.ndarray, "y x"],
    camera: Camera,
    process: Process,
    variation: Variation,
    wavelengths_m: tuple[float, ...] | None = None,
    *,
    depths_m: Sequence[float] = (np.inf,),
    whole_cells: bool = False,
) -> FabricatedDoe:
    """Predict the plate that the masks of a level map and a process with given errors make.

    Args:
        level_map: the DOE, or its `[y, x]` level numbers, the top level where the glass stays blank
            (`fab.level_map.LevelMap.level`).
        camera: DOE grid, clear aperture and material; lens and sensor say how oblique the light is that matters.
        process: depths of the etches and where on the wafer the DOE lies.
        variation: the errors; `Variation()` gives the nominal plate, bit for bit but with `whole_cells` and edges.
        wavelengths_m: vacuum wavelengths; all lines of the camera by default.
        depths_m: nearest and farthest depth of the sources that will be looked at, metres, and any between. They say
            how obliquely cells are lit, which matters where edges moved within them. From other depths the plate looks
            as from the nearest of these; random plates with 0.5 um of overlay are then off by up to 7 %.
        whole_cells: keep the camera's grid, for optimisers that need one for all plates. Where edges moved and the
            sensor sees light too oblique for moments of whole cells, its border is then less exact.

    Returns:
        the plate; a function of `variation` that `jax.grad` and `jax.jvp` accept.

    Raises:
        InputError: an argument of another kind, an error is not a finite number, an edge moves by more than half a cell
            through line-width bias, corners are rounded by more than half a cell, a mask is shifted by more than 8
            cells, or an error has the wrong number of masks.
        ValueError: a level map of another shape than the grid.
    """
    level_map = level_map.level if isinstance(level_map, LevelMap) else level_map
    require_kind("level_map", level_map, np.ndarray, "A design has one: design.level_map.")
    depths_m = distances_from(depths_m, "depths_m") or (np.inf,)
    require_kind("camera", camera, Camera, "A design has one: design.camera.")
    require_kind("process", process, Process, 'For example fab.process_from("contact_aligner", levels).')
    require_kind("variation", variation, Variation, "For example fab.Variation(common_depth_scale=0.02).")
    if level_map.shape != camera.grid.shape:
        raise ValueError(f"`level_map` must have the grid's shape {camera.grid.shape}, but got {level_map.shape}")
    levels = process.levels
    lines = wavelengths_m or tuple(dict.fromkeys(w for c in camera.colours for w in c.wavelengths_m))
    traced = is_traced(variation)
    waves = np.array([camera.waves_per_metre(w) for w in lines])
    rates = jnp.asarray(waves, jnp.float32)
    drawn = jnp.asarray(level_map), jnp.asarray(levels.heights_m(), jnp.float32)
    if not traced and variation.nominal and camera.light == "edges" and not whole_cells:
        height_m = height_of(level_map, levels)
        return _walled(with_edges(height_m, camera, depths_m=depths_m, wavelengths_m=lines), drawn)
    if not traced and variation.nominal and camera.light == "scalar":
        height = jnp.asarray(height_of(level_map, levels).astype(np.float32))
        flat = jnp.stack([height_transmission(height, rate) for rate in rates])
        coverage = jnp.asarray(open_cells(camera.grid, camera.opening))
        views = tuple(View(wavelength, 0.0, np.inf) for wavelength in lines)
        return FabricatedDoe(camera, coverage, coverage * flat, views, flat, lines, *drawn, height)
    if not traced:
        require_possible(camera.grid, process, variation)
    plan, views = plan_of(camera, process, variation, lines, (min(depths_m), max(depths_m)), traced, whole_cells)
    etched = planes(level_map, levels)
    for particle in variation.particles:
        _keep_off(etched, particle, camera.grid)
    widths = None
    if traced or variation.etch_lag:
        widths = np.stack(list(at_once(_widths, list(etched))))
    rough = None
    if traced or variation.roughness_m:
        rough = cell_roughness(camera.grid, variation.roughness_m, variation.correlation_m, variation.seed)
    walls = None
    if camera.light == "edges":
        walls = wall_numbers(camera, lines, _highest_m(process, variation, traced))
    relief = relief_of(process, variation, walls)
    packed = np.packbits(etched, axis=0, bitorder="little")[0]  # bit k for mask k
    left = np.ones(len(waves), np.float32)
    if traced or variation.roughness_m:
        rest = 1.0 - cell_share(variation.correlation_m / camera.grid.pitch_m)
        variance = rest * (2 * np.pi * waves * variation.roughness_m) ** 2
        left = (jnp if traced else np).exp(single(-0.5 * variance))
    along_y, along_x = (view_weights(camera, plan.parts, views, TILE, count) for count in camera.grid.shape)
    grid = _parted(camera.grid, plan.parts)
    coverage = _coverage(grid, camera, variation, traced)
    centre = stacked([single(variation.chrome_y_m), single(variation.chrome_x_m)])
    opening = Opening(centre, outline_of(camera.opening, variation.chrome_diameter_m))
    maps = CellMaps(packed, widths, rough, coverage)
    transmission, means = transmission_of(plan, (along_y, along_x), maps, relief, rates, left, opening)
    found = FabricatedDoe(replace(camera, grid=grid), coverage, transmission, views, means, lines, *drawn)
    if camera.light == "scalar":
        return found
    # Lines of light have no mean within a cell.
    return replace(found, means=found.from_afar(lines) / jnp.where(coverage > 0, coverage, 1.0))


def _widths(plane: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
    """Width of the opening that a pixel belongs to: the shorter of its runs, at most 255."""
    return np.minimum(run_lengths(plane), run_lengths(plane.T).T)


def _highest_m(process: Process, variation: Variation, traced: bool) -> float:
    """A height that no wall exceeds; errors of usual size have it in common, and what is made for it.

    Errors that are traced are not known here: the light of walls beyond is then that of the highest.
    """
    none = (0,) * process.masks
    drawn = [depth * (1 + n) for depth, n in zip(process.depths_m(), variation.repeats or none, strict=True)]
    usual = sum(drawn) or sum(process.depths_m())  # where every etch was missed there are no walls
    scales = none if traced else variation.depth_scale or none
    common = 0.0 if traced else variation.common_depth_scale
    uneven = (variation.radial_nonuniformity, variation.linear_nonuniformity_y, variation.linear_nonuniformity_x)
    most = 1.0 if traced else 1.0 + sum(map(abs, uneven))  # at the wafer's rim
    made = most * sum(abs(depth * (1 + common) * (1 + scale)) for depth, scale in zip(drawn, scales, strict=True))
    return HEADROOM * usual * max(1, int(np.ceil(made / usual / HEADROOM)))


def _walled(optic: EdgeOptic, drawn: tuple[Array, Array]) -> FabricatedDoe:
    """A DOE as drawn, levels and their heights, with its light of walls."""
    light = optic.coverage * optic.transmission
    return FabricatedDoe(optic.camera, optic.coverage, light, optic.views, optic.means, optic.wavelengths_m, *drawn)


def drawn_alike(
    level_map: UInt8[np.ndarray, "y x"],
    camera: Camera,
    process: Process,
    variation: Variation,
    *,
    depths_m: Sequence[float] = (np.inf,),
) -> FabricatedDoe:
    """The DOE as drawn, in cells and views as of one as fabricated: programs compiled for one serve the other.

    Arguments as of `as_fabricated`. Its transmission is that of the heights, which are not kept.
    """
    drawn = as_fabricated(level_map, camera, process, Variation(), depths_m=depths_m)
    if camera.light == "edges":
        return drawn  # with views of its own
    depths = min(depths_m), max(depths_m)
    plan, views = plan_of(camera, process, variation, drawn.wavelengths_m, depths, traced=False)
    means = jnp.asarray(in_parts(drawn.means, plan.parts))
    grid = _parted(camera.grid, plan.parts)
    coverage = jnp.asarray(open_cells(grid, camera.opening))
    transmission = coverage * means[np.array([number for number, _ in plan.views])]
    same = drawn.wavelengths_m, drawn.level, drawn.level_m
    return FabricatedDoe(replace(camera, grid=grid), coverage, transmission, views, means, *same)


def _parted(grid: Grid, parts: int) -> Grid:
    """The grid of `parts` by `parts` equal parts of every cell."""
    ny, nx = grid.shape
    return grid if parts == 1 else Grid((ny * parts, nx * parts), grid.pitch_m / parts)


def _keep_off(etched: UInt8[np.ndarray, "mask y x"], particle: MaskDisc, grid: Grid) -> None:
    """Close the mask pixels whose centres a particle covers, in place."""
    rows = np.flatnonzero(np.abs(grid.axis_m("y") - particle.y_m) <= particle.radius_m)
    columns = np.flatnonzero(np.abs(grid.axis_m("x") - particle.x_m) <= particle.radius_m)
    y, x = grid.axis_m("y")[rows] - particle.y_m, grid.axis_m("x")[columns] - particle.x_m
    inside = np.hypot(y[:, None], x[None, :]) <= particle.radius_m
    etched[particle.mask][np.ix_(rows, columns)] &= ~inside


def _coverage(grid: Grid, camera: Camera, variation: Variation, traced: bool) -> Array:
    chrome = (variation.chrome_y_m, variation.chrome_x_m, variation.chrome_diameter_m)
    if traced or any(chrome):
        coverage = displaced_cells(grid, camera.opening, variation.chrome_diameter_m, chrome[:2])
    else:
        coverage = jnp.asarray(open_cells(grid, camera.opening))
    for hole in variation.pinholes:
        light = circle_coverage(grid, 2 * hole.radius_m, (hole.y_m, hole.x_m))
        coverage = jnp.maximum(coverage, jnp.asarray(light))
    return coverage
