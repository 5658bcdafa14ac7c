"""The paper's figures of a design, each a folder with a picture and its numbers.

figure4/    plates.csv, figure.png            PSFs and MTFs of lens, Fresnel, random, ring and the design
figure8/    depths.csv, figure.png            light against depth, as drawn and as fabricated
bench/      measurement.toml, *.tiff, hidden.toml, images.csv, figure.png     a measurement for `calibrate`
"""

import logging
import math
from collections.abc import Callable
from pathlib import Path

from doedesign.evaluation.optics.bench_measurement import bench_errors, bench_measurement
from doedesign.evaluation.optics.depth_study import depth_study
from doedesign.evaluation.optics.plate_comparison import compare_optics
from doedesign.evaluation.optics.psf_bench import PsfBench
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from fab.errors import InputError
from fab.figure import save
from fab.files import canonical_json, csv_table
from fab.process import Process

FIGURES = {"4": "figure4", "8": "figure8", "bench": "bench"}  # and their folders
_LENS_M = 8e-3  # focal length of the lens behind the paper's bench
_log = logging.getLogger("doedesign")


def figure(
    source: str | Path,
    name: str,
    out: str | Path | None = None,
    *,
    process: Process | str | Path | None = None,
    draws: int = 4,
    seed: int = 1,
) -> Path:
    """Make the folder of one of the paper's figures for a design; return it.

    Args:
        source: run folder of the design.
        name: "4", "8", or "bench" for the bench on which the paper's PSFs were measured, with a plate whose errors are
            written to `hidden.toml`.
        out: folder of all evaluations, in which it gets one of its own; RUN/evaluation if None.
        process: process of plates as fabricated; that of the design's spec if None.
        draws: plates as fabricated in figure 8.
        seed: of their errors, and on the bench of noise.

    Raises:
        InputError: another name, or a design that has no such figure.
    """
    if name not in FIGURES:
        raise InputError("figure", f"must be one of {', '.join(FIGURES)}", f'"{name}"', "Choose one of them.")
    run, design = Path(source), open_design(Path(source))
    writers: list[Callable[[Path], object]] = []
    folder = (run / "evaluation" if out is None else Path(out)) / FIGURES[name]
    if name == "4":
        _log.info("comparing the design with a lens, a Fresnel lens, a diffuser and rings")
        comparison = compare_optics(design)
        tables, picture = {"plates.csv": csv_table(comparison.rows, 6)}, comparison.plot()
    elif name == "8":
        _log.info("following %d plates from afar to the nearest depth", draws + 1)
        study = depth_study(design, process, draws=draws, seed=seed)
        tables, picture = {"depths.csv": csv_table(study.rows, 6)}, study.plot()
    else:
        _log.info("photographing a plate on the bench")
        made_by = design.process(process)
        # What the relay stops would be taken for errors. A longer lens has a wider aperture, and takes a larger bench.
        bench = PsfBench(within_relay=True).scaled(design.camera.focal_length_m / _LENS_M)
        errors, depths = bench_errors(design, made_by, seed), (*design.near_m, math.inf)
        measured = bench_measurement(design, made_by, errors, bench, depths, seed)
        tables, picture = {"images.csv": csv_table(measured.rows, 6)}, measured.plot()
        tables["throughput.json"] = canonical_json(measured.throughput._asdict()).decode()
        writers.append(measured.write)
    with results_folder(folder, design.name, run) as fresh:
        assert fresh is not None  # a folder is given
        for write in writers:
            write(fresh)
        for file, text in tables.items():
            (fresh / file).write_bytes(text.encode())
        save(picture, fresh / "figure.png")
    return folder
