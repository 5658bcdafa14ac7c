"""Whose mask order a folder holds: nothing of another design is replaced, and every command finds a run's own."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import doedesign.lab.order as lab
from doedesign.cli import app
from doedesign.cli.closing import closing_lines
from doedesign.report.page.files import open_files
from doedesign.runs import fabricated
from doedesign.runs.level_maps import open_design
from doedesign.runs.orders import is_order_of, order_of_run, own_level_map, require_replaceable
from doedesign.spec.process import ProcessSpec
from fab.errors import InputError
from fab.files import canonical_json
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.request import order_from, request_of
from fab.order.write import write_order
from fab.process import Process
from tests.doedesign.small_runs import SPEC, call, finished_run

ORIGIN = {"kind": "run", "name": "small"}


def order_of(folder: Path, level_map: LevelMap, of: LevelMap | None = None) -> Path:
    """Write an order of a level map that was made from a run with the level map `of`."""
    return write_order(folder, level_map, source=ORIGIN | {"level_map_sha256": (of or level_map).digest}).folder


@pytest.mark.parametrize("probe", ["0 nm", "-520 nm"])
def test_a_probe_has_a_wavelength(tmp_path: Path, probe: str):
    code, _, said = call("masks", tmp_path, f"--probe={probe}")
    assert (code, said.startswith("doedesign: --probe: must be positive, but got ")) == (2, True)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of one name, runs/small and runs/coarse, of four levels and of two, and the order of the first."""
    folder = tmp_path_factory.mktemp("made")
    for name, spec in (("small", SPEC), ("coarse", SPEC.replace("levels = 4", "levels = 2"))):
        (folder / "runs").mkdir(exist_ok=True)
        (folder / name).mkdir()
        finished_run(folder / name, spec).rename(folder / "runs" / name)
    own = own_level_map(folder / "runs" / "small")
    assert own is not None
    order_of(folder / "masks" / "small", own)
    return folder


