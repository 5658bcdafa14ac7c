"""The meshes of an order: the relief, and on request a window at full resolution, as 3MF, GLB and STL.

A mesh must have the stated volume, and above every column of the map a top of the right height and area.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fab.manifest.records import ModelEntry
from fab.solids.columns import BASE_M, Columns, window_cells
from fab.solids.mesh import Mesh, is_closed
from fab.solids.meshfile import read_mesh, write_3mf, write_glb, write_stl
from fab.solids.model import DoeModel, MeshedRelief, ModelKind, model_entry, window_of
from fab.solids.step_files import volume_problems
from fab.units import MM

# What is left of a volume: picometres as text or single precision.
_RELATIVE_ERROR, _SINGLE = 1e-6, 2.0**-23

_MOST_PER_CELL = 20  # triangles; about five are written

_Shown = Callable[[DoeModel], MeshedRelief | None]


def _entry(
    path: Path, model: DoeModel, shown: _Shown, unit: str, write: Callable[[Path, Mesh], None]
) -> ModelEntry | None:
    relief = shown(model)
    if relief is None:
        return None
    cells, off = relief.cells, _RELATIVE_ERROR
    if relief.window is not None and write is not write_3mf:
        # In single precision walls stand aside, the more so the farther out; over a whole map that cancels out.
        edges, closest = (np.concatenate([f(cells.x_edges_m), f(cells.y_edges_m)]) for f in (np.abs, np.diff))
        off += _SINGLE * float(edges.max() / closest.min())
    entry = model_entry(path, f"{unit}; {relief.about}", relative_error=off, window=relief.window)
    return replace(entry, volumes_mm3={"RELIEF": (cells.volume_m3 + cells.area_m2 * BASE_M) / MM**3})


def _write(path: Path, model: DoeModel, shown: _Shown, write: Callable[[Path, Mesh], None]) -> None:
    relief = shown(model)
    if relief is not None:
        write(path, relief.mesh)


def _problems(path: Path, entry: ModelEntry, model: DoeModel) -> list[str]:
    window = window_of(entry)
    cells = model.relief.cells if window is None else window_cells(model.level_map, window)
    most = _MOST_PER_CELL * cells.height_m.size + 1000
    mesh = read_mesh(path, "mm" if path.suffix == ".stl" else None, most)
    problems = volume_problems(entry, {"RELIEF": mesh.volume_m3 / MM**3})
    if not is_closed(mesh):
        problems.append("its surface is not closed: an edge has not one triangle on either side")
    return problems + _vertex_problems(mesh, cells) + _top_problems(mesh, cells)


def _rounding_m(cells: Columns) -> float:
    """Return how far places in the files may lie aside, metres: as single precision or a picometre rounds them."""
    far = max(np.abs(cells.x_edges_m).max(), np.abs(cells.y_edges_m).max())
    return 1e-12 + _SINGLE * float(far)


def _vertex_problems(mesh: Mesh, cells: Columns) -> list[str]:
    """Check that every vertex lies on an edge of the columns along x and y, and at one of their heights or the base."""
    high = 2e-12 + _SINGLE * (cells.blank_m + BASE_M)
    tops = np.unique(cells.height_m) - cells.blank_m
    places = (cells.x_edges_m, cells.y_edges_m, np.concatenate([[-cells.blank_m - BASE_M], tops]))
    wrong = np.zeros(len(mesh.vertices_m), dtype=np.bool_)
    for found, known, most in zip(
        mesh.vertices_m.T, places, (_rounding_m(cells), _rounding_m(cells), high), strict=True
    ):
        after = np.clip(np.searchsorted(known, found), 1, len(known) - 1)
        wrong |= np.minimum(np.abs(found - known[after - 1]), np.abs(found - known[after])) > most
    count = int(np.count_nonzero(wrong))
    if not count:
        return []
    place = ", ".join(f"{value / MM:.9g}" for value in mesh.vertices_m[int(np.argmax(wrong))])
    return [f"{count} vertices lie on no edge or no height of the relief, the first at {place} mm"]


def _top_problems(mesh: Mesh, cells: Columns) -> list[str]:
    """Check that what faces up covers every column once, at the height of that column."""
    (a, b, c), areas = mesh.corners_m, mesh.areas_m2
    widths, depths = np.diff(cells.x_edges_m), np.diff(cells.y_edges_m)
    # The top of a column is two triangles, and walls stand upright but for the rounding of their corners.
    up = areas > 0.1 * widths.min() * depths.min()
    middles = (a[up] + b[up] + c[up]) / 3
    shape = cells.height_m.shape
    column = np.searchsorted(cells.x_edges_m, middles[:, 0], side="right") - 1
    row = np.searchsorted(cells.y_edges_m, middles[:, 1], side="right") - 1
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    place = np.where(inside, row * shape[1] + column, 0)
    tops = np.stack([a[up, 2], b[up, 2], c[up, 2]], axis=1) - (cells.height_m - cells.blank_m).ravel()[place][:, None]
    # Numbers in the files are rounded to single precision or to a picometre.
    level = np.abs(tops).max(axis=1) <= _SINGLE * max(1e-6, cells.blank_m) + 2e-12
    sound = np.bincount(place, weights=areas[up] * (inside & level), minlength=cells.height_m.size).reshape(shape)
    rounding = 4 * _rounding_m(cells) / min(widths.min(), depths.min())
    wrong = np.abs(sound / (depths[:, None] * widths) - 1) > rounding
    problems = []
    if wrong.any():
        count, (row, column) = np.count_nonzero(wrong), np.unravel_index(int(np.argmax(wrong)), shape)
        problems.append(
            f"{count} columns have no top of the height of the level map, the first at row {row}, column {column}"
        )
    stray = int(np.count_nonzero(~inside))
    return problems + ([f"{stray} triangles face up outside the map"] if stray else [])


def _kinds(name: str, shown: _Shown) -> tuple[ModelKind, ...]:
    formats = ((".3mf", "millimetres", write_3mf), (".glb", "metres", write_glb), ("_MM.stl", "millimetres", write_stl))
    return tuple(
        ModelKind(
            f"{name}{ending}",
            partial(_entry, shown=shown, unit=unit, write=write),
            partial(_write, shown=shown, write=write),
            _problems,
        )
        for ending, unit, write in formats
    )


RELIEFS = _kinds("_RELIEF", lambda model: model.relief)
PATCHES = _kinds("_PATCH", lambda model: model.detail)
