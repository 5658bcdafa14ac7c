"""Numbers that a DOE and its PSFs are judged by, each with its definition, and the one table of them (`METRICS`).

None changes a PSF's energy. `jax.grad`, `jit` and `vmap` go through all but the energy budget.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.fft import fft

from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour, source_path_m
from sim.optic import CellOptic
from sim.tracing import is_traced, stacked, total

Psf = Float[np.ndarray, "y x"] | Float[Array, "y x"]
Number = float | Float[Array, ""]


def radius_map_m(shape: tuple[int, int], pixel_m: float) -> Float[np.ndarray, "y x"]:
    """Distance of every pixel centre from the centre of the window, metres."""
    y, x = (pixel_m * (np.arange(n) - (n - 1) / 2) for n in shape)
    return np.hypot(y[:, None], x[None, :])


@lru_cache(maxsize=32)
def disc_weights(shape: tuple[int, int], pixel_m: float, radius_m: float) -> Float[np.ndarray, "y x"]:
    """Share of every pixel's area inside a centred disc, float32; kept and read-only, for every draw asks for a few."""
    weights = circle_coverage(Grid(shape, pixel_m), 2 * radius_m)
    weights.setflags(write=False)
    return weights


def airy_radius_m(camera: Camera, wavelength_m: float) -> float:
    """Radius of the first dark ring of the ideal lens, 1.22 lambda d / D; D is the shorter side of other apertures."""
    return 1.2197 * wavelength_m * camera.sensor_distance_m / camera.opening.narrowest_m


def mean_wavelength_m(colour: Colour) -> float:
    """Weighted mean wavelength of a colour channel."""
    return float(np.dot(colour.wavelengths_m, colour.weights))


def spot_radius_m(camera: Camera, wavelength_m: float) -> float:
    """Radius that counts as the far spot: the first dark ring, and one pixel to catch it anywhere on the pixel grid."""
    return airy_radius_m(camera, wavelength_m) + camera.pixel_m


