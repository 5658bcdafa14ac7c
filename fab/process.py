"""The cleanroom: what a process is asked to do, how far it strays, and one plate that came back.

A `Process` is the recipe: which etches, in which order and how deep, and how large every error usually is. A
`Variation` is one outcome: the errors of one plate, all of them zero for a plate that is exactly as drawn. Errors are
physical numbers in SI units; `DEVIATIONS` says what each of them is.

Coordinates are those of the height map (`[y, x]`, +y toward higher rows, origin in the middle of the DOE). Rotation and
magnification of a mask, and the wafer's non-uniformity, act about the middle of the wafer.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from fab.errors import InputError
from fab.levels import Levels
from fab.units import MM, UM

__all__ = ["DEVIATIONS", "Defects", "Deviation", "Disc", "MaskDisc", "Normal", "Process", "Variation", "error_names"]

Unit = Literal["1", "m", "rad"]


class Deviation(NamedTuple):
    """One kind of error.

    Attributes:
        source: the group it belongs to in a sensitivity analysis.
        unit: "1" (a share), "m" or "rad".
        per_mask: one value per mask instead of one per plate.
        one_sided: never negative; it is drawn from a folded normal distribution.
        meaning: what a value of it does.
    """

    source: str
    unit: Unit
    per_mask: bool
    one_sided: bool
    meaning: str


DEVIATIONS: Mapping[str, Deviation] = MappingProxyType(
    {
        "common_depth_scale": Deviation("depth", "1", False, False, "all etches too deep by this share"),
        "depth_scale": Deviation("depth", "1", True, False, "this etch too deep by this share, besides the common one"),
        "radial_nonuniformity": Deviation(
            "uniformity", "1", False, False, "depth gained from wafer centre to edge (r^2)"
        ),
        "linear_nonuniformity_y": Deviation("uniformity", "1", False, False, "depth gained along y per wafer radius"),
        "linear_nonuniformity_x": Deviation("uniformity", "1", False, False, "depth gained along x per wafer radius"),
        "overlay_y_m": Deviation("overlay", "m", True, False, "mask shifted toward +y"),
        "overlay_x_m": Deviation("overlay", "m", True, False, "mask shifted toward +x"),
        "rotation_rad": Deviation(
            "overlay", "rad", True, False, "mask turned from +x toward +y about the wafer's centre"
        ),
        "magnification": Deviation(
            "overlay", "1", True, False, "mask too large by this share about the wafer's centre"
        ),
        "common_cd_bias_m": Deviation("cd", "m", False, False, "every etched area grows by this at every edge"),
        "cd_bias_m": Deviation("cd", "m", True, False, "the same for one mask, besides the common one"),
        "corner_radius_m": Deviation("corners", "m", False, True, "radius to which square corners are rounded"),
        "sidewall_rad": Deviation(
            "sidewalls", "rad", False, True, "tilt of etched walls from the vertical, floors narrower"
        ),
        "etch_lag": Deviation("lag", "1", False, True, "share of depth lost per unit of depth / opening width"),
        "roughness_m": Deviation("roughness", "m", False, True, "rms height of the surface's roughness"),
        "correlation_m": Deviation("roughness", "m", False, True, "its correlation length, exp(-r^2 / length^2)"),
        "chrome_y_m": Deviation("chrome", "m", False, False, "chrome opening shifted toward +y"),
        "chrome_x_m": Deviation("chrome", "m", False, False, "chrome opening shifted toward +x"),
        "chrome_diameter_m": Deviation("chrome", "m", False, False, "chrome opening too wide by this"),
    }
)


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
    """The errors of one plate, in metres, radians and shares; all zero is a plate exactly as drawn.

    A per-mask error is empty (zero for every mask) or has one value per mask, mask 0 first; the other values mean what
    `DEVIATIONS` says.

    Attributes:
        repeats: how often each mask was etched more than once: -1 missed, 1 doubled; empty for none.
        particles: particles that kept etches off.
        pinholes: holes in the chrome beyond the clear aperture.
        seed: which roughness, of all with the same statistics.
    """

    common_depth_scale: float = 0.0
    depth_scale: tuple[float, ...] = ()
    radial_nonuniformity: float = 0.0
    linear_nonuniformity_y: float = 0.0
    linear_nonuniformity_x: float = 0.0
    overlay_y_m: tuple[float, ...] = ()
    overlay_x_m: tuple[float, ...] = ()
    rotation_rad: tuple[float, ...] = ()
    magnification: tuple[float, ...] = ()
    common_cd_bias_m: float = 0.0
    cd_bias_m: tuple[float, ...] = ()
    corner_radius_m: float = 0.0
    sidewall_rad: float = 0.0
    etch_lag: float = 0.0
    roughness_m: float = 0.0
    correlation_m: float = 0.0
    chrome_y_m: float = 0.0
    chrome_x_m: float = 0.0
    chrome_diameter_m: float = 0.0
    repeats: tuple[int, ...] = ()
    particles: tuple[MaskDisc, ...] = ()
    pinholes: tuple[Disc, ...] = ()
    seed: int = 0

    @property
    def nominal(self) -> bool:
        """Whether the plate is exactly as drawn."""
        # A correlation length without roughness, and a seed, change nothing.
        idle = ("seed", "correlation_m")
        values = (getattr(self, f.name) for f in fields(self) if f.name not in idle)
        return not any(any(v) if isinstance(v, tuple) else v for v in values)

    def value(self, name: str) -> float:
        """One error by its flat name, such as "corner_radius_m" or "overlay_x_m[2]"."""
        key, mask = _split(name)
        value = getattr(self, key)
        return float(value) if mask is None else float(value[mask]) if value else 0.0


def _split(name: str) -> tuple[str, int | None]:
    key, bracket, mask = name.partition("[")
    return key, int(mask.removesuffix("]")) if bracket else None


def error_names(masks: int, *errors: str) -> tuple[str, ...]:
    """Flat names of some errors (all by default), such as "overlay_x_m[0]", in the order of `DEVIATIONS`."""
    chosen = errors or tuple(DEVIATIONS)
    return tuple(
        name
        for key, error in DEVIATIONS.items()
        if key in chosen
        for name in ([f"{key}[{k}]" for k in range(masks)] if error.per_mask else [key])
    )


class Normal(NamedTuple):
    """How an error is distributed: normal with this mean and standard deviation."""

    mean: float = 0.0
    sigma: float = 0.0


@dataclass(frozen=True)
class Defects:
    """Rare events; lengths in metres.

    Attributes:
        particles_per_m2: particles per area and etch that keep an etch off a disc.
        particle_radius_m: their mean radius; radii are exponentially distributed.
        pinholes_per_m2: pinholes per area of chrome.
        pinhole_radius_m: their mean radius.
        missed: chance that an etch is forgotten.
        doubled: chance that an etch is done twice.
    """

    particles_per_m2: float = 0.0
    particle_radius_m: float = 2 * UM
    pinholes_per_m2: float = 0.0
    pinhole_radius_m: float = 2 * UM
    missed: float = 0.0
    doubled: float = 0.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InputError: a negative density or radius, or chances that are none.
        """
        for field_ in fields(self):
            value = getattr(self, field_.name)
            if not 0 <= value < math.inf:
                where = f"process.defects.{field_.name}"
                raise InputError(where, "must be finite and not negative", value, "Give 0 or more.")
        if self.missed + self.doubled > 1:
            got = f"{self.missed} and {self.doubled}"
            raise InputError("process.defects", "missed and doubled must sum to at most 1", got, "Lower one of them.")


