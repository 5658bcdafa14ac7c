"""Free forms beside classic plates, at a size that shows it works."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from doedesign.build import camera_from_spec
from doedesign.spec import load_spec
from fab.errors import InputError
from sim.metrics import METRICS
from sim.optic import HeightOptic
from sim.psf_bank import psf

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import pareto  # pyright: ignore[reportMissingImports]

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"


@pytest.mark.slow
def test_a_free_form_beats_every_plate_of_a_formula(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """On 128 cells, with a third of the steps of the example."""
    text = QUICK.read_text().replace("samples = 320", "samples = 128").replace("0.592 mm", "0.2368 mm")
    text = text.replace("window = 128", "window = 96").replace("steps = 120", "steps = 45")
    spec = tmp_path / "small.toml"
    spec.write_text(text)
    found = pareto.run(spec, (0.4,), 12, tmp_path / "out")
    # A table of all plates is not made anew, and reads back as it was written, to five digits.
    again = pareto.run(spec, (0.4,), 12, tmp_path / "out")
    assert [one.kind for one in again] == [one.kind for one in found]
    assert [one.loss for one in again] == pytest.approx([one.loss for one in found], rel=1e-4)
    rows = {row["kind"]: row for row in csv.DictReader((tmp_path / "out" / "pareto.csv").read_text().splitlines())}
    assert [*rows] == [*pareto.KINDS]
    loss = {kind: float(row["loss"]) for kind, row in rows.items()}
    assert min(loss, key=loss.__getitem__) == "free form"
    assert float(rows["free form"]["far_spot"]) == pytest.approx(0.4, abs=0.05)  # 45 steps on a small plate
    assert float(rows["flat"]["concentration"]) == pytest.approx(1, rel=1e-6)  # it is the plain lens, in float32
    # A free form that may lose light loses some, and spreads what is near wider.
    free, losing = (rows[kind] for kind in ("free form", "free form, losing light"))
    assert float(losing["window_share"]) < float(free["window_share"])
    assert float(losing["concentration"]) < float(free["concentration"])
    assert (tmp_path / "out" / "pareto.png").stat().st_size > 10_000
    assert "written to" in capsys.readouterr().out


@pytest.mark.slow
def test_the_curve_of_the_bound_is_that_of_the_metrics():
    spec = load_spec(QUICK)
    camera, depths = camera_from_spec(spec), (*spec.scene.near_m, *spec.scene.far_m)
    lens = psf(HeightOptic.of(camera), depths=depths)
    spot, least = pareto.bound(lens, len(spec.scene.near_m))
    inputs = lens.metric_inputs(spec.scene.near_m, lens=lens)
    bounds = [METRICS["concentration_bound"].of(inputs, c, d) for c in range(3) for d in range(3)]
    spots = [METRICS["far_spot"].of(inputs, c, d) for c in range(3) for d in (3, 4)]
    # The plain lens as a design: colours and depths have spots of their own, that differ by 1 %.
    assert np.interp(np.mean(spots), spot, least) == pytest.approx(np.mean(bounds), rel=0.02)


def test_a_spec_without_a_stated_spot_is_refused(tmp_path: Path):
    spec = tmp_path / "other.toml"
    spec.write_text(
        QUICK.read_text().replace('name = "spot_energy"', 'name = "far_spot"').replace("options = { energy", "# ")
    )
    with pytest.raises(InputError, match="an objective must be spot_energy"):
        pareto.asking(spec, 0.3)
