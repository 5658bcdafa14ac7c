"""Level maps and designs from a run, its mask files, or a height map of the user's own."""

import logging
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design.design import Design
from doedesign.runs.folder import (
    CAPTURE_TABLES,
    CONTINUOUS,
    HEIGHT,
    LEVEL_MAP,
    Run,
    open_run,
    require_relief,
    run_of,
    spec_with,
)
from doedesign.runs.orders import own_order, require_order_of
from doedesign.spec import HEIGHT_FILES
from fab.aperture import Aperture, aperture_from
from fab.errors import InputError
from fab.files import path_of, sha256_file
from fab.grid import Grid
from fab.height import HeightMap, outline_of, read_height
from fab.layout.geometry import pixel_edges
from fab.level_map import LevelMap, read_level_map, write_level_map
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.units import NM, format_length

log = logging.getLogger("doedesign")


class Drawing(NamedTuple):
    """Level map to order masks for, the entry of an order's manifest on its source, and its design if it has one."""

    level_map: LevelMap
    origin: dict[str, Any]
    design: Design | None


def read_any_height(
    path: Path,
    pitch_m: float | None = None,
    scale_m: float | None = None,
    aperture: Aperture | float | str | None = None,
) -> HeightMap:
    """Read a height map from .exr, .npy, .tif or .png.

    Args:
        path: the file.
        pitch_m: pixel pitch, metres; needed unless the file holds it (EXR of our own).
        scale_m: metres per count, for integers, or per 1 for floats that are not metres.
        aperture: outline of the relief, its diameter in metres, or the name of a picture of it; by default what the
            file says, or its shorter side.
    """
    if path.is_dir():
        raise InputError(str(path), f"a height map is a file ({', '.join(HEIGHT_FILES)})", "a folder", "Give the file.")
    if path.suffix.lower() not in HEIGHT_FILES:
        rule = f"a height map must be one of {', '.join(HEIGHT_FILES)}"
        raise InputError(str(path), rule, path.suffix or "no suffix", "Convert it first.")
    if path.suffix.lower() != ".exr":
        return read_height(path, pitch_m, scale_m, aperture)
    from sim.store import read_height as read_exr

    stored = read_exr(path)
    pitch_m = stored.pitch_m if pitch_m is None else pitch_m
    if pitch_m is None:
        raise InputError(str(path), "the pixel pitch must be given", "none in the file", "Give the pitch of a pixel.")
    height_m = stored.height_m
    if scale_m is not None:
        if not 0 < scale_m < np.inf:
            raise InputError(str(path), "the scale must be positive and finite", scale_m, "Give metres per count.")
        height_m = height_m * np.float32(scale_m)
    ny, nx = height_m.shape
    grid = Grid((ny, nx), pitch_m)
    outline = outline_of(height_m, grid, stored.aperture if aperture is None else aperture, str(path))
    return HeightMap(height_m, grid, outline)


def level_map_of_run(run: Run, count: int | None = None) -> LevelMap:
    """Return the level map of a run, or its continuous design rounded to another `count` of levels as high."""
    own = levels_from_spec(run.spec.process)
    if count in (None, own.count):
        file = run.path(LEVEL_MAP)
        level_map = read_level_map(file)
        if level_map.levels != own:
            cure = "Restore the manifest of the run, or optimise again."
            raise InputError(str(file), f"must be for {own}", level_map.levels, cure)
        return level_map
    levels = Levels(count, own.period_m / max(count, 1))
    # A training that left the DOE as it was has only the heights after rounding.
    file = run.path(CONTINUOUS) if run.path(CONTINUOUS).is_file() else run.path(HEIGHT)
    # The design repeats with the full height, so the top half step rounds to the lowest level.
    height = read_any_height(file, aperture=run.spec.doe.relief)
    return LevelMap.from_height(height, levels, run.spec.name, wrapped=True)


# What a bare height map needs to be drawn (`drawing_from`).
GEOMETRY = ("step_m", "etch_depths_m", "pitch_m", "scale_m", "aperture_m")


def require_source(name: str, source: object) -> None:
    """Raise an InputError for what is no design, run or path; a plate of one's own is made a design first."""
    if not isinstance(source, Design | Run | str | Path):
        rule, cure = (
            "must be a design, a run or its folder",
            "Of a level map and a camera: dd.Design(level_map, camera).",
        )
        raise InputError(name, rule, f"a {type(source).__name__}", cure)


