"""The far field of a rotationally symmetric DOE, by a Hankel transform of its radial profile.

Within a ring, as wide as a cell, the DOE is constant, so its share of the field,
2 pi / (lambda d) ∫ J0(2 pi r rho / lambda d) r dr, is known exactly through J1; the source wave varies slowly and is
sampled at a few sub-rings. Unlike a raster (`sim.propagation.farfield`), rings have no staircase.

From profile to pixels: field on radii at a little more than its Nyquist rate (one matrix product); band-limited
interpolation of the complex field to eight times finer radii; integration over pixels with weights that hold each
pixel's area as a function of radius. Only one octant of the window is distinct.
"""

import math
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import j1

from fab.grid import Grid
from sim.camera import Camera
from sim.propagation.pixel import Banded
from sim.propagation.pupil import cis
from sim.source import path_at_m, wrapped_waves

_OVERSAMPLING = 2.2  # radii per lambda d / D; the field's band needs 1
_REFINEMENT = 8  # fine radii per coarse radius; intensity is then linear between them to 1e-3
_HALF_TAPS = 8  # one-sided length of the interpolation kernel
_SUBRINGS = 3  # a 5 cm source turns by 0.15 waves across an outermost ring of the paper's plate
_POINTS = 16  # least per pixel and axis, for the areas
_CHUNK = 2**21  # points worked on at once


class Hankel(eqx.Module):
    """Operators of one wavelength for a profile of rings."""

    rings_to_field: Float[Array, "subring coarse"]  # `[subring, coarse radius]`, all constant factors included
    refine: Banded  # coarse radii -> fine radii
    first: Int[Array, " distinct"]  # first fine radius used by each distinct pixel
    areas: Float[Array, "distinct fine"]  # `[distinct pixel, fine radius]` weights of the fine radii from `first` on
    distinct: Int[Array, "y x"]  # `[y, x]` index of the distinct pixel that equals this one
    subrings: int = eqx.field(static=True)  # number of sub-rings per ring

    def energy(
        self,
        profile_m: Float[Array, " ring"],
        source_waves: Float[Array, " subring"],
        waves_per_metre: Float[Array, ""],
    ) -> Float[Array, "y x"]:
        """Energy in every pixel, per unit power incident on the clear aperture.

        Args:
            profile_m: DOE height of every ring, metres.
            source_waves: optical path of the source at every sub-ring (`ring_source_waves`).
            waves_per_metre: `Camera.waves_per_metre`.
        """
        wave = cis(jnp.repeat(profile_m, self.subrings) * waves_per_metre + source_waves)
        parts = jnp.stack([wave.real, wave.imag])
        field = self.refine(jnp.matmul(parts, self.rings_to_field, precision="highest"))
        intensity = field[0] ** 2 + field[1] ** 2
        window = self.first[:, None] + np.arange(self.areas.shape[1])
        return jnp.sum(intensity[window] * self.areas, axis=1)[self.distinct]


def ring_count(camera: Camera) -> int:
    """Rings of one cell's width that reach the edge of the clear aperture."""
    return int(np.ceil(camera.aperture_m / 2 / camera.grid.pitch_m - 1e-9))


def _subring_edges_m(camera: Camera) -> Float[np.ndarray, " edge"]:
    edges = np.arange(ring_count(camera) * _SUBRINGS + 1) * (camera.grid.pitch_m / _SUBRINGS)
    return np.minimum(edges, camera.aperture_m / 2)


def ring_source_waves(camera: Camera, depth_m: float, wavelength_m: float) -> Float[np.ndarray, " subring"]:
    """Wrapped optical path of an on-axis source at the middle of every sub-ring, waves."""
    edges = _subring_edges_m(camera)
    radius = (edges[1:] + edges[:-1]) / 2
    return wrapped_waves(path_at_m(camera, np.zeros(()), radius, depth_m), wavelength_m)


def _interpolation(coarse: int, lead: int) -> Float[np.ndarray, "coarse fine"]:
    """Kaiser-windowed sinc from coarse radii (the first `lead` are negative) to fine ones from 0 on."""
    fine = np.arange((coarse - 2 * lead) * _REFINEMENT) / _REFINEMENT + lead
    distance = fine[None, :] - np.arange(coarse)[:, None]
    window = np.i0(8.0 * np.sqrt(np.maximum(1 - (distance / _HALF_TAPS) ** 2, 0.0))) / np.i0(8.0)
    kernel = np.where(np.abs(distance) < _HALF_TAPS, np.sinc(distance) * window, 0.0)
    return kernel / kernel.sum(axis=0)


def _sine_radius_m(camera: Camera, place_m: Float[np.ndarray, "*s"]) -> tuple[np.ndarray, np.ndarray | float]:
    """Where a lens that images sines would have the light of some radii, and what area there stands for one here."""
    if camera.is_sine:
        return place_m, 1.0

    step_m = 1e-4 * camera.pixel_m
    slope = (_sine_place_m(camera, place_m + step_m) - _sine_place_m(camera, place_m - step_m)) / (2 * step_m)
    radius_m = _sine_place_m(camera, place_m)
    return radius_m, slope * radius_m / place_m


