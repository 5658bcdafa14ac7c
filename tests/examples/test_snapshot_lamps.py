"""The study of lamps read from copies: its summary, and that it goes on where it was left."""

import sys
from pathlib import Path

import numpy as np
import pytest

from doedesign.hdr.study import CASES, LampRow
from fab.files import csv_table

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import snapshot_hdr  # pyright: ignore[reportMissingImports]


def rows(gains: list[float]) -> list[LampRow]:
    """Rows of one case, in which the plate gains these decibels over the plain lens and loses 1 dB elsewhere."""
    found = []
    for scene, gain in enumerate(gains):
        for camera, lamps, elsewhere in (
            ("clipped", 8.0, 20.0),
            ("plain lens", 18.0, 30.0),
            ("plate", 18 + gain, 29.0),
        ):
            found.append(LampRow(CASES[0].name, camera, scene, "a.png", lamps + scene, elsewhere))
    return found


def test_gains_are_taken_scene_by_scene():
    found = snapshot_hdr.summary(rows([9.0, 10.0, 11.0]))[CASES[0].name]
    assert found["scenes"] == 3
    assert found["plate"]["lamps"] == pytest.approx(29)
    assert found["gain_lamps"]["mean"] == pytest.approx(10)
    assert found["gain_lamps"]["least"] == pytest.approx(9)
    # Student's t of two degrees of freedom, 4.303, times the standard error, 1 / sqrt(3).
    assert found["gain_lamps"]["low"] == pytest.approx(10 - 4.303 / 3**0.5, abs=1e-3)
    assert found["gain_elsewhere"]["mean"] == pytest.approx(-1)
    assert CASES[0].name in snapshot_hdr.table({CASES[0].name: found})


def test_rows_are_read_back(tmp_path: Path):
    given = rows([9.0, 10.5])
    assert snapshot_hdr.read_rows(tmp_path / "scores.csv") == []
    (tmp_path / "scores.csv").write_text(csv_table(given))
    assert snapshot_hdr.read_rows(tmp_path / "scores.csv") == given


def test_light_is_shown_up_to_the_brightest():
    light = np.array([0.0, 0.5, 0.8, 200.0, 1e6]).reshape(1, 1, 5).repeat(3, axis=0)
    shown = snapshot_hdr.shown(light)[0, :, 0]
    assert shown[0] == 0
    assert (np.diff(shown) >= 0).all()
    assert shown[3:] == pytest.approx(1)


def test_a_run_that_is_not_there_is_a_mistake_of_the_user(tmp_path: Path):
    assert snapshot_hdr.main([str(tmp_path / "nothing")]) == 2