def open_design(
    source: "Design | Run | str | Path",
    masks: str | Path | Literal[False] | None = None,
    *,
    levels: int | None = None,
    overrides: Sequence[str] = (),
    free: Sequence[str] = CAPTURE_TABLES,
) -> Design:
    """Return the design of a finished run, as its masks draw it.

    Args:
        source: the run, or its folder; a design is returned as it is.
        masks: its mask order, whose files are read; `masks/NAME` where there is one, else the run's own level map;
            False for that in any case.
        levels: a number of levels; mask orders are then left aside and, with another number than the run's own, so is
            what its masks do against the errors of its process.
        overrides: changes to the spec that the design does not depend on, "table.key=value".
        free: tables of the spec that may be changed; of the sensor, only its response to light.

    Raises:
        InputError: no design or run, a run or order that cannot be read, an order of another run, or an override of
            something else.
    """
    if isinstance(source, Design):
        return source
    require_source("design", source)
    run = run_of(source)
    level_map = level_map_of_run(run, levels)
    folder = path_of(masks, "masks") if masks else None
    if masks is None and levels is None:
        folder = own_order(run.spec.name, run.folder, level_map)
    redrawn = levels not in (None, levels_from_spec(run.spec.process).count)
    moves_m = () if redrawn else run.spec.wafer.edge_moves_m
    if levels is None and folder is not None:
        level_map = level_map.with_level(drawn_in_masks(folder, level_map))
        moves_m = tuple(mask.edge_move_nm * NM for mask in read_manifest(folder).masks)
    continuous, aim = run.path(CONTINUOUS), None
    if run.aim_depths_m and not redrawn:
        own = level_map.levels
        aim = replace(level_map, levels=Levels(own.count, own.step_m, run.aim_depths_m))
    return Design(
        level_map,
        camera_from_spec(run.spec),
        run.spec.scene.near_m,
        run.spec.scene.far_m,
        edge_moves_m=moves_m if any(moves_m) else (),
        aim=aim,
        continuous_m=read_any_height(continuous).height_m if continuous.is_file() else None,
        spec=spec_with(run, overrides, free),
        folder=run.folder,
    )


def write_design(folder: Path, design: Design) -> list[str]:
    """Write the level map of a design and its heights, metres; return the names of the files."""
    from sim.store import write_height

    grid, relief = design.level_map.grid, design.level_map.relief
    write_level_map(folder / LEVEL_MAP, design.level_map)
    heights = {HEIGHT: design.nominal_height_m, CONTINUOUS: design.continuous_m}
    names = [name for name, height in heights.items() if height is not None]
    for name in names:
        write_height(folder / name, heights[name], grid.pitch_m, relief)
    return [LEVEL_MAP, *names]


