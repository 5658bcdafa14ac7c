"""Shape of the light that a DOE makes of an area: how much lies on it, how even, how wide, how sharp its edges are."""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from doedesign.areas.problem import AreaLight, AreaScore, lattice_factors, mode_fields
from doedesign.areas.target import FLAT, OUTER, AreaTarget, camera_for, colour_number, in_plane
from doedesign.design.design import Design
from doedesign.design.given_wave import WaveShare
from doedesign.spec import input_files
from doedesign.spec.targets.areas import WITHIN_THE_AREA
from fab.units import MICROMETRES, MILLIMETRES, PlaceUnit, format_length, require_kind
from sim.camera import Camera
from sim.metrics import cell_optic_of, zeroth_order
from sim.optic import CellOptic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

_SAMPLES = 6.0  # per lambda d / D, twice as many as the optimiser has
# Profiles are means over so much of a side, on either side of the middle: straight sides bear more than round ones.
_STRAIGHT, _ROUND = 0.1, 0.03


@dataclass(frozen=True, eq=False)
class Profile:
    """Light along a line through the middle of an area, over the mean of its flat part.

    Places, sizes and edges are metres on the sensor, and radians where there is none.

    Attributes:
        place_m: places from the middle.
        light: light there.
        wanted: light wanted.
        size_m: distance between the outermost places with half the light; None without them.
        edge_m: mean of the distances from 90 to 13.5 % on both sides; None where there is no such fall.
        in_angles: whether places are angles.
    """

    place_m: Float[np.ndarray, " n"]
    light: Float[np.ndarray, " n"]
    wanted: Float[np.ndarray, " n"]
    in_angles: bool = False

    def in_unit(self, value_m: Any, unit: PlaceUnit) -> Any:
        """Places, a size or an edge in a unit of length, or in degrees."""
        return np.degrees(value_m) if self.in_angles else value_m / unit.scale

    @property
    def size_m(self) -> float | None:
        """Distance between the outermost places with half the light."""
        low, high = (self._half(side) for side in (-1, 1))
        return None if low is None or high is None else high - low

    @property
    def edge_m(self) -> float | None:
        """Mean of the distances from 90 to 13.5 % of the light on both sides."""
        widths = []
        for side in (-1, 1):
            half = self._half(side)
            if half is None:
                return None
            place, light = side * self.place_m[::side], self.light[::side]
            outside, inside = place >= side * half, place <= side * half
            low = _crossing(place[outside], light[outside], OUTER)
            high = _crossing(-place[inside][::-1], light[inside][::-1], FLAT)
            if low is None or high is None:
                return None
            widths.append(low + high)
        return float(np.mean(widths))

    def _half(self, side: int) -> float | None:
        """Outermost place with half the light on a side."""
        found = _crossing(self.place_m[::-side], self.light[::-side], 0.5)
        return None if found is None or self.place_m[::-side][0] * side <= 0 else found


def _crossing(place: Float[np.ndarray, " n"], light: Float[np.ndarray, " n"], level: float) -> float | None:
    """The first place where light crosses a level."""
    above = light >= level
    changes = np.flatnonzero(above[1:] != above[:-1])
    if not len(changes):
        return None
    k = changes[0]
    return float(place[k] + (place[k + 1] - place[k]) * (level - light[k]) / (light[k + 1] - light[k]))


