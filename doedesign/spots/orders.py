"""The table of spots or orders that a DOE makes: the light of each, how equal they are, and what light allows."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex, Float

from doedesign.design.given_wave import WaveShare
from doedesign.spec.targets.spots import ONE_OF_THE_SPOTS, open_periods
from doedesign.spots.spots import Spots
from doedesign.spots.superposition import spot_light
from fab.aperture import MaskAperture, RoundAperture
from fab.grid import Grid
from fab.units import MILLIMETRES, PlaceUnit, require_kind
from sim.camera import Camera
from sim.illumination import Beam, EvenBeam
from sim.metrics import cell_optic_of, opening
from sim.propagation.directions import DirectionSum, peak_amplitudes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

# Spot widths from a spot within which light that goes straight on is its light.
_AT_THE_ZEROTH = 0.5
_ALL = 0.9995  # of a beam
_OPEN = 0.999  # of a cell
_AROUND = 3  # orders beyond the spots among which stray light is looked for

# Efficiency of equal spots by a DOE of any phase: the best that is known, columns by rows.
_KNOWN = {
    (2, 1): 0.8106,
    (3, 1): 0.9256,
    (5, 1): 0.9212,
    (6, 1): 0.8908,
    (7, 1): 0.9684,
    (8, 1): 0.9597,
    (9, 1): 0.9928,
    (2, 2): 0.9179,
    (3, 3): 0.9394,
    (4, 4): 0.9546,
    (5, 5): 0.9510,
    (6, 6): 0.9432,
    (7, 7): 0.9400,
    (8, 8): 0.9389,
    (9, 9): 0.9856,  # two rows of nine, one along each axis; searches have found 0.9415
}
_SOURCE = (
    "best of many searches with any phase, or of two rows; rows as L. A. Romero and F. M. Dickey, "
    "J. Opt. Soc. Am. A 24, 2280"
)


@dataclass(frozen=True)
class Ceiling:
    """Largest efficiency that light allows, as far as it is known, and who says so."""

    efficiency: float | None
    source: str

    def behind(self, passed: float) -> "Ceiling":
        """The same of light of which a share has passed the chrome."""
        if self.efficiency is None or passed > _ALL:
            return self
        return Ceiling(passed * self.efficiency, f"{self.source}; times the {100 * passed:.3g} % that pass the chrome")


def ceiling_of(count: tuple[int, int] | None, levels: int, *, equal: bool = True) -> Ceiling:
    """The best known efficiency of a grid of equal spots in any phase, times sinc²(1 / levels) for their levels.

    The second factor is the share that phases of all values keep when they are rounded to equal levels (J. W. Goodman,
    *Introduction to Fourier Optics*). Patterns that keep to few phases lose less, and those of two levels are not bound
    by it at all.
    """
    known = None if count is None or not equal else _KNOWN.get((max(count), min(count)))
    if known is None or levels == 2:
        return Ceiling(None, "none known")
    return Ceiling(known * float(np.sinc(1 / levels)) ** 2, f"{_SOURCE}; times sinc²(1/{levels})")


@dataclass(frozen=True, eq=False)
class OrderTable:
    """Light of every spot of a DOE.

    Attributes:
        spots: where they are.
        efficiency: `[spot]` share of the light on the aperture, or of the power of a beam, Fresnel loss left out.
        zeroth_order: the same of light that goes straight on.
        strongest_stray: the same of the strongest order around the spots that should have none; None where spots lie on
            no lattice.
        fresnel: share of the light that passes both faces of the substrate, which none of these numbers has.
        places_m: `[spot, (y, x)]` on the sensor, direction sines without one.
        ceiling: what light allows.
        light: "scalar" or "edges", as the DOE was looked at.
        unit: in which places are told.
        phase_errors: `[spot]` phases less those that are given, radians, after the best common one; None where free.
        wave: how much light is in the wave of the phases that are given; None where they are free.
        zeroth_order_wanted: whether a spot lies where light goes straight on, so that the 0th order is no leakage.
        colour: name of the colour that was looked at.
    """

    spots: Spots
    efficiency: Float[np.ndarray, " m"]
    zeroth_order: float
    strongest_stray: float | None
    fresnel: float
    places_m: Float[np.ndarray, "m 2"]
    ceiling: Ceiling
    light: str = "scalar"
    unit: PlaceUnit = MILLIMETRES
    phase_errors: Float[np.ndarray, " m"] | None = None
    wave: WaveShare | None = None
    zeroth_order_wanted: bool = False
    colour: str = ""

    @property
    def total(self) -> float:
        """Share of the light on all spots.

        For orders of a unit cell, summed over whole periods in a disc or a rectangle, it is at most 1. Spots apart
        each count a little of their neighbours' light, less than 2 % of that of one at the least distance of a spec
        (`doedesign.spec.targets.spots`), so that their total may be some percent too large.
        """
        return float(self.efficiency.sum())

    @property
    def uniformity_error(self) -> float:
        """(max - min) / (max + min) of the light over what it should be."""
        return spot_light(self.efficiency, self.spots.shares).uniformity_error

    @property
    def rmse(self) -> float:
        """Root mean square of the relative deviations from the wanted shares of the total."""
        return float(np.sqrt(np.mean((self.efficiency / self.spots.shares / self.total - 1) ** 2)))

    @property
    def signal_to_noise(self) -> float | None:
        """Mean spot over the strongest stray order."""
        return None if not self.strongest_stray else self.total / self.spots.count / self.strongest_stray

    @property
    def name(self) -> str:
        """Name of its files and of its entry among metrics."""
        return "orders"

    def summary(self) -> dict[str, Any]:
        """All numbers, for metrics."""
        return (self.wave.summary() if self.wave else {}) | {
            "on_target": self.total,
            "uniformity_error": self.uniformity_error,
            "rmse": self.rmse,
            "zeroth_order_efficiency": self.zeroth_order,
            "zeroth_order_wanted": self.zeroth_order_wanted,
            "strongest_stray": self.strongest_stray,
            "signal_to_noise": self.signal_to_noise,
            "ceiling": self.ceiling.efficiency,
            "ceiling_source": self.ceiling.source,
            "fresnel_transmission": self.fresnel,
            "light": self.light,
            "spots": [float(one) for one in self.efficiency],
        }

    def measures(self) -> dict[str, float]:
        """Numbers that a tolerance study follows."""
        return {"on_target": self.total, "uniformity_error": self.uniformity_error}

    def describe(self) -> str:
        """One line."""
        known = self.ceiling.efficiency
        bound = "ceiling: none known" if known is None else f"ceiling of equal spots: {100 * known:.1f} %"
        wave = f", {self.wave}" if self.wave else ""
        wanted = f" ({ONE_OF_THE_SPOTS})" if self.zeroth_order_wanted else ""
        return (
            f"{self.spots.count} spots: {100 * self.total:.2f} % of the light ({bound}), uniformity error "
            f"{100 * self.uniformity_error:.2f} %{wave}, 0th order {100 * self.zeroth_order:.3f} %{wanted}; Fresnel "
            f"loss of {100 * (1 - self.fresnel):.1f} % apart"
        )

    def to_csv(self) -> str:
        """The table: order, place in millimetres or degrees, efficiency, its share over the wanted one, phase error."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        unit = self.unit.suffix
        given = self.phase_errors is not None
        head = ["order_x", "order_y", f"x_{unit}", f"y_{unit}", "efficiency", "over_wanted"]
        writer.writerow([*head, "phase_error_deg"] if given else head)
        orders = self.spots.orders if self.spots.orders is not None else np.full((self.spots.count, 2), -1)
        over = self.efficiency / self.spots.shares / self.total
        off = np.zeros(self.spots.count) if self.phase_errors is None else np.degrees(self.phase_errors)
        places = self.unit.of(self.places_m)
        for order, place, one, share, angle in zip(orders, places, self.efficiency, over, off, strict=True):
            names = ["", ""] if self.spots.orders is None else [int(order[1]), int(order[0])]
            numbers = [f"{number:.9g}" for number in (place[1], place[0], one, share, angle)]
            writer.writerow([*names, *(numbers if given else numbers[:-1])])
        return out.getvalue()

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the light of every spot as bars, and where they lie; on `ax`, or on a new figure."""
        from doedesign.report.spots import plot_orders

        return plot_orders(self, ax)

    def _repr_html_(self) -> str:
        """Its line and its picture for notebooks."""
        from fab.figure import html_of

        return html_of("Light of every spot", {"spots": self.describe()}, self.plot())


@dataclass(frozen=True)
class OrderTables:
    """Light of the spots of several colours.

    Attributes:
        tables: one for each colour.
    """

    tables: tuple[OrderTable, ...]

    @property
    def name(self) -> str:
        """Name of its files and of its entry among metrics."""
        return "orders"

    def summary(self) -> list[dict[str, Any]]:
        """All numbers of every colour, for metrics."""
        return [{"colour": one.colour, **one.summary()} for one in self.tables]

    def measures(self) -> dict[str, float]:
        """Numbers that a tolerance study follows: those of the worst colour."""
        return {
            "on_target": min(one.total for one in self.tables),
            "uniformity_error": max(one.uniformity_error for one in self.tables),
        }

    def describe(self) -> str:
        """A line for every colour."""
        return "\n".join(f"{one.colour}: {one.describe()}" for one in self.tables)

    def to_csv(self) -> str:
        """The tables of `OrderTable.to_csv`, every line after the name of its colour."""
        head, lines = "", []
        for one in self.tables:
            head, *rows = one.to_csv().splitlines()
            lines += [f"{one.colour},{row}" for row in rows]
        return "\n".join([f"colour,{head}", *lines]) + "\n"

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the spots of every colour below each other; on `ax`, or on a new figure."""
        from doedesign.report.spots import plot_colours

        return plot_colours(self.tables, ax)

    def _repr_html_(self) -> str:
        """Its line and its picture for notebooks."""
        from fab.figure import html_of

        return html_of("Light of every spot", {one.colour: one.describe() for one in self.tables}, self.plot())


