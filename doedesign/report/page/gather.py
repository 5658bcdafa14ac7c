"""A run folder and what lies beside it -> the content of its page."""

from collections.abc import Callable
from pathlib import Path

from doedesign.report.page.blocks import PageContent, PageSection
from doedesign.report.page.files import RunFiles, history_of, listed_json, open_files, understood
from doedesign.report.page.light import budget_section, light_section
from doedesign.report.page.making import calibration_section, order_section, tolerance_section
from doedesign.report.page.maps import level_map_section
from doedesign.report.page.networks import captures_section, evaluation_section, history_section, training_section
from doedesign.report.page.numbers import length
from doedesign.report.page.provenance import provenance_section
from doedesign.report.page.reached import reached_section
from doedesign.runs.folder import is_worked_in
from fab.figure import aperture_text


def gather(folder: Path, order: Path | None = None) -> PageContent:
    """Read all that a page of a run shows.

    Args:
        folder: the run folder, finished or at work.
        order: its mask order; `masks/NAME` beside it by default.

    Raises:
        InputError: something that is damaged, was changed, or does not belong to the run.
    """
    files = open_files(folder, order)
    with understood(folder, "history and metrics"):
        history = history_of(files)
        metrics = (listed_json(folder, "metrics.json") or {}) if files.run is not None else {}
    makers: dict[str, Callable[[], PageSection | None]] = {
        "what was reached": lambda: reached_section(files, metrics, history),
        "level map": lambda: level_map_section(files),
        "light": lambda: light_section(files, metrics),
        "budget": lambda: budget_section(files, metrics),
        "tolerance": lambda: tolerance_section(files),
        "calibration": lambda: calibration_section(files),
        "order": lambda: order_section(files),
        "captures": lambda: captures_section(files),
        "training": lambda: training_section(files),
        "evaluation": lambda: evaluation_section(files),
        "history": lambda: history_section(files),
        "provenance": lambda: provenance_section(files),
    }
    if files.run is None:  # its loss is all there is to see
        makers = {"history": makers.pop("history"), **makers}
    sections = []
    for what, make in makers.items():
        with understood(folder, what):
            sections.append(make())
    there = tuple(one for one in sections if one is not None)
    return PageContent(files.name, _summary(files, len(history)), there, facts_of(files))


def _summary(files: RunFiles, steps: int) -> tuple[str, ...]:
    if files.run is None:
        done = f"{steps} of {files.spec.all_steps} steps at its last checkpoint"
        if is_worked_in(files.folder):
            return (f"This run is at work: {done}.",)
        return (f"This run was stopped: {done}. The same `doedesign optimize` as before goes on from there.",)
    return ()


def facts_of(files: RunFiles) -> tuple[tuple[str, str], ...]:
    """Name and value of what describes a design.

    Args:
        files: the run.
    """
    spec = files.spec
    ny, nx = spec.doe.shape
    colours = ", ".join(colour.name for colour in spec.optics.colours)
    facts = [
        ("relief", f"{aperture_text(spec.doe.relief)}, {nx} × {ny} pixels of {length(spec.doe.pitch_m)}"),
        ("staircase", f"{spec.process.levels} levels of {length(spec.process.level_step_m)}"),
        ("process", spec.process.stock or "its own"),
        ("material", spec.doe.material),
        ("colours", colours),
    ]
    if spec.optics.focal_length_m is not None:
        facts.append(("lens", f"f = {length(spec.optics.focal_length_m)}"))
    return tuple(facts)