def near_and_far(camera: Camera, depths_m: Sequence[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Depths whose defocus disc is wider than the far spot, and the others; without a lens all are others."""
    if camera.distance_m is not None:
        return (), tuple(depths_m)
    spot_m = spot_radius_m(camera, max(line.wavelength_m for line in camera.lines))
    near = tuple(z for z in depths_m if camera.defocus_radius_m(z) > spot_m)
    return near, tuple(z for z in depths_m if z not in near)


def encircled_energy(
    psfs: Float[np.ndarray, "*bank y x"] | Float[Array, "*bank y x"],
    pixel_m: float,
    radii_m: Sequence[float] | np.ndarray,
) -> Float[np.ndarray, "*bank r"] | Float[Array, "*bank r"]:
    """Energy `[..., radius]` of `psfs` `[..., y, x]` of pitch `pixel_m` inside centred discs of `radii_m`, metres.

    Not divided by the total; partly covered pixels count by area.
    """
    y, x = psfs.shape[-2:]
    discs = [disc_weights((y, x), pixel_m, float(radius)) for radius in radii_m]
    if is_traced(psfs):
        return jnp.einsum("...yx,ryx->...r", psfs, np.stack(discs), precision="highest")
    flat = np.asarray(psfs).reshape(-1, y * x).astype(np.float64)
    energies = np.stack([flat @ disc.ravel() for disc in discs], axis=-1)
    return energies.reshape(*psfs.shape[:-2], len(radii_m))


def energy_within(psf: Psf, pixel_m: float, radius_m: float) -> Number:
    """Energy inside one centred disc (`encircled_energy`)."""
    energy = encircled_energy(psf, pixel_m, [radius_m])[0]
    return energy if is_traced(energy) else float(energy)


def disc_radius_m(camera: Camera, depth_m: float) -> float:
    """Radius of the disc to which light of `depth_m`, metres, is blurred if the DOE does not diffract it.

    That of geometric defocus, and one pixel.
    """
    return camera.defocus_radius_m(depth_m) + camera.pixel_m


class RingToDisc(NamedTuple):
    """Energy outside and inside the geometric defocus disc, within the window; lengths in metres."""

    ratio: Number
    ring: Number
    disc: Number
    disc_radius_m: float


def ring_to_disc(psf: Psf, camera: Camera, depth_m: float) -> RingToDisc:
    """Ring:disc ratio of a near `psf` `[y, x]` of a `camera` (3:1 in the paper's simulation, 1:1 in its prototype).

    The disc is that of `disc_radius_m`, `depth_m` in metres; without light in it the ratio is infinite.
    """
    radius = disc_radius_m(camera, depth_m)
    disc = energy_within(psf, camera.pixel_m, radius)
    ring = total(psf) - disc
    if is_traced(disc):
        ratio = jnp.where(disc > 0, ring / jnp.where(disc > 0, disc, 1.0), jnp.inf)
    else:
        ratio = ring / disc if disc > 0 else np.inf
    return RingToDisc(ratio, ring, disc, radius)


def far_spot(psf: Psf, camera: Camera, colour: Colour) -> Number:
    """Energy inside the far spot (`spot_radius_m`)."""
    return energy_within(psf, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(colour)))


def participation(psf: Any) -> Array:
    """Sum of squared pixel energies, the concentration of a `psf`: 1 for one bright pixel, 1/n for n equal ones."""
    return jnp.sum(jnp.asarray(psf) ** 2, axis=(-2, -1))


def mean_transmission(doe: CellOptic) -> Complex[np.ndarray, " w"] | Complex[Array, " w"]:
    """Mean transmission c0 for `doe.wavelengths_m`, weighted by open shares of cells and the irradiance on them."""
    return _mean_over_aperture(doe, doe.means)


def _mean_over_aperture(doe: CellOptic, values: Any) -> Any:
    if doe.camera.beam is not None:
        return stacked([_lit_mean(doe, *each) for each in zip(values, doe.wavelengths_m, strict=True)])
    if is_traced(values, doe.coverage):
        return jnp.einsum("wyx,yx->w", values, doe.coverage, precision="highest") / jnp.sum(doe.coverage)
    coverage = np.asarray(doe.coverage, np.float64)
    return np.einsum("wyx,yx->w", np.asarray(values), coverage, dtype=np.complex128) / coverage.sum()


def _lit_mean(doe: CellOptic, values: Any, wavelength_m: float) -> Any:
    xp = jnp if is_traced(values, doe.coverage) else np
    light = doe.camera.irradiance(wavelength_m)
    assert light is not None
    weights = xp.asarray(doe.coverage) * light
    return xp.sum(xp.asarray(values) * weights) / xp.sum(weights)


def opening(doe: CellOptic, wavelength_m: float) -> Any:
    """Power on the open parts of the cells, over that of the beam, or over that on the nominal aperture without one."""
    camera = doe.camera
    cells, light = camera.opening.area_in(camera.grid.pitch_m), camera.irradiance(wavelength_m)
    return total(doe.coverage if light is None else doe.coverage * light) / cells


def zeroth_order(doe: CellOptic) -> Float[np.ndarray, " w"] | Float[Array, " w"]:
    """Fraction |c0|^2 of the light that passes as if the DOE were flat, for `doe.wavelengths_m`."""
    return abs(mean_transmission(doe)) ** 2


def strehl(doe: CellOptic, nominal: CellOptic) -> Float[np.ndarray, " w"] | Float[Array, " w"]:
    """Overlap |<t conj(t_nominal)>|^2 with the field of the DOE exactly as drawn, for `doe.wavelengths_m`.

    The cells of `doe` and those of `nominal` may be parts of those that were drawn.
    """
    (ny, nx), other = doe.camera.grid.shape, nominal.camera.grid.shape[0]
    xp, common = jnp if is_traced(doe.means, nominal.means, doe.coverage) else np, math.lcm(ny, other)
    meant = in_parts(xp.conj(xp.asarray(nominal.means)), common // other)
    if (parts := common // ny) > 1:
        meant = meant.reshape(len(meant), ny, parts, nx, parts).mean((2, 4))
    return abs(_mean_over_aperture(doe, xp.asarray(doe.means) * meant)) ** 2


def in_parts(values: Any, parts: int) -> Any:
    """Values `[..., y, x]` of cells, numpy's or jax's, as those of `parts` by `parts` equal parts of every cell."""
    return values if parts == 1 else values.repeat(parts, axis=-2).repeat(parts, axis=-1)


class EnergyBudget(NamedTuple):
    """Where the power incident on the clear aperture goes, or that of the beam; the six parts sum to 1."""

    blocked: float  # of the beam by the chrome around the opening; 0 without a beam
    reflected: float  # by the two faces of the substrate
    far_spot: float  # inside the far-spot radius of the window, at every depth
    window_beside_spot: float  # elsewhere in the sensor window: throughput less far_spot
    uncollected: float  # within the DOE grid's band, but outside the window or between light-sensitive squares
    higher_orders: float  # at angles beyond lambda / (2 pitch), scattered by the square cells and the aperture's edge


_ALIKE = 0.005  # waves per cell on either side of the axis


def _band_energy(field: Complex[np.ndarray, "y x"], slope: float, band: float = 0.5) -> float:
    """Energy of square cells within a band, lit from a direction of `slope` waves per cell and cell.

    The band reaches to `band` waves per cell on either side of the axis; at most to that of the cells' grid, 1/2.
    The factor sinc(nu - slope x) of a cell is interpolated between three directions, exact to 1e-3 up to a sixth of the
    band, along each axis for itself: three transforms of all rows and three of all columns take the place of one sum
    per cell. Of directions that differ by less than a hundredth of a wave per cell over the aperture one does, to 1e-4.
    """
    reach = slope * max(field.shape) / 2
    nodes = reach * np.cos(np.pi * np.array([1, 3, 5]) / 6) if abs(reach) > _ALIKE else np.zeros(1)
    # Columns first: those that lie beyond the band need no transform along y.
    for axis in (1, 0):
        cells = field.shape[axis]
        lit, nu = slope * (np.arange(cells) - (cells - 1) / 2), np.fft.fftfreq(cells)
        inside = (nu >= -band) & (nu < band)
        along: tuple[int, int] = (-1, 1) if axis == 0 else (1, -1)
        summed = np.zeros(field.shape, np.complex64)
        for a in nodes:
            share = np.prod([(lit - b) / (a - b) for b in nodes if b != a], axis=0) * np.ones(cells)
            weighted = field * share.astype(np.float32).reshape(along)
            part = np.asarray(fft(weighted, axis=axis, workers=-1, overwrite_x=True))
            part *= np.sinc(nu - a).astype(np.float32).reshape(along)
            summed += part
        field = summed if inside.all() else summed.compress(inside, axis)
    return float(np.sum(np.square(np.abs(field)), dtype=np.float64))


def energy_budget(
    optic: CellOptic,
    psf: Float[np.ndarray, "v u"],
    depth_m: float,
    colour: Colour,
    *,
    pitch_m: float | None = None,
) -> EnergyBudget:
    """Energy budget of one PSF of one colour.

    Args:
        optic: the DOE that made the PSF, on the axis.
        psf: `[y, x]` PSF on the sensor, Fresnel loss included.
        depth_m: source depth, metres.
        colour: colour of this PSF.
        pitch_m: pitch of the DOE's grid, metres, where the optic's cells are parts of its cells.

    The band's share comes from a transform of its own (Parseval on the bare DOE grid, with the cells' sinc), so
    `uncollected` near zero or below it would show a fault in either.
    """
    camera = optic.camera
    cells = camera.grid.shape[0] * camera.grid.shape[1]
    scale = camera.opening.area_in(camera.grid.pitch_m, cells)
    reach = camera.grid.pitch_m / (pitch_m or camera.grid.pitch_m) / 2
    entered = passed = band = 0.0
    curvature = camera.curvature_per_m(1 / depth_m) if camera.distance_m is None else 1 / depth_m
    for line in replace(camera, colours=(colour,)).lines:
        field = np.asarray(optic.field(line, depth_m))
        wavelength, open_ = line.wavelength_m, 1.0
        if camera.distance_m is not None:  # the band is one of directions behind the DOE, not of places
            field = field * np.exp(-2j * np.pi * source_path_m(camera, np.inf) / wavelength).astype(np.complex64)
        if (light := camera.incident(line)) is not None:
            open_ = float(np.sum(np.abs(light) ** 2 * np.asarray(optic.coverage), dtype=np.float64))
            open_ *= cells / scale
        slope = (curvature + camera.beam_curvature_per_m(wavelength)) * camera.grid.pitch_m**2 / wavelength
        entered += line.factor / camera.transmission(wavelength) * open_
        passed += line.factor * open_
        band += line.factor * _band_energy(field, slope, reach) / scale
    energy, spot = float(total(psf)), float(far_spot(psf, camera, colour))
    lost = 0.0 if camera.beam is None else 1 - entered
    return EnergyBudget(lost, entered - passed, spot, energy - spot, band - energy, passed - band)


@dataclass(frozen=True)
class MetricInputs:
    """A DOE and its PSFs, from which metrics are computed."""

    energy: Any  # `[colour, depth, y, x]` PSFs, as in a `PsfBank`
    depths_m: Sequence[float]  # their depths, metres
    camera: Camera  # lens, sensor and substrate
    near_m: Sequence[float] = ()  # which of the depths are obstructions, metres
    doe: CellOptic | None = None  # the DOE
    nominal: CellOptic | None = None  # the DOE exactly as drawn, to compare with
    lens: Any = None  # PSFs of the bare lens, to compare with
    aimed: Mapping[str, float] | None = None  # numbers of what the DOE should draw, for the first colour

    def of_colours(self, values: Any) -> list[Any]:
        """Values for `doe.wavelengths_m` as their weighted sums for every colour."""
        assert self.doe is not None
        found = dict(zip(self.doe.wavelengths_m, values, strict=True))
        return [
            sum(weight * found[w] for w, weight in zip(colour.wavelengths_m, colour.weights, strict=True))
            for colour in self.camera.colours
        ]

    @cached_property
    def orders(self) -> list[Any]:
        """0th order of every colour."""
        assert self.doe is not None
        return self.of_colours(zeroth_order(self.doe))

    @cached_property
    def strehls(self) -> list[Any]:
        """Strehl ratio of every colour."""
        assert self.doe is not None
        assert self.nominal is not None
        return self.of_colours(strehl(self.doe, self.nominal))

    def passed(self, colour: int) -> Any:
        """Power of a colour that passes the opening and the substrate's faces."""
        assert self.doe is not None
        return self._through(self.doe, colour)

    def passed_as_drawn(self, colour: int) -> Any:
        """Power of a colour that passes the DOE as drawn."""
        plain = self.camera.beam is None
        assert plain or self.nominal is not None
        own = (line.factor for line in self.camera.lines if line.colour == colour)
        return sum(own) if plain else self._through(self.nominal, colour)

    def _through(self, doe: Any, colour: int) -> Any:
        own = [line for line in self.camera.lines if line.colour == colour]
        return sum(line.factor * opening(doe, line.wavelength_m) for line in own)

    def far_spot(self, colour: int, depth: int) -> Any:
        """Far-spot energy of one PSF."""
        return far_spot(self.energy[colour, depth], self.camera, self.camera.colours[colour])

    @cached_property
    def lens_participation(self) -> Any:
        """Participation `[colour, depth]` of the bare lens."""
        assert self.lens is not None
        return participation(self.lens)

    def concentration(self, colour: int, depth: int) -> Any:
        """Participation of one PSF over that of the bare lens."""
        own, lens = participation(self.energy[colour, depth]), self.lens_participation[colour, depth]
        return own / lens if is_traced(own, lens) else float(own) / float(lens)

    def concentration_bound(self, colour: int, depth: int) -> Any:
        """Least concentration of a near PSF that keeps all light in the window, or None without a far depth.

        The share s of the light that a far source finds in its sharp spot cannot tell depths apart: nearby it draws
        the bare lens's disc. What is left at best spreads evenly over the window, of which the disc covers the part
        a: s² + (1 - s)² a. The disc's area is that of an even disc as concentrated as the lens's PSF. Light that leaves
        the window may take a PSF below it.
        """
        far = [self.far_spot(colour, d) for d, at in enumerate(self.depths_m) if at not in self.near_m]
        if not far:
            return None
        lens = total(self.lens[colour, depth])
        kept = reduce(jnp.maximum if is_traced(far) else max, far) / lens
        area = lens**2 / self.lens_participation[colour, depth] / self.camera.window**2
        return kept**2 + (1 - kept) ** 2 * area


@dataclass(frozen=True)
class Metric:
    """One number per colour and depth."""

    label: str  # its name in pictures and tables
    # Value for (inputs, colour, depth), the latter two as positions in the bank
    of: Callable[[MetricInputs, int, int], Any]
    tables: tuple[Literal["design", "fabricated"], ...]  # which tables list it
    depths: Literal["all", "near", "far"] = "all"  # for which depths it is meant
    # On which side a DOE is bad, for limits and yield; None for a number without limits
    worse: Literal["high", "low"] | None = None
    unit: Literal["1", "%", "m"] = "1"  # "1", "m", or "%" for a share, which is shown in per cent
    aimed: bool = False  # whether it is known only of a DOE that should draw something
    definition: str = ""  # what it is, with its formula; the reference of numbers takes it from here

    @property
    def share(self) -> bool:
        """Whether it is shown in per cent."""
        return self.unit == "%"


_BOTH = ("design", "fabricated")


def _aimed_metric(name: str, label: str, worse: Literal["high", "low"], definition: str) -> Metric:
    of: Any = lambda e, c, d: (e.aimed or {})[name]  # noqa: E731
    return Metric(label, of, ("fabricated",), "far", worse, "%", aimed=True, definition=definition)


METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        "zeroth_order": Metric(
            "0th order",
            lambda e, c, d: e.orders[c],
            _BOTH,
            worse="high",
            unit="%",
            definition="share of the light that passes as if the DOE were flat: |c0|², c0 the mean transmission over "
            "the open cells, weighted by the irradiance of the beam",
        ),
        "strehl": Metric(
            "relative Strehl ratio",
            lambda e, c, d: e.strehls[c],
            ("fabricated",),
            worse="low",
            definition="overlap of the field behind the DOE with that of the design exactly as drawn, |mean of t "
            "conj(t_drawn)|²: 1 for a plate made as drawn, whatever share of the light its design puts in "
            "the spot (that is far_spot)",
        ),
        "throughput": Metric(
            "throughput",
            lambda e, c, d: total(e.energy[c, d]),
            _BOTH,
            worse="low",
            unit="%",
            definition="share of the light on the clear aperture, or of the beam's power, that lands in the sensor "
            "window: far_spot + window_beside_spot",
        ),
        "outside_window": Metric(
            "light outside the window",
            lambda e, c, d: e.passed(c) - total(e.energy[c, d]),
            ("fabricated",),
            worse="high",
            unit="%",
            definition="share of the light that passes opening and glass and misses the sensor window",
        ),
        "chrome": Metric(
            "light by chrome",
            lambda e, c, d: e.passed(c) - e.passed_as_drawn(c),
            ("fabricated",),
            unit="%",
            definition="light that the chrome opening of the plate lets through beyond that of the design as drawn; "
            "negative where it blocks more",
        ),
        "ring_to_disc": Metric(
            "ring:disc",
            lambda e, c, d: ring_to_disc(e.energy[c, d], e.camera, e.depths_m[d]).ratio,
            _BOTH,
            "near",
            worse="low",
            definition="light of the window outside the geometric defocus disc over that inside, the disc widened by "
            "one pixel (disc_radius)",
        ),
        "disc_radius_m": Metric(
            "radius of the defocus disc",
            lambda e, c, d: disc_radius_m(e.camera, e.depths_m[d]),
            ("design",),
            "near",
            unit="m",
            definition="radius of the geometric defocus disc of the depth and one pixel more, on the sensor; "
            "disc_radius_rad, an angle, without one",
        ),
        "concentration": Metric(
            "concentration",
            lambda e, c, d: e.concentration(c, d),
            ("design",),
            "near",
            definition="sum of the squared pixel energies over that of the plain lens at the same depth: 1 for the "
            "lens, less for light that is spread",
        ),
        "concentration_bound": Metric(
            "least concentration",
            lambda e, c, d: e.concentration_bound(c, d),
            ("design",),
            "near",
            definition="least concentration of a near PSF that keeps all light in the window: s² + (1 - s)² a, s the "
            "largest far_spot of the colour over the lens's light in the window, a the lens's defocus disc "
            "as a share of the window; light that leaves the window may take a PSF below it",
        ),
        "far_spot": Metric(
            "far spot",
            lambda e, c, d: e.far_spot(c, d),
            _BOTH,
            "far",
            worse="low",
            unit="%",
            definition="share of the light inside the far spot, a disc of spot_radius about the chief ray",
        ),
        "spot_radius_m": Metric(
            "radius of the far spot",
            lambda e, c, d: spot_radius_m(e.camera, mean_wavelength_m(e.camera.colours[c])),
            ("design",),
            "far",
            unit="m",
            definition="radius that counts as the far spot: the first dark ring of the ideal lens, 1.22 wavelength x "
            "distance / aperture, and one pixel; spot_radius_rad, an angle, without a sensor",
        ),
        "on_target": _aimed_metric(
            "on_target",
            "light on the target",
            "low",
            "share of the light on what the design should draw, without the loss at the glass faces: on all "
            "spots; where at least 13.5 % of the light of an area is wanted (the worst area of several); "
            "within the foci as wide as wanted, by their weights; of a target pattern inside its spots, or "
            "where it is above half its peak",
        ),
        "uniformity_error": _aimed_metric(
            "uniformity_error",
            "uniformity error",
            "high",
            "(max - min) / (max + min) of the light of all spots, each over the light wanted there",
        ),
        "contrast": _aimed_metric(
            "contrast",
            "contrast",
            "high",
            "root mean square of light over light wanted less 1, where at least 90 % of an area's light is "
            "wanted and in its dark frame; the worst of several areas",
        ),
        "focus_width": _aimed_metric(
            "focus_width",
            "largest width of the foci over that wanted",
            "high",
            "largest full width at half maximum of the foci over the width wanted; a tolerance study counts at most 10",
        ),
    }
)


