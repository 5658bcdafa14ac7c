"""The table of metrics (`METRICS`), each with its definition, and its rows for a DOE and its PSFs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from types import MappingProxyType
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from sim.camera import Camera
from sim.metrics.measures import (
    disc_radius_m,
    far_spot,
    mean_wavelength_m,
    participation,
    ring_to_disc,
    spot_radius_m,
)
from sim.metrics.transmission import opening, strehl, zeroth_order
from sim.optic import CellOptic
from sim.tracing import is_traced, total


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
    needs: Literal["psf", "doe", "lens"] = "psf"  # what it cannot be told without: the DOE, or the bare lens's PSFs
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
            needs="doe",
            definition="share of the light that passes as if the DOE were flat: |c0|², c0 the mean transmission over "
            "the open cells, weighted by the irradiance of the beam",
        ),
        "strehl": Metric(
            "relative Strehl ratio",
            lambda e, c, d: e.strehls[c],
            ("fabricated",),
            worse="low",
            needs="doe",
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
            needs="doe",
            definition="share of the light that passes opening and glass and misses the sensor window",
        ),
        "chrome": Metric(
            "light by chrome",
            lambda e, c, d: e.passed(c) - e.passed_as_drawn(c),
            ("fabricated",),
            unit="%",
            needs="doe",
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
            needs="lens",
            definition="sum of the squared pixel energies over that of the plain lens at the same depth: 1 for the "
            "lens, less for light that is spread",
        ),
        "concentration_bound": Metric(
            "least concentration",
            lambda e, c, d: e.concentration_bound(c, d),
            ("design",),
            "near",
            needs="lens",
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

    What needs a DOE or the bare lens is left out without them. A ring:disc ratio without any light in the disc is
    infinite. Lengths on a sensor are angles where there is none, and
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
                if metric.needs != "psf" and getattr(inputs, metric.needs) is None:
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
