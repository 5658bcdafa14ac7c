"""Baseline designs by name. Each is a start of the optimiser, and a design of its own with `steps = 0`.

A start is a function of a `StartSetup` and its options, under its name in `doedesign.spec.values.STARTS`. It returns
heights in metres: a profile over rings for the radial parametrisation, a map otherwise.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.design import analytic
from doedesign.design.patterns import positive_length
from doedesign.search import least
from doedesign.spec import STARTS
from fab.errors import InputError
from fab.units import parse_angle
from sim.camera import Camera
from sim.material import full_wave_height_m
from sim.propagation.hankel import ring_count

Heights = Float[np.ndarray, "*s"]
_WHERE = "optimize.start_options"
EDGE_WAVES = 40  # of the strongest lens that is searched


class StartSetup(NamedTuple):
    """Design task of a start.

    Attributes:
        camera: optics and sensor.
        radial: whether its heights are a profile over rings instead of a map.
        wavelength_m: the design wavelength, metres.
        seed: of everything random.
        loss: loss of heights.
        level_step_m: distance of the levels to which heights will be rounded, metres; 0 if they will not.
    """

    camera: Camera
    radial: bool
    wavelength_m: float
    seed: int = 0
    loss: Callable[[Heights], float] = lambda _: 0.0
    level_step_m: float = 0.0

    @property
    def wave_m(self) -> float:
        """Height of one wave."""
        return full_wave_height_m(self.camera.material, self.wavelength_m)

    def radii_m(self) -> Heights:
        """Distance from the axis of every cell, or of the middle of every ring."""
        grid = self.camera.grid
        if self.radial:
            return (np.arange(ring_count(self.camera)) + 0.5) * grid.pitch_m
        return np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])


def lens(setup: StartSetup, power_per_m: float) -> Heights:
    """Fresnel lens of optical power 1/f_DOE, wrapped at one wave: phase -pi r² power / lambda."""
    return np.mod(-(setup.radii_m() ** 2) * power_per_m / (2 * setup.wavelength_m), 1.0) * setup.wave_m


class Ridge(NamedTuple):
    """Profile of a binary grating: height of its ridges, metres, and their share of the period, 0-0.5."""

    height_m: float
    duty: float


def zeroth_orders(setup: StartSetup, ridge: Ridge) -> Float[np.ndarray, " w"]:
    """Share of the light of every colour that a binary grating leaves in its 0th order.

    1 - 4 p (1 - p) sin²(phi / 2) for a duty p and ridges of phase phi = 2 pi (n-1) h / lambda, the square of the mean
    of its two waves (J. W. Goodman, *Introduction to Fourier Optics*, §4.4).
    """
    return _order_shares(_waves_of_colours(setup), ridge)


def _waves_of_colours(setup: StartSetup) -> list[tuple[np.ndarray, np.ndarray]]:
    """For every colour the height of a wave at each of its wavelengths, metres, and the wavelength's share."""
    material, colours = setup.camera.material, setup.camera.colours
    waves = [np.array([full_wave_height_m(material, w) for w in colour.wavelengths_m]) for colour in colours]
    return [(wave, np.array(c.weights) / sum(c.weights)) for wave, c in zip(waves, colours, strict=True)]


def _order_shares(waves: list[tuple[np.ndarray, np.ndarray]], ridge: Ridge) -> Float[np.ndarray, " w"]:
    depth = 4 * ridge.duty * (1 - ridge.duty)
    return np.array([1 - depth * share @ np.sin(np.pi * ridge.height_m / wave_m) ** 2 for wave_m, share in waves])