@pytest.fixture
def work(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the runs, the current folder."""
    shutil.copytree(made, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Where `masks` would write; it writes nothing."""
    found: list[Path] = []

    def written(folder: Path, order: object, predict: object) -> None:
        found.append(folder)
        raise InputError("order", "would be written", str(order), str(predict))

    monkeypatch.setattr(lab, "write_planned", written)
    return found


def level_map_in(run: str) -> LevelMap:
    found = own_level_map(Path("runs") / run)
    assert found is not None
    return found


@pytest.mark.usefixtures("work")
def test_the_order_of_another_design_is_not_replaced(places: list[Path]):
    before = (Path("masks") / "small" / "manifest.json").read_bytes()
    code, _, said = call("masks", "runs/coarse")
    assert (code, places) == (2, [])
    assert "doedesign: masks/small: a mask order must not take the place of another design's" in said
    assert 'the order of the design "small" (4 levels of 300 nm, 48 x 48 pixels of 1.85 um, level map ' in said
    assert "another --out, such as masks/coarse, or give --overwrite to replace that order." in said
    assert (Path("masks") / "small" / "manifest.json").read_bytes() == before
    call("masks", "runs/coarse", "--overwrite")
    call("masks", "runs/coarse", "--out", "masks/coarse")
    assert places == [Path("masks/small"), Path("masks/coarse")]


@pytest.mark.usefixtures("work")
@pytest.mark.parametrize("more", [(), ("--levels", 2), ("--on-violation", "fix")])
def test_the_order_of_the_same_run_is_replaced(places: list[Path], more: tuple[object, ...]):
    call("masks", "runs/small", *more)
    assert places == [Path("masks/small")]


@pytest.mark.usefixtures("work")
def test_what_may_be_replaced():
    own, other = level_map_in("small"), level_map_in("coarse")
    source = ORIGIN | {"level_map_sha256": own.digest}
    require_replaceable(Path("masks") / "none", own, source)
    moved = replace(own, levels=Levels(own.levels.count, own.levels.step_m, (310e-9, 620e-9)))
    repaired = own.with_level(np.roll(own.level, 1, axis=0))
    order_of(Path("repaired"), repaired, own)
    require_replaceable(Path("repaired"), own, source)  # made from the same run
    require_replaceable(Path("masks") / "small", own, {"kind": "height map"})  # of the same map, wherever it is from
    for folder, level_map, origin in (
        ("masks/small", other, ORIGIN | {"level_map_sha256": other.digest}),
        ("masks/small", moved, source),  # pre-compensated: the same levels at other depths
        ("repaired", repaired.with_level(np.roll(own.level, 2, axis=0)), {"kind": "height map", "height_sha256": "0"}),
    ):
        with pytest.raises(InputError, match="must not take the place of another design's"):
            require_replaceable(Path(folder), level_map, origin)


@pytest.mark.usefixtures("work")
def test_the_order_of_a_height_map_may_be_drawn_again_and_is_told_by_its_file(places: list[Path]):
    np.save("map.npy", np.zeros((15, 20)))
    height = {"kind": "height map", "name": "map.npy"}
    with pytest.raises(InputError):
        lab.write_masks("map.npy", levels=4, step_m=1e-7, pitch_m=2e-6)
    order = lab.drawing_from("map.npy", 4, step_m=1e-7, pitch_m=2e-6)
    write_order("masks/map", order.level_map, source=height | dict(order.origin))
    bare = ("--step", "75 nm", "--pitch", "2 um", "--levels", 4)
    call("masks", "map.npy", *bare)
    assert places == [Path("masks/map")] * 2
    np.save("map.npy", np.full((15, 20), 1e-7))
    code, _, said = call("masks", "map.npy", *bare)
    assert (code, len(places)) == (2, 2)
    assert 'the order of the height map "map.npy"' in said


@pytest.mark.usefixtures("work")
def test_plates_for_a_stepper_are_written_where_they_are_asked_for(places: list[Path]):
    code, _, said = call("masks", "runs/small", "--process", "stepper")
    assert (code, places) == (2, [])
    assert "plates at 1:1" in said
    assert "by --one-to-one and" in said
    call("masks", "runs/small", "--process", "stepper", "--one-to-one")
    assert places == [Path("masks/small")]


def test_a_stepper_is_one_whatever_the_levels():
    usual = ProcessSpec(levels=4, level_step_m=300e-9, stock="stepper")
    for levels in (Levels(4, 300e-9), Levels(8, 150e-9)):
        made = lab._process(None, levels, usual)
        assert (made.levels, made.reduction) == (levels, 5)


@pytest.mark.usefixtures("work")
def test_an_order_is_made_of_the_material_of_its_design(tmp_path, monkeypatch):
    planned = []
    monkeypatch.setattr(lab, "write_planned", lambda folder, order, predict: planned.append(order))
    (tmp_path / "made").mkdir()
    finished_run(tmp_path / "made", SPEC.replace('"fused_silica"', '"n_bk7"')).rename(Path("runs") / "bk7")
    lab.write_masks(Path("runs") / "bk7", Path("masks") / "bk7")
    lab.write_masks(Path("runs") / "coarse", Path("masks") / "coarse")
    assert [order.material for order in planned] == ["N-BK7", "fused silica"]
    # The manifest tells it where it is not the usual one, so that earlier manifests are read as before.
    for order, told in zip(planned, (True, False), strict=True):
        request = json.loads(canonical_json(request_of(order)))
        assert ("material" in request) == told
        assert order_from(request, order.level_map.level, "manifest").material == order.material


@pytest.mark.usefixtures("work")
def test_commands_find_the_order_of_a_run_by_the_name_of_its_folder(places: list[Path]):
    run, own = Path("runs") / "coarse", level_map_in("coarse")
    # Nobody asked for that of the other run, which is left aside; who does is told.
    assert open_design(run).level_map.digest == own.digest
    with pytest.raises(InputError, match="masks must be those of this run") as refused:
        open_design(run, "masks/small")
    assert refused.value.cure.endswith("a folder of their own: doedesign masks RUN.")
    assert call("psf", run, "--masks", "masks/small")[2].endswith("their own: doedesign masks RUN --out masks/OTHER.\n")
    assert open_files(run).order is None
    code, _, said = call("show", run, "masks", "--print")
    assert code == 2
    assert "must be the run's mask order, but got that of another design" in said
    assert "doedesign masks runs/coarse --out masks/coarse" in said

    order_of(Path("masks") / "coarse", own)
    assert order_of_run("small", run, own) == Path("masks/coarse")
    assert open_design(run).levels.count == 2
    assert open_files(run).order_folder.name == "coarse"
    code, out, _ = call("show", run, "masks", "--print")
    assert code == 0
    assert all(line.startswith("masks/coarse/") for line in out.splitlines())
    call("masks", run)
    assert places == [Path("masks/coarse")]
    # That of the first run stays where it is looked for first.
    assert order_of_run("small", Path("runs/small"), level_map_in("small")) == Path("masks/small")
    assert is_order_of(Path("masks/small"), level_map_in("small"))


@pytest.mark.usefixtures("work")
def test_the_next_command_is_one_that_works():
    assert closing_lines(Path("runs/small"))[-1] == "next: doedesign tolerance runs/small"
    assert closing_lines(Path("runs/coarse"))[-1] == "next: doedesign masks runs/coarse --out masks/coarse"
    order_of(Path("masks") / "coarse", level_map_in("coarse"))
    assert closing_lines(Path("runs/coarse"))[-1] == "next: doedesign tolerance runs/coarse"
    spec = Path("runs/coarse/spec.toml")
    spec.write_text(re.sub(r"\[process\.errors[^\[]*", "", spec.read_text()))
    assert closing_lines(Path("runs/coarse"))[-1] == "next: doedesign report runs/coarse"


@pytest.mark.usefixtures("work")
@pytest.mark.parametrize(
    ("kind", "word"), [("PSFs", "psf"), ("fabricated", "tolerance"), ("certificate", "masks"), ("explanations", "psf")]
)
def test_without_errors_nothing_of_plates_is_proposed(kind: str, word: str):
    run = Path("runs/small")
    name = {"PSFs": "psf"}.get(kind, kind)
    (run / name).mkdir()
    (run / name / "manifest.json").write_text(f'{{"format": "doedesign {name} 1", "run": "small"}}')
    line = closing_lines(run / name, run)[-1]
    assert line.startswith(f"next: doedesign {word} runs/small")
    app.parse_args(line.removeprefix("next: doedesign ").split(), exit_on_error=False, print_error=False)
    spec = run / "spec.toml"
    spec.write_text(re.sub(r"\[process\.errors[^\[]*", "", spec.read_text()))
    wanted = "masks" if kind == "certificate" else "report"  # the sheet of an order tells the certificate
    assert closing_lines(run / name, run)[-1] == f"next: doedesign {wanted} runs/small"


@pytest.mark.usefixtures("work")
def test_a_run_in_place_of_its_order_is_told():
    code, _, said = call("verify", "runs/small")
    assert code == 2
    assert "runs/small: must be the folder of a mask order, but got a run. Give its order: masks/small." in said
    _, _, said = call("verify", "runs/coarse")
    assert "Draw its order first: doedesign masks runs/coarse --out masks/coarse." in said


@pytest.mark.usefixtures("work")
def test_a_plate_without_errors_is_said_to_be_the_one_drawn(caplog: pytest.LogCaptureFixture):
    design = open_design("runs/small")
    design.plate_errors(design.process("ideal"), seed=0)
    (warning,) = caplog.messages
    assert "the process has no errors, so this plate is the one drawn" in warning
    caplog.clear()
    design.plate_errors(design.process(), seed=0)
    design.plate_errors(design.process("contact_aligner"))
    design.plate_errors(design.process("ideal"), design.process("ideal").expected())
    assert caplog.messages == []


@pytest.mark.usefixtures("work")
def test_the_cure_of_a_plate_without_errors_can_be_typed(monkeypatch: pytest.MonkeyPatch):
    asked: list[str] = []

    def computed(design: object, process: Process, errors: object) -> object:
        asked.append(process.name)
        raise InputError(str(design), "is not computed", errors, "None.")

    monkeypatch.setattr(fabricated, "_computed", computed)
    _, _, said = call("psf", "runs/small", "--fabricated", "--seed", 0, "--process", "ideal")
    assert "warning: the process has no errors, so this plate is the one drawn." in said
    assert 'Write stock = "contact_aligner" in [process], or give --process contact_aligner.' in said
    _, _, said = call("psf", "runs/small", "--fabricated", "--seed", 0, "--process", "contact_aligner")
    assert "warning" not in said
    assert asked == ["ideal", "contact_aligner"]


def test_a_run_that_lies_among_the_orders_is_not_taken_for_one(work: Path):
    """A released model is kept in masks/ and has a manifest of its own, which is that of no order."""
    released = work / "masks" / "coarse"
    shutil.copytree(work / "runs" / "coarse", released)
    (released / "manifest.json").write_text('{"format": "doedesign released model 1"}')
    assert order_of_run("small", released, own_level_map(released)) == Path("masks/small")
    (work / "masks" / "small").rename(work / "masks" / "other")
    assert order_of_run("small", released, own_level_map(released)) == Path("masks/small")
    # Nor for that of the run of the same name that it was released from.
    run = Path("runs/coarse")
    assert order_of_run("small", run, own_level_map(run)) == Path("masks/small")
