"""Results at a glance: what a folder holds, its state, its main numbers, and several side by side."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from doedesign.cli import app
from doedesign.cli.closing import closing_lines
from doedesign.overview.comparing import compare_results
from doedesign.overview.kinds import record_of
from doedesign.overview.listing import Entry, list_results
from doedesign.overview.numbers import MainNumber, main_numbers, number_text
from doedesign.overview.pictures import shown_of
from doedesign.runs.costs import Cost
from fab.archive import write_archive
from fab.errors import InputError
from fab.files import canonical_json, sha256_file
from tests.doedesign.small_runs import SPEC, call

MASKS = Path(__file__).parents[2] / "masks"
RELEASED = MASKS / "automotive-2400"


def written(folder: Path, *, state: str = "done", spec: str = SPEC, name: str = "small", order: float = 0.1) -> Path:
    """A run as `optimize` leaves it, with metrics of its own."""
    folder.mkdir(parents=True)
    (folder / "spec.toml").write_text(spec)
    rows = [
        {"throughput": 0.8, "zeroth_order": order, "concentration": 0.11, "concentration_bound": 0.1},
        {"throughput": 0.9, "zeroth_order": order, "far_spot": 0.25},
    ]
    (folder / "metrics.json").write_bytes(canonical_json({"psf": rows}))
    (folder / "psf.png").write_bytes(b"picture")
    digests = {one.name: sha256_file(one) for one in sorted(folder.iterdir())} if state == "done" else {}
    record = {"format": "doedesign run 1", "name": name, "state": state, "results_sha256": digests}
    (folder / "manifest.json").write_bytes(canonical_json(record))
    return folder


def with_metrics(folder: Path, metrics: object) -> Path:
    """The run with other metrics, which its manifest knows of."""
    (folder / "metrics.json").write_bytes(canonical_json(metrics))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["results_sha256"]["metrics.json"] = sha256_file(folder / "metrics.json")
    (folder / "manifest.json").write_bytes(canonical_json(manifest))
    return folder


def numbers_of(folder: Path) -> dict[str, float | None]:
    return {one.key: one.value for one in main_numbers(folder, record_of(folder))}


def by_name(entries: tuple[Entry, ...]) -> dict[str, Entry]:
    return {entry.path.name: entry for entry in entries}


def test_the_main_numbers_of_a_run_are_means_of_its_metrics(tmp_path: Path):
    assert numbers_of(written(tmp_path / "a")) == {
        "far_spot": pytest.approx(25.0),
        "concentration_over_bound": pytest.approx(1.1),
        "throughput": pytest.approx(85.0),
        "zeroth_order": pytest.approx(10.0),
    }


def test_the_main_numbers_of_a_released_design_are_those_that_the_readme_tells():
    found = numbers_of(RELEASED)
    # "0.300 to 0.310 of red, green and blue in its spot", "80 % of the light in the window"
    assert 30.0 < (found["far_spot"] or 0) < 31.0
    assert found["throughput"] == pytest.approx(80.0, abs=1.0)


def test_released_folders_are_found_and_whole():
    found = by_name(list_results([MASKS]))
    released = {
        "automotive-2400": ("run", "done"),
        "automotive-robust-2400": ("run", "done"),
        "dslr-2800": ("run", "done"),
        "example": ("order", "done"),
        "released": ("released model", "done"),
        "released-raindrop": ("released model", "done"),
        "released-fence": ("released model", "done"),
        "released-all": ("released model", "done"),
    }
    # Beside them lie orders of whoever drew some, such as `make demo`.
    assert {name: (one.kind, one.state) for name, one in found.items() if name in released} == released
    assert {one.kind for name, one in found.items() if name not in released} <= {"order"}
    assert {one.key: one.value for one in found["example"].numbers}["masks"] == 4
    held = json.loads((MASKS / "released" / "manifest.json").read_text())["held_out"]["reconstruction"]
    assert {one.key: one.value for one in found["released"].numbers}["psnr_full"] == held["full"]["psnr"]


def test_states_of_folders(tmp_path: Path):
    written(tmp_path / "whole")
    stopped = written(tmp_path / "stopped", state="running", spec=SPEC.replace("steps = 0", "steps = 40"))
    write_archive(stopped / "checkpoint.npz", {"step": 17}, {})
    torn = written(tmp_path / "torn")
    (torn / "psf.png").write_bytes(b"another")
    lost = written(tmp_path / "lost")
    (lost / "psf.png").unlink()
    (written(tmp_path / "cut") / "manifest.json").write_text('{"format": "doedesign run 1"')
    (written(tmp_path / "later") / "manifest.json").write_text('{"format": "another program"}')
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").touch()
    (tmp_path / "empty").mkdir()
    found = by_name(list_results([tmp_path]))
    told = {name: (one.state, one.about) for name, one in found.items()}
    assert told["whole"] == ("done", "")
    assert told["stopped"] == ("stopped", "at step 17 of 40")
    assert told["foreign"] == ("not ours", "no manifest.json")
    assert "empty" not in told
    for name, words in {
        "torn": "psf.png: must be the file that was written",
        "lost": "psf.png: must be there",
        "cut": "manifest.json: the file must be JSON",
        "later": "manifest.json: must be the manifest of results of this program",
    }.items():
        state, about = told[name]
        assert state == "damaged", name
        assert about.startswith(words)
        assert str(tmp_path) not in about  # which stands beside it


def test_records_of_another_form_stop_no_list(tmp_path: Path):
    """Manifests, tables and numbers that were edited: an entry says which file, or has no numbers; none is lost."""
    written(tmp_path / "whole")
    for name, record in {
        "flat": {"format": "doedesign run 1", "results_sha256": True},
        "long": {"format": "doedesign run 1", "results_sha256": {"a" * 300: "0"}},
        "order_flat": {"format": "doedesign mask order 2", "files": True},
        "order_odd": {"format": "doedesign mask order 2", "files": [{"file": [], "sha256": "0"}]},
        "order_masks": {"format": "doedesign mask order 2", "files": [], "masks": [], "levels": "many"},
        "trained": {"format": "doedesign training 1", "state": "running", "options": "none"},
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").write_bytes(canonical_json(record))
    with_metrics(written(tmp_path / "beyond"), {"psf": [{"throughput": 1e308, "zeroth_order": 0.1}]})
    study = tmp_path / "study"
    study.mkdir()
    (study / "study.json").write_bytes(canonical_json({"format": "doedesign evaluation 1"}))
    (study / "table.json").write_text('{"rows": [')
    entries = list_results([tmp_path])
    found = by_name(entries)
    assert {name: one.state for name, one in found.items()} == {
        **dict.fromkeys(("whole", "order_masks", "beyond"), "done"),
        **dict.fromkeys(("flat", "long", "order_flat", "order_odd", "study"), "damaged"),
        "trained": "stopped",
    }
    assert found["flat"].about.startswith("manifest.json: results_sha256: must list files with their digests")
    assert found["order_flat"].about.startswith("manifest.json: files: must list files with their digests")
    assert found["study"].about.startswith("table.json: the file must be JSON")
    assert [len(found[name].numbers) for name in ("order_masks", "beyond")] == [0, 0]
    code, said, told = call("runs", tmp_path)
    assert (code, told) == (0, "")
    assert len(said.splitlines()) == 1 + len(entries)


def test_a_folder_that_must_not_be_read_is_listed_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    written(tmp_path / "run")
    closed = tmp_path / "closed"
    closed.mkdir()
    look = Path.iterdir

    def refused(self: Path):  # whoever runs the tests may be allowed everything
        if self == closed:
            raise PermissionError(13, "Permission denied", str(self))
        return look(self)

    monkeypatch.setattr(Path, "iterdir", refused)
    found = by_name(list_results([tmp_path]))
    assert {name: one.state for name, one in found.items()} == {"run": "done", "closed": "damaged"}
    assert "Permission denied" in found["closed"].about


@pytest.mark.parametrize(
    ("design", "name"),
    [("small", "small"), ({"name": "small", "shape": [8, 8]}, "small"), ({}, "study"), (None, "study")],
)
def test_a_study_has_the_name_of_its_design(tmp_path: Path, design: object, name: str):
    """Studies of plates tell more of it than its name."""
    study = tmp_path / "study"
    study.mkdir()
    (study / "study.json").write_bytes(canonical_json({"format": "doedesign tolerance draws 1", "design": design}))
    assert record_of(study).name == name


def test_results_inside_a_run_are_listed_under_it(tmp_path: Path):
    run = written(tmp_path / "run")
    inside = run / "tolerance"
    inside.mkdir()
    rows = [{"quantity": "strehl", "mean": mean} for mean in (0.8, 0.9)]
    plates = {"count": 7, "yield": {"share": 0.5, "limits": []}, "statistics": rows}
    (inside / "results.json").write_bytes(canonical_json({"plates": plates}))
    digests = {"results.json": sha256_file(inside / "results.json")}
    record = {"format": "doedesign tolerance 1", "run": "small", "results_sha256": digests}
    (inside / "manifest.json").write_bytes(canonical_json(record))
    study = run / "evaluation" / "table2-dirt-paper"
    study.mkdir(parents=True)
    (study / "study.json").write_bytes(canonical_json({"format": "doedesign evaluation 1", "design": "small"}))
    (study / "scores.jsonl").write_text("{}\n{}\n{")
    first, *rest = list_results([run])
    assert (first.path, first.depth) == (run, 0)
    assert [(one.kind, one.depth, one.state, one.about) for one in rest] == [
        ("evaluation", 1, "stopped", "after 2 finished parts"),
        ("tolerance", 1, "done", ""),
    ]
    assert {one.key: one.value for one in rest[1].numbers} == {
        "yield": 50.0,
        "strehl": pytest.approx(0.85),
        "plates": 7,
    }
    # Nothing is counted twice.
    assert first.size_bytes < sum(path.stat().st_size for path in run.rglob("*") if path.is_file())


@pytest.mark.parametrize(
    ("means", "told"),
    [
        ({"strehl": 0.9, "zeroth_order": 0.1}, ["strehl", "zeroth_order"]),
        ({"zeroth_order": 0.1, "on_target": 0.8, "strehl": 0.9}, ["on_target", "zeroth_order"]),
        (
            {"strehl": 0.9, "on_target": 0.8, "uniformity_error": 0.2, "zeroth_order": 0.1},
            ["uniformity_error", "on_target", "zeroth_order"],
        ),
    ],
)
def test_plates_are_told_by_what_their_design_is_for(tmp_path: Path, means: dict[str, float], told: list[str]):
    run = written(tmp_path / "run")
    inside = run / "tolerance"
    inside.mkdir()
    rows = [{"quantity": name, "mean": mean} for name, mean in means.items()]
    (inside / "results.json").write_bytes(canonical_json({"plates": {"count": 7, "statistics": rows}}))
    digests = {"results.json": sha256_file(inside / "results.json")}
    record = {"format": "doedesign tolerance 1", "run": "small", "results_sha256": digests}
    (inside / "manifest.json").write_bytes(canonical_json(record))
    (_, study) = list_results([run])
    assert [one.key for one in study.numbers] == [*told, "plates"]


def test_the_list_as_a_table_and_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert call("runs")[0] == 0  # nothing there is no mistake
    written(Path("runs") / "a")
    hidden = written(Path("runs") / "b")
    (hidden / "manifest.json").write_text('{"format": "doedesign run 1", "name": "\\u001b[2J", "state": "done"}')
    code, out, _ = call("runs")
    assert code == 0
    head, *lines = out.splitlines()
    assert head.split("\t")[:3] == ["folder", "kind", "state"]
    assert [line.split("\t")[0] for line in lines] == ["runs/a", "runs/b"]
    assert "far spot 25.0 %" in lines[0]
    code, out, _ = call("runs", "--json")
    listed = json.loads(out)["results"]
    assert [one["path"] for one in listed] == ["runs/a", "runs/b"]
    assert listed[0]["numbers"]["far_spot"] == {"value": 25.0, "unit": "%", "label": "far spot"}
    assert "\x1b" not in out
    code, _, said = call("runs", "nowhere")
    assert code == 2
    assert "nowhere: must be a folder" in said


def test_two_runs_side_by_side(tmp_path: Path):
    first = written(tmp_path / "a", order=0.1)
    second = written(tmp_path / "b", order=0.2, spec=SPEC.replace('level_step = "300 nm"', 'level_step = "310 nm"'))
    metrics = json.loads((second / "metrics.json").read_text())
    metrics["psf"][1]["far_spot"] = 0.3
    with_metrics(second, metrics)
    found = compare_results([first, second])
    numbers = {one.key: one for one in found.numbers}
    assert numbers["far_spot"].best == 1
    assert numbers["far_spot"].differences == (0.0, pytest.approx(5.0))
    assert numbers["throughput"].best is None  # both the same
    assert numbers["zeroth_order"].best is None  # nobody knows which is better
    assert [(one.key, one.values) for one in found.keys] == [("process.level_step", ('"300 nm"', '"310 nm"'))]
    code, out, _ = call("compare", first, second)
    assert code == 0
    row = next(line.split("\t") for line in out.splitlines() if line.startswith("far spot"))
    assert row == ["far spot", "25.0 %", "30.0 % (+5.0 points) *"]
    assert json.loads(call("compare", first, second, "--json")[1])["spec"][0]["key"] == "process.level_step"


def test_a_table_that_one_spec_lacks_is_one_difference(tmp_path: Path):
    fewer = SPEC.replace('[[limit]]\nquantity = "strehl"\nmin = 0.9\n', "")
    found = compare_results([written(tmp_path / "a"), written(tmp_path / "b", spec=fewer)])
    assert [(one.key, one.values) for one in found.keys] == [("limit[0]", ("there", None))]  # counted as by `--set`


def test_damaged_results_are_not_compared(tmp_path: Path):
    first, second = (written(tmp_path / name) for name in "ab")
    manifest = json.loads((second / "manifest.json").read_text())
    manifest["results_sha256"] = {"metrics.json": "0" * 64}
    (second / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"metrics\.json: must be the file that was written"):
        compare_results([first, second])


def test_what_cannot_be_compared_is_said(tmp_path: Path):
    run = written(tmp_path / "a")
    unfinished = written(tmp_path / "b", state="running")
    with pytest.raises(InputError, match="two or more"):
        compare_results([run])
    with pytest.raises(InputError, match="must hold the same as"):
        compare_results([run, MASKS / "example"])
    with pytest.raises(InputError, match="must be finished"):
        compare_results([run, unfinished])
    assert call("compare", run, tmp_path / "none")[0] == 2


COST = Cost(("optimize",), 75.0, 140.0, 1 << 30, 0, "bench", 2, "2026-01-01T00:00:00+00:00")


def test_the_last_lines_of_a_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    run = written(Path("runs") / "small name")
    lines = closing_lines(run, cost=COST)
    assert lines == [
        "result: far spot 25.0 %, near light's concentration over its bound 1.100, light in the window 85.0 %",
        "look at: runs/small name/psf.png",
        "took: 75 s (2 min of processor time), 1.0 GiB of memory, on bench",
        "next: doedesign masks 'runs/small name'",
    ]
    # Something else lies where its order would go; orders of its own are in `test_orders`.
    shutil.copytree(MASKS / "example", Path("masks") / "small")
    assert closing_lines(run)[-1] == "next: doedesign masks 'runs/small name' --out 'masks/small name'"
    assert closing_lines(tmp_path / "nothing") == []


@pytest.mark.parametrize("name", ["automotive-2400", "example", "released"])
def test_the_next_command_is_one(name: str):
    line = closing_lines(MASKS / name)[-1]
    assert line.startswith("next: doedesign ")
    app.parse_args(line.removeprefix("next: doedesign ").split(), exit_on_error=False, print_error=False)


def test_files_of_an_order_to_look_at():
    shown = shown_of(MASKS / "example", record_of(MASKS / "example"))
    assert shown.pictures[0].name.endswith("_RULES.png")
    assert [path.name.rpartition("_")[2] for path in shown.layout] == ["ALL.oas", "LAYERS.lyp"]
    assert len(shown.pages) == 2


@pytest.mark.parametrize(
    "record",
    [
        "{}",
        '{"psf": 3}',
        '{"psf": []}',
        '{"psf": [{"far_spot": "much"}]}',
        '{"orders": {"on_target": null}}',
        "[1]",
        "",
    ],
)
def test_metrics_that_say_nothing_give_no_number_and_no_traceback(tmp_path: Path, record: str):
    run = written(tmp_path / "a")
    (run / "metrics.json").write_text(record)
    found = main_numbers(run, record_of(run))
    assert all(isinstance(one, MainNumber) for one in found)
    code, out, said = call("runs", tmp_path)
    assert code == 0
    assert "damaged: metrics.json" in out
    assert said == ""


def test_a_copy_elsewhere_is_as_good(tmp_path: Path):
    shutil.copytree(MASKS / "example", tmp_path / "orders" / "copy")
    (entry,) = list_results([tmp_path])
    assert (entry.kind, entry.state) == ("order", "done")


def test_broken_rules_are_counted_in_places(tmp_path: Path):
    lines = closing_lines(MASKS / "example")
    assert lines[0] == "result: 4 masks, 16 levels, 1587 places that break rules (touching corners on 4 masks)"
    assert lines[1].startswith("look at: ")
    assert lines[1].endswith("_RULES.png")
    manifest = json.loads((MASKS / "example" / "manifest.json").read_text())
    planes = manifest["rules"]["planes"]
    for plane in planes[1:]:
        plane["kissing"] = 0
    planes[0]["kissing"], planes[2]["line"]["narrow"] = 20_000, 3

    def told() -> str:
        (tmp_path / "manifest.json").write_text(json.dumps(manifest))
        return main_numbers(tmp_path, record_of(tmp_path))[-1].text()

    both = "(touching corners on 1 mask, narrow lines on 1 mask)"
    assert told() == f"20 003 places that break rules {both}"
    manifest["rules"]["headlines"] = []  # a process that prints everything
    assert told() == "0 places that break rules"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0.0 %"),
        (1.9e-11, "below 0.0001 %"),
        (0.00013, "0.00013 %"),
        (0.0203, "0.02 %"),
        (0.1234, "0.12 %"),
        (-0.5, "-0.5 %"),
        (0.999, "1.0 %"),
        (3.64, "3.6 %"),
        (91.25, "91.2 %"),
    ],
)
def test_small_percentages_keep_two_digits(value: float, text: str):
    assert number_text(value, "%") == text


def test_a_zeroth_order_within_the_area_is_told_as_that(tmp_path: Path):
    """It is wanted light, so that less of it is not better; of several areas those where it is not wanted count."""

    def area(zeroth: float, wanted: bool) -> dict[str, Any]:
        return {"on_target": 0.9, "contrast": 0.1, "zeroth_order": zeroth, "zeroth_order_wanted": wanted}

    made = {"a": area(0.116, True), "b": area(0.043, True), "c": [area(0.116, True), area(0.02, False)]}
    made["d"] = area(0.03, False)
    folders = {name: with_metrics(written(tmp_path / name), {"area": one}) for name, one in made.items()}
    said = "light on target 90.0 %, contrast of the area 10.0 %, 0th order"
    assert closing_lines(folders["a"])[0] == f"result: {said} 11.6 % (within the area)"
    assert closing_lines(folders["c"])[0] == f"result: {said} 2.0 %"
    assert closing_lines(folders["d"])[0] == f"result: {said} 3.0 %"
    for pair, label, best in (("ab", "0th order (within the area)", None), ("cd", "0th order", 0)):
        (number,) = (n for n in compare_results([folders[k] for k in pair]).numbers if n.key == "zeroth_order")
        assert (number.label, number.best) == (label, best)


def test_a_zeroth_order_that_is_a_spot_is_told_as_one(tmp_path: Path):
    """Beside a run of spots that has none there, the comparison does not say so of both."""
    orders = {"on_target": 0.912, "uniformity_error": 0.0002, "zeroth_order_efficiency": 0.036, "spots": [0.036]}
    folders = []
    for name, wanted in (("a", True), ("b", True), ("c", False)):
        record = {"orders": orders | {"zeroth_order_wanted": wanted}}
        folders.append(with_metrics(written(tmp_path / name), record))
    said = "light on target 91.2 %, uniformity error 0.02 %, 0th order 3.6 %"
    assert closing_lines(folders[0])[0] == f"result: {said} (one of the spots)"
    assert closing_lines(folders[2])[0] == f"result: {said}"
    for others, label in ((folders[:2], "0th order (one of the spots)"), (folders, "0th order")):
        labels = {one.key: one.label for one in compare_results(others).numbers}
        assert labels["zeroth_order_efficiency"] == label
    study = folders[0] / "tolerance"
    study.mkdir()
    plates = {"count": 7, "statistics": [{"quantity": "zeroth_order", "mean": 0.03}]}
    (study / "results.json").write_text(json.dumps({"plates": plates}))
    (study / "manifest.json").write_text(json.dumps({"format": "doedesign tolerance 1", "run": "small"}))
    assert "0th order of plates 3.0 % (one of the spots)" in closing_lines(study)[0]
