"""Content of a run sheet in SI units: the order, the wafer, the process, and what the lab should see.

Predictions of the light come as plain numbers from outside, since `fab` does not compute it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from fab.aperture import Aperture
from fab.errors import InputError
from fab.files import IF_ANY
from fab.layout.part import Photomask
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.process import Process
from fab.units import NM

# What the recipes of the run sheet, and the stock processes, are for.
SILICA = "fused silica"


class PhotomaskFile(NamedTuple):
    """The file of one photomask: its name, digest and top cell.

    Every edge of the DOE, not those of test structures and marks, was moved `edge_move_m` outward on the mask.
    """

    file: str
    sha256: str
    cell: str
    edge_move_m: float = 0.0


class Die(NamedTuple):
    """One die on the wafer: its name, its middle from the wafer's middle in metres, and what is special about it."""

    name: str
    x_m: float
    y_m: float
    note: str = ""


class PredictedMetrics(NamedTuple):
    """Metrics of one colour of a point at one depth (None for infinity); shares of the light are 0 to 1."""

    colour: str
    depth_m: float | None
    strehl: float
    zeroth_order: float
    throughput: float
    ring_to_disc: float | None = None
    far_spot: float | None = None


class Grating(NamedTuple):
    """Share of the light that the test gratings send straight on if all depths are off by a share."""

    depth_error: float
    binary: float
    blazed: float


class Importance(NamedTuple):
    """Shares of the variance of Strehl ratio and 0th order, over all DOEs made, that a measured number explains."""

    measured: str
    strehl: float
    zeroth_order: float


class CertifiedOrder(NamedTuple):
    """0th order of the DOE as drawn at one wavelength, and of rows cut out of it; shares of the light, 0 to 1.

    Attributes:
        colour: its name.
        wavelength_m: vacuum wavelength, metres.
        scalar: of the whole DOE as a thin element.
        edges: of the whole DOE with the light of its walls.
        cut_scalar: mean over the cut-outs, as thin elements.
        cut_edges: the same with the light of their walls.
        cut_rigorous: the same by Maxwell's equations.
    """

    colour: str
    wavelength_m: float
    scalar: float
    edges: float
    cut_scalar: float
    cut_edges: float
    cut_rigorous: float


@dataclass(frozen=True)
class Predictions:
    """Light that the lab should see.

    Attributes:
        drawn: the DOE exactly as drawn.
        expected: the DOE with every error of the process at its mean.
        design_m: design wavelength, metres.
        full_wave_m: wavelength at which the full height of the levels is one wave, metres; None if there is none.
        probe_m: wavelength of the laser that the lab tests with, metres.
        probe_waves: the full height in waves at the probe.
        gratings: what the test gratings show at the probe, against an empty window; a depth error of 0 among them.
        ranking: measured numbers, the most important first; empty if the process has no errors.
        index: refractive index of the material at the design wavelength; 0 if it is not stated.
        certified: 0th orders that a certificate of this DOE names; empty if it has none.
    """

    drawn: tuple[PredictedMetrics, ...]
    expected: tuple[PredictedMetrics, ...]
    design_m: float
    full_wave_m: float | None
    probe_m: float
    probe_waves: float
    gratings: tuple[Grating, ...]
    ranking: tuple[Importance, ...] = ()
    index: float = field(default=0.0, metadata=IF_ANY)
    certified: tuple[CertifiedOrder, ...] = field(default=(), metadata=IF_ANY)


class SheetPrediction(NamedTuple):
    """Predictions on the sheet, and what draws the PSFs of the DOE with the process's mean errors, as PNG."""

    predictions: Predictions
    picture: Callable[[], bytes]


# Blanks for the sizes of the chrome's opening: a diameter, or width and height.
OPENING_KEYS = {1: ("opening_diameter_um",), 2: ("opening_width_um", "opening_height_um")}


@dataclass(frozen=True)
class RunSheet:
    """Everything that stands on the sheet.

    Attributes:
        stem: what all files of the order begin with.
        level_map: the DOE; its digest tells one design from another.
        photomasks: all photomasks in the order in which they are used (`fab.layout.part.photomasks_of`).
        files: the file of every photomask, by its name.
        process: what the lab does and how far it strays.
        opening: the opening in the chrome.
        wafer: the substrate, and the blanks of the masks.
        places: named points to measure at, from the middle of the wafer in metres, named as in `fab.layout.marks` and
            `fab.layout.structures` with the place before them ("left site: vernier x, mask 3"). Line widths and depths
            are measured at the first place of each name, overlay at all of them.
        dies: the dies.
        material: what the substrate is made of.
        chrome_m: thickness of the chrome, metres.
        deposition: how the chrome is laid down.
        predictions: what the lab should see; None if nothing is known about the light.
        request_sha256: digest of what was asked for and of the tools that made it, which ties the sheet to its order.

    Raises:
        InputError: a photomask without a file, or etches that are not those of the process, in its order.
    """

    stem: str
    level_map: LevelMap
    photomasks: tuple[Photomask, ...]
    files: Mapping[str, PhotomaskFile]
    process: Process
    opening: Aperture
    wafer: Wafer
    places: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    dies: tuple[Die, ...] = ()
    material: str = SILICA
    chrome_m: float = 100 * NM
    deposition: Literal["evaporated", "sputtered"] = "evaporated"
    predictions: Predictions | None = None
    request_sha256: str = ""

    def __post_init__(self) -> None:
        if missing := [photomask.name for photomask in self.photomasks if photomask.name not in self.files]:
            cure = "Give the file of every photomask."
            raise InputError("run sheet", "every photomask must have a file", f"none for {missing[0]}", cure)
        bits = tuple(photomask.bit for photomask in self.photomasks if photomask.bit is not None)
        if bits != self.process.order:
            rule = f"the etches must come in the order of the process, {self.process.order}"
            raise InputError("run sheet", rule, bits, "List the plates by the order of the process.")
