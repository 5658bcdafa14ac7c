"""What a drawn design will do once it is made: from masks and process errors to PSFs and the numbers a lab measures.

`predict` is one draw of every tolerance study, the model of every calibration, and `doedesign psf --fabricated`.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from doedesign.design.design import Design
from fab.level_map import LevelMap
from fab.process import Process, Variation
from sim.camera import Camera
from sim.leakage import strehl, zeroth_order
from sim.metrics import energy_within, mean_wavelength_m, ring_to_disc, spot_radius_m
from sim.psf_bank import PsfBank, psf
from sim.surface import FabricatedDoe, as_fabricated


class Prediction(NamedTuple):
    """A plate and what it does.

    Attributes:
        surface: the plate.
        bank: its PSFs at `Design.depths_m`.
        rows: see `plate_rows`.
    """

    surface: FabricatedDoe
    bank: PsfBank
    rows: list[dict[str, Any]]


def predict(design: Design, process: Process, variation: Variation) -> Prediction:
    """Predict the plate that a design, a process and its errors give.

    Raises:
        InputError: errors beyond what the model describes (`sim.surface.as_fabricated`).
    """
    surface = as_fabricated(design.level_map.level, design.camera, process, variation)
    bank = psf(surface, depths=design.depths_m)
    return Prediction(surface, bank, plate_rows(design, surface, bank))


def plate_rows(design: Design, surface: FabricatedDoe, bank: PsfBank) -> list[dict[str, Any]]:
    """Numbers of a plate, one row per depth and colour.

    Returns:
        rows with `colour`, `depth_m` (None for infinity), `zeroth_order` |<t>|^2, `strehl` (overlap with the field the
        design means to make), `throughput` (energy in the sensor window per unit incident on the clear aperture,
        Fresnel loss included), `outside_window` (transmitted, but scattered beyond the window or between
        light-sensitive squares), `chrome` (change of the transmitted power by chrome that is not where it should be),
        and for near depths `ring_to_disc`, for far ones `far_spot`. The zeroth order and the Strehl ratio do not depend
        on depth.
    """
    camera = design.camera
    lines = surface.wavelengths_m
    orders = dict(zip(lines, zeroth_order(surface), strict=True))
    strehls = dict(zip(lines, strehl(surface, _nominal(camera, design.level_map)), strict=True))
    # The light that passes, per incident on the nominal opening.
    cells = np.pi * (camera.aperture_m / surface.grid.pitch_m) ** 2 / 4
    opening = float(np.sum(np.asarray(surface.coverage), dtype=np.float64)) / cells
    rows = []
    for d, depth in enumerate(bank.depths_m):
        for c, colour in enumerate(camera.colours):
            weighted = list(zip(colour.wavelengths_m, colour.weights, strict=True))
            passed = sum(weight * camera.transmission(w) for w, weight in weighted)
            psf = bank.energy[c, d]
            throughput = float(psf.sum(dtype=np.float64))
            row: dict[str, Any] = {
                "colour": colour.name,
                "depth_m": None if np.isinf(depth) else depth,
                "zeroth_order": float(sum(weight * orders[w] for w, weight in weighted)),
                "strehl": float(sum(weight * strehls[w] for w, weight in weighted)),
                "throughput": throughput,
                "outside_window": passed * opening - throughput,
                "chrome": passed * (opening - 1),
            }
            if depth in design.near_m:
                row["ring_to_disc"] = ring_to_disc(psf, camera, depth).ratio
            else:
                row["far_spot"] = energy_within(psf, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(colour)))
            rows.append(row)
    return rows


@lru_cache(maxsize=1)
def _nominal(camera: Camera, level_map: LevelMap) -> FabricatedDoe:
    """The plate exactly as drawn; kept, because every draw is compared with it."""
    return as_fabricated(level_map.level, camera, Process(level_map.levels), Variation())