def balanced_ridge(setup: StartSetup, far_energy: float) -> Ridge:
    """Ridge whose 0th order holds `far_energy` of every colour, as evenly as height and duty allow.

    One colour: half of the period, and the height of that order at the design wavelength. Several: the least sum of
    squared misses, with heights up to one wave, by NLopt.
    """
    if len(setup.camera.colours) == 1:
        return Ridge(setup.wave_m * float(np.arccos(np.sqrt(far_energy))) / np.pi, 0.5)

    waves, wave_m = _waves_of_colours(setup), setup.wave_m

    def miss(values: np.ndarray) -> float:
        ridge = Ridge(float(values[0]) * wave_m, float(values[1]))
        return float(np.sum((_order_shares(waves, ridge) - far_energy) ** 2))

    waves_high, duty = least(miss, (0.0, 0.0), (1.0, 0.5), (("direct", 400), ("sbplx", 400)), step=0.01)
    return Ridge(waves_high * wave_m, duty)


def grating(setup: StartSetup, ridge: Ridge, period_m: float) -> Heights:
    """Circular binary grating: its 0th order stays, the rest draws a ring.

    From a far source the ring has radius lambda f / period; a near one widens it by the defocus disc.
    """
    return np.where(np.mod(setup.radii_m() / period_m, 1.0) < ridge.duty, ridge.height_m, 0.0)


def ring_period_m(camera: Camera) -> float:
    """Period whose ring just fits the window for every colour, or 3.03 cells where the grid is too coarse for that."""
    longest = max(w for c in camera.colours for w in c.wavelengths_m)
    reach = 0.96 * camera.window * camera.pixel_m / 2
    sine = reach / camera.sensor_distance_m if camera.is_sine else camera.sines_of(0.0, reach)[1]
    return max(longest / sine, 3.03 * camera.grid.pitch_m)


