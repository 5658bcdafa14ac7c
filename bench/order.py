"""A whole mask order: masks, wafer, rules, solids and height maps, written and proved; and how the cost grows.

    python -m bench.order            the automotive plate, then 1000² to 4000² pixels: minutes
    python -m bench.order --quick    1000² and 2000²
    python -m bench.order --large    1000² to 8000²

Every size runs in a process of its own, whose peak memory is printed. The map is a wrapped cone with noise, the process
a contact aligner.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.reference import wrapped_map
from doedesign.build import process_from_spec
from doedesign.spec.process import ProcessSpec
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels, quantise
from fab.order.write import write_order

PITCH_M, LEVELS = 1.85e-6, Levels(16, 75e-9)
AUTOMOTIVE = 2400
TARGET_S, TARGET_GB = 60.0, 4.0


def one(cells: int) -> None:
    """Write and prove one order, and print seconds and gigabytes."""
    full_m = LEVELS.count * LEVELS.step_m
    level = quantise(np.mod(wrapped_map(cells, smooth_cells=4.0), full_m), LEVELS)
    process = process_from_spec(ProcessSpec(levels=16, level_step_m=75e-9, stock="contact_aligner"))
    level_map = LevelMap(level, LEVELS, Grid((cells, cells), PITCH_M), cells * PITCH_M, "bench")
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        write_order(Path(folder) / "order", level_map, process=process)
        took = time.perf_counter() - begun
    print(took, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2)


def measured(cells: int) -> tuple[float, float]:
    """Seconds and gigabytes of one order in a process of its own."""
    command = [sys.executable, "-m", "bench.order", "--one", str(cells)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    seconds, gigabytes = map(float, done.stdout.split())
    return seconds, gigabytes


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="1000² and 2000²")
    parser.add_argument("--large", action="store_true", help="up to 8000²")
    parser.add_argument("--one", type=int, help="one order of so many pixels per side")
    given = parser.parse_args()
    if given.one:
        one(given.one)
        return
    if not given.quick:
        took, peak = measured(AUTOMOTIVE)
        fast, small = ("ok" if a < b else "missed" for a, b in ((took, TARGET_S), (peak, TARGET_GB)))
        print(f"Mask order, {AUTOMOTIVE} x {AUTOMOTIVE} pixels, 16 levels, everything proved")
        print(f"  {took:6.1f} s (target < {TARGET_S:g}: {fast})  peak {peak:.2f} GB (target < {TARGET_GB:g}: {small})")
    sizes = (1000, 2000) if given.quick else (1000, 2000, 4000, 8000) if given.large else (1000, 2000, 4000)
    print("Growth, per million pixels")
    for cells in sizes:
        took, peak = measured(cells)
        print(f"  {cells} x {cells}: {took:6.1f} s, {took / cells**2 * 1e6:5.2f} s each, peak {peak:5.2f} GB")


if __name__ == "__main__":
    main()
