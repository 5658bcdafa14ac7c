"""Speed and memory of the mask path, printed as ratios that were measured alternately in one run.

    python -m bench.masks            all of it, about two minutes
    python -m bench.masks --quick    a quarter of the width, in seconds; the targets are for the full one

The floor of a mask writer is the time to write the same bytes, without forcing them to the disk. Every
ratio is the median of pairs measured one after the other, so a busy machine touches both sides alike.
Memory and whole orders are measured in a process of their own.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from doedesign.runtime.memory import peak_bytes
from fab.gds.oasis import write_oasis
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.doe import mask_layout
from fab.layout.geometry import Cell, Layer, Layout, Shapes, pixel_edges
from fab.layout.polygons import rectangles
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.write import write_order
from fab.units import NM, UM
from fab.verification.files import read_drawn_levels

LEVELS = Levels(16, 75 * NM)
_CHUNK = bytes(1 << 22)


def ring_map(count: int) -> NDArray[np.uint8]:
    """Return a wrapped axicon (period 60 pixels) with smoothed radial noise, 16 levels, ``[y, x]``."""
    rng = np.random.default_rng(1)
    axis = (np.arange(count, dtype=np.float32) - (count - 1) / 2) ** 2
    radius = np.sqrt(axis[:, None] + axis)
    noise = gaussian_filter1d(rng.standard_normal(count), 20)
    waves = radius / 60 + np.interp(radius, np.arange(count), noise / noise.std())
    return (waves % 1 * 16).astype(np.uint8)


def field_map(count: int) -> NDArray[np.uint8]:
    """Return gaussian-smoothed noise (sigma 6 pixels, one wave rms), wrapped, 16 levels, ``[y, x]``."""
    noise = gaussian_filter(np.random.default_rng(1).standard_normal((count, count), dtype=np.float32), 6)
    return np.minimum(noise / noise.std() % 1 * 16, 15).astype(np.uint8)


def white_map(count: int) -> NDArray[np.uint8]:
    """Return independent random levels, the worst a mask can be, ``[y, x]``."""
    return np.random.default_rng(1).integers(0, 16, (count, count)).astype(np.uint8)


MAPS = {"ring": ring_map, "field": field_map, "white": white_map}


def bench_map(kind: str, count: int, pitch_m: float = UM) -> LevelMap:
    """Return one of the maps as wide as its aperture."""
    return LevelMap(MAPS[kind](count), LEVELS, Grid((count, count), pitch_m), count * pitch_m, f"bench {kind}")


def timed(work: Callable[[], object]) -> float:
    """Return the seconds that a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def ratio(work: Callable[[], object], floor: Callable[[], object], pairs: int) -> tuple[float, float, float]:
    """Return the medians of work, of floor, and of their ratio, measured in turn after one unmeasured pair."""
    work(), floor()
    times = [(timed(work), timed(floor)) for _ in range(pairs)]
    return (
        statistics.median(a for a, _ in times),
        statistics.median(b for _, b in times),
        statistics.median(a / b for a, b in times),
    )


def write_floor(path: Path, size: int) -> None:
    """Write that many bytes in the plainest way."""
    with open(path, "wb", buffering=0) as stream:
        for start in range(0, size, len(_CHUNK)):
            stream.write(_CHUNK[: size - start])


def generate(level_map: LevelMap, path: Path) -> Layout:
    """Draw a map and write it as GDSII: planes, rectangles, file."""
    layout = mask_layout(level_map, "BENCH")
    write_gds(path, layout)
    return layout


def read_back(path: Path, expected: LevelMap) -> None:
    """Read the file with the own reader and compare every pixel."""
    if not np.array_equal(read_drawn_levels([path], LEVELS, pixel_edges(expected.grid), "BENCH"), expected.level):
        raise AssertionError("the file does not hold the map")


def full_size(kind: str, count: int, folder: Path) -> dict[str, float]:
    """Measure one map at full size: ratios to the write floor, and the OASIS file."""
    level_map = bench_map(kind, count)
    gds, other, oasis = folder / "masks.gds", folder / "floor.bin", folder / "masks.oas"
    layout = generate(level_map, gds)
    size = gds.stat().st_size
    write_s, floor_s, write_ratio = ratio(lambda: generate(level_map, gds), lambda: write_floor(other, size), pairs=5)
    read_s, _, read_ratio = ratio(lambda: read_back(gds, level_map), lambda: write_floor(other, size), pairs=5)
    oasis_s = timed(lambda: write_oasis(oasis, layout))
    return {
        "rectangles": sum(map(len, layout.cells[0].shapes.values())),
        "gds_mb": size / 1e6,
        "floor_s": floor_s,
        "write_s": write_s,
        "write_ratio": write_ratio,
        "read_s": read_s,
        "read_ratio": read_ratio,
        "oasis_s": oasis_s,
        "oasis_mb": oasis.stat().st_size / 1e6,
    }


