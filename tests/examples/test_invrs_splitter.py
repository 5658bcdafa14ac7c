"""The public splitter case: closed forms, reciprocity, refused designs, and the score of its best entry."""

import sys
from pathlib import Path

import numpy as np
import pytest

from sim.rigorous import crossed_orders

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import invrs_splitter  # pyright: ignore[reportMissingImports]

FACE = 4 * 1.46 / 2.46**2
ENTRY = Path(__file__).parents[3] / "shared" / "data" / "doe_designs" / "diffractive_splitter_0.npy"


def test_a_thin_flat_plate_has_its_0th_order_alone():
    score = invrs_splitter.thin_score(np.ones((180, 180)), 0.7e-6)
    assert score.total == pytest.approx(FACE)
    assert score.uniformity_error == pytest.approx(1)
    assert score.value == pytest.approx(0, abs=1e-12)


def test_a_thin_half_wave_grating_has_the_closed_form():
    """(2 / pi)² in each first order of equal lines and spaces, and nothing in even ones."""
    design = np.zeros((180, 180))
    design[:90] = 1
    score = invrs_splitter.thin_score(design, 632.8e-9 / 2 / 0.46)
    # 90 samples per line: sinc of a sample, 1e-4.
    assert score.orders[[2, 4], 3] == pytest.approx([FACE * 4 / np.pi**2] * 2, rel=1e-3)
    assert score.orders[3, 3] == pytest.approx(0, abs=1e-12)
    assert score.orders[[1, 5], 3] == pytest.approx([0, 0], abs=1e-12)


@pytest.mark.slow
def test_light_from_either_side_has_the_same_0th_order():
    """Reciprocity, against the solver of the certificate, which lights the glass from the air."""
    pytest.importorskip("fmmax")
    design = np.zeros((180, 180))
    design[:90, :90] = design[90:, 90:] = 1
    design[90:, :90] = 1
    found = invrs_splitter.rigorous_scores(design, 0.6e-6, 120)
    # x along the first axis there, y here.
    wanted = crossed_orders(0.6e-6 * design[::90, ::90].T, 3.6e-6, 632.8e-9, 1.46, 120).within(0, 0)
    for score, own in zip(found, wanted, strict=True):
        # Two ways to transform walls, with few terms.
        assert score.orders[3, 3] == pytest.approx(own[0, 0], abs=0.01)


@pytest.mark.parametrize("design", [np.zeros((10, 10)), np.full((180, 180), 2.0), np.zeros((180, 180), int)])
def test_other_arrays_are_refused(design: np.ndarray, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch):
    np.save(tmp_path / "d.npy", design)
    monkeypatch.setattr(sys, "argv", ["invrs_splitter.py", str(tmp_path / "d.npy"), "--height", "0.7um"])
    assert invrs_splitter.main() == 2
    assert "180 x 180 numbers from 0 to 1" in capsys.readouterr().err


@pytest.mark.study
def test_the_best_public_entry_has_its_public_score():
    """0.5964 on the board: total 0.6405, uniformity error 0.0689."""
    pytest.importorskip("fmmax")
    if not ENTRY.is_file():
        pytest.skip("the design of the public board is not here")
    _, score = invrs_splitter.rigorous_scores(invrs_splitter.read_design(ENTRY), 0.7262474e-6)
    assert score.value == pytest.approx(0.5964, abs=0.02)
    assert score.total == pytest.approx(0.6405, abs=0.02)