def _sine_place_m(camera: Camera, place_m: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    return camera.sensor_distance_m * camera.sines_of(np.zeros_like(place_m), place_m)[1]


def _points(camera: Camera, airy_m: float) -> int:
    """Points per pixel and axis: two per lambda d / D, which no fringe of the intensity is finer than, or more.

    The number is even, so none lies on the axis. `airy_m` is lambda d / D.
    """
    stretch = 1.0
    if not camera.is_sine:  # how much finer fringes are at places on the sensor than of a lens that images sines
        place_m = np.linspace(0.0, camera.window * camera.pixel_m / np.sqrt(2), 257)
        stretch = float(np.max(np.diff(_sine_place_m(camera, place_m)) / np.diff(place_m)))
    return max(_POINTS, 2 * math.ceil(stretch * camera.pixel_m * camera.fill / airy_m - 1e-9))


def _pixel_areas(camera: Camera, fine_m: float, airy_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First fine radius, weights per fine radius, and the map to distinct pixels; `airy_m` is lambda d / D."""
    n, points = camera.window, _points(camera, airy_m)
    steps = np.abs(2 * np.arange(n) - (n - 1))  # distance from the axis in half pixels
    low, high = np.minimum(steps[:, None], steps[None, :]), np.maximum(steps[:, None], steps[None, :])
    keys, distinct = np.unique(high * (n + 1) + low, return_inverse=True)
    far, near = (keys // (n + 1)) * camera.pixel_m / 2, (keys % (n + 1)) * camera.pixel_m / 2
    offsets = Grid((points, points), camera.pixel_m * camera.fill / points).axis_m("x")
    area = (camera.pixel_m * camera.fill) ** 2 / points**2
    firsts, parts = [], []
    at_once = max(1, _CHUNK // points**2)
    for start in range(0, len(keys), at_once):
        some = slice(start, start + at_once)
        place_m = np.hypot(far[some, None, None] + offsets[:, None], near[some, None, None] + offsets)
        first, areas = _areas_of(camera, place_m.reshape(place_m.shape[0], -1), fine_m)
        firsts.append(first)
        parts.append(areas * area)
    width = max(part.shape[1] for part in parts)
    padded = [np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in parts]
    return np.concatenate(firsts), np.concatenate(padded), distinct.reshape(n, n)


def _areas_of(
    camera: Camera, place_m: Float[np.ndarray, "distinct point"], fine_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """First fine radius of some pixels, and how many of their points each fine radius from there on stands for."""
    radius_m, share = _sine_radius_m(camera, place_m)
    if camera.in_angles:  # there is no light beyond a sine of 1
        share = share * (radius_m <= 1)
    radius = radius_m / fine_m
    index = np.floor(radius).astype(np.int64)
    first = index.min(axis=1)
    width, count = int((index.max(axis=1) - first).max()) + 2, len(place_m)
    slot = (index - first[:, None]) + np.arange(count)[:, None] * width
    right = radius - index
    areas = np.bincount(slot.ravel(), (share * (1 - right)).ravel(), minlength=count * width)
    areas += np.bincount(slot.ravel() + 1, (share * right).ravel(), minlength=count * width + 1)[: count * width]
    return first, areas.reshape(count, width)


@lru_cache(maxsize=8)
def plan_hankel(camera: Camera, wavelength_m: float) -> Hankel:
    """Prepare the Hankel transform of one wavelength; matrices are built in float64. Kept, for all depths."""
    scale = wavelength_m * camera.sensor_distance_m
    airy_m = scale / camera.aperture_m
    coarse_m = airy_m / _OVERSAMPLING
    edges = _subring_edges_m(camera)
    first, areas, distinct = _pixel_areas(camera, coarse_m / _REFINEMENT, airy_m)
    fine_needed = int((first + areas.shape[1]).max()) + 1
    coarse = -(-fine_needed // _REFINEMENT) + 2 * _HALF_TAPS
    rate = 2 * np.pi * np.abs(np.arange(coarse) - _HALF_TAPS) * coarse_m / scale
    rate = np.maximum(rate, 1e-3 * rate[-1] / coarse)  # the limit r^2/2 at rate = 0, to 1e-7
    primitive = edges[:, None] * j1(edges[:, None] * rate[None, :]) / rate[None, :]
    area = np.pi * camera.aperture_m**2 / 4
    matrix = np.diff(primitive, axis=0) * (2 * np.pi / scale / np.sqrt(area))
    with jax.ensure_compile_time_eval():  # also where something is traced
        return Hankel(
            rings_to_field=jnp.asarray(matrix, jnp.float32),
            refine=Banded.from_dense(_interpolation(coarse, _HALF_TAPS), 512),
            first=jnp.asarray(first, jnp.int32),
            areas=jnp.asarray(areas, jnp.float32),
            distinct=jnp.asarray(distinct, jnp.int32),
            subrings=_SUBRINGS,
        )


def revolve(profile_m: Float[np.ndarray, " ring"], grid: Grid) -> Float[np.ndarray, "y x"]:
    """Raster of a profile: every cell takes the height of the ring its centre lies in (the last ring beyond)."""
    radius = np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])
    ring = np.minimum((radius / grid.pitch_m).astype(np.int64), len(profile_m) - 1)
    return profile_m[ring]


def radial_profile(height_m: Float[np.ndarray, "y x"], grid: Grid) -> Float[np.ndarray, " ring"] | None:
    """The profile whose raster this map is, or None if it is no raster of rings."""
    if grid.shape[0] != grid.shape[1]:
        return None
    radius = np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])
    ring = (radius / grid.pitch_m).astype(np.int64)
    profile = np.zeros(int(ring.max()) + 1, height_m.dtype)
    profile[ring] = height_m
    inside = grid.inside_circle(min(grid.extent_m))
    if not np.array_equal(profile[ring][inside], height_m[inside]):
        return None
    return profile[: (grid.shape[0] + 1) // 2]