def klayout_pixels(plane: NDArray[np.uint8], path: Path) -> None:
    """Draw one plane the usual way: a KLayout box per pixel, merged, written."""
    import klayout.db as kdb

    layout = kdb.Layout()
    region = kdb.Region()
    for y, x in np.argwhere(plane).tolist():
        region.insert(kdb.Box(1000 * x, 1000 * y, 1000 * x + 1000, 1000 * y + 1000))
    layout.create_cell("TOP").shapes(layout.layer(1, 0)).insert(region.merged())
    layout.write(str(path))


def own_plane(plane: NDArray[np.uint8], path: Path) -> None:
    """Draw the same plane with this package."""
    y_edges, x_edges = (np.arange(n + 1, dtype=np.int32) * 1000 for n in plane.shape)
    write_gds(path, Layout(NM, (Cell("TOP", {Layer(1): Shapes(rectangles(plane, x_edges, y_edges))}),)))


def against_klayout(kind: str, count: int, folder: Path) -> float:
    """Return how many times slower KLayout's boxes are, over all planes of a crop."""
    times = []
    for plane in bench_map(kind, count).planes():
        own_plane(plane, folder / "own.gds")
        own = statistics.median(timed(lambda p=plane: own_plane(p, folder / "own.gds")) for _ in range(3))
        times.append((timed(lambda p=plane: klayout_pixels(p, folder / "klayout.gds")), own))
    return sum(a for a, _ in times) / sum(b for _, b in times)


def child(task: str, kind: str, count: int) -> dict[str, float]:
    """Run one task in a process of its own; return its seconds, start to end, and its peak memory in GB."""
    command = [sys.executable, "-m", "bench.masks", "--task", task, "--kind", kind, "--count", str(count)]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {"seconds": time.perf_counter() - start, **json.loads(done.stdout)}


def task_peak(kind: str, count: int, folder: Path) -> None:
    """Generate and read back once."""
    level_map = bench_map(kind, count)
    generate(level_map, folder / "masks.gds")
    read_back(folder / "masks.gds", level_map)


def task_order(kind: str, count: int, folder: Path) -> None:
    """Write and verify a whole order at the pitch of the automotive design."""
    write_order(folder / "order", bench_map(kind, count, 1.85 * UM))


def run_task(task: str, kind: str, count: int) -> None:
    """Run a task and print its peak memory, JSON."""
    with tempfile.TemporaryDirectory() as name:
        {"peak": task_peak, "order": task_order}[task](kind, count, Path(name))
    print(json.dumps({"peak_gb": peak_bytes() / 1e9}))


def row(what: str, value: float, unit: str, target: str, met: bool | None) -> None:
    """Print one line of the table; `met` is None where nothing is asked."""
    verdict = "" if met is None else "met" if met else "MISSED"
    print(f"{what:<58}{value:>10.2f} {unit:<4} {target:<12}{verdict}", flush=True)


def report(scale: int) -> None:
    """Measure everything and print the table."""
    full, crop, plate = 4400 // scale, 1000 // scale, 2400 // scale
    print(f"masks, {LEVELS.count} levels; {full} x {full} pixels unless stated")
    for kind in ("ring", "field"):
        with tempfile.TemporaryDirectory() as name:
            found = full_size(kind, full, Path(name))
            speedup = against_klayout(kind, crop, Path(name))
        peak = child("peak", kind, full)["peak_gb"]
        row(f"{kind}: rectangles", found["rectangles"] / 1e6, "M", "", None)
        row(f"{kind}: GDSII", found["gds_mb"], "MB", "", None)
        row(f"{kind}: writing the same bytes (floor)", found["floor_s"], "s", "", None)
        row(f"{kind}: planes + rectangles + GDSII", found["write_s"], "s", "", None)
        row(f"{kind}: ... over the floor", found["write_ratio"], "x", "<= 4", found["write_ratio"] <= 4)
        row(f"{kind}: own reader, every pixel compared", found["read_s"], "s", "", None)
        row(f"{kind}: ... over the floor", found["read_ratio"], "x", "<= 4", found["read_ratio"] <= 4)
        row(f"{kind}: OASIS", found["oasis_mb"], "MB", "<= 20", found["oasis_mb"] <= 20)
        row(f"{kind}: OASIS", found["oasis_s"], "s", "", None)
        row(f"{kind}: KLayout pixel boxes + merge, {crop} x {crop}", speedup, "x", ">= 30", speedup >= 30)
        row(f"{kind}: peak memory of a process that writes and reads", peak, "GB", "< 2.5", peak < 2.5)
    for kind in ("ring", "field", "white"):
        order = child("order", kind, plate)
        row(f"{kind}: whole order, {plate} x {plate}, verified", order["seconds"], "s", "< 20", order["seconds"] < 20)
        row(f"{kind}: ... peak memory", order["peak_gb"], "GB", "< 2", order["peak_gb"] < 2)


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description="Speed and memory of the mask path.")
    parser.add_argument("--quick", action="store_true", help="a quarter of the width")
    parser.add_argument("--task", choices=("peak", "order"), help=argparse.SUPPRESS)
    parser.add_argument("--kind", choices=tuple(MAPS), default="ring", help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, default=1, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.task:
        run_task(given.task, given.kind, given.count)
    else:
        report(4 if given.quick else 1)


if __name__ == "__main__":
    main()
