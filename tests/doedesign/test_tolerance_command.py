"""`doedesign tolerance` from the command line to its files, with the real prediction on a plate of 48 x 48 cells."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

import doedesign.optimization
import doedesign.tolerancing.result_files
from doedesign.spec import load_variation
from doedesign.tolerancing.results import plain
from doedesign.tolerancing.studies import study
from fab.files import sha256_file
from tests.doedesign.small_runs import SPEC, call, finished_run
from tests.pictures import leave_out_pictures


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    return finished_run(folder, SPEC)


ASKED = ("--draws", 4, "--budget", "overlay", "--yield", 0.6, "--workers", 1)


@pytest.fixture(scope="module")
def asked(run: Path) -> tuple[int, str, str]:
    return call("tolerance", run, *ASKED)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.slow
def test_a_study_writes_tables_pictures_and_what_they_say(run: Path, asked: tuple[int, str, str]):
    code, out, said = asked
    assert code == 0, said
    folder = run / "tolerance"
    assert out.splitlines() == [str(folder), *map(str, sorted(folder.iterdir()))]
    # One line says it all.
    (line,) = (line for line in said.splitlines() if line.startswith("yield "))
    assert " of 4 plates; most important: " in line
    assert "overlay" in line

    results = json.loads((folder / "results.json").read_text())
    keys = {f"normal/{i}" for i in range(4)} | {"nominal", "expected"}
    with open(folder / "draws.csv") as stream:
        lines = list(csv.DictReader(stream))
    assert keys < {line["key"] for line in lines}
    strehls = [
        float(line["strehl"]) for line in lines if line["key"].startswith("normal/") and line["depth_m"] == "inf"
    ]
    good = sum(value >= 0.9 for value in strehls)
    assert results["plates"]["yield"]["good"] == good
    assert results["plates"]["yield"]["limits"][0]["limit"] == "strehl >= 0.9"
    (nominal,) = (row for row in results["nominal"] if row["depth_m"] is None)
    assert nominal["strehl"] == pytest.approx(1, abs=1e-5)  # single precision
    assert {row["quantity"] for row in results["one_at_a_time"]} >= {"strehl", "far_spot", "ring_to_disc"}
    assert sum(results["shares"]["strehl"].values()) == pytest.approx(1)
    assert [found["plates"] for found in results["budget"]["yields"]] == [4] * 7

    with open(folder / "errors.csv") as stream:
        errors = {line["key"]: line for line in csv.DictReader(stream)}
    plate = study(run, quiet=True).variation("normal/2")
    assert [float(errors["normal/2"][f"overlay_x_m[{k}]"]) for k in range(2)] == list(plate.overlay_x_m)
    assert float(errors["budget/overlay/0.5/2"]["overlay_x_m[0]"]) == pytest.approx(plate.overlay_x_m[0] / 2)

    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest["results_sha256"]) == {
        *("draws.csv", "errors.csv", "results.json"),
        *("histograms.png", "yield.png", "one_at_a_time.png", "budget.png", "nominal_psf.png", "worst_psf.png"),
    }
    for name, digest in manifest["results_sha256"].items():
        assert sha256_file(folder / name) == digest


@pytest.mark.slow
def test_the_same_bytes_again_and_from_two_workers(run: Path, asked: tuple[int, str, str], tmp_path: Path):
    first = content(run / "tolerance")
    assert call("tolerance", run, *ASKED)[0] == 0
    assert content(run / "tolerance") == first
    assert call("tolerance", run, *ASKED[:-1], 2, "--out", tmp_path / "two")[0] == 0
    two = content(tmp_path / "two")
    # The journal is in the order in which plates were finished.
    assert sorted(two.pop("draws.jsonl").splitlines()) == sorted(first.pop("draws.jsonl").splitlines())
    assert two == first


@pytest.mark.slow
def test_a_study_grows_and_leaves_no_old_pictures(
    run: Path, asked: tuple[int, str, str], monkeypatch: pytest.MonkeyPatch
):
    files = doedesign.tolerancing.result_files
    leave_out_pictures(monkeypatch, files)
    monkeypatch.setattr(files, "evaluate_here", lambda model, plates, workers: ((key, None) for key in plates))
    before = (run / "tolerance" / "draws.jsonl").read_bytes()
    more = ("--draws", 5, "--sensitivity", "sobol", "--sobol", 2, "--corners", "--json")
    code, out, said = call("tolerance", run, *more)
    assert code == 0, said
    assert json.loads(out)["results"] == str(run / "tolerance" / "results.json")
    after = content(run / "tolerance")
    assert after["draws.jsonl"].startswith(before)
    # One Monte-Carlo plate, two samples of two rows with two sources, eight corners of three errors.
    assert len(after["draws.jsonl"].splitlines()) - len(before.splitlines()) == 1 + 2 * 4 + 8
    assert {"sobol.png", "yield.png"} < set(after)
    assert not {"budget.png", "one_at_a_time.png"} & set(after)
    results = json.loads(after["results.json"])
    assert {share["source"] for share in results["sobol"]} == {"depth", "overlay"}
    assert results["corners"]["count"] == 8
    assert "budget" not in results


@pytest.mark.slow
def test_any_plate_can_be_repeated_alone(run: Path, asked: tuple[int, str, str], tmp_path: Path):
    lines = (run / "tolerance" / "draws.jsonl").read_text().splitlines()
    kept = {json.loads(line)["key"]: json.loads(line)["rows"] for line in lines}
    code, out, said = call("tolerance", run, "--draw", "budget/overlay/0.5/2")
    assert code == 0, said
    (tmp_path / "plate.toml").write_text(out)
    plate = load_variation(tmp_path / "plate.toml")
    assert plate == study(run, quiet=True).variation("budget/overlay/0.5/2")
    assert "# 550nm at 6 mm: zeroth_order" in out
    assert "# 550nm at infinity: zeroth_order" in out
    alone = json.loads(call("tolerance", run, "--draw", "normal/2", "--json")[1])
    assert alone["rows"] == kept["normal/2"]
    assert alone["variation"]["overlay_x_m"] == list(study(run, quiet=True).variation("normal/2").overlay_x_m)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--draws", 0), "--draws: must be at least 1"),
        (("--seed", -1), "seed: must not be negative"),
        (("--sensitivity", "sobol", "--sobol", 3), "sobol: must be a power of two"),
        (("--limit", "beauty >= 1"), "limit: must be a quantity"),
        (("--budget", "rotation"), "budget: must name errors that vary in this process"),
        (("--budget", "overlay", "--yield", 90), "yield: must lie between 0 and 1"),
        (("--workers", 0), "--workers: must be at least 1"),
        (("--draw", "normal/0", "--corners"), "--corners: must be left out with --draw"),
        (("--sobol", 8), "--sobol: must be given with --sensitivity sobol"),
        (("--yield", 0.5), "--yield: must be given with --budget"),
        (("--process", "missing.toml"), "missing.toml"),
        (("--scheduler", "tcp://127.0.0.1:9", "--workers", 2), "a cluster brings its own workers"),
    ],
)
def test_mistakes_are_told_before_anything_is_computed(run: Path, tmp_path: Path, options: tuple, message: str):
    code, out, said = call("tolerance", run, "--out", tmp_path / "out", *options)
    assert (code, out) == (2, "")
    assert message in said
    assert not (tmp_path / "out").exists()


def test_a_single_plate_has_the_key_of_a_draw(run: Path):
    code, out, said = call("tolerance", run, "--draw", "normal")
    assert (code, out) == (2, "")
    assert "must be the key of a plate" in said


def test_a_process_comes_from_a_file(run: Path, tmp_path: Path):
    perfect, other = tmp_path / "perfect.toml", tmp_path / "other.toml"
    perfect.write_text('[process]\nlevels = 4\nlevel_step = "300 nm"\n')
    code, _, said = call("tolerance", run, "--process", perfect)
    assert code == 2
    assert 'stock = "contact_aligner"' in said
    other.write_text('[process]\nlevels = 16\nlevel_step = "75 nm"\nstock = "contact_aligner"\n')
    code, _, said = call("tolerance", run, "--process", other)
    assert code == 2
    assert "must be for" in said
    perfect.write_text(perfect.read_text() + 'stock = "contact_aligner"\n')
    stock = study(run, process=perfect, quiet=True)
    assert {"depth", "overlay", "cd"} < set(stock.sources)
    assert stock.limits[0].min == 0.9
    assert study(run, limits=[], quiet=True).limits == ()


def test_infinite_numbers_have_a_place_in_every_file():
    found = plain({"a": math.inf, "b": [np.nan, 1.0, (2, None)], "c": {"d": -math.inf}})
    assert found == {"a": None, "b": [None, 1.0, [2, None]], "c": {"d": None}}
    assert json.dumps(found, allow_nan=False)
