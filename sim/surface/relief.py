"""A process and its errors as the numbers that all tiles of a plate share."""

from dataclasses import fields
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline

from fab.deviations import DEVIATIONS
from fab.errors import InputError
from fab.grid import Grid
from fab.process import Process, Variation
from fab.units import format_length
from sim.camera import Camera
from sim.propagation.oblique import ObliqueWaves, oblique_waves
from sim.source import View
from sim.surface.cell import DEGREE, REACH, moment_weights
from sim.tracing import single, stacked

SETTINGS = ("repeats", "particles", "pinholes", "seed")  # what no derivative is taken of
jax.tree_util.register_dataclass(
    Variation, data_fields=[f.name for f in fields(Variation) if f.name not in SETTINGS], meta_fields=list(SETTINGS)
)

# Widest band of wave numbers, in waves per cell, that the weights of moments serve; the widest that the window alone
# may take, so that some is left for sources at different depths; the highest wave number for which moments do, and that
# for which second moments do.
_WIDEST, _WIDEST_SEEN, _HIGHEST, _HIGHEST_SECOND = 0.965, 0.93, 0.7, 0.4
_STILL_M = 1e-13  # an edge that moved by less than this has not
_NODES = 65  # from rim to rim, for which weights are fitted


class EtchParameters(NamedTuple):
    """Errors and depths as numbers."""

    depth_m: Array  # `[mask]` depth of every etch
    shift_m: Array  # `[mask, (y, x)]` displacement of every mask at the middle of the DOE
    turn: Array  # `[mask]` rotation, radians
    growth: Array  # `[mask]` magnification
    bias_m: Array  # `[mask]` growth of openings per edge
    corner_m: Array  # radius of corners
    slope: Array  # tangent of the walls' angle
    lag: Array  # share of depth lost per depth over width
    bowl: Array  # uniformity: depth share per r² (metres²)
    tilt: Array  # `[(y, x)]` depth share per metre
    height_m: Array  # height of the blank surface above the deepest nominal floor
    walls: Any = None  # their light, `sim.surface.lines.WallNumbers`, or None


class TilePlan(NamedTuple):
    """Static properties of a compiled surface. Hashable."""

    grid: Grid
    masks: int
    die_m: tuple[float, float]
    parts: int
    reach: int
    views: tuple[tuple[int, int], ...]  # wavelength of every view, and degree of the highest moments that it needs
    cut: bool
    corners: bool
    walls: bool  # tilted
    lines: bool  # of light, along walls


def effective_bias(relief: EtchParameters) -> Float[Array, " mask"]:
    """Growth of openings per edge, a tilted wall counted as an upright one in the middle of its slope."""
    return relief.bias_m - relief.depth_m * relief.slope / 2


# Cells by which a mask may lie off, and the usual halo: all plates whose masks lie off by less than a cell share one
# compiled program, and under a derivative the errors are not known when the halo is chosen.
_MOST, _USUAL_REACH = 8, 3


def plan_of(
    camera: Camera,
    process: Process,
    variation: Variation,
    wavelengths_m: tuple[float, ...],
    depths_m: tuple[float, float],
    traced: bool,
    whole_cells: bool = False,
) -> tuple[TilePlan, tuple[View, ...]]:
    """Plan the terms that these errors need, all of them where the errors are not known yet (`traced`), and the views.

    A near source lights cells obliquely. Where near and far sources together take too wide a band of wave numbers, the
    depths (the nearest and the farthest) are parted.
    """
    grid = camera.grid
    reach, lines = _USUAL_REACH, camera.light == "edges"
    cut = corners = walls = True
    if not traced:
        corners, walls = bool(variation.corner_radius_m > 0), bool(variation.sidewall_rad > 0)
        shifts = np.abs(_corner_shifts_m(grid, process, variation))
        # Masks may be drawn against the bias: what is left then is rounding, and no edge has moved.
        left = [abs(variation.common_cd_bias_m + own) for own in variation.cd_bias_m or (0.0,)]
        widened = max(left) > _STILL_M
        cut = bool(shifts.max() > 0 or widened or corners or walls or lines)
        # Half a cell for the bias, and a cell more for corners seen from the next one.
        reach = max(_USUAL_REACH, int(np.ceil(shifts.max() / grid.pitch_m)) + 2)
        if reach > _MOST + 2:
            rule = f"masks may lie off by at most {_MOST} cells, {format_length(_MOST * grid.pitch_m)}"
            raise InputError("variation.overlay", rule, format_length(float(shifts.max())), "Align better.")
    oblique = [oblique_waves(camera, wavelength, depths_m) for wavelength in wavelengths_m]
    widest = max(2 * waves.seen / _WIDEST_SEEN for waves in oblique)
    highest = max((waves.seen + max(-waves.low, waves.high, 0)) / _HIGHEST for waves in oblique)
    # Light so oblique that halves of cells do not do is next to none: their sinc has fallen to a tenth.
    parts = 1 if whole_cells else max(1, int(np.ceil(max(widest, min(highest, 2.0)) - 1e-9)))
    # Plates whose edges did not move have the same views, so that all share their compiled programs.
    views = tuple(
        view
        for wavelength, waves in zip(wavelengths_m, oblique, strict=True)
        for view in _views(wavelength, waves.over(parts), depths_m)
    )
    degrees = [
        DEGREE if (waves.seen + max(-waves.low, waves.high, 0)) / parts > _HIGHEST_SECOND else DEGREE - 1
        for waves in oblique
    ]
    numbers = [wavelengths_m.index(view.wavelength_m) for view in views]
    needed = tuple((number, degrees[number]) for number in numbers)
    parts = parts if cut else 1
    return TilePlan(grid, process.masks, process.die_m, parts, reach, needed, cut, corners, walls, lines), views


