"""A process and its errors as the numbers that all tiles of a plate share."""

from dataclasses import fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from fab.grid import Grid
from fab.process import Process, Variation
from fab.units import format_length
from sim.camera import Camera
from sim.tracing import single, stacked

SETTINGS = ("repeats", "particles", "pinholes", "seed")  # what no derivative is taken of
jax.tree_util.register_dataclass(
    Variation, data_fields=[f.name for f in fields(Variation) if f.name not in SETTINGS], meta_fields=list(SETTINGS)
)

_BAND = 0.46  # waves per cell up to which second moments and their filters do


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
    rough_m: Array | None  # `[y, x]` height of the roughness, or None
    height_m: Array  # height of the blank surface above the deepest nominal floor


class TilePlan(NamedTuple):
    """Static properties of a compiled surface. Hashable."""

    grid: Grid
    masks: int
    die_m: tuple[float, float]
    parts: int
    reach: int
    band: float
    cut: bool
    corners: bool
    walls: bool


def effective_bias(relief: EtchParameters) -> Float[Array, " mask"]:
    """Growth of openings per edge, a tilted wall counted as an upright one in the middle of its slope."""
    return relief.bias_m - relief.depth_m * relief.slope / 2


# Cells by which a mask may lie off, and the usual halo: all plates whose masks lie off by less than a cell share one
# compiled program, and under a derivative the errors are not known when the halo is chosen.
_MOST, _USUAL_REACH = 8, 3


def plan_of(camera: Camera, process: Process, variation: Variation, shortest_m: float, traced: bool) -> TilePlan:
    """Plan the terms that these errors need; all of them, where the errors are not known yet (`traced`)."""
    grid = camera.grid
    reach = _USUAL_REACH
    cut = corners = walls = True
    if not traced:
        corners, walls = variation.corner_radius_m > 0, variation.sidewall_rad > 0
        shifts = np.abs(_corner_shifts_m(grid, process, variation))
        widened = bool(variation.common_cd_bias_m) or any(variation.cd_bias_m)
        cut = bool(shifts.max() > 0 or widened or corners or walls)
        # Half a cell for the bias, and a cell more for corners seen from the next one.
        reach = max(_USUAL_REACH, int(np.ceil(shifts.max() / grid.pitch_m)) + 2)
        if reach > _MOST + 2:
            rule = f"masks may lie off by at most {_MOST} cells, {format_length(_MOST * grid.pitch_m)}"
            raise InputError("variation.overlay", rule, format_length(float(shifts.max())), "Align better.")
    # Highest wave number on the sensor, in waves per DOE cell, with a margin for its last pixels.
    needed = (camera.window / 2 + 1) * camera.pixel_m * grid.pitch_m / (shortest_m * camera.sensor_distance_m)
    parts = int(np.ceil(needed / _BAND - 1e-9)) if cut else 1
    return TilePlan(
        grid, process.masks, process.die_m, parts, reach, min(needed / parts, _BAND), cut, corners, walls
    )  # fmt: skip


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


def relief_of(process: Process, variation: Variation, rough_m: Float[Array, "y x"] | None = None) -> EtchParameters:
    """The errors of one plate and the depths of its etches as the numbers that all tiles share."""
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
        rough_m=rough_m,
        height_m=single(levels.count - 1) * single(levels.step_m) if levels.is_binary else single(levels.total_m),
    )


def require_possible(grid: Grid, process: Process, variation: Variation) -> None:
    """Refuse errors that the model does not describe."""
    pitch_m, masks = grid.pitch_m, process.masks
    for name in [f.name for f in fields(Variation) if f.name not in SETTINGS] + ["repeats"]:
        value = getattr(variation, name)
        if isinstance(value, tuple) and value and len(value) != masks:
            rule = f"must have one value per mask, {masks}"
            raise InputError(f"variation.{name}", rule, len(value), "Add or remove values.")
    relief = relief_of(process, variation)
    limits = {"cd_bias": float(jnp.abs(effective_bias(relief)).max()), "corner_radius": variation.corner_radius_m}
    for name, value in limits.items():
        if value >= pitch_m / 2 * (1 + 1e-9):
            rule = f"must stay below half a cell, {format_length(pitch_m / 2)}"
            cure = "Such a process loses single pixels: draw coarser cells, or reduce the error."
            raise InputError(f"variation.{name}", rule, format_length(value), cure)
    if not 0 <= variation.sidewall_rad < np.pi / 4:
        rule = "must lie between 0 and 45 degrees from the vertical"
        raise InputError("variation.sidewall", rule, f"{np.degrees(variation.sidewall_rad):.3g} deg", "Correct it.")
