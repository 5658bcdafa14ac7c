"""What a drawn design will do once it is made: from masks and process errors to PSFs and the numbers a lab measures.

`predict` is one draw of every tolerance study, the model of every calibration, and `doedesign psf --fabricated`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from doedesign.build import camera_from_spec
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import drawn_in_masks, levels_of_run
from fab.files import MANIFEST_NAME, sha256_bytes
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.process import Normal, Process, Variation
from fab.units import NM
from sim.camera import Camera
from sim.leakage import strehl, zeroth_order
from sim.metrics import energy_within, mean_wavelength_m, ring_to_disc, spot_radius_m
from sim.psf_bank import PsfBank, surface_bank
from sim.surface import FabricatedDoe, as_fabricated


@dataclass(frozen=True)
class Drawn:
    """A design as drawn, with all that is needed to predict it. Values only: it may be sent to other processes.

    Attributes:
        name: name of the design.
        level: `[y, x]` level numbers, the top level where the glass stays blank.
        levels: the staircase.
        camera: optics.
        near_m: depths of obstructions.
        far_m: depths of the scene.
        edge_moves_m: how far the masks draw the edges of etched areas outward to make up for the process, mask 0 first;
            empty for nowhere. A variation is relative to the design, so these are in it (`process_with_moves`).
    """

    name: str
    level: NDArray[np.uint8]
    levels: Levels
    camera: Camera
    near_m: tuple[float, ...]
    far_m: tuple[float, ...]
    edge_moves_m: tuple[float, ...] = ()

    @property
    def depths_m(self) -> tuple[float, ...]:
        """All depths, near ones first."""
        return (*self.near_m, *self.far_m)

    def digest(self) -> str:
        """SHA-256 of the level map."""
        return sha256_bytes(np.ascontiguousarray(self.level).tobytes())


def drawn_of(run: Run, masks: Path | None = None) -> Drawn:
    """What a run's masks draw.

    Args:
        run: a finished run.
        masks: its mask order; `masks/NAME` where there is one, else the run's own quantised map.

    Raises:
        InputError: an order that cannot be read, or not of this run.
    """
    drawing = levels_of_run(run)
    folder = masks or Path("masks") / run.spec.name
    moves_m: tuple[float, ...] = ()
    if masks is not None or (folder / MANIFEST_NAME).is_file():
        level = drawn_in_masks(folder, drawing)
        moves_m = tuple(mask.edge_move_nm * NM for mask in read_manifest(folder).masks)
    else:
        level = LevelMap(drawing.level, drawing.levels, drawing.grid, drawing.aperture_m).level
    scene, camera = run.spec.scene, camera_from_spec(run.spec)
    moves_m = moves_m if any(moves_m) else ()
    return Drawn(run.spec.name, level, drawing.levels, camera, scene.near_m, scene.far_m, moves_m)


def process_with_moves(process: Process, edge_moves_m: Sequence[float]) -> Process:
    """Return the process as the design sees it through masks whose edges were moved.

    Args:
        process: what the lab does.
        edge_moves_m: how far every edge of each mask was moved outward, mask 0 first; empty for none.
    """
    if not any(edge_moves_m):
        return process
    names = [f"cd_bias_m[{mask}]" for mask in range(process.masks)]
    old = [process.spreads.get(name, Normal()) for name in names]
    moved = {name: Normal(one.mean + move, one.sigma) for name, one, move in zip(names, old, edge_moves_m, strict=True)}
    return replace(process, spreads={**process.spreads, **moved})


class Prediction(NamedTuple):
    """A plate and what it does.

    Attributes:
        surface: the plate.
        bank: its PSFs at `Drawn.depths_m`.
        rows: see `plate_rows`.
    """

    surface: FabricatedDoe
    bank: PsfBank
    rows: list[dict[str, Any]]


def predict(drawn: Drawn, process: Process, variation: Variation) -> Prediction:
    """Predict the plate that a design, a process and its errors give.

    Raises:
        InputError: errors beyond what the model describes (`sim.surface.as_fabricated`).
    """
    surface = as_fabricated(drawn.level, drawn.camera, process, variation)
    bank = surface_bank(drawn.camera, surface, drawn.depths_m)
    return Prediction(surface, bank, plate_rows(drawn, surface, bank))


def plate_rows(drawn: Drawn, surface: FabricatedDoe, bank: PsfBank) -> list[dict[str, Any]]:
    """Numbers of a plate, one row per depth and colour.

    Returns:
        rows with `colour`, `depth_m` (None for infinity), `zeroth_order` |<t>|^2, `strehl` (overlap with the field the
        design means to make), `throughput` (energy in the sensor window per unit incident on the clear aperture,
        Fresnel loss included), `outside_window` (transmitted, but scattered beyond the window or between
        light-sensitive squares), `chrome` (change of the transmitted power by chrome that is not where it should be),
        and for near depths `ring_to_disc`, for far ones `far_spot`. The zeroth order and the Strehl ratio do not depend
        on depth.
    """
    camera = drawn.camera
    lines = surface.wavelengths_m
    orders = dict(zip(lines, zeroth_order(surface), strict=True))
    strehls = dict(zip(lines, strehl(surface, _nominal(camera, drawn)), strict=True))
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
            if depth in drawn.near_m:
                row["ring_to_disc"] = ring_to_disc(psf, camera, depth).ratio
            else:
                row["far_spot"] = energy_within(psf, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(colour)))
            rows.append(row)
    return rows


class _ById:
    """A design as a key of a cache: its staircase and, by identity, its level map, which is large and never changes."""

    def __init__(self, drawn: Drawn) -> None:
        self.drawn = drawn

    def __hash__(self) -> int:
        return hash((id(self.drawn.level), self.drawn.levels))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _ById):
            return False
        return other.drawn.level is self.drawn.level and other.drawn.levels == self.drawn.levels


@lru_cache(maxsize=1)
def _nominal_of(camera: Camera, key: _ById) -> FabricatedDoe:
    return as_fabricated(key.drawn.level, camera, Process(key.drawn.levels), Variation())


def _nominal(camera: Camera, drawn: Drawn) -> FabricatedDoe:
    """The plate exactly as drawn; kept, because every draw is compared with it."""
    return _nominal_of(camera, _ById(drawn))
