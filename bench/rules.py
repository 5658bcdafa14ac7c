"""Speed of the rules, of the repair and of the compensation, against drawing the same masks.

    python -m bench.rules            all of it, about two minutes
    python -m bench.rules --quick    a quarter of the width; the targets are for the full one

The check of four planes is compared with drawing their rectangles from the same level map, in turn and after one
unmeasured pair. KLayout's checks are given a crop, since they are slow where a plane has many edges.
"""

import argparse
import math
import statistics
import time

import numpy as np
from numpy.typing import NDArray

from bench.masks import LEVELS, bench_map, ratio, row, timed
from fab.grid import Grid
from fab.layout.compensation import grown, read_back
from fab.layout.doe import mask_layout
from fab.layout.geometry import pixel_edges
from fab.layout.polygons import rectangles
from fab.level_map import LevelMap
from fab.rules.check import Rules, check
from fab.rules.repair import repair
from fab.units import UM

RULES = Rules(2 * UM, 2 * UM)
_MOVE = 120


def klayout_checks(plane: NDArray[np.uint8]) -> None:
    """Check one plane with KLayout: boxes, merge, width and space."""
    import klayout.db as kdb

    region = kdb.Region()
    for x0, y0, x1, y1 in rectangles(plane).tolist():
        region.insert(kdb.Box(1000 * x0, 1000 * y0, 1000 * x1, 1000 * y1))
    region.merge()
    options = {"metrics": kdb.Metrics.Projection, "min_projection": 1}
    region.width_check(2000, **options)
    region.space_check(2000, **options)


def check_table(kind: str, count: int, crop: int) -> None:
    """Print the check against the drawing, and against KLayout."""
    level_map = bench_map(kind, count)
    check_s, draw_s, share = ratio(lambda: check(level_map, RULES), lambda: mask_layout(level_map, "BENCH"), pairs=7)
    row(f"{kind}: four planes drawn as rectangles", draw_s, "s", "", None)
    row(f"{kind}: rules of four planes", check_s, "s", "", None)
    row(f"{kind}: ... over the drawing", share, "x", "<= 0.5", share <= 0.5)
    small = LevelMap(level_map.level[:crop, :crop], LEVELS, Grid((crop, crop), UM), math.inf)
    own = statistics.median(timed(lambda: check(small, RULES)) for _ in range(5))
    other = sum(timed(lambda p=plane: klayout_checks(p)) for plane in small.planes())
    row(f"{kind}: KLayout's checks over ours, {crop} x {crop}", other / own, "x", "", None)


def repair_table(kind: str, count: int) -> None:
    """Print the repair of a plate for two minimum sizes."""
    level_map = bench_map(kind, count)
    for least in (2, 3):
        rules = Rules(least * UM, least * UM)
        start = time.perf_counter()
        cost = repair(level_map, rules).cost
        seconds = time.perf_counter() - start
        name = f"{kind}: repair to {least} um, {count} x {count}"
        row(name, seconds, "s", "< 30", seconds < 30)
        row("  ... places broken after it", cost.broken_after, "", "0", cost.broken_after == 0)
        row("  ... pixels changed", 100 * cost.changed_share, "%", "", None)
        row("  ... light that stays where it was meant", 100 * cost.efficiency, "%", "", None)


def compensation_table(kind: str, count: int) -> None:
    """Print the drawing of four planes with moved edges, and reading them back."""
    level_map = bench_map(kind, count)
    bit_planes, edges = level_map.planes(), pixel_edges(level_map.grid)
    for move in (_MOVE, -_MOVE):
        start = time.perf_counter()
        shapes = [grown(plane, edges, move) for plane in bit_planes]
        middle = time.perf_counter()
        same = all(np.array_equal(read_back(s, edges, move), p) for s, p in zip(shapes, bit_planes, strict=True))
        end = time.perf_counter()
        plain = sum(len(rectangles(plane)) for plane in bit_planes)
        row(f"{kind}: four planes with edges moved by {move} nm", middle - start, "s", "", None)
        row("  ... rectangles over those of the plain planes", sum(map(len, shapes)) / plain, "x", "", None)
        row("  ... read back, every pixel the same", end - middle, "s", "", same)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Speed of the rules.")
    parser.add_argument("--quick", action="store_true", help="a quarter of the width")
    scale = 4 if parser.parse_args().quick else 1
    full, plate = 4400 // scale, 2400 // scale
    print(f"rules, {LEVELS.count} levels, lines and spaces of 2 um; {full} x {full} pixels of 1 um unless stated")
    # Compiled before anything is timed.
    repair(bench_map("white", 64), RULES)
    compiled = bench_map("white", 16).planes()[0]
    edges = pixel_edges(Grid((16, 16), UM))
    for move in (1, -1):
        read_back(grown(compiled, edges, move), edges, move)
    for kind in ("ring", "field"):
        check_table(kind, full, 500 // scale)
        repair_table(kind, plate)
        compensation_table(kind, full)


if __name__ == "__main__":
    main()
