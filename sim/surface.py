"""The plate that comes back from the cleanroom, as light sees it. The only model of the process.

`as_fabricated` takes what is drawn (a level map, split into masks here), a process and the errors of one plate
(`fab.process.Variation`) and returns the transmission of every DOE cell. Nothing is oversampled: displaced and widened
masks cut each cell into a few pieces of constant depth whose light is added exactly (`sim.cell`), rounded corners
and tilted walls add what they change at the vertices and along the lines between the pieces, and slow errors
(uniformity, rotation, magnification) are constants of tiles of 32 x 32 cells. Everything is differentiable in every
floating-point error.

How each error enters:

* depth, missed and doubled etches, uniformity: the depth a mask takes away; the bottom profile follows the top's.
* overlay, rotation, magnification, line width: where the masks' edges lie. A mask pixel narrower than twice a negative
  bias is lost, a gap narrower than twice a positive one closes.
* corner rounding: (1 - pi/4) r^2 of area at every corner of an opening or an island; two openings that touch at a
  corner neither merge nor part.
* side walls: floors are narrower than the drawn opening by depth x tan(angle) at each wall, depth falls linearly.
* etch lag: an opening of width w loses the share lag x depth / w of its depth; w is the shorter of its runs along x and
  y as drawn.
* roughness: a random height for every cell with the given rms and correlation length; what varies within a cell is
  light lost to angles beyond the sensor, exp(-variance / 2) of the amplitude.
* particles keep an etch off the mask's pixels whose centres they cover. Chrome: the opening's circle, and pinholes.
"""

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Complex, Float, Int, UInt8

from fab.errors import InputError
from fab.grid import Grid
from fab.levels import height_of
from fab.masks import planes
from fab.process import MaskDisc, Process, Variation
from fab.units import format_length
from sim.aperture import circle_coverage, displaced_circle_coverage
from sim.camera import Camera
from sim.cell import (
    DEGREES,
    FILTER_REACH,
    Cuts,
    axis_moments,
    axis_values,
    cuts,
    moment_filter,
    plane_moments,
    point_moments,
    whole_cell,
)
from sim.pupil import cis
from sim.roughness import cell_roughness

_SETTINGS = ("repeats", "particles", "pinholes", "seed")  # what no derivative is taken of
jax.tree_util.register_dataclass(
    Variation,
    data_fields=[f.name for f in fields(Variation) if f.name not in _SETTINGS],
    meta_fields=list(_SETTINGS),
)

_TILE = 32  # cells
_BAND = 0.46  # waves per cell up to which second moments and their filters do
_PRECISION = jax.lax.Precision.HIGHEST


class Surface(eqx.Module):
    """A plate with its chrome.

    Attributes:
        transmission: `[wavelength, y, x]` complex transmission of every cell, without the chrome; its far field is
            that of the plate within `sim.cell`'s accuracy, and its mean is the plate's.
        coverage: `[y, x]` open share of every cell.
        grid: the cells: those of the DOE, or a whole number of parts of them where the sensor sees waves too
            oblique for moments.
        wavelengths_m: vacuum wavelengths.
    """

    transmission: Complex[Array, "w y x"]
    coverage: Float[Array, "y x"]
    grid: Grid = eqx.field(static=True)
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)

    def at(self, wavelength_m: float) -> Complex[Array, "y x"]:
        """Transmission at one of the wavelengths."""
        return self.transmission[self.wavelengths_m.index(wavelength_m)]


class _Relief(NamedTuple):
    """What all tiles share; leaves that are None are not needed.

    Attributes:
        depth_m: `[mask]` depth of every etch.
        shift_m: `[mask, (y, x)]` displacement of every mask at the middle of the DOE.
        turn: `[mask]` rotation, radians.
        growth: `[mask]` magnification.
        bias_m: `[mask]` growth of openings per edge.
        corner_m: radius of corners.
        slope: tangent of the walls' angle.
        lag: share of depth lost per depth over width.
        bowl: uniformity: depth share per r² (metres²).
        tilt: `[(y, x)]` depth share per metre.
        rough_m: `[y, x]` height of the roughness, or None.
        height_m: height of the blank surface above the deepest nominal floor.
    """

    depth_m: Array
    shift_m: Array
    turn: Array
    growth: Array
    bias_m: Array
    corner_m: Array
    slope: Array
    lag: Array
    bowl: Array
    tilt: Array
    rough_m: Array | None
    height_m: Array


class _Plan(NamedTuple):
    """What a compiled surface depends on besides its arrays. Hashable."""

    grid: Grid
    masks: int
    die_m: tuple[float, float]
    parts: int
    reach: int
    band: float
    cut: bool
    corners: bool
    walls: bool


