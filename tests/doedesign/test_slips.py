"""Slips in calls from Python: words on what to write in place of a traceback, and text with a unit where it serves."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import doedesign as dd
import doedesign.lab.order as lab
import doedesign.report.page.write as write
import fab
from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import open_design
from fab.errors import InputError
from tests.doedesign.small_runs import SPEC, finished_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("slips"), SPEC)


def test_an_empty_name_is_no_process_and_no_file(run: Path):
    with pytest.raises(InputError, match=r'process: must be a file with a \[process\] table or the name .* got ""'):
        open_design(run).fabricated("")
    with pytest.raises(InputError):
        dd.load_spec("")


def test_masks_of_a_design_are_checked_by_its_level_map(run: Path):
    design = open_design(run)
    with pytest.raises(InputError, match=r"must be a LevelMap, but got a Design. A design has one: design\.level_map"):
        fab.check(cast(Any, design), "stepper")
    assert fab.check(design.level_map, "stepper").planes


def test_the_page_of_a_design_is_that_of_its_folder(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked: list[object] = []
    monkeypatch.setattr(write, "gather", lambda folder, order: asked.append(folder))
    monkeypatch.setattr(write, "compared", asked.extend)
    monkeypatch.setattr(write, "render", lambda content: b"")
    design = open_design(run)
    for one in (run, str(run), open_run(run), design):
        dd.write_report(one, out=tmp_path / f"{len(asked)}.html")
    dd.write_report(design, compare=[design, open_run(run)], out=tmp_path / "several.html")
    assert asked == [run] * 7
    with pytest.raises(InputError, match="a page is written of a run folder, but got a design in memory"):
        dd.write_report(design.bare())


def test_depths_have_a_unit_or_are_metres(run: Path):
    text, metres = (dd.psfs(run, depths_m=cast(Any, depths))["quantised"] for depths in (["5 m"], [5.0]))
    assert text.depths_m == metres.depths_m == (5.0,)
    np.testing.assert_array_equal(text.energy, metres.energy)
    for depths in (["five"], [-1.0]):
        with pytest.raises(InputError, match="depth"):
            dd.psfs(run, depths_m=cast(Any, depths))
    with pytest.raises(InputError, match="field_rad: must be two angles"):
        dd.psfs(run, field_rad=(0.0, 2.0))


def test_a_laser_has_a_wavelength_with_a_unit(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    probes: list[float] = []

    def predicted(design: object, process: object, design_m: float, probe_m: float, moves_m: object) -> None:
        probes.append(probe_m)
        raise InputError("probe", "must not be looked at further", "enough", "None.")

    monkeypatch.setattr(lab, "predict_sheet", predicted)
    monkeypatch.setattr(lab, "write_planned", lambda folder, order, predict: predict(order))
    for probe in ("532 nm", 532e-9):
        dd.write_masks(run, tmp_path / "order", probe_m=probe)
    assert probes == pytest.approx([532e-9, 532e-9])
    with pytest.raises(InputError, match="probe_m: must be metres or text with a unit"):
        dd.write_masks(run, tmp_path / "order", probe_m="green")
    assert len(probes) == 2
