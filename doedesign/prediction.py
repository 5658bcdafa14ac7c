"""Prediction of a drawn design once it is made: from masks and process errors to PSFs and the numbers a lab measures.

`predict` is one draw of every tolerance study and the model of every calibration.
"""

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

from doedesign.design.design import Design
from fab.level_map import LevelMap
from fab.process import Process, Variation
from fab.units import require_kind
from sim.camera import Camera
from sim.metrics import metric_rows
from sim.optic import CellOptic
from sim.psf_bank import PsfBank, psf
from sim.surface import FabricatedDoe, as_fabricated

if TYPE_CHECKING:
    from doedesign.areas.shape import AreaTable, AreaTables
    from doedesign.focus.depth import FocusTable
    from doedesign.spots.orders import OrderTable, OrderTables


class Prediction(NamedTuple):
    """A DOE as fabricated, its PSFs at `Design.depths_m`, and their metrics (`plate_rows`)."""

    surface: FabricatedDoe
    bank: PsfBank
    rows: list[dict[str, Any]]


def predict(design: Design, process: Process, variation: Variation) -> Prediction:
    """Predict the DOE that a design, a process and a variation (its errors, SI units) give.

    Raises:
        InputError: an argument of another kind, or errors beyond what the model describes (`sim.as_fabricated`).
    """
    require_kind("design", design, Design, "Of a run: dd.open_design(folder).")
    surface = as_fabricated(design.level_map.level, design.camera, process, variation, depths_m=design.depths_m)
    bank = psf(surface, depths=design.depths_m)
    return Prediction(surface, bank, plate_rows(design, surface, bank))


def plate_rows(design: Design, surface: FabricatedDoe, bank: PsfBank) -> list[dict[str, Any]]:
    """Numbers of a DOE as fabricated, one row per depth and colour (`sim.metrics.METRICS`, table "fabricated")."""
    nominal = as_drawn(design.camera, design.aim or design.level_map, design.depths_m)
    found = on_target(design, surface)
    aimed = None if found is None else found.measures()
    return metric_rows(bank.metric_inputs(design.near_m, surface, nominal, aimed=aimed), "fabricated")


def on_target(
    design: Design, doe: CellOptic
) -> "OrderTable | OrderTables | AreaTable | AreaTables | FocusTable | None":
    """Light on what a design should make, spots, an area or foci, of the design as drawn or as fabricated.

    None for a design that should make none of them.
    """
    if design.spec is None or not design.spec.aims:
        return None
    if design.spec.focus is not None:
        from doedesign.focus.depth import focus_of_design

        return focus_of_design(design, doe)
    if design.spec.spots is not None:
        from doedesign.spots.design import orders_of_design
        from doedesign.spots.orders import OrderTables

        spots = orders_of_design(design, doe)
        return spots[0] if len(spots) == 1 else OrderTables(spots)
    from doedesign.areas.shape import AreaTables, areas_of_design

    tables = areas_of_design(design, doe)
    return tables[0] if len(tables) == 1 else AreaTables(tables)


@lru_cache(maxsize=1)
def as_drawn(camera: Camera, level_map: LevelMap, depths_m: tuple[float, ...]) -> FabricatedDoe:
    """The DOE exactly as drawn; kept, because every draw is compared with it."""
    return as_fabricated(level_map.level, camera, Process(level_map.levels), Variation(), depths_m=depths_m)