def as_fabricated(
    level_map: UInt8[np.ndarray, "y x"],
    camera: Camera,
    process: Process,
    variation: Variation,
    wavelengths_m: tuple[float, ...] | None = None,
) -> Surface:
    """Predict the plate that the masks of a level map and a process with given errors make.

    Args:
        level_map: `[y, x]` level numbers, the top level where the glass stays blank (`fab.masks.unetched_outside`).
        camera: DOE grid, clear aperture and material; the sensor says how oblique the light is that matters.
        process: depths of the etches and where on the wafer the DOE lies.
        variation: the errors; `Variation()` gives the nominal plate bit for bit.
        wavelengths_m: vacuum wavelengths; all lines of the camera by default.

    Returns:
        the plate; a function of `variation` that `jax.grad` and `jax.jvp` accept.

    Raises:
        InputError: an edge moves by half a cell or more through line-width bias, corners are rounded by more than
            half a cell, a mask is shifted by more than 8 cells, or an error has the wrong number of masks.
    """
    levels = process.levels
    lines = wavelengths_m or tuple(dict.fromkeys(w for c in camera.colours for w in c.wavelengths_m))
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(variation))
    rates = jnp.asarray([camera.waves_per_metre(w) for w in lines], jnp.float32)
    if not traced and variation.nominal:
        height = jnp.asarray(height_of(level_map, levels).astype(np.float32))
        flat = jnp.stack([jax.jit(_flat)(height, rate) for rate in rates])
        return Surface(flat, jnp.asarray(circle_coverage(camera.grid, camera.aperture_m)), camera.grid, lines)
    if not traced:
        _require_possible(camera.grid, process, variation)
    plan = _plan(camera, process, variation, min(lines), traced)
    etched = planes(level_map, levels)
    for particle in variation.particles:
        _keep_off(etched, particle, camera.grid)
    widths = _opening_widths(etched) if traced or variation.etch_lag else None
    relief = _relief(camera.grid, process, variation, traced)
    transmission = _transmission(_packed(etched), widths, relief, rates, plan)
    loss = _subcell_loss(variation, camera.grid.pitch_m, rates, traced)
    if loss is not None:
        transmission = transmission * loss[:, None, None]
    grid = _refined(camera.grid, plan.parts)
    return Surface(transmission, _coverage(grid, camera, variation, traced), grid, lines)


def _flat(height_m: Array, rate: Array) -> Array:
    return cis(height_m * rate)


def _refined(grid: Grid, parts: int) -> Grid:
    return grid if parts == 1 else Grid((grid.shape[0] * parts, grid.shape[1] * parts), grid.pitch_m / parts)


def _require_possible(grid: Grid, process: Process, variation: Variation) -> None:
    pitch_m, masks = grid.pitch_m, process.masks
    for name in [f.name for f in fields(Variation) if f.name not in _SETTINGS] + ["repeats"]:
        value = getattr(variation, name)
        if isinstance(value, tuple) and value and len(value) != masks:
            rule = f"must have one value per mask, {masks}"
            raise InputError(f"variation.{name}", rule, len(value), "Add or remove values.")
    relief = _relief(grid, process, variation, traced=False)
    limits = {
        "cd_bias": float(jnp.abs(_effective_bias(relief)).max()),
        "corner_radius": variation.corner_radius_m,
    }
    for name, value in limits.items():
        if value >= pitch_m / 2 * (1 + 1e-9):
            rule = f"must stay below half a cell, {format_length(pitch_m / 2)}"
            cure = "Such a process loses single pixels: draw coarser cells, or reduce the error."
            raise InputError(f"variation.{name}", rule, format_length(value), cure)
    if not 0 <= variation.sidewall_rad < np.pi / 4:
        rule = "must lie between 0 and 45 degrees from the vertical"
        raise InputError("variation.sidewall", rule, f"{np.degrees(variation.sidewall_rad):.3g} deg", "Mend it.")


# Cells by which a mask may lie off; under a derivative the errors are not known when the halo is chosen.
_MOST, _TRACED_REACH = 8, 3


def _plan(camera: Camera, process: Process, variation: Variation, shortest_m: float, traced: bool) -> _Plan:
    grid = camera.grid
    reach = _TRACED_REACH
    cut = corners = walls = True
    if not traced:
        corners, walls = variation.corner_radius_m > 0, variation.sidewall_rad > 0
        shifts = np.abs(_corner_shifts_m(grid, process, variation))
        widened = bool(variation.common_cd_bias_m) or any(variation.cd_bias_m)
        cut = bool(shifts.max() > 0 or widened or corners or walls)
        # Half a cell for the bias, and a cell more for corners seen from the next one.
        reach = int(np.ceil(shifts.max() / grid.pitch_m)) + 2
        if reach > _MOST + 2:
            rule = f"masks may lie off by at most {_MOST} cells, {format_length(_MOST * grid.pitch_m)}"
            raise InputError("variation.overlay", rule, format_length(float(shifts.max())), "Align better.")
    needed = _widest_band(camera, shortest_m)
    parts = int(np.ceil(needed / _BAND - 1e-9)) if cut else 1
    return _Plan(
        grid, process.masks, process.die_m, parts, reach, min(needed / parts, _BAND), cut, corners, walls
    )  # fmt: skip


