"""Refinement of a unit cell by rigorous light: its steps, its run, and what it refuses."""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import doedesign.optimization as optimization
import doedesign.refinement as refinement
from doedesign.design.design import Design
from doedesign.lab.order import write_masks
from doedesign.optimization import optimize
from doedesign.refinement import refine
from doedesign.runs.folder import load_checkpoint, open_run
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec
from doedesign.spots.refinement import RefinementTask, places_of, ranks
from doedesign.spots.spots import Spots
from fab.errors import InputError
from fab.files import read_json
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.verify import verify
from fab.rules.check import Rules, check
from fab.rules.strokes import Strokes
from sim.camera import Colour
from sim.illumination import GaussianBeam
from sim.rigorous import SlabCell, orders_of, row_slabs
from sim.rigorous.rows import POLARISATIONS
from tests.doedesign.small_runs import call
from tests.pictures import leave_out_pictures, leave_out_pictures_of_orders

pytest.importorskip("fmmax")

WAVE, GLASS, PERIOD = 633e-9, 1.457, 3.01 * 633e-9

SPEC = Path(__file__).parents[2] / "examples" / "cell.toml"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        leave_out_pictures(patch, optimization)
        folder = tmp_path_factory.mktemp("run") / "run"
        optimize(SPEC, folder, overrides=["spots.starts=8", "optimize.steps=5"])
        yield folder


@pytest.fixture(autouse=True)
def pictures(monkeypatch: pytest.MonkeyPatch):
    leave_out_pictures(monkeypatch, optimization)
    leave_out_pictures_of_orders(monkeypatch)


