"""Defects planted in mask orders, each with the entries of the manifest changed along, and what `verify` says of them.

    python -m tests.campaign.planted                # plants all, lists what was not caught
    python -m tests.campaign.planted --table        # every defect with the line that names it
    python -m tests.campaign.planted --only label   # those whose name holds a word
    python -m tests.campaign.planted --seed 3 --count 40

Sizes and digests of changed files are put right in the manifest, its entries of changed cells too, and the digests of
masks on the run sheet, so that a defect is caught for what it is and not for a digest that somebody forgot. Changes
that mean nothing are planted likewise, and have to pass.
"""

import argparse
import base64
import gzip
import io
import json
import random
import re
import shutil
import struct
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import klayout.db as kdb
import numpy as np
from PIL import Image, PngImagePlugin

from fab.errors import CheckFailed, InputError
from fab.files import canonical_json, sha256_bytes, sha256_file
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds, write_gds
from fab.grid import Grid
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest import records
from fab.manifest.cells import cell_entry
from fab.order.formats import Formats
from fab.order.order import plan_order
from fab.order.terms import OrderTerms
from fab.order.verify import verify
from fab.order.write import write_planned
from fab.pictures import read_pixels, write_pixels
from fab.runsheet.tables import Grating, Importance, PredictedMetrics, Predictions, SheetPrediction
from fab.solids.mesh import Mesh
from fab.solids.meshfile import read_mesh, write_3mf, write_glb, write_stl
from fab.solids.patch import Patch

MANIFEST = "manifest.json"
Json = dict[str, Any]


@dataclass(frozen=True)
class Defect:
    """A change of an order on the disk; one that is not meaningful has to pass."""

    name: str
    plant: Callable[[Path], None]
    meaningful: bool = True


@dataclass(frozen=True)
class Outcome:
    """What became of a defect: whether the verification failed, and its first line."""

    defect: Defect
    caught: bool
    line: str

    @property
    def right(self) -> bool:
        """Whether it was caught if it means something, and passed otherwise."""
        return self.caught == self.defect.meaningful


def write_base(folder: Path) -> None:
    """Write a small order that has everything an order can have."""
    grid = Grid((28, 24), 1.85e-6)
    level = np.random.default_rng(5).integers(0, 8, grid.shape).astype(np.uint8)
    level_map = LevelMap(level, Levels(8, 150e-9), grid, grid.extent_m[1], "planted")
    wafer = Wafer(dies=(3, 3), zero_layer=True, line_splits_m=(1e-7,), order_control=True)
    order = plan_order(
        level_map, process="contact_aligner", wafer=wafer, patch=Patch(0.0, 0.0, 14.8e-6), papers=True,
        formats=Formats("gds", combined_gds=True), direct_write=True,
        terms=OrderTerms(revision="B", contact="A. Tester", quantity=2, cd_tolerance_m=1e-7),
        source={"kind": "run", "name": "planted", "level_map_sha256": level_map.digest},
    )  # fmt: skip
    near = PredictedMetrics("red", 0.05, 0.81, 0.0123, 0.86, ring_to_disc=3.21)
    far = PredictedMetrics("red", None, 0.81, 0.0123, 0.91, far_spot=0.654)
    gratings = tuple(Grating(error, 0.01 + error**2, 0.004 + error**2) for error in (-0.02, 0.0, 0.02))
    ranking = (Importance("overlay of mask 3", 0.61, 0.02),)
    light = Predictions((near, far), (near, far), 550e-9, 552e-9, 520e-9, 1.0645, gratings, ranking)
    picture = _png(np.random.default_rng(0).integers(0, 255, (32, 48, 3)).astype(np.uint8))
    write_planned(folder, order, predict=lambda _: SheetPrediction(light, lambda: picture))


# --- tools ------------------------------------------------------------------------------------------------------------


def _manifest(folder: Path) -> Json:
    return json.loads((folder / MANIFEST).read_text())


def _seal(folder: Path, manifest: Json) -> None:
    content = {key: value for key, value in manifest.items() if key != "sha256"}
    (folder / MANIFEST).write_bytes(canonical_json({**content, "sha256": sha256_bytes(canonical_json(content))}))


def _restate(folder: Path, change: Callable[[Json], object]) -> None:
    manifest = _manifest(folder)
    change(manifest)
    _seal(folder, manifest)


def _state(folder: Path, *files: str) -> None:
    """Put the entries of changed files right, and the digests of masks on the order form and the run sheet."""
    manifest, digests = _manifest(folder), {}
    does = {manifest["doe_cell"], *(split["cell"] for split in manifest["splits"])}
    papers = [entry["file"] for entry in manifest["files"] if re.search(r"_(RUNSHEET|ORDER)\.", entry["file"])]
    for file in [*files, *papers]:
        path = folder / file
        if file in papers:
            text = path.read_bytes()
            for old, new in digests.items():
                text = text.replace(old.encode(), new.encode())
            path.write_bytes(text)
        for entry in manifest["files"]:
            if entry["file"] == file:
                digests[entry["sha256"]] = sha256_file(path)
                entry |= {"bytes": path.stat().st_size, "sha256": sha256_file(path)}
                try:
                    layout = _layout(path) if entry["cells"] else None
                except InputError:  # what masks may not hold, such as a text, has no entry
                    layout = None
                if layout is not None:
                    around = [cell_entry(cell, layout.dbu_m) for cell in layout.cells if cell.name not in does]
                    found = {cell.cell: json.loads(canonical_json(_plain(cell))) for cell in around}
                    known = [found.pop(cell["cell"]) for cell in entry["cells"] if cell["cell"] in found]
                    entry["cells"] = [*known, *found.values()]
    _seal(folder, manifest)


def _plain(entry: Any) -> Any:
    if hasattr(entry, "__dataclass_fields__"):
        return {field.name: _plain(getattr(entry, field.name)) for field in fields(entry)}
    return [_plain(one) for one in entry] if isinstance(entry, list) else entry


def _layout(path: Path) -> Layout:
    if path.suffix == ".gds":
        return read_gds(path)
    with tempfile.TemporaryDirectory() as folder:
        gds = Path(folder) / "o.gds"
        oasis_to_gds(path, gds, 10**7)
        return read_gds(gds)


