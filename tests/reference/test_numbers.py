"""Every number of a result file has its definition, and every definition has a number."""

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import doedesign.optimization
import doedesign.runs.fabricated
import doedesign.runs.psfs
from doedesign.calibration.explanations import Curve, Explanation, ExplanationSet, Targets
from doedesign.design.accuracy import Accuracy
from doedesign.evaluation.optics.bench_measurement import BenchRow
from doedesign.evaluation.optics.depth_study import DepthRow
from doedesign.evaluation.optics.plate_comparison import PlateRow
from doedesign.evaluation.tables import SCORES, PairFacts, ScoreLine
from doedesign.optimization import optimize
from doedesign.overview.kinds import record_of
from doedesign.overview.numbers import main_numbers
from doedesign.precompensation import _MaskRow
from doedesign.reference.numbers import METRICS_GROUPS, metrics_numbers, number
from doedesign.reference.other_numbers import OTHER_GROUPS
from doedesign.runs.certificate import certify
from doedesign.runs.fabricated import fabricated
from doedesign.runs.psfs import psfs
from doedesign.spec import load_spec
from doedesign.spec.process import LimitSpec, Quantity
from doedesign.tolerancing.results import tolerance
from fab.process import DEVIATIONS
from fab.runsheet.tables import CertifiedOrder
from sim.metrics import METRICS, EnergyBudget
from tests.pictures import leave_out_pictures

ROOT = Path(__file__).parents[2]
# Keys of metrics.json that hold tables; all others name a number or a text.
TABLES = {
    "psf",
    "budget",
    "accuracy",
    "patterns",
    "etches",
    "orders",
    "area",
    "focus",
    "foci",
    "refinement",
    "precompensation",
}
TABLES |= {"continuous", "quantised", "from_masks", "nominal", "fabricated", "split", "certified"}

HEAD = """
name = "small"

[optics]
{lens}wavelengths = ["532 nm"]
design_wavelength = "532 nm"

[doe]
samples = 48
pitch = "2 um"
aperture = "96 um"
material = "fused_silica"

[process]
levels = 4
level_step = "289 nm"
chrome_overlap = "1 um"
"""
QUICK = """
[scene]
near = ["2 mm"]
far = ["inf"]

[sensor]
pitch = "2 um"
window = 48

[optimize]
start = "random"
steps = 2
"""
OBJECTIVES = """
[[objective]]
name = "far_spot"

[[objective]]
name = "near_spread"
"""
PATTERN = """
[[objective]]
name = "target_pattern"
options = { pattern = "square", width = "20 um" }
"""
STEPS = "\n[optimize]\nsteps = 4\n"
ORDERS = '\n[spots]\ncount = [3, 3]\nperiod = "16 um"\nstarts = 2\n' + STEPS
AREA = '\n[area]\nshape = "rectangle"\nwidth = "300 um"\n\n[sensor]\npitch = "10 um"\n' + STEPS
AREAS = AREA.replace("[area]", "[[area]]") + '\n[[area]]\nshape = "ellipse"\nwidth = "400 um"\nphase = "flat"\n'
FOCUS = '\n[focus]\ndistances = ["1 mm", "2 mm"]\n' + STEPS
LENS = 'focal_length = "5 mm"\n'
TASKS = {
    "see_through": (LENS, QUICK + OBJECTIVES),
    "pattern": (LENS, QUICK.replace('near = ["2 mm"]', "near = []") + PATTERN),
    "orders": ("", ORDERS),
    "areas": (LENS, AREAS),
    "focus": ("", FOCUS),
}


