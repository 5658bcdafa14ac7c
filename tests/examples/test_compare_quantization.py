"""The comparison of ways to round to levels, at a size that shows it works."""

import csv
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from doedesign.optimization import optimize
from doedesign.spec import load_spec
from tests.doedesign.small_runs import SPREAD

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import compare_quantization  # pyright: ignore[reportMissingImports]


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SPREAD)
    return path


@pytest.mark.study
def test_every_strategy_is_judged_alike(spec: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    compare_quantization.run(spec, (2, 8), 60, tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "out" / "quantization.csv").read_text().splitlines()))
    assert [row["strategy"] for row in rows] == [*compare_quantization.STRATEGIES] * 2
    loss = {(row["levels"], row["strategy"]): float(row["loss"]) for row in rows}
    # What is rounded is worse with two levels than with eight.
    assert all(loss["8", name] < loss["2", name] for _, name in loss if name != "continuous")
    assert (tmp_path / "out" / "quantization.png").stat().st_size > 10_000
    assert "written to" in capsys.readouterr().out


def test_edges_of_masks_are_counted_within_the_aperture(spec: Path):
    design = optimize(load_spec(spec, ["optimize.steps=0", "optimize.start=flat"]))
    assert compare_quantization.edge_length_m(design) == 0
    level = design.level_map.level.copy()
    level[20:24, 20:24] = 3  # masks 0 and 1, each with a square of four cells
    changed = replace(design, level_map=replace(design.level_map, level=level))
    assert compare_quantization.edge_length_m(changed) == pytest.approx(2 * 16 * 1.85e-6, rel=1e-9)
