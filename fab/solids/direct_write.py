"""The relief for direct-write and greyscale exposure, where a writer takes a dose per level and no set of masks.

    <JOB>_DIRECT.oas    one layer per level, level l on layer l + 1: merged polygons, no two of which meet but at the
                        edges of fields of 64 x 64 pixels
    <JOB>_DIRECT.dxf    the same, in micrometres
    <JOB>_DOSE.csv      height and depth of every level, and blanks for the dose, which the lab's contrast curve gives

Merged polygons matter where an exposure is not the sum of its parts: rectangles side by side leave seams.
"""

import csv
import io
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import read_bytes, write_atomic
from fab.layout.geometry import pixel_edges
from fab.layout.polygons import paint, rectangles
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import ModelEntry
from fab.solids.model import DoeModel, ModelKind, model_entry
from fab.units import NM, UM

_FIELD = 64
# A comment, which every version of DXF may have; a header variable of units came later than the version written here.
_DXF_UNIT = b"999\nunit of all lengths: 1 micrometre\n"


def _layer_name(level: int, levels: Levels) -> str:
    height = f"{levels.heights_m()[level] / NM:.6g}".replace(".", "P")
    return f"LEVEL_{level}_{height}NM_HIGH"


def _fields(plane: NDArray[np.bool_]) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
    """Yield first row, first column and pixels of every field that is not empty."""
    for row in range(0, plane.shape[0], _FIELD):
        for column in range(0, plane.shape[1], _FIELD):
            field = plane[row : row + _FIELD, column : column + _FIELD]
            if field.any():
                yield row, column, np.ascontiguousarray(field, dtype=np.uint8)


def _layout(level_map: LevelMap) -> Any:
    """Draw all levels as a layout of KLayout, a layer each."""
    import klayout.db as kdb

    edges = pixel_edges(level_map.grid)
    layout = kdb.Layout()
    layout.dbu = edges.dbu_m / UM
    top = layout.create_cell("LEVELS")
    for level in range(level_map.levels.count):
        shapes = top.shapes(layout.layer(level + 1, 0, _layer_name(level, level_map.levels)))
        for row, column, field in _fields(level_map.level == level):
            region = kdb.Region()
            x0, y0, x1, y1 = rectangles(field).T
            boxes = (edges.x[x0 + column], edges.y[y0 + row], edges.x[x1 + column], edges.y[y1 + row])
            for box in np.stack(boxes, axis=1).tolist():
                region.insert(kdb.Box(*box))
            # Pixels that meet at a corner only stay apart.
            region.min_coherence = True
            shapes.insert(region.merged())
    return layout


def _write(path: Path, model: DoeModel) -> None:
    import klayout.db as kdb

    options = kdb.SaveLayoutOptions()
    options.format = "OASIS" if path.suffix == ".oas" else "DXF"
    options.oasis_write_cblocks = True
    try:
        _layout(model.level_map).write(str(path), options)
    except RuntimeError as error:
        raise InputError(str(path), "the file must be writable", str(error), "Check the disk.") from error
    if options.format == "DXF":
        path.write_bytes(_DXF_UNIT + path.read_bytes())


def _problems(path: Path, entry: ModelEntry, model: DoeModel) -> list[str]:
    """Paint every level as KLayout reads it, and compare pixel by pixel."""
    import klayout.db as kdb

    level_map, edges = model.level_map, pixel_edges(model.level_map.grid)
    options = kdb.LoadLayoutOptions()
    options.dxf_dbu = edges.dbu_m / UM
    options.dxf_unit = 1.0
    layout = kdb.Layout()
    try:
        layout.read(str(path), options)
    except RuntimeError as error:
        return [f"it cannot be read: {error}"]
    named = {info.name: index for index, info in zip(layout.layer_indexes(), layout.layer_infos(), strict=True)}
    wanted = [_layer_name(level, level_map.levels) for level in range(level_map.levels.count)]
    problems = [f"layer {name} should not be there" for name in named if name not in {*wanted, "0"}]
    for level, name in enumerate(wanted):
        plane = level_map.level == level
        found = kdb.Region() if name not in named else kdb.Region(layout.top_cell().begin_shapes_rec(named[name]))
        boxes = [(b.left, b.bottom, b.right, b.top) for b in (p.bbox() for p in found.decompose_trapezoids())]
        canvas = np.zeros(plane.shape, dtype=np.uint8)
        painted = paint(np.array(boxes, dtype=np.int32).reshape(-1, 4), edges.x, edges.y, 0, canvas)
        wrong = int(np.count_nonzero(canvas != plane)) + painted.strays + painted.overlaps
        problems += [f"layer {name}: {wrong} pixels differ from the level map"] if wrong else []
    return problems


def dose_table(levels: Levels) -> bytes:
    """Return the table of doses as CSV, from the blank surface down; the dose itself is for the lab to fill in."""
    heights_m, total_m = levels.heights_m(), levels.total_m
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\r\n")
    writer.writerow(("level", "layer", "height_nm", "depth_nm", "share_of_full_depth", "dose_mJ_per_cm2"))
    for level in reversed(range(levels.count)):
        height_m = float(heights_m[level])
        numbers = (round(value, 6) for value in (height_m / NM, (total_m - height_m) / NM, 1 - height_m / total_m))
        writer.writerow((level, f"{level + 1}/0", *numbers, ""))
    return text.getvalue().encode()


def _dose_problems(path: Path, entry: ModelEntry, model: DoeModel) -> list[str]:
    same = read_bytes(path) == dose_table(model.level_map.levels)
    return [] if same else ["levels, heights or depths are others than those of the level map"]


def _entry(path: Path, model: DoeModel, content: str) -> ModelEntry | None:
    return model_entry(path, content) if model.direct_write else None


def _kind(
    ending: str,
    content: str,
    write: Callable[[Path, DoeModel], object],
    problems: Callable[[Path, ModelEntry, DoeModel], list[str]],
) -> ModelKind:
    return ModelKind(ending, partial(_entry, content=content), write, problems)


KINDS = (
    _kind("_DIRECT.oas", "one layer per level, merged polygons", _write, _problems),
    _kind("_DIRECT.dxf", "one layer per level, merged polygons, micrometres", _write, _problems),
    _kind(
        "_DOSE.csv",
        "heights and depths of the levels, blanks for the doses",
        lambda path, model: write_atomic(path, dose_table(model.level_map.levels)),
        _dose_problems,
    ),
)
