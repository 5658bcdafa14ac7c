"""`doedesign precompensate`: from a process with known errors to a run whose plate comes out as it was designed."""

import csv
from pathlib import Path

import numpy as np
import pytest

import doedesign.optimization
import doedesign.precompensation as precompensation
from doedesign.optimization import optimize
from doedesign.precompensation import precompensate
from doedesign.prediction import predict
from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec
from fab.errors import InputError
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.process import Normal, Process, Variation
from sim.psf_bank import psf
from tests.doedesign.small_runs import SPEC, call, finished_run
from tests.doedesign.test_areas import SPEC as AREA
from tests.doedesign.test_focus import SMALL as FOCUS
from tests.doedesign.test_spots_run import SPEC as SPOTS
from tests.pictures import leave_out_pictures, leave_out_pictures_of_orders

# As far off as etches stopped by time and resist exposed too long are, and two masks that lie off.
ESTIMATE = """
[process]
levels = 4
level_step = "300 nm"

[process.errors]
common_depth_scale = { mean = 0.04, sigma = 0.001 }
depth_scale = { mean = [-0.02, 0.01], sigma = 0.001 }
common_cd_bias = { mean = "150 nm", sigma = "5 nm" }
cd_bias = { mean = ["-20 nm", "50 nm"], sigma = "5 nm" }
"""
OVERLAY = 'overlay_x = { mean = ["0 nm", "300 nm"], sigma = "20 nm" }\n'
WALLS = 'sidewall = { mean = "12 deg", sigma = "1 deg" }\n'
DEEP = 1.04 * np.array([0.98, 1.01]) - 1
WIDE_NM = np.array([130.0, 200.0])
WITHOUT_OBJECTIVE = SPEC.replace('[[objective]]\nname = "far_spot"\n', "")


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_pictures(monkeypatch, doedesign.optimization)
    leave_out_pictures_of_orders(monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("small"), WITHOUT_OBJECTIVE)


@pytest.fixture
def estimate(tmp_path: Path) -> Path:
    path = tmp_path / "estimate.toml"
    path.write_text(ESTIMATE)
    return path


