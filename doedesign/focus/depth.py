"""Foci of a DOE through the distances: how wide, how bright, and how much of the light lies in them."""

import csv
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign.design.design import Design
from doedesign.focus.foci import Foci
from doedesign.focus.problem import BESIDE, focus_light
from fab.units import require_kind
from sim.camera import Camera
from sim.metrics import cell_optic_of, zeroth_order
from sim.optic import CellOptic
from sim.propagation.near_axis import profiles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

_PLACES = np.linspace(-2.0, 2.0, 129)  # of the profiles, over the width wanted


@dataclass(frozen=True, eq=False)
class FocusTable:
    """Foci of a design.

    Attributes:
        foci: distances and widths wanted.
        camera: optics.
        light: `[focus, (y, x), place]` light along y and x at `places`, over that on the axis.
        strength: `[focus]` light on the axis over that of an ideal lens of the same aperture, the Strehl ratio there.
        share: `[focus]` share of the incident light within a circle as wide as is wanted, Fresnel loss left out.
        zeroth_order: share of the light that passes as if the DOE were flat.
        fresnel: share of the light that passes both faces of the substrate, which none of these numbers has.
    """

    foci: Foci
    camera: Camera
    light: Float[np.ndarray, "focus 2 place"]
    strength: Float[np.ndarray, " focus"]
    share: Float[np.ndarray, " focus"]
    zeroth_order: float
    fresnel: float

    @property
    def name(self) -> str:
        """Name of its files and of its entry among metrics."""
        return "focus"

    @property
    def places(self) -> Float[np.ndarray, " place"]:
        """Places of the profiles, over the width wanted."""
        return _PLACES

    @property
    def width_m(self) -> Float[np.ndarray, "focus 2"]:
        """Full width at half of the light on the axis along y and x; infinite beyond four times the width wanted."""
        own = [[_width(along) for along in focus] for focus in self.light]
        return np.array(own) * self.foci.width_m[:, None]

    @property
    def worst(self) -> float:
        """Largest width over that wanted."""
        return float((self.width_m / self.foci.width_m[:, None]).max())

    @property
    def loss(self) -> float:
        """Number that the design makes as small as it can, with the light beside the axis to all four sides."""
        beside = self.light[:, :, np.isin(np.abs(_PLACES), BESIDE)].reshape(len(self.light), -1)
        light = self.strength[:, None] * np.concatenate([np.ones((len(beside), 1)), beside], axis=1)
        return float(focus_light(jnp.asarray(light), jnp.asarray(self.foci.weight)).loss)

    def summary(self) -> dict[str, Any]:
        """All numbers, for metrics."""
        widths = self.width_m
        rows = [
            {
                "distance_m": float(self.foci.distance_m[k]),
                "colour": self.camera.colours[self.foci.colour[k]].name,
                "width_wanted_m": float(self.foci.width_m[k]),
                **{f"width_{axis}_m": _finite(width) for axis, width in zip("yx", widths[k], strict=True)},
                "strength": float(self.strength[k]),
                "share": float(self.share[k]),
            }
            for k in range(len(widths))
        ]
        return {
            "foci": rows,
            "focus_width": _finite(self.worst),
            "zeroth_order": self.zeroth_order,
            "ceiling": None,
            "ceiling_source": "none known",
            "fresnel_transmission": self.fresnel,
            "light": self.camera.light,
        }

    def measures(self) -> dict[str, float]:
        """Numbers that a tolerance study follows; a lost focus counts as ten times as wide, for means need a number."""
        return {"on_target": float(self.foci.weight @ self.share), "focus_width": min(self.worst, 10.0)}

    def describe(self) -> str:
        """One line."""
        ends = sorted({0, len(self.strength) - 1})
        strengths = " to ".join(f"{100 * s:.2g}" for s in sorted({self.strength.min(), self.strength.max()}))
        words = ", ".join(f"{_um(self.width_m[k].max())} um at {self.foci.words(k, self.camera)}" for k in ends)
        worst = "?" if np.isinf(self.worst) else f"{self.worst:.2f}"
        return (
            f"focus {words} wide; at worst {worst} times the width wanted, of {len(self.strength)} looked at; "
            f"{strengths} % of an ideal lens's light on the axis (ceiling: none known), 0th order "
            f"{100 * self.zeroth_order:.3g} %; Fresnel loss of {100 * (1 - self.fresnel):.1f} % apart"
        )

    def to_csv(self) -> str:
        """A row per focus: distance, colour, widths, strength and share."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["distance_mm", "colour", "wanted_um", "width_y_um", "width_x_um", "strength", "share"])
        for k, (along_y, along_x) in enumerate(self.width_m):
            own = self.foci.distance_m[k] * 1e3, self.foci.width_m[k] * 1e6, along_y * 1e6, along_x * 1e6
            distance, *widths = (f"{value:.6g}" for value in own)
            colour = self.camera.colours[self.foci.colour[k]].name
            writer.writerow([distance, colour, *widths, f"{self.strength[k]:.6g}", f"{self.share[k]:.6g}"])
        return out.getvalue()

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw widths and light through the distances; on `ax`, or on a new figure."""
        from doedesign.report.focus import plot_focus

        return plot_focus(self, ax)

    def _repr_html_(self) -> str:
        """Its line and its picture for notebooks."""
        from fab.figure import html_of

        return html_of("Foci", {"foci": self.describe()}, self.plot())


