"""What is to be drawn, from wherever it comes: a run, its mask files, an EXR file, or a map the user brings."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isclose
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from doedesign.build import levels_from_spec
from doedesign.runs.folder import Run, open_run
from doedesign.spec import HEIGHT_FILES
from fab.errors import InputError
from fab.grid import Grid
from fab.height import HeightMap, read_height
from fab.layout.geometry import pixel_edges
from fab.levels import Levels, height_of, quantise, quantise_wrapped
from fab.manifest.records import read_manifest
from fab.units import format_length


@dataclass(frozen=True)
class LevelMap:
    """A map that can be drawn.

    Attributes:
        level: level numbers `[y, x]`.
        levels: the staircase.
        grid: the raster.
        aperture_m: diameter of the relief, metres.
        name: what it is called, letters A-Z and digits at least in part.
        file: where its heights were read.
    """

    level: NDArray[np.uint8]
    levels: Levels
    grid: Grid
    aperture_m: float
    name: str
    file: Path


def read_any_height(
    path: Path, pitch_m: float | None = None, scale_m: float | None = None, aperture_m: float | None = None
) -> HeightMap:
    """Read a height map from .exr, .npy, .tif or .png.

    Args:
        path: the file.
        pitch_m: pixel pitch; needed unless the file holds it (EXR of our own).
        scale_m: metres per count, for integers.
        aperture_m: diameter of the relief; by default what the file says, or its shorter side.

    Raises:
        InputError: the file cannot be read or something needed is missing.
    """
    if path.is_dir():
        raise InputError(str(path), f"a height map is a file ({', '.join(HEIGHT_FILES)})", "a folder", "Give the file.")
    if path.suffix.lower() != ".exr":
        return read_height(path, pitch_m, scale_m, aperture_m)
    from sim.store import read_height as read_exr

    stored = read_exr(path)
    pitch = stored.pitch_m if pitch_m is None else pitch_m
    if pitch is None:
        raise InputError(str(path), "the pixel pitch must be given", "none in the file", "Add --pitch-um.")
    ny, nx = stored.height_m.shape
    grid = Grid((ny, nx), pitch)
    if aperture_m is None:
        aperture_m = stored.aperture_m or min(grid.extent_m)
    return HeightMap(stored.height_m, grid, aperture_m)


def levels_of_run(run: Run, count: int | None = None) -> LevelMap:
    """What a run draws, or its continuous design rounded to another number of levels over the same full height."""
    drawn = levels_from_spec(run.spec.process)
    aperture, name = run.spec.doe.aperture_m, run.spec.name
    if count in (None, drawn.count) and run.spec.optimize.quantisation != "none":
        file = run.path("height.exr")
        height = read_any_height(file)
        level = quantise(height.height_m, drawn)
        _require_on(level, height.height_m, drawn, file)
        return LevelMap(level, drawn, height.grid, aperture, name, file)
    levels = drawn if count in (None, drawn.count) else Levels(count, drawn.period_m / max(count, 1))
    file = run.path("height_continuous.exr")
    height = read_any_height(file)
    # The design repeats with the full height, so the top half step rounds to the lowest level.
    return LevelMap(quantise_wrapped(height.height_m, levels), levels, height.grid, aperture, name, file)


def _require_on(level: NDArray[np.uint8], height_m: NDArray[np.floating], levels: Levels, file: Path) -> None:
    """Refuse heights that are not those of levels; equal steps, which the spec's digest vouches for, go unlooked at."""
    if levels.is_binary:
        return
    off_m = float(np.abs(height_m - height_of(level, levels)).max())
    # As much as any two levels are apart, and far above what single precision loses.
    if off_m > 1e-3 * levels.step_m:
        got = f"one that is {format_length(float(f'{off_m:.3g}'))} off"
        cure = "Restore the manifest of the run, or optimise again."
        raise InputError(str(file), f"every height must be one of the {levels.told}", got, cure)


def level_map_from(
    source: Path,
    count: int | None,
    *,
    step_m: float | None = None,
    depths_m: Sequence[float] = (),
    pitch_m: float | None = None,
    scale_m: float | None = None,
    aperture_m: float | None = None,
) -> LevelMap:
    """The level map of a run folder or of a height map.

    Args:
        source: the run folder or height map.
        count: number of levels.
        step_m: height of one level; for a bare height map, like the rest.
        depths_m: depth of every mask where it is not 2^k steps, mask 0 first.
        pitch_m: pixel pitch.
        scale_m: metres per count, for integers.
        aperture_m: diameter of the relief.

    Raises:
        InputError: neither a run nor a readable height map, or the number or step of the levels is missing.
    """
    if not source.exists():
        raise InputError(str(source), "must be a run folder or a height map", "nothing of that name", "Check the path.")
    if source.is_dir():
        options = {"--step": step_m, "--etch-depths": depths_m or None, "--pitch-um": pitch_m, "--scale": scale_m}
        options["--aperture"] = aperture_m
        for option, value in options.items():
            if value is not None:
                cure = "Leave the option out, or give a height map."
                raise InputError(option, "a run brings its own geometry", "a value", cure)
        return levels_of_run(open_run(source), count)
    if count is None or step_m is None:
        missing, example = ("--levels", "--levels 16") if count is None else ("--step", '--step "75 nm"')
        raise InputError(str(source), f"a bare height map needs {missing}", "none", f"Add {example}.")
    levels = Levels(count, step_m, tuple(depths_m))
    height = read_any_height(source, pitch_m, scale_m, aperture_m)
    try:
        level = quantise(height.height_m, levels)
    except InputError as error:
        raise InputError(str(source), error.rule, error.got, error.cure) from error
    # What a mask shop takes in a name; a name of other letters alone leaves nothing.
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in source.stem).strip("_") or "height"
    return LevelMap(level, levels, height.grid, height.aperture_m, name, source)


def drawn_in_masks(folder: Path, drawing: LevelMap) -> np.ndarray:
    """Level map that the combined GDS file of a mask order draws, `[y, x]`.

    Args:
        folder: the mask order.
        drawing: what it should draw.

    Raises:
        InputError: no mask order, a broken file, or a drawing on another raster or with other levels.
    """
    from fab.verification.verify import read_drawn_levels  # it needs what only those who draw have: training goes without

    manifest = read_manifest(folder)
    levels, grid = manifest.staircase(), manifest.grid()
    alike = grid.shape == drawing.grid.shape and levels.count == drawing.levels.count
    # The manifest rounds lengths to its units' last digit.
    lengths = [(grid.pitch_m, drawing.grid.pitch_m), (levels.step_m, drawing.levels.step_m)]
    lengths += zip(levels.depths_m, drawing.levels.depths_m, strict=False)
    if not (alike and all(isclose(found, wanted, rel_tol=1e-6) for found, wanted in lengths)):
        raise InputError(
            str(folder),
            f"the masks must be those of this run, {_told(drawing.grid, drawing.levels)}",
            _told(grid, levels),
            "Give the masks of this run (--masks).",
        )
    combined, moves = folder / manifest.combined_gds, manifest.edge_moves()
    return read_drawn_levels(combined, levels, pixel_edges(grid), manifest.doe_cell, moves)


def _told(grid: Grid, levels: Levels) -> str:
    pixels = f"{grid.shape[0]} x {grid.shape[1]} pixels of {format_length(grid.pitch_m)}"
    return f"{pixels} in {levels.told}"