def table(run: Path, name: str = "precompensation.csv") -> list[dict[str, str]]:
    with open(run / name) as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def made(run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The new run, and what the command said."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "estimate.toml").write_text(ESTIMATE)
    asked = ("precompensate", run, "--process", folder / "estimate.toml", "--evaluations", 12, "--out", folder / "run")
    with pytest.MonkeyPatch.context() as patch:
        leave_out_pictures(patch, doedesign.optimization)
        code, said, words = call(*asked)
    assert code == 0, words
    assert said == f"{folder / 'run'}\n"
    return folder / "run", words


def test_depths_and_widths_are_undone(made: tuple[Path, str]):
    folder, words = made
    said = "mask 1: 300 nm designed, 294.3 commanded, 300 expected; edges drawn 130 nm further in, expected 0 nm out"
    assert said in words
    # Undone exactly, but for the tenth of a nanometre of a recipe; edges lie on whole database units.
    for row, designed, deep, wide in zip(table(folder), (300.0, 600.0), DEEP, WIDE_NM, strict=True):
        assert float(row["designed_nm"]) == designed
        assert float(row["commanded_nm"]) == pytest.approx(designed / (1 + deep), abs=0.051)
        assert float(row["expected_nm"]) == pytest.approx(designed, abs=0.06)
        assert float(row["edge_move_nm"]) == pytest.approx(-wide, abs=1e-6)
        assert float(row["expected_edge_nm"]) == pytest.approx(0.0, abs=1e-6)


def test_the_plate_comes_out_as_designed(run: Path, made: tuple[Path, str], estimate: Path):
    design, new = open_design(run, False), open_design(made[0], False)
    wanted = psf(design, depths=design.depths_m).energy
    plain = psf(design.fabricated(estimate), depths=design.depths_m).energy
    found = psf(new.fabricated(), depths=new.depths_m).energy
    # A tenth of a nanometre is 1e-4 of a wave, and changes light by some 1e-3 of its peak at the most.
    assert np.abs(found - wanted).max() < 2e-3 * wanted.max()
    assert np.abs(plain - wanted).max() > 0.02 * wanted.max()
    assert np.array_equal(new.level_map.level, design.level_map.level)
    assert new.aim is not None
    assert new.aim.levels == design.levels != new.levels
    # The Strehl ratio is against what should come out, not against what is commanded.
    light = {(row["depth_m"], row["quantity"]): row for row in table(made[0], "precompensation_light.csv")}
    assert float(light["", "strehl"]["compensated"]) == pytest.approx(1.0, abs=2e-3)
    assert float(light["", "strehl"]["without"]) < 0.99


@pytest.mark.slow
def test_masks_predictions_and_studies_take_the_new_run(made: tuple[Path, str], tmp_path: Path):
    folder, order = made[0], tmp_path / "order"
    code, _, words = call("masks", folder, "--out", order)
    assert code == 0, words
    manifest = read_manifest(order)
    assert [mask.edge_move_nm for mask in manifest.masks] == [-130.0, -200.0]
    assert [mask.depth_nm for mask in manifest.masks] == [float(row["commanded_nm"]) for row in table(folder)]
    assert call("verify", order)[0] == 0
    by_masks, own = open_design(folder, order), open_design(folder, False)
    assert by_masks.edge_moves_m == pytest.approx(own.edge_moves_m)
    seen, known = by_masks.process().expected(), own.process().expected()
    assert seen.cd_bias_m == pytest.approx(known.cd_bias_m, abs=1e-15)  # lengths of the manifest are nanometres
    assert seen.depth_scale == known.depth_scale
    draws = ("--draws", 2, "--sensitivity", "none", "--workers", 1, "--out", tmp_path / "study")
    code, _, words = call("tolerance", folder, "--limit", "strehl >= 0.9", *draws)
    assert code == 0, words
    assert "yield 100.0 %" in words


def test_depths_are_undone_where_the_doe_lies_on_the_wafer(run: Path):
    """A mean bowl of 4 % etches 2.56 % too deep at 40 of 50 mm: so much less is commanded, and the design expected."""
    design = open_design(run, False)
    spreads = {"radial_nonuniformity": Normal(0.04), "common_depth_scale": Normal(0.01)}
    process = Process(design.levels, spreads=spreads, die_m=(40e-3, 0.0), wafer_radius_m=50e-3)
    task = precompensation._Task(design, process, lambda _: 0.0)
    commands = task.search(0)
    for row, depth_m in zip(task.mask_rows(commands), design.levels.depths_m, strict=True):
        designed = depth_m / 1e-9
        # Within the tenth of a nanometre of a recipe.
        assert row.commanded_nm == pytest.approx(designed / (1.01 * 1.0256), abs=0.051)
        assert row.expected_nm == pytest.approx(designed, abs=0.06)
    # And so the light of the plate is the design's.
    wanted = psf(design, depths=design.depths_m).energy
    found = psf(task.plate(commands), depths=design.depths_m).energy
    assert np.abs(found - wanted).max() < 2e-3 * wanted.max()


def test_it_is_made_once(run: Path, made: tuple[Path, str], estimate: Path, monkeypatch: pytest.MonkeyPatch):
    def refused(*_: object) -> None:
        raise AssertionError("searched again")

    monkeypatch.setattr(precompensation._Task, "search", refused)
    before = (made[0] / "manifest.json").read_bytes()
    again = precompensate(run, made[0], process=estimate, evaluations=12)
    assert again.folder == made[0]
    assert (made[0] / "manifest.json").read_bytes() == before
    with pytest.raises(InputError, match="must belong to this pre-compensation"):
        precompensate(run, made[0], process=estimate, evaluations=13)


def test_another_round_aims_at_the_same_plate(run: Path, made: tuple[Path, str], tmp_path: Path):
    """A second wafer that came out 1 % too deep still, and 20 nm too wide, is corrected from where it stands."""
    second = open_design(made[0], False)
    spreads = {"common_depth_scale": Normal(0.01), "common_cd_bias_m": Normal(170e-9)}
    # Relative to the masks and depths of the second wafer, as a calibration of it says.
    process = Process(second.levels, spreads=spreads)
    third = precompensate(made[0], tmp_path / "third", process=process, evaluations=0)
    assert third.name == "small_v3"
    assert third.aim is not None
    assert third.aim.levels == open_design(run, False).levels
    assert third.edge_moves_m == pytest.approx((-170e-9, -170e-9))
    assert third.levels.depths_m == pytest.approx(np.array([300e-9, 600e-9]) / 1.01, abs=0.051e-9)


def test_what_is_drawn_anew_is_that_of_the_own_process(run: Path, tmp_path: Path):
    path = tmp_path / "estimate.toml"
    path.write_text(ESTIMATE + OVERLAY)
    settings = {"process": path, "evaluations": 0}
    kept = precompensate(run, tmp_path / "kept", **settings)
    anew = precompensate(run, tmp_path / "anew", **settings, random=["overlay"])
    assert kept.process().spreads["overlay_x_m[1]"] == Normal(300e-9, 20e-9)
    assert anew.process().spreads["overlay_x_m[1]"] == Normal(0.0, 0.4e-6)
    with pytest.raises(InputError, match="must be an error that a plate has in a definite way"):
        precompensate(run, tmp_path / "else", **settings, random=["dust"])


@pytest.mark.slow
def test_a_search_finds_more_than_undoing_the_means(tmp_path: Path):
    """Walls that lean close openings by half of what they lean: edges and depths are found that make up for it."""
    run, path = finished_run(tmp_path, SPEC), tmp_path / "leaning.toml"
    path.write_text(ESTIMATE + WALLS)
    loss, found = {}, {}
    for evaluations in (0, 60):
        settings = {"process": path, "by": "loss", "evaluations": evaluations}
        found[evaluations] = precompensate(run, tmp_path / f"{evaluations}", **settings)  # type: ignore[arg-type]
        design, process = found[evaluations], found[evaluations].process()
        rows = predict(design, process, process.expected()).rows
        # The objective of the spec is the light that misses the far spot.
        loss[evaluations] = 1 - next(row["far_spot"] for row in rows if "far_spot" in row)
    assert loss[60] < loss[0] - 1e-3
    assert found[60].levels.depths_m != found[0].levels.depths_m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "changes"),
    [(SPOTS, ["optimize.steps=5"]), (AREA, ["optimize.steps=30"]), (FOCUS, ["optimize.steps=30"])],
    ids=["spots", "area", "focus"],
)
def test_spots_areas_and_foci_judge_a_plate(text: str, changes: list[str], tmp_path: Path):
    """The plate as drawn is better than one with etches too deep, which is better than with twice as much."""
    (tmp_path / "aimed.toml").write_text(text)
    design = optimize(load_spec(tmp_path / "aimed.toml", changes))
    loss, process = precompensation._loss_of(design, ()), Process(design.levels)
    plates = [design.fabricated(process, variation=Variation(common_depth_scale=deep)) for deep in (0.0, 0.1, 0.2)]
    losses = [loss(plate) for plate in plates]
    assert losses == sorted(losses)
    assert losses[0] < losses[1] - 1e-3
    if text == AREA:  # on a lattice twice as fine as the design's, whose border is a third of the contrast
        assert losses[0] == pytest.approx(design.history[-1]["loss"], rel=2e-3)