def _file(folder: Path, ending: str) -> str:
    return next(entry["file"] for entry in _manifest(folder)["files"] if entry["file"].endswith(ending))


def _plates(folder: Path) -> list[str]:
    return [plate["file"] for plate in _manifest(folder)["plates"]]


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if inner is None:
        yield path
        return
    for key, part in inner:
        yield from _leaves(part, (*path, key))


def _at(value: Any, path: Iterable[Any]) -> Any:
    for key in path:
        value = value[key]
    return value


def _other(value: Any) -> Any:
    """Return another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return float(f"{value * 1.001:.12g}") if value else 0.001
    if isinstance(value, str):
        swaps = {"clear": "dark", "dark": "clear", "right": "wrong", "chrome": "glass", "mask 1": "mask 2"}
        for one, other in swaps.items():
            if one in value:
                return value.replace(one, other)
        return value[:-1] + ("A" if value[-1:] != "A" else "B")
    return 1 if value is None else [*value, 1] if isinstance(value, list) else {**value, "more": 1}


def _change_leaf(tree: Any, share: float) -> None:
    """Change the value that stands so far through a tree."""
    paths = list(_leaves(tree))
    *path, key = paths[min(int(share * len(paths)), len(paths) - 1)]
    _at(tree, path)[key] = _other(_at(tree, path)[key])


# --- the manifest -----------------------------------------------------------------------------------------------------

# Where entries of each kind stand.
_ENTRIES: dict[str, tuple[type, Callable[[Json], list[Json]]]] = {
    "masks": (records.MaskEntry, lambda m: m["masks"]),
    "plates": (records.PhotomaskEntry, lambda m: m["plates"]),
    "models": (records.ModelEntry, lambda m: m["models"]),
    "splits": (records.SplitEntry, lambda m: m["splits"]),
    "split layers": (records.DrawnEntry, lambda m: m["splits"][0]["layers"]),
    "wafer": (records.WaferEntry, lambda m: [m["wafer"]]),
    "chrome": (records.ChromeEntry, lambda m: [m["chrome"]]),
    "files": (records.FileEntry, lambda m: m["files"]),
    "cells": (records.CellEntry, lambda m: m["files"][0]["cells"]),
    "cell layers": (records.LayerEntry, lambda m: m["files"][0]["cells"][0]["layers"]),
}
_SCALARS = [f.name for f in fields(records.Manifest) if f.name not in ("masks", "plates", "models", "splits", "files")]


def _change_entry(folder: Path, kind: str, key: str, last: bool) -> None:
    def change(manifest: Json) -> None:
        entry = _ENTRIES[kind][1](manifest)[-1 if last else 0]
        if isinstance(entry[key], dict | list) and entry[key]:
            _change_leaf(entry[key], 0.6)
        else:
            entry[key] = _other(entry[key])

    _restate(folder, change)


def _change_scalar(folder: Path, key: str) -> None:
    def change(manifest: Json) -> None:
        if isinstance(manifest[key], dict | list) and manifest[key]:
            _change_leaf(manifest[key], 0.4)
        else:
            manifest[key] = _other(manifest[key])

    _restate(folder, change)


def _twice(manifest: Json, key: str, at: int) -> None:
    manifest[key].insert(at, manifest[key][at])


def _exchanged(manifest: Json, key: str) -> None:
    manifest[key][0], manifest[key][1] = manifest[key][1], manifest[key][0]


def _unlist(manifest: Json, word: str) -> None:
    """Leave files out of the manifest altogether, as if the order had none."""
    manifest["files"] = [entry for entry in manifest["files"] if word not in entry["file"]]
    manifest["models"] = [entry for entry in manifest["models"] if word not in entry["file"]]


def _format(folder: Path, ending: str, kind: str) -> None:
    file = _file(folder, ending)

    def change(manifest: Json) -> None:
        for entry in manifest["files"]:
            if entry["file"] == file:
                entry["format"] = kind

    _restate(folder, change)


def _tolerance(folder: Path, ending: str) -> None:
    def change(manifest: Json) -> None:
        for model in manifest["models"]:
            if model["file"].endswith(ending):
                model["relative_error"] = 0.5

    _restate(folder, change)


def _everywhere(folder: Path, old: str, new: str) -> None:
    """Replace a word in every value of the manifest."""
    text = json.dumps({key: value for key, value in _manifest(folder).items() if key != "sha256"})
    assert old in text, old
    _seal(folder, json.loads(text.replace(old, new)))


def _manifest_defects() -> Iterator[Defect]:
    for kind, (entry, _) in _ENTRIES.items():
        for field in fields(entry):
            for last in (False, True) if kind not in ("wafer", "chrome") else (False,):
                if (kind, field.name) in (("files", "bytes"), ("files", "sha256")):
                    continue  # with a file that stays, they are seen at once
                name = f"manifest: {kind}, {'last' if last else 'first'}: {field.name}"
                yield Defect(name, partial(_change_entry, kind=kind, key=field.name, last=last))
    for key in _SCALARS:
        yield Defect(f"manifest: {key}", partial(_change_scalar, key=key))
    for key in ("request", "rules", "conventions", "tools", "wafer"):
        for step in range(24 if key == "request" else 6):
            share = (step + 0.5) / (24 if key == "request" else 6)

            def change(folder: Path, key: str = key, share: float = share) -> None:
                _restate(folder, lambda manifest: _change_leaf(manifest[key], share))

            yield Defect(f"manifest: {key}, value at {100 * share:.0f} %", change)
    for key in ("masks", "plates", "models", "files", "splits"):
        for name, alter in (
            ("first left out", lambda m, key: m[key].pop(0)),
            ("last left out", lambda m, key: m[key].pop()),
            ("first twice", partial(_twice, at=0)),
            ("last twice", partial(_twice, at=-1)),
            ("first two exchanged", _exchanged),
        ):

            def plant(folder: Path, key: str = key, alter: Any = alter) -> None:
                _restate(folder, lambda manifest: alter(manifest, key=key))

            yield Defect(f"manifest: {key}: {name}", plant)
    for word in ("RUNSHEET", "_RELIEF", "_PATCH", ".step", "HEIGHT", "SAG", "GREY", "WAFER.png", "MARKS", "RULES"):

        def unlist(folder: Path, word: str = word) -> None:
            _restate(folder, lambda manifest: _unlist(manifest, word))

        def leave_out(folder: Path, word: str = word) -> None:
            names = [entry["file"] for entry in _manifest(folder)["files"] if word in entry["file"]]
            _restate(folder, lambda manifest: _unlist(manifest, word))
            for name in names:
                (folder / name).unlink()

        yield Defect(f"manifest: {word} unlisted", unlist)
        yield Defect(f"order: {word} unlisted and removed", leave_out)
    for ending in ("_ALL.gds", "_ALL.oas", "_CHROME.gds", "_M1_150NM.gds", "_ZERO.gds", ".step", ".png"):
        for kind in ("GDSII", "OASIS", "PDF"):
            if kind != {".gds": "GDSII", ".oas": "OASIS"}.get(ending[-4:]):
                yield Defect(f"manifest: {ending} called {kind}", partial(_format, ending=ending, kind=kind))
    for ending in ("_PLATE.step", "_WAFER.step", "_RELIEF.3mf", "_RELIEF.glb", "_MM.stl"):
        yield Defect(f"manifest: tolerance of {ending}", partial(_tolerance, ending=ending))
    for old, new in (
        ("digitised data clear", "digitised data dark"),
        ("dark field", "clear field"),
        ("right-reading chrome down", "wrong-reading chrome up"),
        ('"depth_nm": 150.0', '"depth_nm": 155.0'),
        ('"step_nm": 150.0', '"step_nm": 151.0'),
        ("contact_aligner", "stepper"),
    ):
        yield Defect(f"manifest: {old} everywhere", partial(_everywhere, old=old, new=new))


def _spell(folder: Path, change: Callable[[str], str]) -> None:
    text = (folder / MANIFEST).read_text()
    changed = change(text)
    assert changed != text
    (folder / MANIFEST).write_text(changed)


def _spelling_defects() -> Iterator[Defect]:
    changes: dict[str, Callable[[str], str]] = {
        "a blank at the end": lambda text: text + " ",
        "no newline at the end": lambda text: text.rstrip("\n"),
        "other indentation": lambda text: json.dumps(json.loads(text), indent=4, sort_keys=True) + "\n",
        "one line": lambda text: json.dumps(json.loads(text), sort_keys=True) + "\n",
        "keys in another order": lambda text: json.dumps(dict(reversed(json.loads(text).items())), indent=1) + "\n",
        "a key twice, alike": lambda text: text.replace('"levels": 8,', '"levels": 8,\n "levels": 8,', 1),
        "a key twice, different": lambda text: text.replace('"levels": 8,', '"levels": 4,\n "levels": 8,', 1),
        "a key twice in an entry": lambda text: text.replace('"bit": 0,', '"bit": 0,\n   "bit": 0,', 1),
        "a number spelt otherwise": lambda text: text.replace('"step_nm": 150.0', '"step_nm": 1.5e2'),
        "a letter escaped": lambda text: text.replace('"planted"', '"pl\\u0061nted"', 1),
        "no number": lambda text: text.replace('"step_nm": 150.0', '"step_nm": NaN'),
        "Windows lines": lambda text: text.replace("\n", "\r\n"),
    }
    for name, change in changes.items():
        yield Defect(f"manifest spelt: {name}", partial(_spell, change=change))


# --- layouts ----------------------------------------------------------------------------------------------------------

Redraw = Callable[[Layout], Layout]


def _cells(layout: Layout, ending: str, change: Callable[[Cell], Cell]) -> Layout:
    """Change the cells whose names end so ("" for the top cell); the same layout if none of them has it."""
    chosen = [cell.name for cell in layout.cells if (cell is layout.top if not ending else cell.name.endswith(ending))]
    assert chosen
    cells = tuple(change(cell) if cell.name in chosen else cell for cell in layout.cells)
    alike = all(one is other for one, other in zip(cells, layout.cells, strict=True))
    return layout if alike else replace(layout, cells=cells)


def _shapes(cell: Cell, change: Callable[[Shapes], Shapes]) -> Cell:
    """Change the shapes on the lowest layer of a cell that has rectangles, or any."""
    drawn = {layer: shapes for layer, shapes in cell.shapes.items() if len(shapes)}
    if not drawn:
        return cell
    lowest = min(drawn, key=lambda layer: (not len(drawn[layer].rectangles), layer.number, layer.datatype))
    return replace(cell, shapes={**cell.shapes, lowest: change(drawn[lowest])})


def _moved(shapes: Shapes, units: int, which: slice = slice(None)) -> Shapes:
    rects = shapes.rectangles.copy()
    rects[which] += np.array([units, 0, units, 0], dtype=np.int32)
    polygons = tuple(polygon + np.array([units, 0], dtype=np.int32) for polygon in shapes.polygons)
    return Shapes(rects, polygons if which == slice(None) else shapes.polygons)


def _without_first(shapes: Shapes) -> Shapes:
    if len(shapes.rectangles):
        return Shapes(shapes.rectangles[1:], shapes.polygons)
    return Shapes(shapes.rectangles, shapes.polygons[1:])


def _wider(shapes: Shapes) -> Shapes:
    rects = shapes.rectangles.copy()
    rects[-1:, 2] += 1
    return Shapes(rects, shapes.polygons)


def _place(word: str, units: int, which: slice = slice(None)) -> Callable[[Cell], Cell]:
    """Move the placed cells whose names hold a word."""

    def change(cell: Cell) -> Cell:
        chosen = [n for n, reference in enumerate(cell.references) if word in reference.cell][which]
        if not chosen:
            return cell
        moved = (replace(r, x=r.x + units) if n in chosen else r for n, r in enumerate(cell.references))
        return replace(cell, references=tuple(moved))

    return change


def _mirrored(layout: Layout) -> Layout:
    def flip(shapes: Shapes) -> Shapes:
        sign = np.array([-1, 1, -1, 1], dtype=np.int32)
        polygons = tuple(polygon[::-1] * np.array([-1, 1], dtype=np.int32) for polygon in shapes.polygons)
        return Shapes(shapes.rectangles[:, [2, 1, 0, 3]] * sign, polygons)

    cells = (
        replace(
            cell,
            shapes={layer: flip(shapes) for layer, shapes in cell.shapes.items()},
            references=tuple(replace(r, x=-r.x - (r.columns - 1) * r.step_x) for r in cell.references),
        )
        for cell in layout.cells
    )
    return replace(layout, cells=tuple(cells))


def _relayered(layout: Layout) -> Layout:
    cells = (
        replace(cell, shapes={Layer(layer.number + 20, layer.datatype): s for layer, s in cell.shapes.items()})
        for cell in layout.cells
    )
    return replace(layout, cells=tuple(cells))


def _with_more(layout: Layout) -> Layout:
    layer = layout.layers[0]
    extra = Cell("DOE_MORE", {layer: Shapes(np.array([[0, 0, 5000, 5000]], dtype=np.int32))})
    top = replace(layout.top, references=(*layout.top.references, Reference(extra.name, 30_000_000, 0)))
    return replace(layout, cells=(extra, *layout.cells[:-1], top))


_REDRAWN: dict[str, Redraw] = {
    "dies moved by 1 um": lambda lo: _cells(lo, "_WAFER", _place("_DIE", 1000)),
    "one die moved by 1 nm": lambda lo: _cells(lo, "_WAFER", _place("_DIE", 1, slice(-1, None))),
    "alignment sites moved": lambda lo: _cells(lo, "_WAFER", _place("_SITE", 1000)),
    "one alignment site moved by 1 nm": lambda lo: _cells(lo, "_WAFER", _place("_SITE", 1, slice(1))),
    "test structures moved": lambda lo: _cells(lo, "_WAFER", _place("_TEST", 1000)),
    "DOE moved in its die": lambda lo: _cells(lo, "_DIE", _place("_DOE", 1, slice(1))) if _has_doe(lo) else lo,
    "wafer moved on the plate": lambda lo: _cells(lo, "", _place("_WAFER", 1000)),
    "a mark moved": lambda lo: _cells(lo, "_SITE", lambda c: _shapes(c, lambda s: _moved(s, 1000, slice(1)))),
    "a mark deleted": lambda lo: _cells(lo, "_SITE", lambda c: _shapes(c, _without_first)),
    "all marks deleted": lambda lo: _cells(lo, "_SITE", lambda c: replace(c, shapes={})),
    "a mark of the dies deleted": lambda lo: _cells(lo, "_DIE", lambda c: _shapes(c, _without_first)),
    "a test structure wider by 1 nm": lambda lo: _cells(lo, "_TEST", lambda c: _shapes(c, _wider)),
    "label moved": lambda lo: _cells(lo, "", lambda c: _shapes(c, lambda s: _moved(s, 10_000))),
    "a letter deleted": lambda lo: _cells(lo, "", lambda c: _shapes(c, _without_first)),
    "mirrored": _mirrored,
    "on other layers": _relayered,
    "twice as large": lambda lo: replace(lo, dbu_m=2 * lo.dbu_m),
    "something added": _with_more,
}


def _has_doe(layout: Layout) -> bool:
    return any(cell.name.endswith("_DOE") and cell.shapes for cell in layout.cells)


def _redraw(folder: Path, plate: int | None, change: Redraw) -> None:
    """Redraw a plate, or the combined file."""
    file = _file(folder, "_ALL.gds") if plate is None else _plates(folder)[plate]
    layout = read_gds(folder / file)
    changed = change(layout)
    if changed is layout:  # not every plate holds everything
        changed = _REDRAWN["a mark moved"](layout)
    write_gds(folder / file, changed)
    _state(folder, file)


def _redraw_all(folder: Path, change: Redraw) -> None:
    """Redraw every plate and the combined file alike."""
    files = [*_plates(folder), _file(folder, "_ALL.gds")]
    for file in files:
        write_gds(folder / file, change(read_gds(folder / file)))
    _oasis_from_gds(folder)
    _state(folder, *files, _file(folder, "_ALL.oas"))


def _oasis_from_gds(folder: Path) -> None:
    layout = kdb.Layout()
    layout.read(str(folder / _file(folder, "_ALL.gds")))
    _write_oasis(layout, folder / _file(folder, "_ALL.oas"))


def _write_oasis(layout: kdb.Layout, path: Path, level: int = 2, blocks: bool = True) -> None:
    options = kdb.SaveLayoutOptions()
    options.format = "OASIS"
    options.oasis_compression_level = level
    options.oasis_write_cblocks = blocks
    layout.write(str(path), options)


def _redraw_oasis(folder: Path, change: Callable[[kdb.Layout], object]) -> None:
    file = _file(folder, "_ALL.oas")
    layout = kdb.Layout()
    layout.read(str(folder / file))
    change(layout)
    _write_oasis(layout, folder / file)
    _state(folder, file)


def _oasis_cell(layout: kdb.Layout, ending: str) -> kdb.Cell:
    return next(cell for cell in layout.each_cell() if cell.name.endswith(ending)) if ending else layout.top_cell()


def _oasis_shift(layout: kdb.Layout, ending: str) -> None:
    cell = _oasis_cell(layout, ending)
    index = next(index for index in layout.layer_indexes() if cell.shapes(index).size())
    shape = next(cell.shapes(index).each())
    shape.transform(kdb.Trans(1, 0))


def _oasis_delete(layout: kdb.Layout, ending: str) -> None:
    cell = _oasis_cell(layout, ending)
    index = next(index for index in layout.layer_indexes() if cell.shapes(index).size())
    cell.shapes(index).erase(next(cell.shapes(index).each()))


def _oasis_dies(layout: kdb.Layout) -> None:
    instance = next(i for i in _oasis_cell(layout, "_WAFER").each_inst() if i.cell.name.endswith("_DIE"))
    instance.transform(kdb.Trans(1000, 0))


def _oasis_layers(layout: kdb.Layout) -> None:
    one, other = (layout.find_layer(number, 0) for number in (1, 2))
    layout.swap_layers(one, other)


def _oasis_unit(layout: kdb.Layout) -> None:
    layout.dbu = 2 * layout.dbu


def _layout_defects() -> Iterator[Defect]:
    for name, change in _REDRAWN.items():
        for plate in range(5):
            yield Defect(f"plate {plate + 1}: {name}", partial(_redraw, plate=plate, change=change))
        yield Defect(f"combined: {name}", partial(_redraw, plate=None, change=change))
    for name in ("dies moved by 1 um", "a mark deleted", "test structures moved", "mirrored"):
        yield Defect(f"all layouts alike: {name}", partial(_redraw_all, change=_REDRAWN[name]))
    oasis: dict[str, Callable[[kdb.Layout], object]] = {
        "a pixel moved": partial(_oasis_shift, ending="_DOE"),
        "a pixel missing": partial(_oasis_delete, ending="_DOE"),
        "a mark moved": partial(_oasis_shift, ending="_SITE"),
        "a mark missing": partial(_oasis_delete, ending="_SITE"),
        "a letter missing": partial(_oasis_delete, ending=""),
        "a test structure moved": partial(_oasis_shift, ending="_TEST"),
        "a die moved": _oasis_dies,
        "layers exchanged": _oasis_layers,
        "twice as large": _oasis_unit,
        "a label": lambda layout: layout.top_cell().shapes(layout.layer(1, 0)).insert(kdb.Text("HI", 0, 0)),
    }
    for name, alter in oasis.items():
        yield Defect(f"OASIS: {name}", partial(_redraw_oasis, change=alter))
    yield Defect("plates 2 and 3 exchanged", _exchange_plates)


def _exchange_plates(folder: Path) -> None:
    one, other = _plates(folder)[1:3]
    _exchange(folder, one, other)


def _exchange(folder: Path, one: str, other: str) -> None:
    first, second = ((folder / file).read_bytes() for file in (one, other))
    (folder / one).write_bytes(second)
    (folder / other).write_bytes(first)
    _state(folder, one, other)


# --- the run sheet ----------------------------------------------------------------------------------------------------


def _sheet_value(folder: Path, share: float) -> None:
    file = _file(folder, "_RUNSHEET.json")
    sheet = json.loads((folder / file).read_text())
    _change_leaf(sheet, share)
    (folder / file).write_bytes(canonical_json(sheet))
    _state(folder, file)


def _page_number(folder: Path, share: float) -> None:
    """Change a number that is printed on the page."""
    file = _file(folder, "_RUNSHEET.html")
    text = (folder / file).read_text()
    body = re.sub(r"<style.*?</style>|<[^>]*>", lambda tag: "\0" * len(tag[0]), text, flags=re.DOTALL)
    places = [found.start() for found in re.finditer(r"\d(?=[^\d])", body)]
    at = places[min(int(share * len(places)), len(places) - 1)]
    (folder / file).write_text(text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :])
    _state(folder, file)


def _alter(folder: Path, ending: str, old: str, new: str) -> None:
    file = _file(folder, ending)
    text = (folder / file).read_bytes()
    assert old.encode() in text, old
    (folder / file).write_bytes(text.replace(old.encode(), new.encode(), 1))
    _state(folder, file)


def _page_picture(folder: Path, number: int, black: bool) -> None:
    file = _file(folder, "_RUNSHEET.html")
    text = (folder / file).read_text()
    found = list(re.finditer(r"data:image/png;base64,[A-Za-z0-9+/=]*", text))[number]
    with Image.open(io.BytesIO(base64.b64decode(found[0].partition(",")[2]))) as image:
        dots = np.asarray(image.convert("RGB"))
    other = np.zeros_like(dots) if black else dots[::-1]
    data = "data:image/png;base64," + base64.b64encode(_png(other)).decode()
    (folder / file).write_text(text[: found.start()] + data + text[found.end() :])
    _state(folder, file)


def _sheet_defects() -> Iterator[Defect]:
    for step in range(60):
        share = (step + 0.5) / 60
        yield Defect(f"run sheet: value at {100 * share:.0f} %", partial(_sheet_value, share=share))
    for step in range(40):
        share = (step + 0.5) / 40
        yield Defect(f"page: number at {100 * share:.0f} %", partial(_page_number, share=share))
    for old, new in (("</table>", "</table><p>Skip this step.</p>"), ("mask 2", "mask 3"), ("dark", "clear")):
        yield Defect(f"page: {old} as {new}", partial(_alter, ending="_RUNSHEET.html", old=old, new=new))
    for number in range(3):
        yield Defect(f"page: picture {number} black", partial(_page_picture, number=number, black=True))
        yield Defect(f"page: picture {number} upside down", partial(_page_picture, number=number, black=False))
    for ending, old, new in (
        ("_ORDER.csv", "dark field", "clear field"),
        ("_ORDER.csv", "A. Tester", "B. Tester"),
        ("_ORDER.csv", ",2,", ",3,"),
        ("_ORDER.html", "dark field", "clear field"),
        ("_ORDER.html", "A. Tester", "B. Tester"),
        ("_LAYERS.lyp", "1/0", "2/0"),
        ("_CHECK.drc", "1.0", "0.9"),
        ("_DOSE.csv", "1050", "1051"),
        ("_DIRECT.dxf", "LEVEL_1_", "LEVEL_2_"),
    ):
        yield Defect(f"{ending}: {old} as {new}", partial(_alter, ending=ending, old=old, new=new))


# --- pictures ---------------------------------------------------------------------------------------------------------


def _png(dots: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(dots).save(stream, format="PNG")
    return stream.getvalue()


def _paint(folder: Path, ending: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    file = _file(folder, ending)
    with Image.open(folder / file) as image:
        dots = np.array(image.convert("RGB"))
    (folder / file).write_bytes(_png(change(dots)))
    _state(folder, file)


def _stain(dots: np.ndarray) -> np.ndarray:
    ny, nx = dots.shape[:2]
    dots[ny // 2 : ny // 2 + 24, nx // 2 : nx // 2 + 24] = 255 - dots[ny // 2 : ny // 2 + 24, nx // 2 : nx // 2 + 24]
    return dots


_PAINTED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "black": np.zeros_like,
    "white": lambda dots: np.full_like(dots, 255),
    "mirrored": lambda dots: dots[:, ::-1],
    "upside down": lambda dots: dots[::-1],
    "cropped": lambda dots: dots[:-40],
    "stained": _stain,
    "colours exchanged": lambda dots: dots[..., [2, 1, 0]],
}
_PICTURES = ("_PREVIEW.png", "_WAFER.png", "_MARKS.png", "_RULES.png")


def _picture_defects() -> Iterator[Defect]:
    for ending in _PICTURES:
        for name, change in _PAINTED.items():
            yield Defect(f"{ending}: {name}", partial(_paint, ending=ending, change=change))
    for one, other in (("_PREVIEW.png", "_RULES.png"), ("_WAFER.png", "_MARKS.png"), ("_GREY.png", "_MARKS.png")):

        def exchange(folder: Path, one: str = one, other: str = other) -> None:
            _exchange(folder, _file(folder, one), _file(folder, other))

        yield Defect(f"{one} and {other} exchanged", exchange)


# --- solids and height maps -------------------------------------------------------------------------------------------


def _npy(folder: Path, metres: float) -> None:
    file = _file(folder, "_HEIGHT.npy")
    heights = np.load(folder / file)
    heights[3, 4] += metres
    np.save(folder / file, heights)
    _state(folder, file)


def _counts(folder: Path, ending: str) -> None:
    file = _file(folder, ending)
    pixels = read_pixels(folder / file).copy()
    pixels[2, 3] = abs(int(pixels[2, 3]) - 1)
    write_pixels(folder / file, pixels, about="heights")
    _state(folder, file)


def _sag(folder: Path, change: Callable[[list[str]], object]) -> None:
    file = _file(folder, "_SAG.DAT")
    lines = (folder / file).read_text().splitlines()
    change(lines)
    (folder / file).write_text("\r\n".join(lines) + "\r\n", newline="")
    _state(folder, file)


def _sag_word(lines: list[str], line: int, word: int, value: str) -> None:
    words = lines[line].split()
    words[word] = value
    lines[line] = " ".join(words)


def _mesh(folder: Path, ending: str, change: Callable[[Mesh], Mesh]) -> None:
    file = _file(folder, ending)
    mesh = read_mesh(folder / file, "mm" if file.endswith(".stl") else None)
    {".3mf": write_3mf, ".glb": write_glb, ".stl": write_stl}[Path(file).suffix](folder / file, change(mesh))
    _state(folder, file)


def _vertex(mesh: Mesh, which: str, axis: int, metres: float) -> Mesh:
    """Move a vertex of the base, of the top or of a wall, with all of its copies."""
    vertices = mesh.vertices_m.copy()
    z = vertices[:, 2]
    inner = (np.abs(vertices[:, 0]) < 0.9 * np.abs(vertices[:, 0]).max()) & (np.abs(vertices[:, 1]) < 1e-5)
    wanted = {"base": z < z.min() + 1e-9, "top": inner & (z > z.max() - 1e-9), "wall": inner & (z > z.min() + 1e-9)}
    chosen = vertices[np.flatnonzero(wanted[which])[0]]
    vertices[(vertices == chosen).all(axis=1), axis] += metres
    return replace(mesh, vertices_m=vertices)


_MESHED: dict[str, Callable[[Mesh], Mesh]] = {
    "not closed": lambda mesh: replace(mesh, triangles=mesh.triangles[1:]),
    "a hole in its top": lambda mesh: replace(mesh, triangles=mesh.triangles[:-7]),
    "a triangle twice": lambda mesh: replace(mesh, triangles=np.concatenate([mesh.triangles, mesh.triangles[-1:]])),
    "a triangle turned over": lambda mesh: replace(
        mesh, triangles=np.concatenate([mesh.triangles[:-1], mesh.triangles[-1:, ::-1]])
    ),
    "inside out": lambda mesh: replace(mesh, triangles=mesh.triangles[:, ::-1]),
    "a corner of the base moved": partial(_vertex, which="base", axis=2, metres=-1e-9),
    "a corner of the base aside": partial(_vertex, which="base", axis=0, metres=-20e-9),
    "a corner of a top moved": partial(_vertex, which="top", axis=2, metres=1e-9),
    "a corner of a wall moved": partial(_vertex, which="wall", axis=0, metres=20e-9),
    "turned": lambda mesh: replace(mesh, vertices_m=mesh.vertices_m[:, [1, 0, 2]], triangles=mesh.triangles[:, ::-1]),
    "higher": lambda mesh: replace(mesh, vertices_m=mesh.vertices_m + np.array([0, 0, 1e-9])),
}


def _step(folder: Path, ending: str, change: Callable[[str], str]) -> None:
    file = _file(folder, ending)
    text = (folder / file).read_text()
    changed = change(text)
    assert changed != text
    (folder / file).write_text(changed)
    _state(folder, file)


def _step_point(text: str, share: float, off: float) -> str:
    """Move one of the points of a STEP file along z, or along x where it is no number of its own."""
    places = list(re.finditer(r"CARTESIAN_POINT\('',\(([^,()]*),([^,()]*),([^,()]*)\)\)", text))
    found = places[min(int(share * len(places)), len(places) - 1)]
    x, y, z = (float(found[n]) for n in (1, 2, 3))
    return f"{text[: found.start()]}CARTESIAN_POINT('',({x:.15G},{y:.15G},{z + off:.15G})){text[found.end() :]}"


def _model_defects() -> Iterator[Defect]:
    for picometres in (0.5, -0.5, 100.0):
        yield Defect(f"NPY: a height off by {picometres} pm", partial(_npy, metres=picometres * 1e-12))
    for ending in ("_HEIGHT.tif", "_GREY.png"):
        yield Defect(f"{ending}: a height off by a count", partial(_counts, ending=ending))
    sags: dict[str, Callable[[list[str]], object]] = {
        "a slope": partial(_sag_word, line=5, word=1, value="0.001"),
        "a slope along y": partial(_sag_word, line=9, word=2, value="1e-9"),
        "a twist": partial(_sag_word, line=3, word=3, value="1"),
        "a point without data": partial(_sag_word, line=7, word=4, value="1"),
        "a height off by 1 pm": lambda lines: _sag_word(lines, 4, 0, f"{float(lines[4].split()[0]) + 1e-9:.9f}"),
        "another pitch": partial(_sag_word, line=0, word=2, value="0.00186"),
        "another unit": partial(_sag_word, line=0, word=4, value="1"),
        "another place": partial(_sag_word, line=0, word=5, value="0.001"),
        "a row left out": lambda lines: lines.pop(),
        "a row more": lambda lines: lines.append(lines[-1]),
    }
    for name, change in sags.items():
        yield Defect(f"grid sag: {name}", partial(_sag, change=change))
    for ending in ("_RELIEF.3mf", "_RELIEF.glb", "_RELIEF_MM.stl", "_PATCH.3mf", "_PATCH.glb", "_PATCH_MM.stl"):
        for name, redo in _MESHED.items():
            yield Defect(f"{ending}: {name}", partial(_mesh, ending=ending, change=redo))
    for ending in ("_PLATE.step", "_WAFER.step", "_PATCH.step"):
        for share in (0.1, 0.3, 0.5, 0.7, 0.9):
            for off in (1e-3, 1e-6):
                name = f"{ending}: the point at {100 * share:.0f} % moved by {1e6 * off:g} nm"
                yield Defect(name, partial(_step, ending=ending, change=partial(_step_point, share=share, off=off)))
        yield Defect(
            f"{ending}: in centimetres",
            partial(_step, ending=ending, change=lambda text: text.replace("SI_UNIT(.MILLI.,", "SI_UNIT(.CENTI.,")),
        )
    yield Defect("_PLATE.step: a part renamed", partial(_step, ending="_PLATE.step", change=_renamed))
    yield Defect("_WAFER.step: radius of a circle", partial(_step, ending="_WAFER.step", change=_rounder))


def _renamed(text: str) -> str:
    return text.replace("'CHROME'", "'GLASS'")


def _rounder(text: str) -> str:
    return re.sub(
        r"(CIRCLE\('',#\d+,)([\d.E+-]+)\)", lambda found: f"{found[1]}{float(found[2]) + 1e-3:.15G})", text, count=1
    )


# --- the folder -------------------------------------------------------------------------------------------------------


def _add(folder: Path, name: str, content: str) -> None:
    path = folder / name.replace("JOB", _plates(folder)[0].removesuffix("_ZERO.gds"))
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = (folder / _plates(folder)[1]).read_bytes()
    path.write_bytes({"mask": mask, "packed": gzip.compress(mask)}.get(content, content.encode()))


def _link(folder: Path, ending: str) -> None:
    file = folder / (MANIFEST if ending == MANIFEST else _file(folder, ending))
    elsewhere = folder.parent / f"elsewhere_{folder.name}"
    elsewhere.mkdir(exist_ok=True)
    shutil.move(file, elsewhere / file.name)
    file.symlink_to(elsewhere / file.name)


def _folder_defects() -> Iterator[Defect]:
    for name, content in (
        ("JOB_M5.gds", "mask"),
        ("JOB_M5.gds.gz", "packed"),
        ("JOB_M5.GDS", "mask"),
        ("JOB_M5.oasis", "mask"),
        ("JOB_M5.OAS", "mask"),
        ("JOB_M5.dxf", "0\nSECTION\n"),
        ("JOB_M5.cif", "DS 1;"),
        ("sub/JOB_M5.gds", "mask"),
        ("sub/deeper/mask5.gds.gz", "packed"),
        ("sub/m5.dxf", "0\nSECTION\n"),
        ("mask5", "mask"),
        ("mask5.bin", "mask"),
        ("plates.zip", "packed"),
        ("plates.tar.gz", "packed"),
        ("JOB_RUNSHEET_2.html", "<html></html>"),
        ("JOB_PATCH2.step", "ISO-10303-21;"),
    ):
        yield Defect(f"folder: {name} beside the order", partial(_add, name=name, content=content))
    for ending in (
        "_ALL.gds", "_ALL.oas", "_CHROME.gds", "_RUNSHEET.html", "_RUNSHEET.json", "_PREVIEW.png", "_PLATE.step",
        "_RELIEF.3mf", "_LEVELS.npy", MANIFEST,
    ):  # fmt: skip
        yield Defect(f"folder: {ending} is a link", partial(_link, ending=ending))

        def missing(folder: Path, ending: str = ending) -> None:
            (folder / (MANIFEST if ending == MANIFEST else _file(folder, ending))).unlink()

        yield Defect(f"folder: {ending} is missing", missing)


# --- changes that mean nothing ----------------------------------------------------------------------------------------


def _rewrite(folder: Path, ending: str, change: Callable[[bytes], bytes]) -> None:
    file = _file(folder, ending)
    data = (folder / file).read_bytes()
    changed = change(data)
    assert changed != data
    (folder / file).write_bytes(changed)
    _state(folder, file)


def _redated(data: bytes) -> bytes:
    """Give a GDSII file another date."""
    return data.replace(
        struct.pack(">12H", *(2000, 1, 1, 0, 0, 0) * 2), struct.pack(">12H", *(2026, 7, 31, 12, 5, 9) * 2)
    )


def _rewound(layout: Layout) -> Layout:
    """Draw every shape from another corner, the other way round, the last one first."""

    def turned(shapes: Shapes) -> Shapes:
        corners = [np.array([(x0, y0), (x0, y1), (x1, y1), (x1, y0)], np.int32) for x0, y0, x1, y1 in shapes.rectangles]
        others = [np.roll(polygon[::-1], 2, axis=0) for polygon in shapes.polygons]
        return Shapes(polygons=tuple([*others, *corners][::-1]))

    cells = (replace(c, shapes={layer: turned(s) for layer, s in c.shapes.items()}) for c in layout.cells)
    return replace(layout, cells=tuple(cells))


def _unrolled(layout: Layout) -> Layout:
    """Place every die by itself, the last one first."""

    def single(cell: Cell) -> Cell:
        places = [
            Reference(r.cell, r.x + column * r.step_x, r.y + row * r.step_y)
            for r in cell.references
            for column in range(r.columns)
            for row in range(r.rows)
        ]
        return replace(cell, references=tuple(places[::-1]))

    return replace(layout, cells=tuple(map(single, layout.cells)))


def _repacked(data: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as new:
        for name in old.namelist():
            new.writestr(zipfile.ZipInfo(name, (2026, 7, 31, 12, 0, 0)), old.read(name))
    return stream.getvalue()


def _resaved(data: bytes) -> bytes:
    """Pack a PNG otherwise, and say in it who did."""
    info, stream = PngImagePlugin.PngInfo(), io.BytesIO()
    info.add_text("Software", "another program")
    with Image.open(io.BytesIO(data)) as image:
        image.save(stream, format="PNG", compress_level=1, pnginfo=info)
    return stream.getvalue()


def _renpy(data: bytes) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.load(io.BytesIO(data)), version=(2, 0))
    return stream.getvalue()


def _resaved_oasis(folder: Path, level: int, blocks: bool) -> None:
    file = _file(folder, "_ALL.oas")
    layout = kdb.Layout()
    layout.read(str(folder / file))
    _write_oasis(layout, folder / file, level, blocks)
    _state(folder, file)


def _cosmetic() -> Iterator[Defect]:
    def means_nothing(name: str, plant: Callable[[Path], None]) -> Defect:
        return Defect(f"means nothing: {name}", plant, meaningful=False)

    yield means_nothing("untouched", lambda folder: None)
    for ending in ("_ALL.gds", "_CHROME.gds", "_ZERO.gds"):
        yield means_nothing(f"date of {ending}", partial(_rewrite, ending=ending, change=_redated))
    for plate in (None, 0, 1, 4):
        what = "the combined file" if plate is None else f"plate {plate + 1}"
        yield means_nothing(f"winding and order in {what}", partial(_redraw, plate=plate, change=_rewound))
        yield means_nothing(f"references of {what}", partial(_redraw, plate=plate, change=_unrolled))
    for level, blocks in ((0, False), (10, True)):
        yield means_nothing(f"OASIS packed {level}, {blocks}", partial(_resaved_oasis, level=level, blocks=blocks))
    changes: dict[str, tuple[str, Callable[[bytes], bytes]]] = {
        "3MF packed otherwise": ("_RELIEF.3mf", _repacked),
        "date of a STEP file": (
            "_PLATE.step",
            lambda data: data.replace(b"2000-01-01T", b"2026-07-31T"),
        ),
        "header of an STL": ("_RELIEF_MM.stl", lambda data: b"written again".ljust(80) + data[80:]),
        "array of format 2": ("_HEIGHT.npy", _renpy),
        "line ends of the grid sag": ("_SAG.DAT", lambda data: data.replace(b"\r\n", b"\n")),
        "indentation of the run sheet": (
            "_RUNSHEET.json",
            lambda data: json.dumps(json.loads(data), indent=3).encode(),
        ),
        "blanks at line ends of the page": ("_RUNSHEET.html", lambda data: data.replace(b"\n", b" \n")),
        **{f"{ending} packed otherwise": (ending, _resaved) for ending in (*_PICTURES, "_GREY.png")},
    }
    for name, (ending, change) in changes.items():
        yield means_nothing(name, partial(_rewrite, ending=ending, change=change))
    yield means_nothing("a note beside the order", lambda folder: _add(folder, "notes.txt", "Called the shop."))


def defects() -> tuple[Defect, ...]:
    """Return every defect and every change that means nothing; each is planted in a folder of `write_base`."""
    families = (
        _manifest_defects, _spelling_defects, _layout_defects, _sheet_defects, _picture_defects, _model_defects,
        _folder_defects, _cosmetic,
    )  # fmt: skip
    return tuple(defect for family in families for defect in family())


def outcome(defect: Defect, base: Path, folder: Path) -> Outcome:
    """Plant a defect in a copy of an order at `folder`, which must not exist, and verify it; the copy is removed."""
    shutil.copytree(base, folder, symlinks=True)
    try:
        defect.plant(folder)
        try:
            told = verify(folder).differences
        except InputError as error:
            told = (str(error),)
        except CheckFailed as error:
            told = tuple(error.args[0])
    finally:
        shutil.rmtree(folder)
        shutil.rmtree(folder.parent / f"elsewhere_{folder.name}", ignore_errors=True)
    return Outcome(defect, bool(told), told[0] if told else "")


def main() -> int:
    """Plant the chosen defects and print what was not caught, or all."""
    parser = argparse.ArgumentParser(description="Plant defects in a mask order, and list what verify does not catch.")
    parser.add_argument("--seed", type=int, default=0, help="of the sample that --count takes")
    parser.add_argument("--count", type=int, help="how many are planted; all by default")
    parser.add_argument("--only", default="", help="a word in their names")
    parser.add_argument("--table", action="store_true", help="print every defect, whether caught, and the line")
    asked = parser.parse_args()
    chosen = [defect for defect in defects() if asked.only in defect.name]
    if asked.count is not None:
        chosen = random.Random(asked.seed).sample(chosen, min(asked.count, len(chosen)))
    began, found = time.monotonic(), []
    with tempfile.TemporaryDirectory() as scratch:
        base = Path(scratch) / "base"
        write_base(base)
        for defect in chosen:
            one = outcome(defect, base, Path(scratch) / "planted")
            found.append(one)
            if asked.table or not one.right:
                mark = "ok  " if one.right else "LOST" if defect.meaningful else "HURT"
                print(f"{mark} {defect.name}: {one.line.replace(scratch, '')[:200]}", flush=True)
    meant = [one for one in found if one.defect.meaningful]
    nothing = [one for one in found if not one.defect.meaningful]
    print(
        f"{sum(one.caught for one in meant)} of {len(meant)} defects caught, {sum(one.right for one in nothing)} of "
        f"{len(nothing)} changes that mean nothing passed, in {time.monotonic() - began:.0f} s"
    )
    return 0 if all(one.right for one in found) else 1


if __name__ == "__main__":
    sys.exit(main())