@dataclass(frozen=True, eq=False)
class AreaTable:
    """Light on the area of a design.

    Attributes:
        target: the area, on a lattice finer than that of the optimiser.
        light: `[y, x]` light on the lattice over the mean of the flat part.
        camera: optics and sensor.
        efficiency: share of the incident light where at least 13.5 % is wanted, Fresnel loss left out.
        contrast: root mean square of light over what is wanted less 1, where at least 90 % is, and in a frame that
            should be dark.
        pixel_contrast: standard deviation over mean of the sensor's pixels that lie in the flat part; None without such
            pixels, and for pictures.
        zeroth_order: share of the light that passes as if the DOE were flat.
        side_lobe: strongest light where less than 13.5 % is wanted, over the mean of the flat part.
        fresnel: share of the light that passes both faces of the substrate, which none of these numbers has.
        along_x: profile along x; None for a picture.
        along_y: profile along y; None for a picture.
        wave: how much light is in the wave of the phase that is given, which is looked at where light should be flat,
            weighted by the light wanted; None where it is free.
    """

    target: AreaTarget
    light: Float[np.ndarray, "v u"]
    camera: Camera
    efficiency: float
    contrast: float
    pixel_contrast: float | None
    zeroth_order: float
    side_lobe: float
    fresnel: float
    along_x: Profile | None
    along_y: Profile | None
    wave: WaveShare | None = None

    @property
    def name(self) -> str:
        """Name of its files and of its entry among metrics."""
        return "area"

    @property
    def place(self) -> str:
        """The colour that lights it, and how far away it lies on a sensor."""
        if self.camera.in_angles:
            return self.camera.colours[0].name
        return f"{self.camera.colours[0].name}, {format_length(float(f'{self.camera.sensor_distance_m:.4g}'))}"

    def summary(self) -> dict[str, Any]:
        """All numbers, for metrics."""
        profiles, unit = (("x", self.along_x), ("y", self.along_y)), "rad" if self.camera.in_angles else "m"
        sizes = {f"size_{name}_{unit}": p and p.size_m for name, p in profiles}
        edges = {f"edge_{name}_{unit}": p and p.edge_m for name, p in profiles}
        return (self.wave.summary() if self.wave else {}) | {
            "on_target": self.efficiency,
            "contrast": self.contrast,
            "pixel_contrast": self.pixel_contrast,
            "zeroth_order": self.zeroth_order,
            "zeroth_order_wanted": self.zeroth_order_wanted,
            "side_lobe": self.side_lobe,
            **sizes,
            **edges,
            "ceiling": None,
            "ceiling_source": "none known",
            "fresnel_transmission": self.fresnel,
            "light": self.camera.light,
        }

    def measures(self) -> dict[str, float]:
        """Numbers that a tolerance study follows."""
        return {"on_target": self.efficiency, "contrast": self.contrast}

    @property
    def zeroth_order_wanted(self) -> bool:
        """Whether light goes straight on into the area, whose own light there is part of the 0th order."""
        at = []
        for axis, sine in zip((self.target.sines_y, self.target.sines_x), self.camera.moved_sines(), strict=True):
            if not axis[0] <= sine <= axis[-1]:
                return False
            at.append(int(np.abs(axis - sine).argmin()))
        return bool(self.target.lit[at[0], at[1]])

    @property
    def zeroth_order_note(self) -> str:
        """Words after the 0th order where it is wanted."""
        return f" ({WITHIN_THE_AREA})" if self.zeroth_order_wanted else ""

    def describe(self) -> str:
        """One line."""
        size = ""
        if self.along_x is not None and self.along_y is not None:
            found = [(p, p.size_m) for p in (self.along_x, self.along_y)]
            wide = ["?" if w is None else f"{p.in_unit(w, MICROMETRES):.5g}" for p, w in found]
            size = f", {wide[0]} x {wide[1]} {self.camera.told_in(MICROMETRES).suffix} at half the light"
        wave = f", {self.wave}" if self.wave else ""
        pixels = "" if self.pixel_contrast is None else f" ({100 * self.pixel_contrast:.2f} % on pixels)"
        return (
            f"{self.target.shape}: {100 * self.efficiency:.2f} % of the light (ceiling: none known), contrast "
            f"{100 * self.contrast:.2f} %{pixels}{size}{wave}, "
            f"0th order {100 * self.zeroth_order:.3f} %{self.zeroth_order_note}; "
            f"Fresnel loss of {100 * (1 - self.fresnel):.1f} % apart"
        )

    def to_csv(self) -> str:
        """Both profiles: axis, place in millimetres or degrees, light and light wanted."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["axis", f"place_{self.camera.told_in(MILLIMETRES).suffix}", "light", "wanted"])
        for axis, profile in (("x", self.along_x), ("y", self.along_y)):
            if profile is not None:
                rows = zip(profile.in_unit(profile.place_m, MILLIMETRES), profile.light, profile.wanted, strict=True)
                writer.writerows([axis, *(f"{value:.9g}" for value in row)] for row in rows)
        return out.getvalue()

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the light of the area and its profiles; on `ax`, or on a new figure."""
        from doedesign.report.areas import plot_area

        return plot_area(self, ax)

    def _repr_html_(self) -> str:
        """Its line and its picture for notebooks."""
        from fab.figure import html_of

        return html_of("Light on the area", {"area": self.describe()}, self.plot())