def _views(wavelength_m: float, waves: ObliqueWaves, depths_m: tuple[float, float]) -> list[View]:
    """As many views as are needed."""
    count = max(1, int(np.ceil((waves.high - waves.low) / (_WIDEST - 2 * waves.seen) - 1e-9)))
    return View.several(wavelength_m, depths_m, count)


@lru_cache(maxsize=8)  # every draw of a study needs the same
def view_weights(
    camera: Camera, parts: int, views: tuple[View, ...], tile: int, count: int
) -> Float[np.ndarray, "..."]:
    """Light that moments of a row of tiles add to cells: `[tile, view, kind, in, cell, out, cell + 2 reach]`.

    Along an axis with `count` DOE cells, of which a tile is `tile` wide; each is divided into `parts`. Kinds are those
    of `moment_weights`: of lines, with edges. `in` and `out` are real and imaginary part, of the moments and of the
    light; one place each where weights are real.
    """
    size, cells = tile * parts, count * parts
    count, radius = -(-count // tile), camera.opening.widest_m / 2 / camera.grid.pitch_m * parts
    place = (np.arange(count * size) - (cells - 1) / 2) / radius
    nodes = np.linspace(-1, 1, _NODES)
    found = []
    for view in views:
        waves = oblique_waves(camera, view.wavelength_m, (view.nearest_m, view.farthest_m)).over(parts)
        lit = nodes * waves.low, nodes * waves.high
        slope = (waves.low + waves.high) / 2 / radius
        bands = -waves.seen - np.maximum(*lit), waves.seen - np.minimum(*lit)
        weights = moment_weights(*bands, slope)
        every = make_interp_spline(nodes, weights, k=1)(np.clip(place, -1, 1))
        # Within reach of the grid's border there are fewer cells around.
        for cell in {*range(min(REACH, cells)), *range(max(cells - REACH, 0), cells)}:
            low, high = (np.interp(place[cell : cell + 1], nodes, edge) for edge in bands)
            every[cell] = moment_weights(low, high, slope, (max(-cell, -REACH), min(cells - 1 - cell, REACH)))[0]
        found.append(every[:, : DEGREE if camera.light == "scalar" else None])
    weights = np.moveaxis(np.stack(found).reshape(len(views), count, size, *found[0].shape[1:]), 0, 1)
    spread = np.zeros((count, len(views), weights.shape[3], size, size + 2 * REACH), complex)
    for cell in range(size):
        spread[..., cell, cell : cell + 2 * REACH + 1] = weights[:, :, cell]
    real, imaginary = np.real(spread).astype(np.float32), np.imag(spread).astype(np.float32)
    if np.abs(imaginary).max() < 1e-6:
        return real[:, :, :, None, :, None]
    return np.stack([np.stack([real, imaginary], -2), np.stack([-imaginary, real], -2)], 3)


def _corner_shifts_m(grid: Grid, process: Process, variation: Variation) -> np.ndarray:
    """Largest displacements of every mask over the DOE."""
    zeros = (0.0,) * process.masks
    half_y, half_x = (extent / 2 for extent in grid.extent_m)
    y, x = (abs(d) + half for d, half in zip(process.die_m, (half_y, half_x), strict=True))
    turn, growth = (np.abs(v or zeros) for v in (variation.rotation_rad, variation.magnification))
    return np.stack(
        [
            np.abs(variation.overlay_y_m or zeros) + growth * y + turn * x,
            np.abs(variation.overlay_x_m or zeros) + growth * x + turn * y,
        ]
    )


def relief_of(
    process: Process,
    variation: Variation,
    walls: Any = None,
) -> EtchParameters:
    """The errors of one plate, the depths of its etches and the light of its walls as the numbers that tiles share."""
    masks, levels = process.masks, process.levels

    # Known errors are numbers of the host: one by one, the operations below would take a second to compile.
    def per_mask(value: tuple[float | Array, ...]) -> Any:
        return stacked([single(v) for v in value or (0.0,) * masks])

    repeats = np.asarray(variation.repeats or (0,) * masks)
    nominal = np.asarray(process.depths_m())
    scale = (1.0 + variation.common_depth_scale) * (1.0 + per_mask(variation.depth_scale))
    y, x = process.die_m
    turn, growth = per_mask(variation.rotation_rad), per_mask(variation.magnification)
    shift = [
        per_mask(variation.overlay_y_m) + growth * y + turn * x,
        per_mask(variation.overlay_x_m) + growth * x - turn * y,
    ]
    radius = process.wafer_radius_m
    tilt = stacked([single(variation.linear_nonuniformity_y), single(variation.linear_nonuniformity_x)])
    return EtchParameters(
        depth_m=(nominal * (1 + repeats)).astype(np.float32) * scale,
        shift_m=stacked(shift, 1),
        turn=turn,
        growth=growth,
        bias_m=single(variation.common_cd_bias_m) + per_mask(variation.cd_bias_m),
        corner_m=single(variation.corner_radius_m),
        slope=jnp.tan(single(variation.sidewall_rad)),
        lag=single(variation.etch_lag),
        bowl=single(variation.radial_nonuniformity) / radius**2,
        tilt=tilt * (np.float32(1) / np.float32(radius)),
        height_m=single(levels.count - 1) * single(levels.step_m) if levels.is_binary else single(levels.total_m),
        walls=walls,
    )


def _require_numbers(variation: Variation, masks: int) -> None:
    """Raise an InputError for errors that are no numbers, or one number where every mask has its own."""
    for name, deviation in DEVIATIONS.items():
        value = getattr(variation, name)
        if deviation.per_mask and not isinstance(value, tuple):
            example = ", ".join(["1e-6" if deviation.unit == "m" else "1e-3", *["0.0"] * (masks - 1)])
            cure = f"For example ({example},)." if masks == 1 else f"For example ({example})."
            raise InputError(f"variation.{name}", f"must have one value per mask, {masks}", repr(value), cure)
        for one in value if deviation.per_mask else [value]:
            if isinstance(one, str) or np.ndim(one) or np.asarray(one).dtype.kind not in "fiu":
                unit = {"m": "metres", "rad": "radians", "1": "a share, 0.03 for 3 %"}[deviation.unit]
                raise InputError(f"variation.{name}", f"must be a number, {unit}", repr(one), "Give SI units.")


def require_possible(grid: Grid, process: Process, variation: Variation) -> None:
    """Refuse errors that the model does not describe."""
    pitch_m, masks = grid.pitch_m, process.masks
    _require_numbers(variation, masks)
    for name in [f.name for f in fields(Variation) if f.name not in SETTINGS] + ["repeats"]:
        value = getattr(variation, name)
        if isinstance(value, tuple) and value and len(value) != masks:
            rule = f"must have one value per mask, {masks}"
            raise InputError(f"variation.{name}", rule, len(value), "Add or remove values.")
    relief = relief_of(process, variation)
    limits = {"cd_bias": float(jnp.abs(effective_bias(relief)).max()), "corner_radius": variation.corner_radius_m}
    for name, value in limits.items():
        if value >= pitch_m / 2 * (1 + 1e-9):
            rule = f"must be at most half a cell, {format_length(pitch_m / 2)}"
            cure = "Such a process loses single pixels: draw coarser cells, or reduce the error."
            raise InputError(f"variation.{name}", rule, format_length(value), cure)
    if not 0 <= variation.sidewall_rad < np.pi / 4:
        rule = "must lie between 0 and 45 degrees from the vertical"
        raise InputError("variation.sidewall", rule, f"{np.degrees(variation.sidewall_rad):.3g} deg", "Correct it.")
    for name, deviation in DEVIATIONS.items():
        for value in np.ravel(getattr(variation, name)):
            if not np.isfinite(value):
                raise InputError(f"variation.{name}", "must be finite", value, "Correct it.")
            if deviation.source == "depth" and value < -1:
                rule = "no etch is shallower than nothing: must be -1 or more"
                raise InputError(f"variation.{name}", rule, value, "Give a share, -0.02 for 2 % too shallow.")
            if deviation.one_sided and value < 0:  # it would be taken for 0, or for its opposite
                raise InputError(f"variation.{name}", "must not be negative", value, "Give 0 or more.")