def order_table(
    optic: Any,
    spots: Spots,
    *,
    period_m: float | None = None,
    count: tuple[int, int] | None = None,
    levels: int = 0,
    colour: int = 0,
) -> OrderTable:
    """Look at the spots of a DOE: as drawn, as fabricated, with or without the light of its walls.

    Args:
        optic: the DOE: a design, or an optic of cells, such as a DOE as fabricated.
        spots: where light should go.
        period_m: side of a unit cell that is repeated, metres. Only whole periods within the aperture, in a square if
            it is round, are looked at, as if there were no end of them: behind a round aperture the feet of bright
            neighbours add to a peak, and so they do where a mask closes corners of a rectangle.
        count: columns and rows of a grid of equal spots, for the ceiling.
        levels: levels of the DOE, for the ceiling.
        colour: number of the colour whose first wavelength is looked at.

    Raises:
        InputError: an argument of another kind, or a colour that the camera does not have.
    """
    optic = cell_optic_of("optic", optic, colour)
    cure = "For example dd.Spots(waves_per_m, shares); those of a spec are in dd.fabricated(design, seed=0).aimed."
    require_kind("spots", spots, Spots, cure)
    camera, line = optic.camera, next(one for one in optic.camera.lines if one.colour == colour)
    # Directions are what a lens would show in its focus, whatever the light on the DOE and the way behind it.
    away = camera.distance_m is not None and not camera.in_angles
    focal = {"distance_m": None, "focal_length_m": camera.distance_m} if away else {}
    bare = camera.beam is not None or away
    plain = replace(optic, camera=replace(camera, beam=_even_along(camera.beam), **focal)) if bare else optic
    field, coverage, grid = np.asarray(plain.field(line, np.inf)), np.asarray(optic.coverage), camera.grid
    # Of a beam that is wider than the opening the chrome takes its part, as it does from PSFs and areas.
    even = camera.beam is None or isinstance(camera.beam, EvenBeam)
    passed = 1.0 if even else float(opening(optic, line.wavelength_m))
    if camera.beam is not None and period_m is None:  # a spot is what has the shape of the beam's own far field
        light = camera.irradiance(line.wavelength_m)
        field, coverage = field * light, coverage * light
    middle_m = (0.0, 0.0)
    if period_m is not None:
        field, coverage, grid, middle_m = _whole_periods(field, coverage, camera, period_m, spots)
    asked = [spots.waves_per_m, np.zeros((1, 2)), *([stray] if len(stray := _stray(spots)) else [])]
    light = peak_amplitudes(field, coverage, grid, np.concatenate(asked)) * np.sqrt(passed)
    found, own_light, given = np.abs(light) ** 2, light[: spots.count], spots.about(middle_m)
    errors, wave = (None, None) if given.phases is None else _in_wave(given, own_light, coverage, grid, passed)
    own, zeroth, rest = np.split(found, [spots.count, spots.count + 1])
    equal = bool(np.ptp(spots.shares) < 1e-9)
    return OrderTable(
        spots,
        own,
        float(zeroth[0]),
        float(rest.max()) if len(rest) else None,
        camera.transmission(line.wavelength_m),
        _places_m(spots, camera, line.wavelength_m),
        ceiling_of(count, levels, equal=equal).behind(passed) if levels else Ceiling(None, "none known"),
        camera.light,
        camera.told_in(MILLIMETRES),
        errors,
        wave,
        bool(np.any(np.hypot(*(spots.waves_per_m * camera.opening.widest_m).T) < _AT_THE_ZEROTH)),
        camera.colours[colour].name,
    )