def test_phases_that_are_given_count_in_the_loss(tmp_path: Path):
    """Two spots of equal light, and the same half a turn apart, whose light is none of the wave."""
    (tmp_path / "two.toml").write_text(SPOTS)
    two = "optimize.steps=20", "spots.count=[2, 1]"
    own, other = (
        optimize(load_spec(tmp_path / "two.toml", [*two, f'spots.phases=["0 deg", "{turn} deg"]']))
        for turn in (60, 240)
    )
    loss = precompensation._loss_of(own, ())
    # Both designs have come to rest: single precision.
    assert loss(own.fabricated(Process(own.levels))) == pytest.approx(own.history[-1]["loss"], abs=1e-6)
    assert loss(other.fabricated(Process(own.levels))) == pytest.approx(1.0, abs=1e-6)


def test_a_plate_that_was_designed_is_judged_by_its_psfs(tmp_path: Path):
    """Where errors cancel, the least difference from the design is where they are undone, whatever the loss says."""
    run, path = finished_run(tmp_path, SPEC), tmp_path / "estimate.toml"
    path.write_text(ESTIMATE)
    made = precompensate(run, tmp_path / "psfs", process=path, evaluations=20)
    undone = precompensate(run, tmp_path / "undone", process=path, evaluations=0)
    assert made.levels == undone.levels
    assert made.edge_moves_m == undone.edge_moves_m


