"""Ordinary processes by name, and where each of their numbers comes from.

    STOCK["contact_aligner"].errors["overlay_x_m"].source.text

A number is *sourced* where somebody published it (the text says who) and an *estimate* where it is what such equipment
usually does, or follows from the other numbers; the text then says how. A lab's own numbers are better than either:
give them in the spec, where each replaces one of these. Masks share their numbers.

All three processes etch fused silica with reactive ions through photoresist and deposit chrome last; they differ in how
the masks are printed.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from fab.deviations import Source, Typical, estimate, sourced
from fab.errors import InputError
from fab.levels import Levels
from fab.process import DEVIATIONS, Defects, Normal, Process, error_names
from fab.units import require_kind


class Figure(NamedTuple):
    """One number and its source; SI units."""

    value: float
    source: Source


class Number(NamedTuple):
    """A number of a stock process with its source; named as in `DEVIATIONS`, `Stock` or `Defects`, SI units."""

    name: str
    kind: Literal["mean", "sigma", "value"]
    value: float
    source: Source

    def __str__(self) -> str:
        """Return the number with its source on one line."""
        return f"{self.name} {self.kind} {self.value:g} ({self.source.kind}: {self.source.text})"


@dataclass(frozen=True)
class Stock:
    """The usual numbers of one kind of process, errors by their name in `DEVIATIONS` (zero where missing).

    `not_drawn` says what it takes in place of the plates of an order, which print a whole wafer by contact; `reduction`
    how many times as large as on the wafer its reticles are.
    """

    name: str
    title: str
    errors: Mapping[str, Typical]
    minimum_line_m: Figure
    minimum_space_m: Figure
    wafer_radius_m: Figure
    defects: Mapping[str, Figure]
    tone: Literal["clear", "dark"] = "clear"
    not_drawn: str = ""
    reduction: int = 1

    def numbers(self) -> Iterator[Number]:
        """Yield every number with its source, errors first, in the order of `DEVIATIONS`."""
        for name in DEVIATIONS:
            if typical := self.errors.get(name):
                if typical.mean:
                    yield Number(name, "mean", typical.mean, typical.source)
                yield Number(name, "sigma", typical.sigma, typical.source)
        for name in ("minimum_line_m", "minimum_space_m", "wafer_radius_m"):
            yield Number(name, "value", *getattr(self, name))
        for name, figure in self.defects.items():
            yield Number(name, "value", *figure)

    def process(self, levels: Levels) -> Process:
        """Return the process with these numbers for a staircase; all masks have the same ones."""
        spreads = {
            name: Normal(typical.mean, typical.sigma)
            for error in DEVIATIONS
            if (typical := self.errors.get(error))
            for name in error_names(levels.bits, error)
        }
        limits = {name: getattr(self, name).value for name in ("minimum_line_m", "minimum_space_m", "wafer_radius_m")}
        defects = Defects(**{name: figure.value for name, figure in self.defects.items()})
        known: dict[str, Any] = {"tone": self.tone, "reduction": self.reduction, "name": self.name, **limits}
        return Process(levels, spreads=spreads, defects=defects, **known)


def process_from(given: Process | str | None, levels: Levels) -> Process:
    """Return a process for a staircase: the one `given`, the stock process of that name, or by default the ideal one.

    Raises:
        InputError: an unknown name, one that makes another staircase than `levels`, or something else than these.
    """
    require_kind("levels", levels, Levels, "A level map has them: level_map.levels.")
    known = {**STOCK, IDEAL.name: IDEAL}
    if given is None or isinstance(given, Process):
        process = given or Process(levels)
        if process.levels != levels:
            cure = "Give a process for this design."
            raise InputError("process", f"must be for {levels}", process.levels, cure)
        return process
    if not isinstance(given, str) or given not in known:
        raise InputError("process", "must be a process or the name of one", repr(given), f"Name {' or '.join(known)}.")
    return known[given].process(levels)


# --- rare events ------------------------------------------------------------------------------------------------------

_CAUGHT = estimate("none: the step height is measured after every etch; set it to see what one would do")
_DUST = estimate("one per cm2 and etch, a class 100 cleanroom with manual handling")
_DUST_RADIUS = estimate("what settles and stays through a spin rinse is a few um wide")
_PINHOLES = estimate("one per cm2 of evaporated chrome 100 nm thick")
_PINHOLE_RADIUS = estimate("as wide as the dust that causes them")


def _defects(particles_per_m2: float, dust: Source) -> Mapping[str, Figure]:
    return MappingProxyType(
        {
            "particles_per_m2": Figure(particles_per_m2, dust),
            "particle_radius_m": Figure(2e-6, _DUST_RADIUS),
            "pinholes_per_m2": Figure(0.01e6, _PINHOLES),
            "pinhole_radius_m": Figure(2e-6, _PINHOLE_RADIUS),
            "missed": Figure(0.0, _CAUGHT),
            "doubled": Figure(0.0, _CAUGHT),
        }
    )


def _errors(alignment: Typical, **printing: Typical) -> Mapping[str, Typical]:
    """Etching, which all processes share, the alignment of etches and chrome, and what printing adds."""
    etching = {name: error.stock for name, error in DEVIATIONS.items() if error.stock}
    aligned = dict.fromkeys(("overlay_y_m", "overlay_x_m", "chrome_y_m", "chrome_x_m"), alignment)
    return MappingProxyType(etching | aligned | printing)


# --- printing ---------------------------------------------------------------------------------------------------------

_MA6 = "Karl Suss MA6 contact aligner, mems-exchange.org catalog P1530"
_PLATE = "International Phototool Company, photomask inspection criteria (photoplotstore.com)"
_FOUR_INCH = sourced(f"{_MA6}: fields up to 4 inch")

_MA6_OVERLAY = sourced(f"{_MA6}: alignment tolerance 0.5 um, read as the standard deviation of alignment by eye")
_MA6_LINE = sourced(f"{_MA6}: 1 um, in vacuum contact only")
_PLATE_CD = sourced(f"{_PLATE}: lines below 10 um to +-0.5 um, read as two standard deviations, half of it per edge")
_PLATE_OPENING = sourced(f"{_PLATE}: features above 250 um to +-2.54 um, read as two standard deviations")

_CONTACT_ALIGNER = Stock(
    name="contact_aligner",
    title="contact aligner, laser-written chrome plates at 1:1, aligned by eye",
    errors=_errors(
        Typical(0.0, 0.5e-6, _MA6_OVERLAY),
        rotation_rad=Typical(0.0, 10e-6, estimate("the overlay at marks 70 mm apart: 0.5 um * sqrt(2) / 70 mm")),
        magnification=Typical(
            0.0, 5e-6, estimate("a soda-lime plate expands by 8.5e-6 per kelvin more than the wafer; 0.6 kelvin")
        ),
        common_cd_bias_m=Typical(0.0, 0.1e-6, estimate("exposure and development at a gap that varies by a few um")),
        cd_bias_m=Typical(0.0, 0.125e-6, _PLATE_CD),
        corner_radius_m=Typical(0.5e-6, 0.1e-6, estimate("half of the narrowest line")),
        chrome_diameter_m=Typical(0.0, 1.27e-6, _PLATE_OPENING),
    ),
    minimum_line_m=Figure(1e-6, _MA6_LINE),
    minimum_space_m=Figure(1e-6, _MA6_LINE),
    wafer_radius_m=Figure(50e-3, _FOUR_INCH),
    defects=_defects(0.02e6, estimate("two per cm2 and etch: a class 100 cleanroom, and the plate touches the resist")),
)

_I_LINE = estimate(
    "Rayleigh with k1 = 0.7: 0.7 * 365 nm / 0.5; "
    "an older GCA 6200 is listed with 1 um (mems-exchange.org catalog P2260)"
)
_STEPPER_OVERLAY = estimate(
    "0.15 um is a usual limit, read as three standard deviations; "
    "an older GCA 6200 is listed with 2 um (mems-exchange.org catalog P2260)"
)

_STEPPER = Stock(
    name="stepper",
    title="i-line wafer stepper, numerical aperture 0.5, reticles five times as large",
    reduction=5,
    errors=_errors(
        Typical(0.0, 50e-9, _STEPPER_OVERLAY),
        rotation_rad=Typical(0.0, 1e-6, estimate("the overlay at marks 70 mm apart: 50 nm * sqrt(2) / 70 mm")),
        magnification=Typical(0.0, 1e-6, estimate("lens and reticle are trimmed to 1e-6 or 2e-6")),
        common_cd_bias_m=Typical(0.0, 30e-9, estimate("dose and focus: 10 % of a line of 0.6 um, half per edge")),
        cd_bias_m=Typical(0.0, 25e-9, sourced(f"{_PLATE_CD.text}; a fifth of it on the wafer")),
        corner_radius_m=Typical(0.25e-6, 50e-9, estimate("half of the narrowest line")),
        chrome_diameter_m=Typical(0.0, 0.254e-6, sourced(f"{_PLATE_OPENING.text}; a fifth of it on the wafer")),
    ),
    minimum_line_m=Figure(0.5e-6, _I_LINE),
    minimum_space_m=Figure(0.5e-6, _I_LINE),
    wafer_radius_m=Figure(50e-3, estimate("many take 100 mm wafers; larger ones move the edge outward")),
    defects=_defects(0.01e6, _DUST),
)

_DWL = sourced(
    "Heidelberg DWL-200 at the University of Alberta nanoFAB: 1 um with the 4 mm lens, where features below 2 um may "
    "show distortions or fail"
)
_WRITER_OVERLAY = estimate(
    "a camera reads each mark to 0.1 or 0.2 um, and the stage drifts by as much while it writes; "
    "marks read to below 0.1 um are a research result (Micromachines 16, 871, 2025)"
)

_DIRECT_WRITE = Stock(
    name="direct_write",
    title="laser writer, every layer written onto the wafer without a plate",
    not_drawn="a laser writer takes no masks but a file for each layer, which comes with an order for direct writing",
    errors=_errors(
        Typical(0.0, 0.25e-6, _WRITER_OVERLAY),
        rotation_rad=Typical(0.0, 5e-6, estimate("the overlay at marks 70 mm apart: 0.25 um * sqrt(2) / 70 mm")),
        magnification=Typical(0.0, 1e-6, estimate("silica expands by 0.55e-6 per kelvin; 2 kelvin")),
        common_cd_bias_m=Typical(0.0, 0.1e-6, estimate("dose, and focus over a wafer that is not flat")),
        cd_bias_m=Typical(0.0, 50e-9, estimate("drift of laser power between layers")),
        corner_radius_m=Typical(0.5e-6, 0.1e-6, estimate("half of a laser spot 1 um wide")),
        chrome_diameter_m=Typical(0.0, 0.2e-6, estimate("twice the common bias of its edge")),
    ),
    minimum_line_m=Figure(1e-6, _DWL),
    minimum_space_m=Figure(1e-6, _DWL),
    wafer_radius_m=Figure(50e-3, estimate("the stage takes more; 100 mm is what fits most etchers")),
    defects=_defects(0.01e6, _DUST),
)

_NOTHING = estimate("a process without errors and without limits")

IDEAL = Stock(
    name="ideal",
    title="no errors",
    errors=MappingProxyType({}),
    minimum_line_m=Figure(0.0, _NOTHING),
    minimum_space_m=Figure(0.0, _NOTHING),
    wafer_radius_m=Figure(50e-3, _NOTHING),
    defects=MappingProxyType(
        {name: Figure(2e-6 if name.endswith("radius_m") else 0.0, _NOTHING) for name in _CONTACT_ALIGNER.defects}
    ),
)

STOCK: Mapping[str, Stock] = MappingProxyType(
    {stock.name: stock for stock in (_CONTACT_ALIGNER, _STEPPER, _DIRECT_WRITE)}
)