def metric_rows(inputs: MetricInputs, table: Literal["design", "fabricated"]) -> list[dict[str, Any]]:
    """One row per depth and colour: `colour`, `depth_m` (None for infinity) and the metrics of a table.

    A ring:disc ratio without any light in the disc is infinite. Lengths on a sensor are angles where there is none, and
    their names end in `_rad`.
    """
    rows = []
    for d, depth in enumerate(inputs.depths_m):
        shown = ("all", "near" if depth in inputs.near_m else "far")
        for c, colour in enumerate(inputs.camera.colours):
            row: dict[str, Any] = {"colour": colour.name, "depth_m": None if np.isinf(depth) else depth}
            for name, metric in METRICS.items():
                if metric.aimed and (c > 0 or name not in (inputs.aimed or {})):
                    continue
                if table in metric.tables and metric.depths in shown:
                    value = metric.of(inputs, c, d)
                    key = name
                    if metric.unit == "m" and inputs.camera.in_angles:
                        key, value = f"{name.removesuffix('_m')}_rad", np.arcsin(min(float(value), 1.0))
                    row[key] = None if value is None else float(value)
            rows.append(row)
    return rows


def without_infinities(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows for a JSON file, which has no infinity: None in its place."""
    return [{name: None if value == np.inf else value for name, value in row.items()} for row in rows]