def flat(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """No relief: the plain lens."""
    del options
    return np.zeros_like(setup.radii_m())


def random(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Random diffuser: heights uniform over one wave, constant over squares (or rings) of side `feature`."""
    pitch_m, shape = setup.camera.grid.pitch_m, setup.radii_m().shape
    cells = min(max(1, round(_length(options, "feature", pitch_m) / pitch_m)), max(shape))
    heights = np.random.default_rng(setup.seed).uniform(0, setup.wave_m, tuple(-(-n // cells) for n in shape))
    for axis in range(heights.ndim):
        heights = np.repeat(heights, cells, axis=axis)
    return heights[tuple(slice(0, n) for n in shape)]


def ring(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Circular `grating` of `period`, equally bright in all colours (`balanced_ridge`), that the optimiser can leave.

    `height` and `duty` may be given in place of `far_energy`. A perfect grating is a stationary point in many
    directions; a little `roughness`, in waves, lets the optimiser leave it. The floor of the grating is the level next
    to a quarter wave, away from the wrap at zero and from where two levels meet.
    """
    ridge = balanced_ridge(setup, _number(options, "far_energy", 0.25, 0.0, 1.0))
    ridge = Ridge(_length(options, "height", ridge.height_m), _number(options, "duty", ridge.duty, 0.0, 1.0))
    heights = grating(setup, ridge, _length(options, "period", ring_period_m(setup.camera)))
    return _loosened(setup, heights, options)


def _loosened(setup: StartSetup, heights: Heights, options: Mapping[str, Any]) -> Heights:
    """Heights on a floor of their own, with a little `roughness` (see `ring`)."""
    noise = np.random.default_rng(setup.seed).standard_normal(heights.shape)
    floor_m, step_m = setup.wave_m / 4, setup.level_step_m
    if step_m:
        floor_m = step_m * round(floor_m / step_m - 1e-3)  # of two levels the lower one
    return heights + floor_m + setup.wave_m * _number(options, "roughness", 0.02, 0.0, 1.0) * noise


class RingLens(NamedTuple):
    """A circular grating with a lens: few numbers, each within a range that does not depend on the camera.

    Attributes:
        period: logarithm to base 2 of the period over `ring_period_m`.
        chirp: share by which the period is wider on the axis than half way to the rim.
        height: of the ridges, in waves.
        duty: their share of the period.
        power: third root of the optical power, which at 1 takes a phase of `EDGE_WAVES` at the rim.
    """

    period: float
    chirp: float
    height: float
    duty: float
    power: float

    def heights(self, setup: StartSetup) -> Heights:
        """Its heights, metres."""
        camera, radii = setup.camera, setup.radii_m()
        share = radii / camera.opening.reach_m
        place = radii / (ring_period_m(camera) * 2**self.period) * (1 + self.chirp * (share / 2 - 0.5))
        ridges = np.where(np.mod(place, 1.0) < self.duty, self.height * setup.wave_m, 0.0)
        power_per_m = self.power**3 * EDGE_WAVES * 2 * setup.wavelength_m / camera.opening.reach_m**2
        return ridges + lens(setup, power_per_m) if self.power else ridges


_LOWEST, _HIGHEST = RingLens(-1.0, -0.8, 0.0, 0.05, -1.0), RingLens(3.0, 0.8, 1.0, 0.95, 1.0)
_SEARCHES = {
    "crs": (("crs", 0.75), ("sbplx", 0.25)),
    "mlsl": (("mlsl", 1.0),),
    "isres": (("isres", 0.75), ("sbplx", 0.25)),
}


def nlopt(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """The `RingLens` of least loss that NLopt finds with `algorithm` in `evaluations` of the loss.

    A global search, controlled random ("crs"), by local searches from many starts ("mlsl") or by evolution ("isres"),
    over the five numbers of a whole plate; the free-form search then begins at the best of them. `roughness` is as for
    `ring`.
    """
    algorithm = options.get("algorithm", "crs")
    if algorithm not in _SEARCHES:
        rule, cure = f"must be one of {', '.join(_SEARCHES)}", "Choose one of them, or leave it out."
        raise InputError(f"{_WHERE}.algorithm", rule, repr(algorithm), cure)
    evaluations = int(_number(options, "evaluations", 400, 20, 100_000))
    stages = [(name, round(share * evaluations)) for name, share in _SEARCHES[algorithm]]

    def loss(values: np.ndarray) -> float:
        return setup.loss(RingLens(*map(float, values)).heights(setup))

    found = least(loss, _LOWEST, _HIGHEST, stages, step=0.1, seed=setup.seed)
    return _loosened(setup, RingLens(*found).heights(setup), options)


def fresnel(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Fresnel lens of `focal_length`, or whose focal length gives the least loss in `evaluations` of it.

    The paper's "Fresnel" baseline. The power is searched between minus and plus 40 edge waves by NLopt, globally for
    most of the evaluations, then from the best point.
    """
    if "focal_length" in options:
        return lens(setup, 1.0 / _length(options, "focal_length", 1.0))
    evaluations = int(_number(options, "evaluations", 30, 3, 10_000))
    limit = EDGE_WAVES * 2 * setup.wavelength_m / setup.camera.opening.reach_m**2

    def loss(power: np.ndarray) -> float:
        return setup.loss(lens(setup, float(power[0]) * limit))

    stages = (("direct", evaluations * 2 // 3), ("sbplx", evaluations // 3))
    (power,) = least(loss, (-1.0,), (1.0,), stages, step=0.02)
    return lens(setup, power * limit)


def axicon(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Cone that bends light toward the axis by `angle` (`doedesign.design.analytic`)."""
    return _wrapped(setup, analytic.axicon(setup.radii_m(), _angle(options, "angle", None), setup.wavelength_m))


def vortex(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Spiral of `charge` waves per turn."""
    charge = _number(options, "charge", 1, -1000, 1000)
    if charge != round(charge) or charge == 0:
        raise InputError(f"{_WHERE}.charge", "must be a whole number, and not 0", repr(charge), "For example 1.")
    return _wrapped(setup, analytic.vortex(*_places(setup, "vortex"), int(charge)))


def blazed(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Sawtooth of `period` that sends light toward `azimuth`."""
    azimuth_rad, (period_m,) = _angle(options, "azimuth", 0.0), _needed(options, "period")
    return _wrapped(setup, analytic.blazed(*_places(setup, "blazed"), period_m, azimuth_rad))


def lens_array(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Square lenses of `focal_length`, `pitch` apart."""
    pitch_m, focal_m = _needed(options, "pitch", "focal_length")
    return _wrapped(setup, analytic.lens_array(*_places(setup, "lens_array"), pitch_m, focal_m, setup.wavelength_m))


def cubic(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Cubic phase of so many `waves` at the rim on each axis."""
    rim_m = setup.camera.opening.widest_m / 2
    return _wrapped(setup, analytic.cubic(*_places(setup, "cubic"), _number(options, "waves", 5, -1e3, 1e3), rim_m))


def quartic(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Rings of fourth order of so many `waves`, which are in focus over as many waves of defocus on both sides."""
    waves = _number(options, "waves", 5, -1e3, 1e3)
    return _wrapped(setup, analytic.quartic(setup.radii_m(), waves, setup.camera.opening.reach_m))


def axilens(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Lens of a focal length from `near` on the axis to `far` at the rim."""
    return _wrapped(setup, analytic.axilens(setup.radii_m(), *_foci(setup, options), setup.wavelength_m))


def logarithmic_asphere(setup: StartSetup, options: Mapping[str, Any]) -> Heights:
    """Lens whose zones of equal area focus at distances from `near` to `far`, equally spaced."""
    return _wrapped(setup, analytic.logarithmic_asphere(setup.radii_m(), *_foci(setup, options), setup.wavelength_m))


def _wrapped(setup: StartSetup, waves: Heights) -> Heights:
    """Heights of a phase, wrapped at one wave."""
    return np.mod(waves, 1.0) * setup.wave_m


def _places(setup: StartSetup, name: str) -> tuple[Heights, Heights]:
    """Places (y, x) of all cells; a mistake for rings, which have none."""
    if setup.radial:
        cure = 'Use parametrization = "freeform".'
        raise InputError("optimize.start", "rings have a start that is a profile over the radius", f'"{name}"', cure)
    grid = setup.camera.grid
    y, x = np.meshgrid(grid.axis_m("y"), grid.axis_m("x"), indexing="ij")
    return y, x


def _needed(options: Mapping[str, Any], *keys: str) -> list[float]:
    """Lengths among the options that have no usual value."""
    found = [_length(options, key, 0.0) for key in keys]
    for key in keys:
        if key not in options:
            raise InputError(f"{_WHERE}.{key}", "the start needs it", "nothing", f'For example {key} = "250 um".')
    return found


def _foci(setup: StartSetup, options: Mapping[str, Any]) -> tuple[float, float, float]:
    """The options `near` and `far`, and the radius of the rim, metres."""
    near_m, far_m = _needed(options, "near", "far")
    if near_m == far_m:
        cure = 'For one focal length use start = "fresnel".'
        raise InputError(f"{_WHERE}.far", "must differ from `near`", repr(options["far"]), cure)
    return near_m, far_m, setup.camera.opening.reach_m


BUILT_IN = {name: globals()[name] for name in STARTS}


def start_heights(name: str, options: Mapping[str, Any], setup: StartSetup) -> Heights:
    """Heights, metres, of a start of `doedesign.spec.values.STARTS` with its options."""
    if unknown := [key for key in options if key not in STARTS[name]]:
        known = ", ".join(STARTS[name]) or "none"
        raise InputError(_WHERE, f'options of start "{name}" are: {known}', unknown[0], "Remove or rename it.")
    return BUILT_IN[name](setup, options)


def _number(options: Mapping[str, Any], key: str, default: float, low: float, high: float) -> float:
    value = options.get(key, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        rule = f"must be a number from {low:g} to {high:g}"
        raise InputError(f"{_WHERE}.{key}", rule, repr(value), "Correct it.")
    return float(value)


def _angle(options: Mapping[str, Any], key: str, default_rad: float | None) -> float:
    if key not in options and default_rad is not None:
        return default_rad
    try:
        return parse_angle(options.get(key, ""))
    except ValueError as error:
        rule, cure = "must be an angle with a unit", f'For example {key} = "1 deg".'
        raise InputError(f"{_WHERE}.{key}", rule, repr(options.get(key)), cure) from error


def _length(options: Mapping[str, Any], key: str, default_m: float) -> float:
    return positive_length(options[key], f"{_WHERE}.{key}") if key in options else default_m