def _widest_band(camera: Camera, wavelength_m: float) -> float:
    """Highest wave number on the sensor, in waves per DOE cell, with a margin for its last pixels."""
    half = (camera.window / 2 + 1) * camera.pixel_m
    return half * camera.grid.pitch_m / (wavelength_m * camera.sensor_distance_m)


def _per_mask(value: tuple[float, ...], masks: int) -> Array:
    return jnp.asarray(jnp.stack([jnp.asarray(v, jnp.float32) for v in value]) if value else jnp.zeros(masks))


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


def _relief(grid: Grid, process: Process, variation: Variation, traced: bool) -> _Relief:
    masks = process.masks
    per_mask = partial(_per_mask, masks=masks)
    repeats = np.asarray(variation.repeats or (0,) * masks)
    nominal = np.asarray(process.depths_m())
    scale = (1.0 + variation.common_depth_scale) * (1.0 + per_mask(variation.depth_scale))
    y, x = process.die_m
    turn, growth = per_mask(variation.rotation_rad), per_mask(variation.magnification)
    shift = jnp.stack(
        [
            per_mask(variation.overlay_y_m) + growth * y + turn * x,
            per_mask(variation.overlay_x_m) + growth * x - turn * y,
        ],
        axis=1,
    )
    radius = process.wafer_radius_m
    tilt = jnp.stack([jnp.asarray(variation.linear_nonuniformity_y), jnp.asarray(variation.linear_nonuniformity_x)])
    rough = None
    if traced or variation.roughness_m:
        rough = cell_roughness(grid, variation.roughness_m, variation.correlation_m, variation.seed)
    return _Relief(
        depth_m=jnp.asarray((nominal * (1 + repeats)).astype(np.float32)) * scale,
        shift_m=shift,
        turn=turn,
        growth=growth,
        bias_m=jnp.asarray(variation.common_cd_bias_m, jnp.float32) + per_mask(variation.cd_bias_m),
        corner_m=jnp.asarray(variation.corner_radius_m, jnp.float32),
        slope=jnp.tan(jnp.asarray(variation.sidewall_rad, jnp.float32)),
        lag=jnp.asarray(variation.etch_lag, jnp.float32),
        bowl=jnp.asarray(variation.radial_nonuniformity, jnp.float32) / radius**2,
        tilt=tilt / radius,
        rough_m=rough,
        height_m=jnp.float32(process.levels.count - 1) * jnp.float32(process.levels.step_m),
    )


def _packed(etched: UInt8[np.ndarray, "mask y x"]) -> UInt8[np.ndarray, "y x"]:
    """All masks of a pixel in one number, bit k for mask k."""
    out = np.zeros(etched.shape[1:], np.uint8)
    for mask, plane in enumerate(etched):
        out |= plane << np.uint8(mask)
    return out


def _keep_off(etched: UInt8[np.ndarray, "mask y x"], particle: MaskDisc, grid: Grid) -> None:
    """Close the mask pixels whose centres a particle covers, in place."""
    rows = np.flatnonzero(np.abs(grid.axis_m("y") - particle.y_m) <= particle.radius_m)
    columns = np.flatnonzero(np.abs(grid.axis_m("x") - particle.x_m) <= particle.radius_m)
    y, x = grid.axis_m("y")[rows] - particle.y_m, grid.axis_m("x")[columns] - particle.x_m
    inside = np.hypot(y[:, None], x[None, :]) <= particle.radius_m
    etched[particle.mask][np.ix_(rows, columns)] &= ~inside


def _opening_widths(etched: UInt8[np.ndarray, "mask y x"]) -> UInt8[np.ndarray, "mask y x"]:
    """Width in pixels of the opening that every open pixel belongs to: the shorter of its runs, at most 255."""
    from fab.polygons import run_lengths

    return np.stack([np.minimum(run_lengths(plane), run_lengths(plane.T).T) for plane in etched])


def _subcell_loss(variation: Variation, pitch_m: float, rates: Array, traced: bool) -> Array | None:
    """Amplitude left after the roughness within a cell."""
    if not traced and not variation.roughness_m:
        return None
    from sim.roughness import cell_share

    rest = 1.0 - cell_share(jnp.asarray(variation.correlation_m, jnp.float32) / pitch_m)
    return jnp.exp(-0.5 * rest * (2 * jnp.pi * rates * variation.roughness_m) ** 2)