def _even_along(beam: Beam | None) -> EvenBeam | None:
    """Plane light as bright everywhere from where a beam comes: oblique glass delays it more. None along the axis."""
    if beam is None or not any((*beam.angle_rad, *beam.tilt_rad)):
        return None
    return EvenBeam(angle_rad=beam.angle_rad, tilt_rad=beam.tilt_rad)


def _in_wave(
    spots: Spots, light: Complex[np.ndarray, " m"], coverage: Float[np.ndarray, "y x"], grid: Grid, passed: float
) -> tuple[Float[np.ndarray, " m"], WaveShare]:
    """Phase errors of spots of given phases, and how much light is in their wave, of which a share has `passed`."""
    wave = DirectionSum(grid, spots.waves_per_m).superposition(spots.wave)
    in_step = np.sum(np.abs(wave) * coverage, dtype=np.float64) / np.sum(coverage, dtype=np.float64)
    errors = spots.phase_errors(light)
    return errors, WaveShare(spots.in_wave(light), float(passed * in_step**2), float(np.sqrt(np.mean(errors**2))))


def _whole_periods(
    field: Complex[np.ndarray, "y x"], coverage: Float[np.ndarray, "y x"], camera: Camera, period_m: float, spots: Spots
) -> tuple[Complex[np.ndarray, "v u"], Float[np.ndarray, "v u"], Grid, tuple[float, float]]:
    """Field, open share, grid and middle of the whole periods that fit into the opening, or a square in a round one."""
    grid = camera.grid
    period, within = round(period_m / grid.pitch_m), 1.0
    if isinstance(camera.opening, MaskAperture):
        assert spots.orders is not None
        height, width = (period if np.ptp(orders) else 1 for orders in spots.orders.T)
        whole = open_periods(coverage > _OPEN, (height, width))
        # Chrome that lies off may leave none whole.
        whole = whole if whole.any() else coverage > 0
        return field * whole, coverage * whole, grid, (0.0, 0.0)
    if isinstance(camera.opening, RoundAperture):
        within = np.sqrt(2)
    open_ = [np.count_nonzero(line > _OPEN) for line in (coverage[:, grid.shape[1] // 2], coverage[grid.shape[0] // 2])]
    height, width = (period * max(1, int(count / within) // period) for count in open_)
    first = [(n - side) // 2 for n, side in zip(grid.shape, (height, width), strict=True)]
    block = tuple(slice(at, at + side) for at, side in zip(first, (height, width), strict=True))
    y_m, x_m = (
        (at + side / 2 - n / 2) * grid.pitch_m for at, side, n in zip(first, (height, width), grid.shape, strict=True)
    )
    return field[block], coverage[block], Grid((height, width), grid.pitch_m), (y_m, x_m)


def _stray(spots: Spots) -> Float[np.ndarray, "n 2"]:
    """Directions of the lattice in and around the spots that should stay dark."""
    if spots.orders is None or spots.lattice_per_m is None:
        return np.empty((0, 2))
    axes = [
        np.arange(orders.min() - _AROUND, orders.max() + _AROUND + 1) if np.ptp(orders) else np.zeros(1, int)
        for orders in spots.orders.T
    ]
    every: Sequence[tuple[int, int]] = [(int(y), int(x)) for y in axes[0] for x in axes[1]]
    wanted = {(int(y), int(x)) for y, x in spots.orders}
    dark = [one for one in every if one not in wanted]
    return np.array(dark, float).reshape(-1, 2) * np.asarray(spots.lattice_per_m)


def _places_m(spots: Spots, camera: Camera, wavelength_m: float) -> Float[np.ndarray, "m 2"]:
    """Places (y, x) of the spots on the sensor, as far as a tilted beam has moved them."""
    return np.stack(camera.image_m(*(spots.waves_per_m * wavelength_m + np.array(camera.moved_sines())).T), axis=1)
