"""Designs and evaluations of no more than a few numbers, for the tests of tolerance studies.

Worker processes import this module, so it stands in a file of its own and imports nothing heavy.
"""

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.design.design import Design
from fab.errors import InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.process import Defects, Normal, Process, Variation, error_names
from sim.camera import Camera, Colour

LEVELS = Levels(4, 75e-9)
GRID = Grid((8, 8), 1e-3 / 8)
CAMERA = Camera(GRID, 1e-3, "fused_silica", (Colour("green", (550e-9,), (1.0,)),), 4e-3, 4e-6, 16)


def design(name: object = "fake") -> Design:
    """A design whose name tells the evaluations below where to leave their marks."""
    level = np.arange(64, dtype=np.uint8).reshape(8, 8) % 4
    level_map = LevelMap(level, LEVELS, GRID, 1e-3, str(name))
    return Design(level_map, CAMERA, (0.05,), (np.inf,))


def process(**sigmas: float) -> Process:
    """Errors by the name in `ERRORS`, one sigma for all masks; those of three sources by default."""
    chosen = sigmas or {"overlay_x_m": 0.5e-6, "depth_scale": 0.02, "corner_radius_m": 0.2e-6}
    spreads = {name: Normal(0.0, sigma) for key, sigma in chosen.items() for name in error_names(LEVELS.bits, key)}
    return Process(LEVELS, spreads=spreads)


def with_defects(**rates: float) -> Process:
    return Process(LEVELS, spreads=process().spreads, defects=Defects(**rates))


def rows(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    """A plate whose numbers are plain functions of its errors: light 0.01 + (sum of depth errors)² goes straight."""
    depth = sum(variation.value(f"depth_scale[{k}]") for k in range(process.masks))
    shift = sum((variation.value(f"overlay_x_m[{k}]") / 1e-6) ** 2 for k in range(process.masks))
    events = 0.05 * len(variation.particles) + 0.1 * sum(map(abs, variation.repeats))
    zeroth = 0.01 + depth**2 + events
    out: list[dict[str, Any]] = []
    for colour, factor in (("red", 1.0), ("blue", 2.0)):
        common = {"colour": colour, "zeroth_order": factor * zeroth, "strehl": 1 - shift / 10 - 0.1 * events}
        common |= {"throughput": 0.9, "outside_window": 0.03 + depth / 10}
        out.append({**common, "depth_m": 0.05, "ring_to_disc": 3.0 - factor * shift})
        out.append({**common, "depth_m": None, "far_spot": 0.4 - depth - variation.corner_radius_m / 1e-5})
    return out


def slow_rows(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    time.sleep(0.05)
    return rows(design, process, variation)


def _mark(design: Design, word: str) -> int:
    """Append a line to a file beside the test; returns how many there are."""
    with open(Path(design.name) / word, "a") as stream:
        stream.write(json.dumps({"pid": os.getpid()}) + "\n")
    return len((Path(design.name) / word).read_text().splitlines())


def rows_or_death_once(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    """Kills its worker at the third plate, the first time only."""
    if _mark(design, "plates") == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return slow_rows(design, process, variation)


def rows_or_death(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    """Kills its worker whenever the errors are those of a certain plate."""
    if variation.overlay_x_m and abs(variation.overlay_x_m[0] - DEADLY) < 1e-12:
        os.kill(os.getpid(), signal.SIGKILL)
    return slow_rows(design, process, variation)


DEADLY = 1.234e-6


def refused(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    """Cannot model a shift of more than 0.5 um."""
    if variation.overlay_x_m and max(map(abs, variation.overlay_x_m)) > 0.5e-6:
        raise InputError("overlay_x", "must stay below 0.5 um", "more", "Take a smaller sigma.")
    return rows(design, process, variation)


def broken(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    raise ZeroDivisionError("a mistake in the user's own function")


def settings(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    """How the worker that computes it is set up."""
    import sys

    names = ("XLA_FLAGS", "OMP_NUM_THREADS", "JAX_PLATFORMS")
    found = {name: os.environ.get(name) for name in names}
    return [{"colour": "red", "depth_m": None, "pid": os.getpid(), "main": sys.modules["__main__"].__name__, **found}]


class Heavy:
    """An evaluation that tells its copies' parent how often it was sent off; an item comes back with its worker."""

    noun = "item"
    token = "heavy"

    def __init__(self) -> None:
        self.sent = 0

    def __getstate__(self) -> dict[str, Any]:
        self.sent += 1
        return {}

    def __call__(self, item: int) -> tuple[int, int]:
        time.sleep(0.02)
        return item**2, os.getpid()


def marked_rows(design: Design, process: Process, variation: Variation) -> list[dict[str, Any]]:
    """Leaves its process id in a file."""
    _mark(design, "plates")
    return slow_rows(design, process, variation)


class Busy:
    """An evaluation that computes for a while: an item is how many seconds."""

    noun = "item"
    token = "busy"

    def __call__(self, seconds: float) -> None:
        begun = time.process_time()
        while time.process_time() < begun + seconds:
            pass