def focus_of_design(design: Design, doe: CellOptic) -> FocusTable:
    """Foci of a design's spec, of the design as drawn or as fabricated."""
    assert design.spec is not None
    assert design.spec.focus is not None
    return focus_table(doe, Foci.shown(design.spec.focus, design.camera))


def focus_table(doe: Any, foci: Foci) -> FocusTable:
    """Look at the foci of a DOE without a lens.

    Args:
        doe: the DOE: a design, or an optic of cells, as drawn, as fabricated, with or without the light of its walls.
        foci: where to look.

    Raises:
        InputError: an argument of another kind.
    """
    doe = cell_optic_of("doe", doe)
    cure = "For example dd.Foci(distance_m, width_m, weight, colour); those of a spec: dd.fabricated(design).aimed."
    require_kind("foci", foci, Foci, cure)
    camera = doe.camera
    light, strength, share = [], [], []
    for distance, width, colour in zip(foci.distance_m, foci.width_m, foci.colour, strict=True):
        along, axis, ideal = np.zeros((2, len(_PLACES))), 0.0, 0.0
        own = [line for line in camera.lines if line.colour == colour]
        whole = sum(line.factor for line in own)
        for line in own:
            behind = np.asarray(doe.field(line))
            field, most = profiles(camera, behind, line, _PLACES * width, float(distance))
            along += line.factor / whole * np.abs(field) ** 2
            axis += line.factor / whole * abs(field[0, len(_PLACES) // 2]) ** 2
            ideal += line.factor / whole * most**2
        light.append(along / axis)
        strength.append(axis / ideal)
        share.append(_within(along, width))
    return FocusTable(
        foci,
        camera,
        np.array(light),
        np.array(strength),
        np.array(share),
        float(zeroth_order(doe)[0]),
        camera.transmission(camera.lines[0].wavelength_m),
    )


def _within(along: Float[np.ndarray, "2 place"], width_m: float) -> float:
    """Light within a circle of a width: the mean of both profiles and sides at every radius, around the axis."""
    middle = len(_PLACES) // 2
    radius = _PLACES[middle:] * width_m
    light = (along[:, middle:] + along[:, middle::-1]).mean(0) / 2
    inside = radius <= width_m / 2 * (1 + 1e-9)
    return float(np.trapezoid(2 * np.pi * radius[inside] * light[inside], radius[inside]))


def _width(along: Float[np.ndarray, " place"]) -> float:
    """Distance between the first places on both sides where light has half its value on the axis."""
    middle = len(_PLACES) // 2
    sides = []
    for light in (along[middle:], along[middle::-1]):
        below = np.flatnonzero(light < 0.5)
        if not len(below):
            return np.inf
        k = below[0]
        sides.append(k - (0.5 - light[k]) / (light[k - 1] - light[k]))
    return float(sum(sides) * (_PLACES[1] - _PLACES[0]))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _um(width_m: float) -> str:
    return "?" if np.isinf(width_m) else f"{width_m * 1e6:.4g}"