def blazed_task(steps: int, count: int = 4, strokes: Strokes | None = None) -> RefinementTask:
    """A blazed grating whose light is to go to the first order."""
    level = (np.arange(12) * count // 12).astype(np.uint8)[None]
    step = WAVE / (GLASS - 1) / count
    solver = SlabCell((1, 12), PERIOD / 12, np.full(count - 1, step), WAVE, GLASS, 21)
    spots = Spots(np.array([[0.0, 1 / PERIOD]]), np.ones(1), np.array([[0, 1]]), (1 / PERIOD, 1 / PERIOD))
    return RefinementTask(solver, spots, 1.0, np.array([0.5, 0.5]), level, count, strokes, steps, 0)


def coupled(level: np.ndarray, step: float, order: int) -> float:
    """An order by another solver with more waves, mean of both polarisations."""
    found = [orders_of(row_slabs(level * step, PERIOD / 12, GLASS), WAVE, GLASS, way, 50) for way in POLARISATIONS]
    return float(np.mean([one.transmitted[one.at(order)] for one in found]))


@pytest.mark.study
def test_a_blazed_grating_of_three_waves_gains_by_another_solver():
    """Scalar light rates four levels at sinc²(1/4) = 81 %; of so small a period Maxwell leaves 66 %, 80 % refined."""
    task, step = blazed_task(60), WAVE / (GLASS - 1) / 4
    state = task.initial_state()
    for state, record in task.run(state):  # noqa: B020 - goes on from it
        assert record["step"] == state.step - 1
    before, after = (coupled(cell[0], step, 1) for cell in (task.start, state.best))
    assert before == pytest.approx(0.66, abs=0.01)
    assert after > before + 0.1
    orders = task.solver.transmitted(task.filled(state.best))
    assert task.light(orders, task.solver.number).merit(1.0) == pytest.approx(state.numbers[1], abs=1e-12)
    assert state.numbers[1] == pytest.approx(after, abs=5e-3)


@pytest.mark.slow
def test_a_stopped_refinement_goes_on_with_the_same_numbers():
    task = blazed_task(12, 2)
    whole = [state for state, _ in task.run(task.initial_state())]
    half = whole[5]._replace(step=6)
    again = [state for state, _ in task.run(half)]
    for one, other in zip(again[-1].arrays, whole[-1].arrays, strict=True):
        np.testing.assert_array_equal(one, other)
    assert [array.dtype for array in whole[-1].arrays] == [array.dtype for array in task.template]
    assert [array.shape for array in whole[-1].arrays] == [array.shape for array in task.template]


@pytest.mark.slow
def test_two_levels_keep_to_the_widths_on_the_way():
    strokes = Strokes(2, 3, False)
    task = blazed_task(16, 2, strokes)
    state = task.initial_state()
    for state, _ in task.run(state):  # noqa: B020 - goes on from it
        assert strokes.follows(state.cell > 0)
        assert strokes.follows(state.best > 0)
    assert state.numbers[1] > task.light(task.solver.transmitted(task.filled(task.first)), task.solver.number).merit(
        1.0
    )


def test_slabs_are_filled_from_the_glass_up():
    task = blazed_task(3)
    filled = task.filled(np.array([[0, 1, 2, 3] * 3], np.uint8))
    np.testing.assert_array_equal(filled[:, 0, :4], [[0, 0, 0, 1], [0, 0, 1, 1], [0, 1, 1, 1]])


def test_levels_in_any_order_have_ranks():
    levels = Levels(4, 300e-9, (500e-9, 200e-9))
    order, rank = ranks(levels)
    np.testing.assert_array_equal(levels.heights_m()[order], levels.by_height()[1])
    np.testing.assert_array_equal(order[rank], np.arange(4))


def test_orders_are_found_by_their_numbers():
    spots = Spots(np.zeros((2, 2)), np.ones(2) / 2, np.array([[0, -1], [1, 0]]), (1.0, 1.0))
    np.testing.assert_array_equal(places_of(spots, np.array([[1, 0], [0, 0], [0, -1]])), [2, 0])
    with pytest.raises(KeyError):
        places_of(spots, np.array([[0, 0]]))


@pytest.mark.slow
def test_a_run_becomes_another_run(run: Path, tmp_path: Path):
    before = open_design(run, False)
    digest = (run / "manifest.json").read_bytes()
    found = refine(run, tmp_path / "refined", terms=15, steps=12)
    assert (run / "manifest.json").read_bytes() == digest
    assert found.folder == tmp_path / "refined"
    assert found.name == "cell_refined"
    assert {path.name for path in run.iterdir()} <= {path.name for path in (tmp_path / "refined").iterdir()}
    manifest = read_json(tmp_path / "refined" / "manifest.json")
    assert manifest["refined"] == {
        "run": "cell", "level_map_sha256": before.level_map.digest, "terms": 15, "steps": 12,
        "polarisation": "unpolarised",
    }  # fmt: skip
    level = found.level_map.level
    np.testing.assert_array_equal(level, np.tile(level[:1, :8], (48, 6)))
    with (tmp_path / "refined" / "refinement.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["cell"], row["terms"]) for row in rows] == [
        (cell, terms) for cell in ("before", "refined") for terms in ("0", "15", "23")
    ]
    metrics = json.loads((tmp_path / "refined" / "metrics.json").read_text())
    assert [row["on_target"] for row in metrics["refinement"]] == pytest.approx([float(r["on_target"]) for r in rows])
    # Of the same thin element as in the table of orders.
    assert float(rows[3]["on_target"]) == pytest.approx(metrics["orders"]["on_target"], rel=1e-4)
    zeroth = metrics["orders"]["zeroth_order_efficiency"]
    assert float(rows[3]["zeroth_order_efficiency"]) == pytest.approx(zeroth, rel=1e-3, abs=1e-6)
    merits = [float(row["on_target"]) - float(row["uniformity_error"]) for row in rows]
    assert merits[4] >= merits[1]
    assert merits[5] == pytest.approx(merits[4], abs=0.03)
    # A second call has nothing to do, and the folder is not that of other terms.
    refine(run, tmp_path / "refined", terms=15, steps=12)
    with pytest.raises(InputError, match="must belong to this spec"):
        refine(run, tmp_path / "refined", terms=17, steps=12)


@pytest.mark.slow
def test_a_killed_refinement_is_resumed(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = refine(run, tmp_path / "whole", terms=15, steps=6)
    save, saved = refinement.save_checkpoint, []

    def stop(*given: object) -> None:
        save(*given)  # type: ignore[arg-type]
        saved.append(given)
        if len(saved) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(refinement, "save_checkpoint", stop)
    with pytest.raises(KeyboardInterrupt):
        refine(run, tmp_path / "halves", terms=15, steps=6)
    monkeypatch.setattr(refinement, "save_checkpoint", save)
    halves = refine(run, tmp_path / "halves", terms=15, steps=6)
    assert halves.level_map.digest == whole.level_map.digest
    for name in ("manifest.json", "history.jsonl", "level_map.npz", "refinement.csv"):
        assert (tmp_path / "halves" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert load_checkpoint(open_run(tmp_path / "halves"), []) is None


REFUSED: dict[str, tuple[dict[str, int], str]] = {
    "terms": ({"terms": 8}, "terms: must lie from 9 to"),
    "orders": ({"terms": 100_000}, "100000 for a cell of 1 x 8, 300 nm wide"),
    "steps": ({"steps": 0}, "steps: must lie from 1"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_numbers_beyond_their_limits_are_refused(name: str, run: Path, tmp_path: Path):
    options, words = REFUSED[name]
    with pytest.raises(InputError, match=words):
        refine(run, tmp_path / "refined", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "refined").exists()


def test_the_folder_of_the_run_is_refused(run: Path):
    with pytest.raises(InputError, match="needs a folder of its own"):
        refine(run, run, steps=1)


def test_what_has_no_cell_for_one_wavelength_is_refused(run: Path, monkeypatch: pytest.MonkeyPatch):
    design = open_design(run, False)
    camera, spec = design.camera, design.spec
    assert spec is not None
    two = replace(camera, colours=(*camera.colours, Colour("green", (532e-9,), (1.0,))))
    tilted = replace(camera, beam=GaussianBeam((5e-6, 5e-6), tilt_rad=(0.0, 0.1)))
    level_map = design.level_map
    given = spec.model_copy(
        update={"spots": spec.spots and spec.spots.model_copy(update={"phases_rad": (0.0, 1.0, 0.0)})}
    )
    small = LevelMap(level_map.level, level_map.levels, level_map.grid, 1.2e-6)
    for other, words in (
        (replace(design, spec=spec.model_copy(update={"spots": None})), "only the unit cell of a grid of orders"),
        (replace(design, spec=given), "refined for their light alone, but got phases that are given"),
        (replace(design, aim=level_map), "for the depths that come out, but got etches that make up for a process"),
        (replace(design, camera=two), "for one wavelength, but got 532 nm, 633 nm"),
        (replace(design, camera=tilted), "normal incidence, but got 0, 5.73 degrees along y and x"),
        (replace(design, level_map=small), "must hold a whole period of 2.4 um"),
    ):
        monkeypatch.setattr(refinement, "open_design", lambda *_, other=other: other)
        with pytest.raises(InputError, match=words):
            refine(run)


def test_too_large_a_cell_is_told_how_large_it_may_be(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(refinement, "_MOST_BYTES", 2 * 10**6)
    with pytest.raises(InputError, match=r"Refine a cell of [0-9.]+ nm at most"):
        refine(run, tmp_path / "refined")


@pytest.mark.study
def test_a_binary_grid_from_its_spec_to_its_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Through the command; what is drawn obeys the process, and light gained by more terms than it was refined with."""
    monkeypatch.chdir(tmp_path)
    narrow = 'process.minimum_line="500 nm"', 'process.minimum_space="500 nm"'
    two = "process.levels=2", "process.level_step=692 nm", "spots.count=[2, 2]", "doe.aperture=14.4 um"
    options = [word for change in (*two, *narrow) for word in ("--set", change)]
    assert call("optimize", SPEC, *options)[0] == 0
    code, out, err = call("refine", "runs/cell", "--terms", 60, "--steps", 24)
    assert (code, out.strip()) == (0, str(Path("runs") / "cell_refined")), err
    found = open_design("runs/cell_refined", False)
    assert check(found.level_map, Rules(500e-9, 500e-9)).clean
    rows = json.loads(Path("runs/cell_refined/metrics.json").read_text())["refinement"]
    merits = {(row["cell"], row["terms"]): row["on_target"] - row["uniformity_error"] for row in rows}
    terms = sorted({row["terms"] for row in rows})
    assert len(terms) == 3
    for count in terms[1:]:
        assert merits["refined", count] > merits["printable", count] + 0.02
    order = write_masks("runs/cell_refined")
    assert verify(order.folder).passed
    assert call("certify", "runs/cell_refined", "--pieces", "0", "--cells", "8")[0] == 0
    assert isinstance(found, Design)
    assert load_spec("runs/cell_refined/spec.toml").name == "cell_refined"
