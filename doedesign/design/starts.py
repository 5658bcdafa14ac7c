"""Baseline designs by name. Each is a start of the optimiser, and a design of its own with `steps = 0`.

They return heights in metres: a profile over rings for the radial parametrisation, a map otherwise.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from fab.units import parse_length
from sim.camera import Camera
from sim.material import full_wave_height_m
from sim.propagation.hankel import ring_count

Heights = Float[np.ndarray, "*s"]
Judge = Callable[[Heights], float]


def _radii_m(camera: Camera, radial: bool) -> Heights:
    if radial:
        return (np.arange(ring_count(camera)) + 0.5) * camera.grid.pitch_m
    return np.hypot(camera.grid.axis_m("y")[:, None], camera.grid.axis_m("x")[None, :])


def _number(options: Mapping[str, Any], key: str, default: float, low: float, high: float) -> float:
    value = options.get(key, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(
            f"optimize.start_options.{key}", f"must be a number from {low:g} to {high:g}", repr(value), "Correct it."
        )
    return float(value)


def _length(options: Mapping[str, Any], key: str, default_m: float) -> float:
    if key not in options:
        return default_m
    try:
        length = parse_length(str(options[key]))
    except ValueError as error:
        raise InputError(
            f"optimize.start_options.{key}", "must be a length", repr(options[key]), 'Such as "5.6 um".'
        ) from error
    if not length > 0:
        raise InputError(f"optimize.start_options.{key}", "must be positive", repr(options[key]), 'Such as "5.6 um".')
    return length


def flat(camera: Camera, radial: bool) -> Heights:
    """No relief: the plain lens."""
    return np.zeros_like(_radii_m(camera, radial))


def random(camera: Camera, radial: bool, wavelength_m: float, seed: int, feature_m: float) -> Heights:
    """A random diffuser: heights uniform over one wave, constant over squares (or rings) of side `feature_m`."""
    shape = _radii_m(camera, radial).shape
    cells = min(max(1, round(feature_m / camera.grid.pitch_m)), max(shape))
    coarse = tuple(-(-n // cells) for n in shape)
    heights = np.random.default_rng(seed).uniform(0, full_wave_height_m(camera.material, wavelength_m), coarse)
    for axis in range(heights.ndim):
        heights = np.repeat(heights, cells, axis=axis)
    return heights[tuple(slice(0, n) for n in shape)]


def ring(camera: Camera, radial: bool, wavelength_m: float, far_energy: float, period_m: float) -> Heights:
    """A circular binary grating: `far_energy` of the light stays in the 0th order, the rest draws a ring.

    Half of each period is raised by h with cos²(phi/2) = far_energy, phi = 2 pi (n-1) h / lambda, the 0th-order
    efficiency of a binary grating (J. W. Goodman, *Introduction to Fourier Optics*, §4.4). From a far source the ring
    has radius lambda f / period; a near one widens it by the defocus disc.
    """
    phase = 2 * np.arccos(np.sqrt(far_energy))
    height = full_wave_height_m(camera.material, wavelength_m) * phase / (2 * np.pi)
    return np.where(np.mod(_radii_m(camera, radial) / period_m, 1.0) < 0.5, height, 0.0)


def ring_period_m(camera: Camera) -> float:
    """Period whose ring just fits the window for every colour, or 3.03 cells where the grid is too coarse for that."""
    longest = max(w for c in camera.colours for w in c.wavelengths_m)
    reach = 0.96 * camera.window * camera.pixel_m / 2
    return max(longest * camera.sensor_distance_m / reach, 3.03 * camera.grid.pitch_m)


def lens(camera: Camera, radial: bool, wavelength_m: float, power_per_m: float) -> Heights:
    """A Fresnel lens of optical power 1/f_DOE, wrapped at one wave: phase -pi r² power / lambda."""
    wave = full_wave_height_m(camera.material, wavelength_m)
    return np.mod(-(_radii_m(camera, radial) ** 2) * power_per_m / (2 * wavelength_m), 1.0) * wave


def fresnel(camera: Camera, radial: bool, wavelength_m: float, judge: Judge, evaluations: int) -> Heights:
    """The Fresnel lens whose one free focal length is best for the objective, found by NLopt.

    The paper's "Fresnel" baseline. The power is searched between minus and plus 40 edge waves with DIRECT-L (global,
    no gradient; D. R. Jones et al. 1993, as in NLopt) for most of the evaluations, then with Sbplx from the best point.
    """
    import nlopt

    limit = 40 * 2 * wavelength_m / (camera.aperture_m / 2) ** 2

    def loss(power: np.ndarray, _gradient: np.ndarray) -> float:
        return judge(lens(camera, radial, wavelength_m, float(power[0]) * limit))

    best = np.zeros(1)
    for algorithm, count in ((nlopt.GN_DIRECT_L, evaluations * 2 // 3), (nlopt.LN_SBPLX, evaluations // 3)):
        search = nlopt.opt(algorithm, 1)
        search.set_min_objective(loss)
        search.set_lower_bounds(-1.0)
        search.set_upper_bounds(1.0)
        search.set_initial_step(0.02)
        search.set_maxeval(max(count, 1))
        best = search.optimize(best)
    return lens(camera, radial, wavelength_m, float(best[0]) * limit)


_OPTIONS = {
    "flat": (),
    "random": ("feature",),
    "fresnel": ("focal_length", "evaluations"),
    "ring": ("far_energy", "period", "roughness"),
}


def start_heights(
    name: str,
    options: Mapping[str, Any],
    camera: Camera,
    *,
    radial: bool,
    wavelength_m: float,
    seed: int,
    judge: Judge,
) -> Heights:
    """Heights of a named start.

    Args:
        name: "flat", "random", "fresnel" or "ring".
        options: `optimize.start_options` of the spec.
        camera: optics.
        radial: a profile over rings instead of a map.
        wavelength_m: design wavelength.
        seed: seed of random starts.
        judge: the objective's value for given heights (used by "fresnel").

    Raises:
        InputError: an option the start does not know, or an impossible value.
    """
    unknown = [key for key in options if key not in _OPTIONS[name]]
    if unknown:
        known = ", ".join(_OPTIONS[name]) or "none"
        raise InputError(
            "optimize.start_options", f'options of start "{name}" are: {known}', unknown[0], "Remove or rename it."
        )
    if name == "flat":
        return flat(camera, radial)
    if name == "random":
        return random(camera, radial, wavelength_m, seed, _length(options, "feature", camera.grid.pitch_m))
    if name == "fresnel":
        if "focal_length" in options:
            return lens(camera, radial, wavelength_m, 1.0 / _length(options, "focal_length", 1.0))
        evaluations = int(_number(options, "evaluations", 30, 3, 10_000))
        return fresnel(camera, radial, wavelength_m, judge, evaluations)
    heights = ring(
        camera,
        radial,
        wavelength_m,
        _number(options, "far_energy", 0.25, 0.0, 1.0),
        _length(options, "period", ring_period_m(camera)),
    )
    wave = full_wave_height_m(camera.material, wavelength_m)
    # A perfect grating is a stationary point in many directions; a little roughness lets the optimiser leave it. The
    # quarter wave below keeps the floor of the grating away from the wrap at zero.
    rough = _number(options, "roughness", 0.02, 0.0, 1.0) * np.random.default_rng(seed).standard_normal(heights.shape)
    return heights + wave * (0.25 + rough)
