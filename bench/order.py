"""A whole mask order, written and proved: how large the folder is, how long `masks` and `verify` take, how both grow.

    python -m bench.order            2400 x 2400 pixels of three kinds, then 1000² to 4000² pixels: minutes
    python -m bench.order --quick    1000² and 2000²
    python -m bench.order --large    1000² to 8000²

Every order has a process of its own, whose peak memory is printed, and so has every proof. The formats are the usual
ones, the maps a wrapped cone with noise (like the automotive plate) for a contact aligner, and rings and smooth noise.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.masks import bench_map
from bench.reference import wrapped_map
from doedesign.build import process_from_spec
from doedesign.runtime.memory import peak_bytes
from doedesign.spec.process import ProcessSpec
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels, quantise
from fab.order.verify import verify
from fab.order.write import write_order

PITCH_M, LEVELS = 1.85e-6, Levels(16, 75e-9)
PLATE = 2400
TARGET_MB, TARGET_MASKS_S, TARGET_VERIFY_S, TARGET_GB = 120.0, 30.0, 15.0, 4.0


class Cost(NamedTuple):
    """What an order costs: megabytes, seconds to write and prove it, seconds to prove it again, gigabytes of memory."""

    size_mb: float
    masks_s: float
    verify_s: float
    peak_gb: float


def automotive_map(cells: int) -> LevelMap:
    """Return a map like the automotive plate's."""
    full_m = LEVELS.count * LEVELS.step_m
    level = quantise(np.mod(wrapped_map(cells, smooth_cells=4.0), full_m), LEVELS)
    return LevelMap(level, LEVELS, Grid((cells, cells), PITCH_M), cells * PITCH_M, "bench")


def write(kind: str, cells: int, folder: Path) -> None:
    """Write and prove one order."""
    if kind != "automotive":
        write_order(folder, bench_map(kind, cells, PITCH_M))
        return
    process = process_from_spec(ProcessSpec(levels=16, level_step_m=75e-9, stock="contact_aligner"))
    write_order(folder, automotive_map(cells), process=process)


def _timed(*arguments: str) -> tuple[float, float]:
    """Seconds and gigabytes of a task in a process of its own, start and imports included."""
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "bench.order", *arguments], check=True, capture_output=True, text=True)
    return time.perf_counter() - begun, float(done.stdout.split()[-1])


def measured(kind: str, cells: int) -> Cost:
    """Write an order, and prove it again."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "order"
        masks_s, peak = _timed("--write", kind, "--cells", str(cells), "--folder", str(folder))
        verify_s, again = _timed("--verify", "--folder", str(folder))
        size = sum(path.stat().st_size for path in folder.iterdir())
    return Cost(size / 1e6, masks_s, verify_s, max(peak, again))


def _line(kind: str, cost: Cost) -> str:
    targets = Cost(TARGET_MB, TARGET_MASKS_S, TARGET_VERIFY_S, TARGET_GB)
    words = ("MB", "s masks", "s verify", "GB peak")
    parts = (
        f"{value:6.1f} {word} (target {target:g}: {'ok' if value <= target else 'missed'})"
        for value, target, word in zip(cost, targets, words, strict=True)
    )
    return f"  {kind:<11}{'  '.join(parts)}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="1000² and 2000²")
    parser.add_argument("--large", action="store_true", help="up to 8000²")
    parser.add_argument("--write", help=argparse.SUPPRESS)
    parser.add_argument("--verify", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--cells", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.write or given.verify:
        if given.write:
            write(given.write, given.cells, given.folder)
        else:
            verify(given.folder).require()
        print(peak_bytes() / 1e9)
        return
    if not given.quick:
        print(f"Mask order, {PLATE} x {PLATE} pixels, 16 levels, usual formats, everything proved")
        for kind in ("ring", "field", "automotive"):
            print(_line(kind, measured(kind, PLATE)), flush=True)
    sizes = (1000, 2000) if given.quick else (1000, 2000, 4000, 8000) if given.large else (1000, 2000, 4000)
    print("Growth, per million pixels")
    for cells in sizes:
        cost = measured("automotive", cells)
        each = cost.masks_s / cells**2 * 1e6
        print(
            f"  {cells} x {cells}: {cost.masks_s:6.1f} s, {each:5.2f} s each, peak {cost.peak_gb:5.2f} GB", flush=True
        )


if __name__ == "__main__":
    main()
