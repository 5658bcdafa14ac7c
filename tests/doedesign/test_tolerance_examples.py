"""The narrated tolerance scripts run, and say what they found, on a plate of 48 x 48 cells."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = ("doe.samples=48", "doe.aperture=88.8 um", "sensor.window=32", "optimize.steps=1", 'scene.far=["inf"]')

pytestmark = pytest.mark.slow


def example(name: str) -> ModuleType:
    found = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The design of both examples; the second finds the one that the first made."""
    runs = tmp_path_factory.mktemp("runs")
    made = [example(name).design(runs=runs, overrides=SMALL) for name in ("tolerance_overlay", "tolerance_budget")]
    assert made[0] == made[1] == runs / "tolerance-example"
    return made[0]


def test_the_overlay_example_names_the_mask_that_matters(run: Path):
    told = example("tolerance_overlay").overlay(run, draws=3, workers=1)
    assert told.startswith("yield of 3 plates: ")
    lines = told.splitlines()
    table = [line.split() for line in lines[lines.index("mask  one sigma left  one sigma right") + 1 :][:4]]
    strehls = [(float(left), float(right)) for _, left, right in table]
    # A strip that is wrong by one level step does least harm.
    assert 1 > min(strehls[0]) > max(max(pair) for pair in strehls[1:])
    for name in ("histograms.png", "masks.png"):
        assert (run / "overlay" / name).is_file()
        assert str(run / "overlay" / name) in lines


def test_the_budget_example_has_a_line_for_every_source(run: Path):
    told = example("tolerance_budget").budgets(run, ("overlay", "depth"), draws=2, limits=("strehl >= 0.8",), workers=1)
    lines = told.splitlines()
    assert lines[0].startswith("yield as the process is: ")
    assert [line.split()[0] for line in lines[3:5]] == ["overlay", "depth"]
    assert (run / "budget" / "depth.png").is_file()
