"""Errors of a process: one table of all that a DOE may come back with, and the errors of one DOE.

`Variation` is the table. To add an error, add a field to it here and what it does to the glass to
`sim/surface/relief.py`: specs, draws, stock processes, tolerance studies, calibration and run sheets read the rest from
the field. Errors are physical numbers in SI units, and the unit ends the name.
"""

import math
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from functools import partial
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from fab.units import UM

Unit = Literal["1", "m", "rad"]

# The largest mean or standard deviation of an error that can be meant, by its unit.
_LARGEST = {"1": 0.5, "m": 100 * UM, "rad": math.radians(45)}
# What a lab measures to find an error, by its source; chrome is not measured.
_MEASURED = {
    "depth": "depth",
    "overlay": "overlay",
    "cd": "line width (CD bars)",
    "uniformity": "depth at the rim of the wafer against its middle",
    "corners": "rounding of the corners",
    "sidewalls": "tilt of the walls",
    "lag": "etch lag (depth of the small pads)",
    "roughness": "roughness of the floors",
}


class Source(NamedTuple):
    """Where a number comes from: "sourced" was published, by whom `text` says; "estimate" rests on what `text` says."""

    kind: Literal["sourced", "estimate"]
    text: str


def sourced(text: str) -> Source:
    """Source of a published number."""
    return Source("sourced", text)


def estimate(text: str) -> Source:
    """Source of a number that nobody has published."""
    return Source("estimate", text)


class Typical(NamedTuple):
    """Mean and standard deviation of one error, SI units, and their source."""

    mean: float
    sigma: float
    source: Source


class Deviation(NamedTuple):
    """One kind of error.

    Attributes:
        source: the group it belongs to in a sensitivity analysis.
        unit: "1" (a share), "m" or "rad".
        per_mask: one value per mask instead of one per DOE.
        meaning: what a value of it does.
        one_sided: never negative; it is drawn from a folded normal distribution.
        largest: the largest mean or standard deviation that a spec may give.
        prior_sigma: standard deviation before a calibration where the process gives none; 0 for roughness, which is
            random.
        measured: what a lab measures to find it; "" if nothing.
        stock: mean and standard deviation in every stock process; None where they differ (`fab.stock`) or are zero.
    """

    source: str
    unit: Unit
    per_mask: bool
    meaning: str
    one_sided: bool
    largest: float
    prior_sigma: float
    measured: str
    stock: Typical | None


def _error(source: str, meaning: str, default: float | tuple[float, ...] = 0.0, **rest: Any) -> Any:
    """A field of `Variation` that is an error; see `Deviation`."""
    return field(default=default, metadata={"source": source, "meaning": meaning, **rest})


_per_mask, _one_sided = partial(_error, default=()), partial(_error, one_sided=True)


def _deviation(error: Field[Any]) -> Deviation:
    """The kind of an error; its name ends with the unit."""
    unit: Unit = "m" if error.name.endswith("_m") else "rad" if error.name.endswith("_rad") else "1"
    given = dict(error.metadata)
    stock = Typical(*given.pop("stock")) if "stock" in given else None
    usual = {"one_sided": False, "largest": _LARGEST[unit], "prior_sigma": 0.0}
    measured = _MEASURED.get(given["source"], "")
    return Deviation(unit=unit, per_mask=error.default == (), measured=measured, stock=stock, **{**usual, **given})


def _degrees(angle: float) -> float:
    # Fifteen digits, as when text is read, so that it is written as "5 deg" again.
    return float(f"{math.radians(angle):.15g}")


# Etching is the same in all stock processes.
_RATE = estimate("etches stopped by time, with the rate of a test wafer; 2 % is usual without an end point")
_SCATTER = estimate("what remains between etches of one day on one machine")
_UNIFORMITY = estimate("2 % from the centre to the edge of a 100 mm wafer, class of a parallel-plate etcher")
_TILT = estimate("half the radial share: gas flow and clamping are seldom symmetric")
_WALLS = estimate("walls of 80 to 88 degrees are usual for silica etched through photoresist")
_LAG = estimate(
    "some 5 % less depth where openings are as narrow as deep; that such plates suffer from lag is published "
    "(Amata, Fu and Heidrich, Opt. Express 31, 41533, 2023), its size here is not"
)
_ROUGHNESS = estimate("1 to 3 nm rms is usual after 1 um of silica etched with CHF3; SF6 leaves more")
_CORRELATION = estimate("grain of micromasked silica as atomic force microscopes show it, a fraction of 1 um")


class Disc(NamedTuple):
    """A pinhole in the chrome, metres."""

    y_m: float
    x_m: float
    radius_m: float


class MaskDisc(NamedTuple):
    """A particle that keeps one mask's etch off a disc, metres."""

    mask: int
    y_m: float
    x_m: float
    radius_m: float


