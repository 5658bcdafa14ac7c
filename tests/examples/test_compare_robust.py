"""The comparison of robust designs, at a size that shows it works."""

import csv
import sys
from pathlib import Path

import pytest

from doedesign.design.problem import problem_of
from doedesign.optimization import optimize
from doedesign.spec import load_spec
from tests.doedesign.small_runs import SPREAD

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import compare_robust  # pyright: ignore[reportMissingImports]


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SPREAD.replace("steps = 0", "steps = 12\nlearning_rate = 0.5"))
    return path


@pytest.mark.slow
def test_plates_of_a_process_without_errors_are_as_drawn(spec: Path):
    small = load_spec(spec)
    found = compare_robust.plates_of("small", optimize(small), "ideal", 3, problem_of(small, {})[0].terms)
    # Two programs for the same plate: single precision.
    assert found.mean_loss == pytest.approx(found.drawn_loss, rel=1e-5)
    assert found.ring_to_disc_of_90_percent == pytest.approx(found.drawn_ring_to_disc, rel=1e-4)
    assert found.median_zeroth_order == pytest.approx(found.drawn_zeroth_order, rel=1e-4)


@pytest.mark.study
def test_every_design_meets_every_process(spec: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "robust.csv"
    found = compare_robust.run(spec, 24, 2, ["contact_aligner", "direct_write"], out)
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [(row["design"], row["process"]) for row in rows] == [(one.design, one.process) for one in found]
    assert len(found) == 2 * len(compare_robust.DESIGNS)
    # A process of half the overlay does less to every plate; some designs were not made for the loss that judges them.
    alike = [one for one in found if one.design not in compare_robust.RINGS]
    assert len(alike) == len(found) - 4
    for coarse, fine in zip(alike[::2], alike[1::2], strict=True):
        assert abs(fine.mean_loss - fine.drawn_loss) < abs(coarse.mean_loss - coarse.drawn_loss)
    assert "written to" in capsys.readouterr().out