def drawing_from(
    source: Design | Run | str | Path,
    count: int | None = None,
    *,
    step_m: float | None = None,
    etch_depths_m: Sequence[float] = (),
    pitch_m: float | None = None,
    scale_m: float | None = None,
    aperture_m: float | Sequence[float] | str | None = None,
) -> Drawing:
    """Return the level map of a design, of a run (as optimised, not as an order draws it) or of a height map.

    Args:
        source: the design, the run or its folder, or the height map.
        count: number of levels.
        step_m: height of one level, metres; for a bare height map, like the rest.
        etch_depths_m: depth of every mask where it is not 2^k steps, first mask first, metres.
        pitch_m: pixel pitch, metres.
        scale_m: metres per count, for integers, or per 1 for floats that are not metres.
        aperture_m: diameter of the relief, or its width and height, metres; or the name of a picture of it
            (`fab.aperture.picture`).

    Raises:
        InputError: neither a run nor a readable height map, or the number or step of the levels is missing.
    """
    require_source("source", source)
    if isinstance(source, str):
        source = Path(source)
    if isinstance(source, Path):
        require_relief(source)
    if not isinstance(source, Path) or source.is_dir():
        geometry = {"step_m": step_m, "etch_depths_m": etch_depths_m or None, "pitch_m": pitch_m, "scale_m": scale_m}
        for name, value in {**geometry, "aperture_m": aperture_m}.items():
            if value is not None:
                cure = "Leave it out, or give a height map."
                raise InputError(name, "a run brings its own geometry", "a value", cure)
        if isinstance(source, Path):
            source = open_run(source)
        if isinstance(source, Run):
            design = open_design(source, False, levels=count)
            own = level_map_of_run(source)
        elif count in (None, source.levels.count):
            design, own = source, source.level_map
        else:
            raise InputError("levels", "a design has its own levels", count, "Leave it out, or give its run.")
        origin: dict[str, Any] = {"kind": "run", "name": own.name, "level_map_sha256": own.digest}
        if design.levels != own.levels:
            origin["rounded"] = {"designed_levels": own.levels.count, "efficiency": _kept_light(design, own)}
        return Drawing(design.level_map, origin, design)
    if count is None or step_m is None:
        missing, name = ("number of levels", "levels") if count is None else ("height of a level", "step")
        raise InputError(str(source), f"a bare height map needs the {missing}", "none", f"Give `{name}`.")
    levels = Levels(count, step_m, tuple(etch_depths_m))
    relief = aperture_m if aperture_m is None or isinstance(aperture_m, str) else aperture_from(aperture_m)
    height = read_any_height(source, pitch_m, scale_m, relief)
    name = _ascii_name(source.stem)
    try:
        level_map = LevelMap.from_height(height, levels, name, wrapped=_is_wrapped(height, levels))
    except InputError as error:
        part = "" if error.where in ("level map", "height map") else f": {error.where}"
        raise InputError(f"{source}{part}", error.rule, error.got, error.cure) from error
    origin = {"kind": "height map", "name": source.name, "height_sha256": sha256_file(source)}
    return Drawing(level_map, origin, None)


def _ascii_name(stem: str) -> str:
    """Turn the name of a file into one that mask shops take, ASCII without accents; "height" where nothing is left."""
    plain = "".join(c for c in unicodedata.normalize("NFKD", stem) if not unicodedata.combining(c))
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in plain).strip("_") or "height"


def _kept_light(design: Design, own: LevelMap) -> float:
    """Share of the light that goes where a run's `own` level map sends it, in its design drawn with other levels.

    As for a repair, |mean exp(2 pi i dh waves_per_metre)|^2 over the relief; it is said in a warning, too.
    """
    assert design.spec is not None  # that of its run
    wavelength_m = design.spec.optics.design_wavelength_m
    inside = own.relief.inside(own.grid)
    moved_m = np.subtract(design.height_m, own.height_m, dtype=np.float64)[inside]
    kept = float(abs(np.exp(2j * np.pi * design.camera.waves_per_metre(wavelength_m) * moved_m).mean()) ** 2)
    words = "designed with %d levels and drawn with %d: %.2g %% of its light at %s goes astray; an optimisation with %d"
    counts = own.levels.count, design.levels.count
    log.warning(f"{words} levels allows for them", *counts, 100 * (1 - kept), format_length(wavelength_m), counts[1])
    return kept


def _is_wrapped(height: HeightMap, levels: Levels) -> bool:
    """Whether heights beyond the top level stay within one wave, as those of a phase do; say what becomes of them."""
    top_m = levels.total_m + levels.step_m / 2
    beyond = height.height_m > top_m * (1 + 1e-6)
    if not beyond.any() or height.height_m.max() > levels.period_m * (1 + 1e-6):
        return False
    wave, top = format_length(levels.period_m), format_length(top_m)
    words = "heights repeat after one wave, %s: %.2g %% of the pixels lie above %s and are drawn as nearly 0"
    log.info(words, wave, 100 * beyond.mean(), top)
    return True


def drawn_in_masks(folder: Path, level_map: LevelMap) -> np.ndarray:
    """Return the level numbers ``[y, x]`` that the masks of the order of a level map draw.

    Raises:
        InputError: no order that can be read, or the order of another level map.
    """
    from fab.verification.files import read_drawn_levels  # slow to import

    manifest = read_manifest(folder)
    require_order_of(folder, manifest, level_map)
    levels, grid = manifest.staircase(), manifest.grid()
    files, moves = manifest.drawn_files(folder), manifest.edge_moves()
    return read_drawn_levels(files, levels, pixel_edges(grid), manifest.doe_cell, moves)