@dataclass(frozen=True)
class Process:
    """What a fab lab does to a plate, and how well; lengths in metres.

    Attributes:
        levels: the staircase that the etches make together.
        order: masks in the order in which they are etched; shallow to deep by default.
        spreads: mean and standard deviation of errors by flat name (`error_names`); what is missing is zero.
        defects: rare events.
        tone: what a mask's polygons mean on the plate, "clear" (dark-field plate) or "dark".
        minimum_line_m: narrowest line the lithography prints.
        minimum_space_m: narrowest gap it prints.
        die_m: where on the wafer the DOE lies (y, x).
        wafer_radius_m: radius of the wafer.
        name: what it is called.
    """

    levels: Levels
    order: tuple[int, ...] = ()
    spreads: Mapping[str, Normal] = field(default_factory=dict, hash=False)
    defects: Defects = Defects()
    tone: Literal["clear", "dark"] = "clear"
    minimum_line_m: float = 0.0
    minimum_space_m: float = 0.0
    die_m: tuple[float, float] = (0.0, 0.0)
    wafer_radius_m: float = 50 * MM
    name: str = "ideal"

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InputError: an order that does not name every mask once, an unknown error or an impossible spread, an
                unknown tone, or a length that cannot be.
        """
        masks = tuple(range(self.levels.bits))
        if not self.order:
            object.__setattr__(self, "order", tuple(sorted(masks, key=self.levels.etch_depth_m)))
        if tuple(sorted(self.order)) != masks:
            rule = f"must name each of the masks 0 to {len(masks) - 1} once"
            raise InputError("process.order", rule, self.order, "List every mask.")
        # A copy, and a plain dictionary, because a read-only view of one cannot be sent to another process.
        object.__setattr__(self, "spreads", dict(self.spreads))
        self._check_spreads()
        if self.tone not in ("clear", "dark"):
            raise InputError("process.tone", 'must be "clear" or "dark"', self.tone, "Choose one of them.")
        for name in ("minimum_line_m", "minimum_space_m", "wafer_radius_m"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"process.{name}", "must be finite and not negative", getattr(self, name), "Mend it.")
        if not math.hypot(*self.die_m) <= self.wafer_radius_m:
            rule = f"must lie on the wafer of radius {self.wafer_radius_m} m"
            raise InputError("process.die_m", rule, self.die_m, "Move the die.")

    def _check_spreads(self) -> None:
        known = error_names(self.masks)
        for name, spread in self.spreads.items():
            if name not in known:
                raise InputError(f"process.errors.{name}", "must be a known error", name, f"One of {', '.join(known)}.")
            if not (math.isfinite(spread.mean) and 0 <= spread.sigma < math.inf):
                raise InputError(f"process.errors.{name}", "sigma must be finite and not negative", spread, "Mend it.")
            if spread.mean < 0 and DEVIATIONS[_split(name)[0]].one_sided:
                rule = "the mean of an error that is never negative must not be negative"
                raise InputError(f"process.errors.{name}", rule, spread, "Give 0 or more.")

    @property
    def masks(self) -> int:
        """Number of etch masks."""
        return self.levels.bits

    def depths_m(self) -> tuple[float, ...]:
        """Nominal depth of every mask's etch, mask 0 first."""
        return self.levels.depths_m

    def expected(self) -> Variation:
        """The plate with every error at its mean."""
        return variation_of(self.masks, {name: spread.mean for name, spread in self.spreads.items()})


def variation_of(masks: int, values: Mapping[str, float], **rest: Any) -> Variation:
    """A variation from values by flat name; errors that are not named are zero.

    Args:
        masks: number of etch masks.
        values: error values by flat name.
        rest: `repeats`, `particles`, `pinholes`, `seed`.
    """
    chosen: dict[str, Any] = {}
    for name, value in values.items():
        key, mask = _split(name)
        if mask is None:
            chosen[key] = value
        else:
            chosen.setdefault(key, [0.0] * masks)[mask] = value
    made = {key: tuple(value) if isinstance(value, list) else value for key, value in chosen.items()}
    return Variation(**made, **rest)