@dataclass(frozen=True)
class AreaTables:
    """Light on the areas of a design that has several.

    Attributes:
        tables: one for each area, its camera with the one colour that lights it and with its sensor in its plane.
    """

    tables: tuple[AreaTable, ...]

    @property
    def name(self) -> str:
        """Name of its files and of its entry among metrics."""
        return "area"

    def summary(self) -> list[dict[str, Any]]:
        """All numbers of every area, for metrics."""
        return [
            {"colour": one.camera.colours[0].name, "distance_m": one.camera.sensor_distance_m, **one.summary()}
            for one in self.tables
        ]

    def measures(self) -> dict[str, float]:
        """Numbers that a tolerance study follows: those of the worst area."""
        every = [one.measures() for one in self.tables]
        return {
            "on_target": min(one["on_target"] for one in every),
            "contrast": max(one["contrast"] for one in every),
        }

    def describe(self) -> str:
        """A line for every area."""
        return "\n".join(f"{one.place}: {one.describe()}" for one in self.tables)

    def to_csv(self) -> str:
        """The profiles of `AreaTable.to_csv`, each after the number of its area, from 1."""
        head, lines = "", []
        for number, one in enumerate(self.tables, 1):
            head, *rows = one.to_csv().splitlines()
            lines += [f"{number},{row}" for row in rows]
        return "\n".join([f"area,{head}", *lines]) + "\n"

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the light of every area and its profiles; on `ax`, or on a new figure."""
        from doedesign.report.areas import plot_areas

        return plot_areas(self.tables, ax)

    def _repr_html_(self) -> str:
        """Its line and its picture for notebooks."""
        from fab.figure import html_of

        return html_of(
            "Light on the areas", {f"area {k}": one.describe() for k, one in enumerate(self.tables)}, self.plot()
        )


def areas_of_design(design: Design, doe: CellOptic) -> tuple[AreaTable, ...]:
    """Light on each of the areas of a design's spec, of the design as drawn or as fabricated."""
    return tuple(area_table(*one) for one in _areas_seen(design, doe))


def area_lights(design: Design, doe: CellOptic) -> tuple[AreaLight, ...]:
    """Light on each of these areas as the loss of the design judges it, on the lattices of `areas_of_design`."""
    found = []
    for seen, target, colour in _areas_seen(design, doe):
        fields, score = _fields_on(seen, target, colour), AreaScore.of(target)
        given = score.wave is not None  # by one mode
        found.append(
            score.judge_field(jnp.asarray(fields[0])) if given else score.judge(jnp.asarray(_light_of(fields)))
        )
    return tuple(found)


def _areas_seen(design: Design, doe: CellOptic) -> Iterator[tuple[CellOptic, AreaTarget, int]]:
    """The DOE before the plane of each area, the area, and the number of its colour."""
    assert design.spec is not None
    for area, target in zip(design.spec.areas, targets_of_design(design), strict=True):
        seen = doe if area.distance_m is None else doe.with_camera(in_plane(area, doe.camera))
        yield seen, target, colour_number(area, doe.camera)


def targets_of_design(design: Design) -> tuple[AreaTarget, ...]:
    """The areas of a design's spec, on lattices as fine as their light is looked at; those that it holds, if any.

    Raises:
        InputError: a picture that is missing or cannot be drawn.
    """
    if design.area_targets:
        return design.area_targets
    spec, targets = design.spec, []
    assert spec is not None
    for index, area in enumerate(spec.areas):
        key = spec.area_key(index)
        picture = input_files(spec, f"{key}.picture")[f"{key}.picture"] if area.picture else None
        phase = input_files(spec, f"{key}.phase")[f"{key}.phase"] if area.phase_picture else None
        camera = camera_for(area, design.camera)
        targets.append(AreaTarget.of(area, camera, picture, phase, samples=_SAMPLES, key=key))
    return tuple(targets)


def area_table(doe: Any, target: AreaTarget, colour: int = 0) -> AreaTable:
    """Look at the area of a DOE, in the light of a colour's first wavelength.

    Args:
        doe: the DOE: a design, or an optic of cells, as drawn, as fabricated, with or without the light of its walls.
        target: the area, on a lattice as fine as its light is to be seen.
        colour: number of the colour.

    Raises:
        InputError: an argument of another kind, or a colour that the camera does not have.
    """
    doe = cell_optic_of("doe", doe, colour)
    cure = "For example dd.AreaTarget.of(area, camera); areas of a spec are in dd.fabricated(design, seed=0).aimed."
    require_kind("target", target, AreaTarget, cure)
    camera = replace(doe.camera, colours=(doe.camera.colours[colour],))
    fields, score = _fields_on(doe, target, colour), AreaScore.of(target)
    light, wave = _light_of(fields), target.wave
    shares = jnp.asarray(light, jnp.float32)
    over, judged = light / max(float(score.inside(shares)), 1e-30), score.judge(shares)
    picture = target.shape == "picture"
    return AreaTable(
        target,
        over,
        camera,
        float(judged.efficiency),
        float(judged.contrast),
        None if picture else _on_pixels(over, target, camera),
        float(zeroth_order(doe)[doe.wavelengths_m.index(camera.lines[0].wavelength_m)]),
        float(over[~target.lit].max(initial=0.0)),
        camera.transmission(camera.lines[0].wavelength_m),
        None if picture else _profile(over, target, camera, 1),
        None if picture else _profile(over, target, camera, 0),
        None if wave is None else _in_wave(doe, target, wave, fields[0], camera, colour),
    )