def test_what_cannot_be_undone_is_said(run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Openings of one cell of 1.85 um close before edges come in by half of it; nine tenths of that are left."""
    design = open_design(run, False)
    process = Process(design.levels, spreads={"common_cd_bias_m": Normal(0.9e-6)})
    made = precompensate(run, tmp_path / "new", process=process, evaluations=0)
    assert "edges of mask 1 should be drawn 900 nm further in, which would close its narrowest" in caplog.text
    assert "edges of mask 2" not in caplog.text
    # In whole database units of 2 nm; openings of the second mask are wider.
    assert made.edge_moves_m == pytest.approx((-832e-9, -900e-9), abs=1e-15)


def test_the_wafer_is_that_of_the_run(tmp_path: Path):
    """A process for another size of wafer takes the run's, or is refused where depths differ over it."""
    run = finished_run(tmp_path, WITHOUT_OBJECTIVE + '[wafer]\ndiameter = "150 mm"\n')
    smaller = ESTIMATE.replace("[process]", '[process]\nwafer_radius = "50 mm"')
    (tmp_path / "estimate.toml").write_text(smaller)
    (tmp_path / "bowl.toml").write_text(smaller + "radial_nonuniformity = 0.02\n")
    precompensate(run, tmp_path / "new", process=tmp_path / "estimate.toml", evaluations=0)
    spec = open_run(tmp_path / "new").spec
    assert (spec.process.wafer_radius_m, spec.wafer.diameter_m) == (0.075, 0.15)
    with pytest.raises(InputError, match="must be for the wafer of the run, of radius 75 mm, where"):
        precompensate(run, tmp_path / "other", process=tmp_path / "bowl.toml", evaluations=0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "must have errors whose means are not 0"),
        ({"process": "stepper", "evaluations": -1}, "must lie from 0 to"),
        ({"process": Process(Levels(4, 200e-9), spreads={"common_depth_scale": Normal(0.1)})}, "must be for 4 levels"),
        ({"process": "no-such.toml"}, "no-such.toml"),
        (
            {"process": Process(Levels(4, 300e-9), spreads={"common_depth_scale": Normal(0.1)}), "by": "loss"},
            "by: a loss must be that of objectives",
        ),
    ],
)
def test_mistakes_are_told(run: Path, tmp_path: Path, settings: dict[str, object], words: str):
    with pytest.raises(InputError, match=words):
        precompensate(run, tmp_path / "new", **settings)  # type: ignore[arg-type]
    assert not (tmp_path / "new").exists()


def test_a_folder_of_something_else_is_refused_before_the_search(
    run: Path, estimate: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def searched(*_: object) -> None:
        raise AssertionError("searched before the folder was looked at")

    monkeypatch.setattr(precompensation._Task, "search", searched)
    with pytest.raises(InputError, match="needs a folder of its own"):
        precompensate(run, run, process=estimate)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    with pytest.raises(InputError, match="other content"):
        precompensate(run, tmp_path / "full", process=estimate, evaluations=0)
    with pytest.raises(InputError, match="a run needs a folder, but got a file"):
        precompensate(run, estimate, process=estimate, evaluations=0)


def test_a_name_that_would_be_too_long_is_refused_before_the_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delattr(precompensation._Task, "search")
    run = finished_run(tmp_path, WITHOUT_OBJECTIVE.replace("small", "n" * 62))
    (tmp_path / "estimate.toml").write_text(ESTIMATE)
    with pytest.raises(InputError, match="must have 64 letters at most"):
        precompensate(run, tmp_path / "new", process=tmp_path / "estimate.toml")


def test_edges_are_given_by_mask_or_by_the_process(tmp_path: Path):
    path = tmp_path / "spec.toml"
    for text, words in (
        ('edge_moves = ["10 nm"]', "must have one entry per mask, 2 for 4 levels"),
        ('edge_moves = ["10 nm", "20 nm"]\ncompensate = true', "or against the bias of the process"),
        ('edge_moves = ["10 nm", "20 mm"]', "must lie between"),
    ):
        path.write_text(f"{SPEC}\n[wafer]\n{text}\n")
        with pytest.raises(InputError, match=words):
            load_spec(path)
    path.write_text(f'{SPEC}\n[wafer]\nedge_moves = ["-10 nm", "20 nm"]\n')
    assert load_spec(path).wafer.edge_moves_m == (-10e-9, 20e-9)
