"""The cleanroom: what a process is asked to do, and how far it strays.

A `Process` is the recipe: which etches, in which order and how deep, and how large every error usually is. A
`Variation` is one outcome, the errors of one DOE; `DEVIATIONS` says what each of them is (`fab.deviations`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Literal, NamedTuple

from fab.deviations import (
    DEVIATIONS,
    Deviation,
    Disc,
    MaskDisc,
    Variation,
    deviation_of,
    error_names,
    short_name,
    variation_of,
)
from fab.errors import InputError
from fab.files import IF_ANY
from fab.levels import Levels
from fab.units import MM, UM, is_whole, number_of, numbers_of, require_kind

__all__ = [
    "DEVIATIONS",
    "Defects",
    "Deviation",
    "Disc",
    "MaskDisc",
    "Normal",
    "Process",
    "Variation",
    "deviation_of",
    "error_names",
    "short_name",
    "variation_of",
]


class Normal(NamedTuple):
    """How an error is distributed: normally.

    Attributes:
        mean: mean, in the SI unit of the error.
        sigma: standard deviation, likewise.
    """

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
        for field_ in fields(self):
            value = getattr(self, field_.name)
            if not 0 <= number_of(value) < math.inf:
                where = f"defects: {field_.name}"
                raise InputError(where, "must be finite and not negative", value, "Give 0 or more.")
        if self.missed + self.doubled > 1:
            got = f"{self.missed} and {self.doubled}"
            raise InputError("defects", "missed and doubled must sum to at most 1", got, "Lower one of them.")


# Errors by which depths differ over the wafer.
OVER_THE_WAFER = ("radial_nonuniformity", "linear_nonuniformity_y", "linear_nonuniformity_x")


@dataclass(frozen=True)
class Process:
    """Etches that a fab lab makes, and how well; lengths in metres.

    Attributes:
        levels: the staircase that the etches make together.
        order: masks in the order in which they are etched; shallow to deep by default.
        spreads: mean and standard deviation of errors by flat name (`error_names`); what is missing is zero.
        defects: rare events.
        tone: what polygons are on a photomask, "clear" (dark field, positive resist) or "dark" (clear field, negative).
        minimum_line_m: narrowest line the lithography prints.
        minimum_space_m: narrowest gap it prints.
        die_m: where on the wafer the DOE lies (y, x).
        wafer_radius_m: radius of the wafer.
        reduction: how many times as large as on the wafer its reticles are, which hold one die; 1 for photomasks that
            print a whole wafer by contact.
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
    reduction: int = field(default=1, metadata=IF_ANY)
    name: str = "ideal"

    def __post_init__(self) -> None:
        require_kind("process: levels", self.levels, Levels, "Give a fab.Levels(count, step_m).")
        masks = tuple(range(self.levels.bits))
        order = numbers_of(self.order) or tuple(sorted(masks, key=self.levels.etch_depth_m))
        if tuple(sorted(order)) != masks:
            rule = f"must name each of the masks 0 to {len(masks) - 1} once"
            raise InputError("process: order", rule, self.order, "List every mask.")
        object.__setattr__(self, "order", tuple(int(mask) for mask in order))  # of numpy, they would not go into JSON
        # A copy, and a plain dictionary, because a read-only view of one cannot be sent to another process.
        require_kind("process: spreads", self.spreads, Mapping, 'For example {"corner_radius_m": fab.Normal(5e-7)}.')
        object.__setattr__(self, "spreads", dict(self.spreads))
        self._check_spreads()
        if not isinstance(self.tone, str) or self.tone not in ("clear", "dark"):
            raise InputError("process: tone", 'must be "clear" or "dark"', self.tone, "Choose one of them.")
        for name in ("minimum_line_m", "minimum_space_m", "wafer_radius_m"):
            if not 0 <= number_of(getattr(self, name)) < math.inf:
                rule, cure = "must be finite and not negative, in metres", "Give 0 or more, such as 1e-6."
                raise InputError(f"process: {name}", rule, repr(getattr(self, name)), cure)
            object.__setattr__(self, name, float(getattr(self, name)))  # rules of an order are told as they are kept
        if not is_whole(self.reduction, 1):
            rule = "must be a whole number, 1 or more"
            raise InputError("process: reduction", rule, repr(self.reduction), "For example 5.")
        self._check_die()

    def _check_die(self) -> None:
        die_m = numbers_of(self.die_m)
        if len(die_m) != 2 or not math.hypot(*die_m) <= self.wafer_radius_m:
            rule = f"must lie on the wafer of radius {self.wafer_radius_m} m, (y, x) in metres from its middle"
            raise InputError("process: die_m", rule, repr(self.die_m), "Move the die, for example to (0.0, 0.01).")
        object.__setattr__(self, "die_m", die_m)

    def _check_spreads(self) -> None:
        known = error_names(self.masks)
        for name, spread in self.spreads.items():
            if name not in known:
                raise InputError(
                    f"process: spreads: {name}", "must be a known error", name, f"One of {', '.join(known)}."
                )
            if not isinstance(spread, Normal):
                rule, cure = "must be a mean and a sigma in SI units", "For example fab.Normal(0.0, 0.5e-6)."
                raise InputError(f"process: spreads: {name}", rule, repr(spread), cure)
            if not all(map(math.isfinite, map(number_of, spread))):
                rule = "mean and sigma must be finite numbers"
                raise InputError(f"process: spreads: {name}", rule, spread, "For example fab.Normal(0.0, 0.5e-6).")
            if spread.sigma < 0:
                raise InputError(
                    f"process: spreads: {name}", "sigma must be finite and not negative", spread, "Give 0 or more."
                )
            if spread.mean < 0 and deviation_of(name).one_sided:
                rule = "the mean of an error that is never negative must not be negative"
                raise InputError(f"process: spreads: {name}", rule, spread, "Give 0 or more.")

    @property
    def masks(self) -> int:
        """Number of etch masks."""
        return self.levels.bits

    def depths_m(self) -> tuple[float, ...]:
        """Nominal depth of every mask's etch, first mask first."""
        return self.levels.depths_m

    @property
    def depth_at_die(self) -> float:
        """Depth of an etch at the middle of the DOE over that at the middle of the wafer, by mean non-uniformity."""
        y, x = (at / self.wafer_radius_m for at in self.die_m) if any(self.die_m) else (0.0, 0.0)
        bowl, tilt_y, tilt_x = (self.spreads.get(name, Normal()).mean for name in OVER_THE_WAFER)
        return 1 + bowl * (y * y + x * x) + (tilt_y * y + tilt_x * x)

    def expected(self) -> Variation:
        """The plate with every error at its mean."""
        return variation_of(self.masks, {name: spread.mean for name, spread in self.spreads.items()})
