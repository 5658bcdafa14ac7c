"""A run sheet for the tests, with marks and test structures where they really are."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from fab.aperture import RoundAperture
from fab.grid import Grid
from fab.layout.marks import alignment_site, die_marks
from fab.layout.part import moved, photomasks_of, prefixed
from fab.layout.structures import process_monitor
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.process import Normal, Process, error_names
from fab.runsheet.tables import Die, Grating, Importance, PhotomaskFile, PredictedMetrics, Predictions, RunSheet
from fab.units import NM, UM

STEM = "DOE_TEST"
DBU_M = 1e-9
LEVELS = Levels(16, 75 * NM)


def doe(levels: Levels = LEVELS) -> LevelMap:
    """A DOE of 4.44 mm."""
    return LevelMap(np.zeros((24, 24), np.uint8), levels, Grid((24, 24), 185 * UM), 4.44e-3)


DIGEST = doe().digest


def spreads_of(levels: Levels, **means_and_sigmas: tuple[float, float]) -> dict[str, Normal]:
    """The same mean and sigma for every mask, by the name in `ERRORS`."""
    return {name: Normal(*one) for key, one in means_and_sigmas.items() for name in error_names(levels.bits, key)}


def sheet(
    levels: Levels = LEVELS,
    order: Sequence[int] = (),
    tone: Literal["clear", "dark"] = "clear",
    chrome: Literal["liftoff", "etch"] = "liftoff",
    zero_layer: bool = False,
    spreads: Mapping[str, Normal] | None = None,
    moves_m: Sequence[float] = (),
    **rest: Any,
) -> RunSheet:
    """A run sheet of a few dies; `rest` goes into it as it is."""
    order = tuple(order) or tuple(range(levels.bits))
    plates = photomasks_of(levels, order, tone, chrome, zero_layer)
    process = Process(levels, order, spreads or {}, tone=tone, minimum_line_m=1.2 * UM, name="a lab")
    site = alignment_site(plates, DBU_M)
    places = {
        **prefixed(moved(site, -35e-3, 0), "left site: ").places,
        **prefixed(moved(site, 35e-3, 0), "right site: ").places,
        **prefixed(moved(die_marks(plates, DBU_M), 0, -4e-3), "middle die: ").places,
        **moved(process_monitor(levels, plates, 2 * UM, DBU_M, 1.2 * UM), 0, -20e-3).places,
    }
    moves = dict(enumerate(moves_m))
    files = {
        plate.name: PhotomaskFile(
            f"{STEM}_{plate.code}.gds",
            f"{plate.layer:x}" * 64,
            f"{STEM}_{plate.code}",
            0.0 if plate.bit is None else moves.get(plate.bit, 0.0),
        )
        for plate in plates
    }
    wafer = Wafer(chrome=chrome, zero_layer=zero_layer)
    given = {"level_map": doe(levels), "opening": RoundAperture(4.43e-3), **rest}
    dies = (Die("A1", 0.0, 0.0), Die("A2", 10e-3, 0.0, 'edges of <all> masks "+50 nm"'))
    return RunSheet(
        stem=STEM, photomasks=plates, files=files, process=process, wafer=wafer, places=places, dies=dies,
        **given,
    )  # fmt: skip


def predictions() -> Predictions:
    """Numbers that no plate has."""
    near = PredictedMetrics("red", 0.05, 0.81, 0.0123, 0.86, ring_to_disc=3.21)
    far = PredictedMetrics("red", None, 0.81, 0.0123, 0.91, far_spot=0.654)
    gratings = tuple(Grating(error, 0.01 + error**2, 0.004 + error**2) for error in (-0.02, 0.0, 0.02))
    ranking = (Importance("overlay of mask 4", 0.61, 0.02), Importance("line width (CD bars) of every mask", 0.2, 0.7))
    return Predictions((near, far), (near, far), 550 * NM, 552.06 * NM, 520 * NM, 1.0645, gratings, ranking)