def _coverage(grid: Grid, camera: Camera, variation: Variation, traced: bool) -> Array:
    chrome = (variation.chrome_y_m, variation.chrome_x_m, variation.chrome_diameter_m)
    if traced or any(chrome):
        diameter = camera.aperture_m + variation.chrome_diameter_m
        coverage = displaced_circle_coverage(grid, diameter, chrome[:2])
    else:
        coverage = jnp.asarray(circle_coverage(grid, camera.aperture_m))
    for hole in variation.pinholes:
        light = circle_coverage(grid, 2 * hole.radius_m, (hole.y_m, hole.x_m))
        coverage = jnp.maximum(coverage, jnp.asarray(light))
    return coverage


@partial(jax.jit, static_argnames=("plan",))
def _transmission(
    etched: UInt8[Array, "y x"],
    widths: UInt8[Array, "mask y x"] | None,
    relief: _Relief,
    rates: Float[Array, " w"],
    plan: _Plan,
) -> Complex[Array, "w v u"]:
    """Transmission of every cell, tile by tile, with the far field of the whole plate within the band."""
    ny, nx = plan.grid.shape
    count_y, count_x = -(-ny // _TILE), -(-nx // _TILE)
    halo = ((plan.reach, plan.reach + count_y * _TILE - ny), (plan.reach, plan.reach + count_x * _TILE - nx))
    etched = jnp.pad(etched, halo)
    widths = None if widths is None else jnp.pad(widths, ((0, 0), *halo))
    rough = None if relief.rough_m is None else jnp.pad(relief.rough_m, [(0, after - plan.reach) for _, after in halo])

    def tile(start_y: Array, start_x: Array) -> Array:
        side = _TILE + 2 * plan.reach
        bits = jax.lax.dynamic_slice(etched, (start_y, start_x), (side, side))
        masks = (bits[None] >> jnp.arange(plan.masks, dtype=jnp.uint8)[:, None, None]) & 1
        states = masks.astype(jnp.float32)
        if widths is not None:
            width = jax.lax.dynamic_slice(widths, (0, start_y, start_x), (plan.masks, side, side)).astype(jnp.float32)
            lost = relief.lag * relief.depth_m[:, None, None] / (jnp.maximum(width, 1.0) * plan.grid.pitch_m)
            states = states * jnp.clip(1.0 - lost, 0.0, 1.0)
        bump = None if rough is None else jax.lax.dynamic_slice(rough, (start_y, start_x), (_TILE, _TILE))
        return _tile_moments(states, relief, bump, (start_y, start_x), rates, plan)

    def strip(start_y: Array) -> Array:
        starts = jnp.arange(count_x) * _TILE
        moments = jax.lax.map(jax.checkpoint(lambda start_x: tile(start_y, start_x)), starts)
        return _strip_values(moments, plan)

    strips = jax.lax.map(strip, jnp.arange(count_y) * _TILE)
    return _joined(strips)[:, : ny * plan.parts, : nx * plan.parts]


def _tile_moments(
    states: Float[Array, "mask side side"],
    relief: _Relief,
    bump: Float[Array, "t t"] | None,
    start: tuple[Array, Array],
    rates: Float[Array, " w"],
    plan: _Plan,
) -> Float[Array, "moment 2 w t t"]:
    """Moments of the transmission of one tile's cells (`sim.cell.plane_moments` says which)."""
    pitch, tile = plan.grid.pitch_m, _TILE
    ny, nx = plan.grid.shape
    middle_y = (start[0] + (tile - ny) / 2) * pitch
    middle_x = (start[1] + (tile - nx) / 2) * pitch
    if plan.cut:
        bias = _effective_bias(relief) / pitch
        along_y = cuts((relief.shift_m[:, 0] + relief.growth * middle_y + relief.turn * middle_x) / pitch, bias)
        along_x = cuts((relief.shift_m[:, 1] + relief.growth * middle_x - relief.turn * middle_y) / pitch, bias)
        around = _STATES if plan.corners else range(3)
        kinds = jax.lax.map(
            lambda k: _mask_states(states[k], along_y, along_x, k, bias[k], around, plan), jnp.arange(plan.masks)
        )
        own = slice(-around[0], 3 - around[0])
        pieces = kinds[:, own, own]
    else:
        along_y = along_x = whole_cell(plan.masks)
        inner = states[:, plan.reach : plan.reach + tile, plan.reach : plan.reach + tile]
        pieces = kinds = jnp.broadcast_to(inner[:, None, None], (plan.masks, 3, 3, tile, tile))
    chosen_y, chosen_x = (jax.nn.one_hot(c.state, 3, axis=1) for c in (along_y, along_x))
    taken = relief.depth_m[:, None, None, None, None] * jnp.einsum("kia,kjb->kijab", chosen_y, chosen_x)
    segments = along_y.state.shape[1], along_x.state.shape[1]
    taken = jnp.transpose(taken, (3, 4, 0, 1, 2)).reshape(segments[0] * segments[1], -1)
    depth = jnp.dot(taken, pieces.reshape(-1, tile * tile), precision=_PRECISION)
    axis = (jnp.arange(tile) - (tile - 1) / 2) * pitch
    y, x = middle_y + plan.die_m[0] + axis[:, None], middle_x + plan.die_m[1] + axis[None, :]
    uniform = 1.0 + relief.bowl * (y * y + x * x) + relief.tilt[0] * y + relief.tilt[1] * x
    depth = depth * uniform.reshape(-1)
    height = relief.height_m - depth
    if bump is not None:
        height = height + bump.reshape(-1)
    light = _light(height, rates)
    weights = plane_moments(axis_moments(along_y.edges, plan.parts), axis_moments(along_x.edges, plan.parts))
    moments = _summed(weights, light)
    if plan.walls:
        moments = moments + _walls(light, depth, along_y, along_x, relief, rates, plan)
    if plan.corners:
        kinds = kinds.reshape(*kinds.shape[:3], -1) > 0
        moments = moments + _corners(light, kinds, along_y, along_x, relief, rates, plan)
    return moments.reshape(*moments.shape[:3], tile, tile)


def _effective_bias(relief: _Relief) -> Float[Array, " mask"]:
    """Growth of openings per edge, a tilted wall counted as an upright one in the middle of its slope."""
    return relief.bias_m - relief.depth_m * relief.slope / 2


@jax.custom_jvp
def _light(height: Float[Array, "p c"], rates: Float[Array, " w"]) -> Float[Array, "p 2 w c"]:
    """Transmission of every piece, real and imaginary part apart, so that all sums over pieces are real products.

    One sine of the phase and of the phase plus a quarter, to 4e-6 like `sim.pupil.cis`: a single expression without
    complex numbers compiles to a loop several times faster.
    """
    waves = height[:, None] * rates[None, :, None]
    waves = jnp.stack([waves + 0.25, waves], axis=1)
    waves = waves - jnp.round(waves)
    folded = jnp.copysign(0.25 - jnp.abs(jnp.abs(waves) - 0.25), waves)
    z = folded * folded
    return folded * (6.2831853 + z * (-41.341702 + z * (81.605249 + z * (-76.704978 + z * 42.058))))


@_light.defjvp
def _light_tangent(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    height, rates = primals
    light = _light(height, rates)
    phase = 2 * np.pi * (tangents[0][:, None] * rates[None, :, None] + height[:, None] * tangents[1][None, :, None])
    return light, _turned(light) * phase[:, None]


def _turned(light: Float[Array, "... 2 w c"]) -> Float[Array, "... 2 w c"]:
    """The light times i."""
    return jnp.flip(light, -3) * jnp.array([-1.0, 1.0])[:, None, None]


class _Pair(NamedTuple):
    """Complex numbers as two real arrays, for loops that the compiler can vectorise."""

    real: Array
    imaginary: Array

    def times(self, other: "_Pair") -> "_Pair":
        return _Pair(
            self.real * other.real - self.imaginary * other.imaginary,
            self.real * other.imaginary + self.imaginary * other.real,
        )

    def plus(self, other: "_Pair", factor: Array) -> "_Pair":
        return _Pair(self.real + factor * other.real, self.imaginary + factor * other.imaginary)

    def each(self, work: Callable[..., Array]) -> "_Pair":
        return _Pair(work(self.real), work(self.imaginary))


def _weighted(weights: Float[Array, "m ..."], values: Float[Array, "... w c"]) -> Float[Array, "m w c"]:
    """Sum over pieces (or lines, or crossings) of values times each row of weights."""
    rows, rest = weights.shape[0], values.shape[-2:]
    product = jnp.dot(weights.reshape(rows, -1), values.reshape(-1, np.prod(rest)), precision=_PRECISION)
    return product.reshape(rows, *rest)


def _summed(weights: Float[Array, "m ..."], light: Float[Array, "... 2 w c"]) -> Float[Array, "m 2 w c"]:
    """The same for both parts of light."""
    rows, rest = weights.shape[0], light.shape[-3:]
    product = jnp.dot(weights.reshape(rows, -1), light.reshape(-1, np.prod(rest)), precision=_PRECISION)
    return product.reshape(rows, *rest)


# States of a mask along an axis: 0, 1 and 2 are before, between and behind its lines in the cell; 2 is also the first
# of the next cell, and so on.
_STATES = range(-2, 5)


def _mask_states(
    state: Float[Array, "side side"],
    along_y: Cuts,
    along_x: Cuts,
    mask: Int[Array, ""],
    bias: Float[Array, ""],
    kinds: range,
    plan: _Plan,
) -> Float[Array, "j i t t"]:
    """What is left open of one mask in each of its kinds of piece, for all cells of a tile.

    Args:
        state: the mask's pixels with a halo.
        along_y: where its lines are along y.
        along_x: where they are along x.
        mask: its number.
        bias: growth of openings; only its sign counts here.
        kinds: the states along either axis.
        plan: for the width of the halo.
    """
    cell, within = (np.array(part) for part in zip(*(divmod(kind, 2) for kind in kinds), strict=True))

    def seen(along: Cuts) -> tuple[Array, Array]:
        return plan.reach + along.low[mask, within] + cell, plan.reach + along.high[mask, within] + cell

    def joined(of: Array, pixels: tuple[Array, Array], axis: int) -> Array:
        first, second = (jax.lax.dynamic_slice_in_dim(of, pixel, _TILE, axis) for pixel in pixels)
        return jnp.where(bias >= 0, jnp.maximum(first, second), jnp.minimum(first, second))

    # Loops compile to copies of rows; side by side in one expression, every element would look for its piece.
    across = jax.lax.map(lambda pixels: joined(state, pixels, 1), seen(along_x))
    return jax.lax.map(lambda pixels: joined(across, pixels, 1), seen(along_y))


def _walls(
    light: Float[Array, "p 2 w c"],
    depth: Float[Array, "p c"],
    along_y: Cuts,
    along_x: Cuts,
    relief: _Relief,
    rates: Float[Array, " w"],
    plan: _Plan,
) -> Float[Array, "m 2 w c"]:
    """What tilted walls do besides shifting the wall (`_effective_bias`), along every line.

    On a strip of width depth tan(angle) the light of the floor, B (1 above), is replaced by the mean over the slope,
    A = exp(-i pi d) sinc(d), d being the etch's depth in waves. (A - B) = (B - 1) (-1/2 + i g) with
    g = (sinc d - cos(pi d)) / (2 sin(pi d)): the -1/2 is a wall moved by half the strip, the rest is added here. It is
    a small part of a small strip, so along the wall the cell is taken to be as in its longest segment.
    """
    segments = along_y.state.shape[1], along_x.state.shape[1]
    lit = light.reshape(*segments, *light.shape[1:])
    deep = depth.reshape(*segments, -1)
    waves = rates[:, None] * relief.depth_m[None, :]  # [w, mask]
    sine = jnp.sin(jnp.pi * waves)
    # At whole waves there is no step for the formula to scale.
    bounded = jnp.where(jnp.abs(sine) < 1e-2, 1e-2, sine)
    quadrature = jnp.where(waves == 0, 0.0, (jnp.sinc(waves) - jnp.cos(jnp.pi * waves)) / (2 * bounded))
    strength = quadrature * relief.depth_m * relief.slope / plan.grid.pitch_m  # [w, mask], cells

    def over(across: Cuts, along: Cuts, axis: int) -> Array:
        longest = jnp.argmax(jnp.diff(along.edges))
        lit_there, deep_there = (
            jax.lax.dynamic_index_in_dim(a, longest, 1 - axis, keepdims=False) for a in (lit, deep)
        )
        toward_floor = jnp.diff(lit_there, axis=0) * jnp.sign(jnp.diff(deep_there, axis=0))[:, None, None]
        owner = jnp.zeros((plan.masks, across.edges.shape[0] - 2))
        owner = owner.at[jnp.arange(plan.masks)[:, None], across.line].add(1.0)
        # A strip's share of a part of the cell is as many times larger as the part is smaller.
        points, lengths = axis_values(across.edges[1:-1], plan.parts), axis_moments(jnp.array([0.0, 1.0]), plan.parts)
        weights = plane_moments(points, lengths) if axis == 0 else plane_moments(lengths, points)
        return _summed(weights, toward_floor * (owner.T @ strength.T)[:, None, :, None])

    return _turned(over(along_y, along_x, 0) + over(along_x, along_y, 1))


# Where the middle of the area between a square corner and its rounding lies, along each axis, in radii.
_CORNER_MIDDLE = (1 / 2 - np.pi / 4 * (1 - 4 / (3 * np.pi))) / (1 - np.pi / 4)
_SIDE_Y, _SIDE_X = np.indices((2, 2)).reshape(2, -1)  # of a crossing: 0 below the line, 1 above


def _corners(
    light: Float[Array, "p 2 w c"],
    kinds: Bool[Array, "mask j i c"],
    along_y: Cuts,
    along_x: Cuts,
    relief: _Relief,
    rates: Float[Array, " w"],
    plan: _Plan,
) -> Float[Array, "m 2 w c"]:
    """What rounding changes where exactly one of the four pieces around a crossing of a mask's lines differs.

    The odd piece loses (1 - pi/4) r^2 to the state of its neighbours in that mask, in the middle of that area, with the
    other masks as they are there; where several masks have the same corner they change it together. Every crossing is
    looked at from its four sides; seen from a side that lies in the next cell, it is a crossing of that cell.
    """
    radius = relief.corner_m / plan.grid.pitch_m
    bias = _effective_bias(relief) / plan.grid.pitch_m
    # Openings that touch at a corner: rounding takes from both what it gives to both gaps, unless the bias has clearly
    # joined or parted them.
    apart = jnp.clip(2 * jnp.abs(bias) / jnp.maximum(radius, 1e-6), 0.0, 1.0)
    shared = _shared_corners(along_y, along_x, bias, radius)
    segments_x = along_x.state.shape[1]

    def looked_at(mask_and_opening: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        k, opening = mask_and_opening
        crossing = _crossings(kinds[k], along_y, along_x, k, opening, bias[k], _CORNER_MIDDLE * radius)
        amount = crossing.odd * jnp.where(crossing.touching, apart[k], 1.0)
        return crossing.y, crossing.x, amount, light[crossing.row * segments_x + crossing.column]

    # A loop, because its results exist: fused into what follows, they would be computed again for every colour.
    masks, openings = np.indices((plan.masks, 2)).reshape(2, -1)
    ys, xs, amounts, found = jax.lax.map(looked_at, (masks, openings > 0))
    total, earlier = jnp.zeros(()), []
    for k in range(plan.masks):
        # What the masks before this one change on each side, and with it the light that this one finds there.
        changed = _Pair(jnp.ones(()), jnp.zeros(()))
        for other, before in enumerate(earlier):
            changed = changed.plus(changed.times(before), shared[k, other])
        gains = []
        for opening in range(2):
            at = 2 * k + opening
            # Light gained where this mask's etch is missing from an opening, or added to a gap: factor - 1.
            phase = 2 * jnp.pi * (2 * opening - 1) * rates * relief.depth_m[k]
            gain = _Pair(jnp.cos(phase) - 1, jnp.sin(phase)).each(
                lambda part, a=amounts[at]: part[:, None] * a[:, None]
            )
            gained = changed.times(gain).times(_Pair(found[at, :, 0], found[at, :, 1]))
            points = point_moments(axis_values(ys[at], plan.parts), axis_values(xs[at], plan.parts))
            total = total + jnp.stack([_weighted(points, gained.real), _weighted(points, gained.imaginary)], axis=1)
            gains.append(gain)
        # On one side a cell has an odd opening or an odd gap of this mask, not both.
        earlier.append(gains[0].plus(gains[1], jnp.ones(())))
    return (1 - np.pi / 4) * radius**2 * total


class _Crossings(NamedTuple):
    """The crossings of a mask's lines seen from each of four sides, in the cells where those sides lie.

    Attributes:
        y: `[side]` middle of the area that rounding changes, in cells.
        x: the same along x.
        row: `[side]` segment there along y.
        column: the same along x.
        odd: `[side, cell]` whether the mask is open there (closed, for gaps) and not on the other three sides.
        touching: `[side, cell]` whether two openings touch here at their corners.
    """

    y: Array
    x: Array
    row: Array
    column: Array
    odd: Array
    touching: Array


def _crossings(
    kinds: Bool[Array, "j i c"], along_y: Cuts, along_x: Cuts, mask: Array, opening: Array, bias: Array, step: Array
) -> _Crossings:
    """Crossings where an odd opening (or an odd gap) may lie."""
    y, row, low_y, outer_y = _beside(along_y, mask, _SIDE_Y, opening, bias, step)
    x, column, low_x, outer_x = _beside(along_x, mask, _SIDE_X, opening, bias, step)
    own, other_y, other_x, far = (
        kinds[low_y + (_SIDE_Y ^ dy), low_x + (_SIDE_X ^ dx)] for dy, dx in ((0, 0), (1, 0), (0, 1), (1, 1))
    )
    corners = [kinds[outer_y + dy, outer_x + dx] for dy, dx in ((0, 0), (2, 2), (0, 2), (2, 0))]
    touching = (corners[0] == corners[1]) & (corners[2] == corners[3]) & (corners[0] != corners[2])
    odd = (own == opening) & (own != other_y) & (own != other_x) & (own != far)
    return _Crossings(y, x, row, column, odd, touching)


def _beside(
    along: Cuts, mask: Array, side: Int[np.ndarray, " side"], opening: Array, bias: Array, step: Array
) -> tuple[Array, Array, Array, Array]:
    """Points `step` to one side of a mask's lines, in the cells where they lie.

    An opening above its line (or a gap below it) begins at shift - bias, all others at shift + bias.

    Returns:
        their places in those cells, the segments there, and the entries of `_STATES` of the mask below each line and
        below both lines.
    """
    upper = (side != opening) ^ (bias < 0)
    rank = along.line[mask]
    line = jnp.where(upper, rank[1], rank[0])
    second = (line == rank.max()).astype(jnp.int32)
    at = along.edges[1 + line] + (2 * side - 1) * step
    cell = jnp.floor(at).astype(jnp.int32)
    at = at - cell
    segment = jnp.clip(jnp.searchsorted(along.edges, at, side="right") - 1, 0, along.state.shape[1] - 1)
    below_both = -2 * cell - _STATES[0]
    return at, segment, below_both + second, below_both


def _shared_corners(along_y: Cuts, along_x: Cuts, bias: Array, radius: Array) -> Float[Array, "mask mask"]:
    """How much of the area at a corner two masks change together, 1 where their edges coincide."""

    def apart(along: Cuts) -> Array:
        middle = along.edges[1 + along.line].mean(axis=1)
        gap = middle[:, None] - middle[None, :]
        return gap - jnp.round(gap)

    squared = apart(along_y) ** 2 + apart(along_x) ** 2 + (bias[:, None] - bias[None, :]) ** 2
    # Halved at a tenth of the radius: the area is a narrow hook.
    return jnp.exp(-squared / jnp.maximum((0.12 * radius) ** 2, 1e-12))


def _strip_values(moments: Float[Array, "tile moment 2 w t t"], plan: _Plan) -> Complex[Array, "w v u"]:
    """One row of tiles as values of its cells, with what spills to the cells `FILTER_REACH` above and below."""
    count, _, _, lines = moments.shape[:4]
    parts, reach = plan.parts, FILTER_REACH
    moments = moments.reshape(count, parts, parts, len(DEGREES), 2, lines, _TILE, _TILE)
    # [degree, 2, w, (row, part), (tile, column, part)]
    moments = jnp.transpose(moments, (3, 4, 5, 6, 1, 0, 7, 2))
    values = moments.reshape(len(DEGREES), 2, lines, _TILE * parts, count * _TILE * parts)
    values = values.reshape(len(DEGREES), 2 * lines, *values.shape[-2:])
    spill = ((0, 0), (reach, reach), (0, 0))
    if not plan.cut:
        total = jnp.pad(values[0], spill)
    else:
        first, second = (moment_filter(q, plan.band) for q in (1, 2))
        of = dict(zip(DEGREES, values, strict=True))
        even = of[0, 0] + _filtered(of[0, 1], first, 2) + _filtered(of[0, 2], second, 2)
        odd = of[1, 0] + _filtered(of[1, 1], first, 2)
        wide = _filtered(jnp.pad(odd, spill), first, 1) + _filtered(jnp.pad(of[2, 0], spill), second, 1)
        total = jnp.pad(even, spill) + wide
    return jax.lax.complex(*total.reshape(2, lines, *total.shape[1:]))


def _filtered(values: Float[Array, "n v u"], weights: Float[np.ndarray, " tap"], axis: int) -> Float[Array, "n v u"]:
    """Convolution along an axis; beyond the ends there is nothing."""
    reach, size = len(weights) // 2, values.shape[axis]
    padded = jnp.pad(values, [(reach, reach) if a == axis else (0, 0) for a in range(values.ndim)])
    shifted = (
        jax.lax.slice_in_dim(padded, 2 * reach - tap, 2 * reach - tap + size, axis=axis) * jnp.float32(weight)
        for tap, weight in enumerate(weights)
        if weight
    )
    return sum(shifted, jnp.zeros_like(values))


def _joined(strips: Complex[Array, "strip w v u"]) -> Complex[Array, "w y u"]:
    """Strips side by side, what spills from each added to its neighbours."""
    reach = FILTER_REACH
    main = strips[:, :, reach:-reach]
    # Above the last strip and below the first one nothing is kept.
    from_next = jnp.concatenate([strips[1:, :, :reach], jnp.zeros_like(strips[:1, :, :reach])])
    from_last = jnp.concatenate([jnp.zeros_like(strips[:1, :, -reach:]), strips[:-1, :, -reach:]])
    main = main.at[:, :, -reach:].add(from_next).at[:, :, :reach].add(from_last)
    return jnp.moveaxis(main, 0, 1).reshape(strips.shape[1], -1, strips.shape[3])