def names_in(record: Any) -> Iterator[str]:
    """Names of all values of a record, tables aside."""
    for name, value in record.items() if isinstance(record, dict) else ():
        if name not in TABLES:
            yield name
        yield from names_in(value)
    for one in record if isinstance(record, list) else ():
        yield from names_in(one)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run of every kind of task, with PSFs, one plate of each and a certificate."""
    folder = tmp_path_factory.mktemp("numbers")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        leave_out_pictures(patch, doedesign.optimization, doedesign.runs.psfs, doedesign.runs.fabricated)
        for name, (lens, rest) in TASKS.items():
            path = folder / f"{name}.toml"
            path.write_text(HEAD.format(lens=lens) + rest)
            changes = ['process.etch_depths="optimize"'] if name == "pattern" else []
            optimize(path, folder / name, overrides=changes)
            if name in ("see_through", "orders", "areas", "focus"):
                fabricated(folder / name, process="contact_aligner", seed=0, out=folder / f"{name}_fabricated")
        certify(folder / "see_through", cells=6, pieces=0, out=folder / "see_through" / "certificate")
        psfs(folder / "see_through", out=folder / "see_through_psf")
        yield folder


def found_in(folder: Path) -> set[str]:
    return {name for path in folder.rglob("metrics.json") for name in names_in(json.loads(path.read_text()))}


@pytest.mark.study
def test_every_number_of_a_run_is_defined(folder: Path) -> None:
    assert {name for name in found_in(folder) if number(name) is None} == set()


@pytest.mark.study
def test_every_definition_is_of_a_number_that_a_run_has(folder: Path) -> None:
    known, found = metrics_numbers(), found_in(folder)
    found |= {f"{name.removesuffix('_rad')}_m" for name in found if name.endswith("_rad") and name not in known}
    # Those of a refined cell need the rigorous solver (tests/doedesign/test_refine.py), those of masks a
    # search (tests/doedesign/test_precompensate.py); those of a study are below.
    of_a_study = {name for name, metric in METRICS.items() if metric.aimed}
    of_commands = {"cell", "terms", *_MaskRow._fields}
    assert set(metrics_numbers()) - found <= of_commands | of_a_study
    assert {"on_target", "uniformity_error", "contrast", "focus_width"} <= found


@pytest.mark.study
def test_the_main_numbers_of_every_task_are_numbers_of_its_metrics(folder: Path) -> None:
    """What `runs`, `compare` and the last lines of commands tell."""
    aims = {
        "see_through": {"far_spot", "concentration_over_bound", "throughput", "zeroth_order"},
        "pattern": {"far_spot", "throughput", "zeroth_order"},
        "orders": {"on_target", "uniformity_error", "zeroth_order_efficiency", "ceiling"},
        "areas": {"on_target", "contrast", "zeroth_order", "ceiling"},
        "focus": {"focus_width", "zeroth_order"},
    }
    for name in TASKS:
        told = main_numbers(folder / name, record_of(folder / name))
        assert {one.key for one in told if one.value is not None} >= aims[name] - {"ceiling"}, name
        assert {one.key for one in told} <= aims[name], name
        assert all(number(one.key) is not None for one in told if one.key != "concentration_over_bound")


@pytest.mark.study
def test_twins_are_one_number(folder: Path) -> None:
    """A name has one value in a row: shares of the budget are the numbers beside it."""
    for row in json.loads((folder / "see_through" / "metrics.json").read_text())["psf"]:
        budget = row["budget"]
        assert set(budget) == set(EnergyBudget._fields)
        # The same pixels, summed once as float32.
        assert budget["far_spot"] + budget["window_beside_spot"] == pytest.approx(row["throughput"], rel=1e-6)
        assert row.get("far_spot", budget["far_spot"]) == budget["far_spot"]


@pytest.mark.study
def test_a_plate_as_drawn_has_a_relative_strehl_ratio_of_one_and_its_own_spot(folder: Path) -> None:
    rows = json.loads((folder / "see_through_fabricated" / "metrics.json").read_text())["nominal"]
    # Means of float32 transmissions.
    assert all(row["strehl"] == pytest.approx(1, abs=1e-5) for row in rows)
    assert all(row.get("far_spot", 0.0) < 0.95 for row in rows)


@pytest.mark.study
def test_numbers_of_a_study_are_those_of_metrics(folder: Path) -> None:
    """`on_target` of a draw is that of the table in metrics.json."""
    for name, key in (("orders", "orders"), ("areas", "area")):
        record = json.loads((folder / f"{name}_fabricated" / "metrics.json").read_text())
        for plate in ("nominal", "fabricated"):
            tables = record[key][plate] if isinstance(record[key][plate], list) else [record[key][plate]]
            assert record[plate][0]["on_target"] == min(table["on_target"] for table in tables)


@pytest.mark.study
def test_columns_of_tables_are_defined(folder: Path) -> None:
    own = OTHER_GROUPS[0].numbers
    for path in folder.rglob("*.csv"):
        if path.name in ("orders.csv", "area.csv", "focus.csv"):
            header = next(csv.reader(io.StringIO(path.read_text())))
            unknown = {name for name in header if name.replace("_deg", "_mm") not in own and number(name) is None}
            assert unknown - {"phase_error_deg"} == set(), path


@pytest.mark.study
def test_results_of_a_study_are_defined(folder: Path) -> None:
    asked: dict[str, Any] = {"process": "contact_aligner", "draws": 2, "limits": ["strehl >= 0.5"], "budget": "depth"}
    result = tolerance(folder / "see_through", **asked, workers=1)
    record = json.loads(json.dumps(result.record()))
    own = OTHER_GROUPS[1].numbers
    rows = [*names_in(record["nominal"]), *names_in(record["plates"]["worst"])]
    assert {name for name in rows if number(name) is None and name not in own} <= {"rows"}
    for part in (record["plates"]["statistics"], record["one_at_a_time"], record["budget"]):
        # Standard deviations of a budget are named after the errors.
        known = {*own, *METRICS, *DEVIATIONS, "colour", "depth_m", "yields"}
        assert {name.partition("[")[0] for name in names_in(part)} <= known


def test_every_metric_is_defined_and_can_be_limited() -> None:
    from typing import get_args

    assert all(len(metric.definition) > 20 for metric in METRICS.values())
    # A plate can be good or bad by these, in a spec as in Python.
    assert set(get_args(Quantity)) == {name for name, metric in METRICS.items() if metric.worse is not None}
    assert LimitSpec.model_validate({"quantity": "focus_width", "max": 1.2}).max == 1.2
    with pytest.raises(ValueError, match="must lie between 0 and 1"):
        LimitSpec.model_validate({"quantity": "on_target", "min": 1.2})


def test_rows_of_tables_are_defined() -> None:
    numbers = {group.title: set(group.numbers) for group in (*METRICS_GROUPS, *OTHER_GROUPS)}
    everywhere = set(metrics_numbers())
    assert set(_MaskRow._fields) == numbers["Pre-compensated masks"]
    assert {*ScoreLine._fields, *PairFacts._fields} == numbers["Evaluation tables"]
    figures = {*PlateRow._fields, *DepthRow._fields, *BenchRow._fields}
    assert figures - everywhere == numbers["Figures of optics"] - everywhere
    assert set(Accuracy._fields) <= everywhere
    tables = {"targets", "nominal", "singles", "pairs", "curves", "assumed"}
    told = {*ExplanationSet._fields, *Explanation._fields, *Targets._fields, *Curve._fields} - tables
    assert told - everywhere - {"wavelength_m"} == numbers["Explanations of a measured ratio"]
    assert set(SCORES) | {"covered"} == numbers["Scores of pictures"]


def test_definitions_are_complete() -> None:
    for group in (*METRICS_GROUPS, *OTHER_GROUPS):
        for name, one in group.numbers.items():
            assert one.unit, name
            assert one.definition, name
            assert one.source, name
    assert {"colour", *CertifiedOrder._fields} - {"colour"} <= set(METRICS_GROUPS[4].numbers) | {"colour"}


@pytest.mark.parametrize("design", ["automotive-2400", "automotive-robust-2400", "dslr-2800"])
def test_released_designs_have_todays_names(design: str) -> None:
    metrics = json.loads((ROOT / "masks" / design / "metrics.json").read_text())
    assert {name for name in names_in(metrics) if number(name) is None} == set()
    for row in metrics["psf"]:
        # Six shares of all light, in float32 sums.
        assert np.isclose(sum(row["budget"].values()), 1, atol=1e-6)
    assert load_spec(ROOT / "masks" / design / "spec.toml").name == metrics.get("design", design.partition("-")[0])
