"""Whose mask order a folder holds: where that of a run is looked for, and what may be replaced."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from math import isclose
from pathlib import Path
from typing import Any

from doedesign.runs.folder import LEVEL_MAP
from fab.errors import InputError
from fab.files import MANIFEST_NAME
from fab.level_map import LevelMap, read_level_map
from fab.manifest.records import Manifest, read_manifest
from fab.units import format_length

MASKS = Path("masks")
_log = logging.getLogger("doedesign")
_SHOWN = 12  # characters of a digest
# By what the source of an order is known, whatever was drawn of it.
_DIGESTS = ("level_map_sha256", "height_sha256")


def order_of_run(name: str, folder: Path | None, level_map: LevelMap | None, homes: Sequence[Path] = (Path(),)) -> Path:
    """Folder of the mask order of a run where none is named, whether there is one or not.

    That is `masks/NAME`; where it holds the order of another run of that name, `free_place` if this run's is there.

    Args:
        name: name of its design.
        folder: the run folder, if there is one.
        level_map: its level map; None where nobody knows it, and every order is taken for its own.
        homes: where the folder of orders may lie, the first one first.
    """
    places = [place for home in homes for place in _places(home / MASKS, name, folder)]
    # A released run lies among the orders and has a manifest of its own.
    there = [place for place in places if (place / MANIFEST_NAME).is_file() and not (place / LEVEL_MAP).is_file()]
    own = (place for place in there if level_map is None or is_order_of(place, level_map))
    return next(own, None) or next(iter(there), places[0])


def own_order(name: str, folder: Path | None, level_map: LevelMap) -> Path | None:
    """Folder of the mask order of a run where none is named, if there is one; that of another design is left aside.

    Args:
        name: name of its design.
        folder: the run folder, if there is one.
        level_map: its level map.

    Raises:
        InputError: a manifest that cannot be read.
    """
    place = order_of_run(name, folder, level_map)
    if not (place / MANIFEST_NAME).is_file():
        return None
    read_manifest(place)  # damage is told
    if is_order_of(place, level_map):
        return place
    _log.info("%s holds the masks of another design, or others than those of this run: they are left aside", place)
    return None


def place_of_order(level_map: LevelMap, origin: Mapping[str, Any], run: Path | None = None) -> Path:
    """Folder to write an order into where none is named: where one of the same run lies, or else `masks/NAME`.

    Args:
        level_map: what it is to draw.
        origin: where that comes from, as the manifest of an order says it.
        run: the run folder, if there is one.
    """
    places = _places(MASKS, level_map.name, run)
    return next((place for place in places if _holds_same(place, level_map, origin)), places[0])


def free_place(name: str, folder: Path | None) -> Path:
    """A folder for the order of a run that holds nothing yet: `masks/NAME`, or named for the run folder.

    Args:
        name: name of its design.
        folder: the run folder, if there is one.
    """
    return next(place for place in _numbered(MASKS, name, folder) if not place.exists() or _is_empty(place))


def is_order_of(folder: Path, level_map: LevelMap) -> bool:
    """Whether a folder holds a mask order that draws a level map, as designed or repaired.

    Args:
        folder: the folder.
        level_map: the level map.
    """
    try:
        require_order_of(folder, read_manifest(folder), level_map)
    except InputError:
        return False
    return True


def is_made_from(folder: Path, level_map: LevelMap) -> bool:
    """Whether a folder holds a mask order of a run, be it with other levels than those of the run.

    Args:
        folder: the folder.
        level_map: level map of the run.
    """
    return _holds_same(folder, level_map, {"kind": "run", "level_map_sha256": level_map.digest})


def own_level_map(run: Path) -> LevelMap | None:
    """Level map in a run folder; None where there is none that can be read.

    Args:
        run: the run folder.
    """
    try:
        return read_level_map(run / LEVEL_MAP)
    except InputError:
        return None


def require_order_of(folder: Path, manifest: Manifest, level_map: LevelMap) -> None:
    """Refuse the order of another level map than that of a run.

    Args:
        folder: folder of the order, for the message.
        manifest: its manifest.
        level_map: level map of the run.

    Raises:
        InputError: another raster or staircase, or other levels.
    """
    rule = "the masks must be those of this run"
    cure = "Give its own, or draw them into a folder of their own: doedesign masks RUN."
    if not _alike(manifest, level_map):
        got = f"{_raster(manifest)} in {manifest.staircase()}"
        raise InputError(str(folder), f"{rule}, {level_map}", got, cure)
    if manifest.source.get("level_map_sha256", level_map.digest) != level_map.digest:
        raise InputError(str(folder), rule, "those of another, such as an earlier one", cure)


def require_replaceable(folder: Path, level_map: LevelMap, origin: Mapping[str, Any], run: Path | None = None) -> None:
    """Refuse to replace the mask order of something else.

    An order of the same level map may be replaced, and one that was made from the same run or height map: both can be
    made again. What is no mask order is for `fab.order.write` to refuse.

    Args:
        folder: folder of the order to be.
        level_map: what it is to draw.
        origin: where that comes from, as the manifest of an order says it.
        run: the run folder, to propose another place by.

    Raises:
        InputError: an order of another level map, or a manifest that cannot be read.
    """
    if not (folder / MANIFEST_NAME).is_file():
        return
    manifest = read_manifest(folder)
    if _same_source(manifest, level_map, origin):
        return
    source = manifest.source
    whose = {"run": "the design", "height map": "the height map"}.get(str(source.get("kind")), "the level map")
    drawn = f"{manifest.staircase()}, {_raster(manifest)}, level map {manifest.level_map_sha256[:_SHOWN]}"
    raise InputError(
        str(folder),
        "a mask order must not take the place of another design's",
        f'the order of {whose} "{source.get("name", manifest.name)}" ({drawn})',
        f"Choose another output folder, such as {free_place(level_map.name, run)}, or give `overwrite` to replace that "
        "order.",
    )


def _places(masks: Path, name: str, folder: Path | None) -> list[Path]:
    """Where the order of a run is looked for, the usual place first."""
    numbered = _numbered(masks, name, folder)
    return [next(numbered), next(numbered)]


def _numbered(masks: Path, name: str, folder: Path | None) -> Iterator[Path]:
    """Places for the order of a run: by its name, by that of its folder where that is another, then numbered."""
    yield masks / name
    own = "" if folder is None else folder.resolve().name
    if own not in ("", name):
        yield masks / own
    for number in count(2):
        yield masks / f"{own or name}_{number}"


def _holds_same(folder: Path, level_map: LevelMap, origin: Mapping[str, Any]) -> bool:
    try:
        return _same_source(read_manifest(folder), level_map, origin)
    except InputError:  # nothing, or nothing that can be read
        return False


def _same_source(manifest: Manifest, level_map: LevelMap, origin: Mapping[str, Any]) -> bool:
    """Whether an order draws a level map, or was made from the same run or height map as that."""
    # Pre-compensation changes the depths of a staircase and no level, so the digest alone does not tell.
    alike = _alike(manifest, level_map)
    if alike and manifest.level_map_sha256 == level_map.digest:
        return True
    same = any(key in origin and origin[key] == manifest.source.get(key) for key in _DIGESTS)
    return same and (alike or manifest.levels != level_map.levels.count or origin.get("kind") != "run")


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())


def _alike(manifest: Manifest, level_map: LevelMap) -> bool:
    """Whether an order has the raster and the staircase of a level map."""
    levels, grid = manifest.staircase(), manifest.grid()
    if grid.shape != level_map.shape or levels.count != level_map.levels.count:
        return False
    # The manifest rounds lengths to its units' last digit.
    lengths = [(grid.pitch_m, level_map.grid.pitch_m), (levels.step_m, level_map.levels.step_m)]
    lengths += zip(levels.depths_m, level_map.levels.depths_m, strict=False)
    return all(isclose(found, wanted, rel_tol=1e-6) for found, wanted in lengths)


def _raster(manifest: Manifest) -> str:
    grid = manifest.grid()
    return f"{grid.shape[0]} x {grid.shape[1]} pixels of {format_length(grid.pitch_m)}"