@dataclass(frozen=True)
class Variation:
    """The errors of one DOE; all zero is a DOE exactly as drawn.

    Lengths are metres, angles radians. A per-mask error is empty (zero for every mask) or has one value per mask, mask
    0 first; lists become tuples. Coordinates are those of the height map (`[y, x]`, +y toward higher rows, origin in
    the middle of the DOE); rotation and magnification of a mask, and the wafer's non-uniformity, act about the middle
    of the wafer.

    Attributes:
        repeats: how often each mask was etched more than once: -1 missed, 1 doubled; empty for none.
        particles: particles that kept etches off.
        pinholes: holes in the chrome beyond the clear aperture.
        seed: which roughness, of all with the same statistics.
    """

    common_depth_scale: float = _error(
        "depth", "all etches too deep by this share", prior_sigma=0.05, stock=(0.0, 0.02, _RATE)
    )
    depth_scale: tuple[float, ...] = _per_mask(
        "depth",
        "this etch too deep by this share, besides the common one",
        prior_sigma=0.03,
        stock=(0.0, 0.01, _SCATTER),
    )
    radial_nonuniformity: float = _error(
        "uniformity", "depth gained from wafer centre to edge (r^2)", prior_sigma=0.05, stock=(0.0, 0.02, _UNIFORMITY)
    )
    linear_nonuniformity_y: float = _error(
        "uniformity", "depth gained along y per wafer radius", prior_sigma=0.03, stock=(0.0, 0.01, _TILT)
    )
    linear_nonuniformity_x: float = _error(
        "uniformity", "depth gained along x per wafer radius", prior_sigma=0.03, stock=(0.0, 0.01, _TILT)
    )
    overlay_y_m: tuple[float, ...] = _per_mask("overlay", "mask shifted toward +y", prior_sigma=1e-6)
    overlay_x_m: tuple[float, ...] = _per_mask("overlay", "mask shifted toward +x", prior_sigma=1e-6)
    rotation_rad: tuple[float, ...] = _per_mask(
        "overlay", "mask turned from +x toward +y about the wafer's centre", largest=math.radians(1), prior_sigma=3e-4
    )
    magnification: tuple[float, ...] = _per_mask(
        "overlay", "mask too large by this share about the wafer's centre", largest=0.01, prior_sigma=3e-5
    )
    common_cd_bias_m: float = _error("cd", "every etched area grows by this at every edge", prior_sigma=0.3e-6)
    cd_bias_m: tuple[float, ...] = _per_mask("cd", "the same for one mask, besides the common one", prior_sigma=0.2e-6)
    corner_radius_m: float = _one_sided("corners", "radius to which square corners are rounded", prior_sigma=0.5e-6)
    sidewall_rad: float = _one_sided(
        "sidewalls",
        "tilt of etched walls from the vertical, floors narrower",
        prior_sigma=0.1,
        stock=(_degrees(5), _degrees(2), _WALLS),
    )
    etch_lag: float = _one_sided(
        "lag", "share of depth lost per unit of depth / opening width", prior_sigma=0.05, stock=(0.05, 0.02, _LAG)
    )
    roughness_m: float = _one_sided(
        "roughness", "rms height of the surface's roughness", largest=1 * UM, stock=(2e-9, 0.5e-9, _ROUGHNESS)
    )
    correlation_m: float = _one_sided(
        "roughness", "its correlation length, exp(-r^2 / length^2)", stock=(200e-9, 50e-9, _CORRELATION)
    )
    chrome_y_m: float = _error("chrome", "chrome opening shifted toward +y", prior_sigma=2e-6)
    chrome_x_m: float = _error("chrome", "chrome opening shifted toward +x", prior_sigma=2e-6)
    chrome_diameter_m: float = _error("chrome", "chrome opening too wide by this", prior_sigma=4e-6)
    repeats: tuple[int, ...] = ()
    particles: tuple[MaskDisc, ...] = ()
    pinholes: tuple[Disc, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        for name, error in DEVIATIONS.items():
            values: Any = getattr(self, name)
            if error.per_mask and (isinstance(values, list) or getattr(values, "ndim", 0) == 1):
                object.__setattr__(self, name, tuple(values))

    @property
    def nominal(self) -> bool:
        """Whether the DOE is exactly as drawn."""
        # A correlation length without roughness, and a seed, change nothing.
        idle = ("seed", "correlation_m")
        values = (getattr(self, f.name) for f in fields(self) if f.name not in idle)
        return not any(any(v) if isinstance(v, tuple) else v for v in values)

    def value(self, name: str) -> float:
        """One error by its flat name, such as "corner_radius_m" or "overlay_x_m[2]"."""
        key, mask = _split(name)
        value = getattr(self, key)
        return float(value) if mask is None else float(value[mask]) if value else 0.0


DEVIATIONS: Mapping[str, Deviation] = MappingProxyType({f.name: _deviation(f) for f in fields(Variation) if f.metadata})
"""All kinds of error by their name in `Variation`."""


def _split(name: str) -> tuple[str, int | None]:
    key, bracket, mask = name.partition("[")
    return key, int(mask.removesuffix("]")) if bracket else None


def deviation_of(name: str) -> Deviation:
    """The kind of an error by its flat name, such as "overlay_x_m[2]"."""
    return DEVIATIONS[name.partition("[")[0]]


def short_name(name: str) -> str:
    """A flat name without its unit, as specs have it: "overlay_x[2]" for "overlay_x_m[2]"."""
    key, bracket, mask = name.partition("[")
    return key.removesuffix("_m").removesuffix("_rad") + bracket + mask


def error_names(masks: int, *errors: str) -> tuple[str, ...]:
    """Flat names of some errors (all by default), such as "overlay_x_m[0]", in the order of `DEVIATIONS`."""
    chosen = errors or tuple(DEVIATIONS)
    return tuple(
        name
        for key, error in DEVIATIONS.items()
        if key in chosen
        for name in ([f"{key}[{k}]" for k in range(masks)] if error.per_mask else [key])
    )


def variation_of(masks: int, values: Mapping[str, float], **rest: Any) -> Variation:
    """Return a variation from values (SI units) by flat name, other errors zero; `rest` are the other fields."""
    chosen: dict[str, Any] = {}
    for name, value in values.items():
        key, mask = _split(name)
        if mask is None:
            chosen[key] = value
        else:
            chosen.setdefault(key, [0.0] * masks)[mask] = value
    made = {key: tuple(value) if isinstance(value, list) else value for key, value in chosen.items()}
    return Variation(**made, **rest)