def light_on(doe: CellOptic, target: AreaTarget, colour: int = 0) -> Float[np.ndarray, "v u"]:
    """Share of the incident light of a colour's first wavelength on each sample of a lattice, Fresnel loss left out."""
    return _light_of(_fields_on(doe, target, colour))


def _fields_on(doe: CellOptic, target: AreaTarget, colour: int) -> list[Complex[np.ndarray, "v u"]]:
    """Field of every mode on the samples of a lattice; the squares are shares of the incident light."""
    camera = replace(doe.camera, colours=(doe.camera.colours[colour],))
    rows, columns = (part.astype(np.complex64) for part in lattice_factors(target, camera))
    return [rows @ mode @ columns.T for mode in mode_fields(doe, colour)]


def _light_of(fields: list[Complex[np.ndarray, "v u"]]) -> Float[np.ndarray, "v u"]:
    light = np.zeros(fields[0].shape)
    for field in fields:
        light += np.real(field) ** 2 + np.imag(field) ** 2
    return light


def _in_wave(
    doe: CellOptic,
    target: AreaTarget,
    wave: Complex[np.ndarray, "v u"],
    field: Complex[np.ndarray, "v u"],
    camera: Camera,
    colour: int,
) -> WaveShare:
    """Light in a wave, of one mode."""
    over, weight = (field * wave.conj())[target.flat], np.abs(wave[target.flat]) ** 2
    off = np.angle(over * over.sum().conj())
    rows, columns = lattice_factors(target, camera)
    in_step = np.sum(np.abs(rows.conj().T @ wave @ columns.conj()) * np.abs(mode_fields(doe, colour)[0]))
    rmse = np.sqrt(np.sum(weight * off**2) / weight.sum())
    return WaveShare(float(np.abs(np.vdot(wave, field)) ** 2), float(in_step**2), float(rmse))


def _places(target: AreaTarget, camera: Camera, axis: int) -> Float[np.ndarray, " n"]:
    """Places of the rows (axis 0) or columns of a lattice, from the middle of the area and along a line through it."""
    middle = camera.sines_of(*target.centre_m)
    if axis == 0:
        return camera.image_m(target.sines_y, middle[1])[0] - target.centre_m[0]
    return camera.image_m(middle[0], target.sines_x)[1] - target.centre_m[1]


def _profile(over: Float[np.ndarray, "v u"], target: AreaTarget, camera: Camera, axis: int) -> Profile:
    """Profile along y (axis 0) or x."""
    across = _places(target, camera, 1 - axis)
    share = _STRAIGHT if target.shape == "rectangle" else _ROUND
    near = np.abs(across) <= max(share * target.size_m[1 - axis], np.abs(across).min() * 1.001)
    light, wanted = (np.compress(near, values, 1 - axis).mean(1 - axis) for values in (over, target.value))
    place, centre = _places(target, camera, axis), target.centre_m[axis]
    if camera.in_angles:
        place = np.arcsin(place + centre) - np.arcsin(centre)
    return Profile(place, light, wanted, camera.in_angles)


def _on_pixels(over: Float[np.ndarray, "v u"], target: AreaTarget, camera: Camera) -> float | None:
    """Contrast of the mean light on pixels whose samples all lie inside."""
    numbers = []
    for axis in (0, 1):
        place = _places(target, camera, axis) + target.centre_m[axis]
        numbers.append(np.floor(place / camera.pixel_m + camera.window / 2).astype(int))
    rows, columns = (number - number.min() for number in numbers)
    shape = rows.max() + 1, columns.max() + 1
    place = np.ravel_multi_index(np.broadcast_arrays(rows[:, None], columns), shape).ravel()
    count, lit, inside = (
        np.bincount(place, weights, shape[0] * shape[1])
        for weights in (None, over.ravel(), target.flat.ravel().astype(float))
    )
    whole = (count > 0) & (inside == count)
    if np.count_nonzero(whole) < 4:
        return None
    pixels = lit[whole] / count[whole]
    return float(pixels.std() / pixels.mean())
