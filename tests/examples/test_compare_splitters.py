"""The comparison of splitters, at a size that shows it works."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import compare_splitters  # pyright: ignore[reportMissingImports]

from doedesign.spots import design as spots_design

SMALL = ("doe.samples=96", "doe.aperture=0.192 mm", "spots.starts=20")
SPLITTER = {"1 x 3": compare_splitters.Task((3, 1), "64 um", 3.0, 1.0)}


@pytest.mark.slow
def test_plates_of_a_process_without_errors_are_as_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compare_splitters, "SPLITTERS", SPLITTER)
    drawn = compare_splitters.design_of("1 x 3", "as drawn", "contact_aligner", tmp_path, SMALL)
    light, unequal = compare_splitters.uniformity_errors(drawn, "ideal", 2)
    assert np.ptp(light) == np.ptp(unequal) == 0
    assert light[0] > 0.85
    assert unequal[0] < 0.02  # the lens of the camera sees whole periods, and all levels are there


@pytest.mark.study
def test_both_designs_meet_every_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(compare_splitters, "SPLITTERS", SPLITTER)
    monkeypatch.setattr(spots_design, "_LAST_OFFERS", 2**18)
    found = compare_splitters.run(20, ["contact_aligner", "direct_write"], tmp_path, SMALL)
    rows = list(csv.DictReader((tmp_path / "splitters.csv").read_text().splitlines()))
    assert [(row["design"], row["process"]) for row in rows] == [(one.design, one.process) for one in found]
    assert (tmp_path / "splitters.png").read_bytes().startswith(b"\x89PNG")
    assert "written to" in capsys.readouterr().out
    nominal, fabricated = found[0], found[2]
    assert fabricated.p95_uniformity_error < nominal.p95_uniformity_error
    assert fabricated.drawn_uniformity_error > nominal.drawn_uniformity_error
