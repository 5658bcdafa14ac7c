"""Rows of later runs are joined to a table, and a table is drawn anew from its file alone."""

import csv
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "examples" / "results"
sys.path.insert(0, str(ROOT / "examples"))

import joined_tables  # noqa: E402

NAME = "table2-fence-paper.csv"
OTHER = "table2-dirt-radiometric.csv"
CAPTURES = ["capture_fabricated", "robust_capture", "robust_capture_fabricated"]
ROBUST = ["robust", "robust_fabricated", "robust_untold"]


def test_a_table_comes_back_from_its_file(tmp_path: Path):
    path = tmp_path / NAME
    path.write_bytes((RESULTS / NAME).read_bytes())
    assert joined_tables.main([str(path)]) == 0
    for name in (NAME, NAME.replace(".csv", ".tex")):
        assert (tmp_path / name).read_bytes() == (RESULTS / name).read_bytes()
    assert path.with_suffix(".png").stat().st_size > 0


def test_rows_of_a_later_run_are_joined(tmp_path: Path):
    """One run after the other, as the table that is kept was made."""
    path = tmp_path / NAME
    lines = list(csv.DictReader((RESULTS / NAME).read_text().splitlines()))
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, [name for name in lines[0] if name != "run"], lineterminator="\n")
        table.writeheader()  # as the tables of one run once were, without a column for it
        table.writerows({k: v for k, v in one.items() if k != "run"} for one in lines if one["run"] == "1")
    joined = {"robust": ROBUST, "biharmonic": ["biharmonic_of_capture"], "captures": CAPTURES}
    joined["optics"] = ["optics_only_fabricated"]
    for later, rows in joined.items():
        given = [str(path), "--later", str(RESULTS / "later" / later / NAME), "--rows", *rows]
        assert joined_tables.main(given) == 0
    assert path.read_bytes() == (RESULTS / NAME).read_bytes()


def test_a_table_may_have_nothing_but_the_rows_that_are_joined(tmp_path: Path):
    later = RESULTS / "later" / "robust" / NAME
    path = tmp_path / NAME
    header, *lines = later.read_text().splitlines(keepends=True)
    path.write_text(header + "".join(line for line in lines if line.startswith("robust,")))
    assert joined_tables.main([str(path), "--later", str(later), "--rows", "robust"]) == 0
    assert {one["row"] for one in csv.DictReader(path.read_text().splitlines())} == {"robust"}


def test_what_cannot_be_joined_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, later = tmp_path / NAME, RESULTS / "later" / "biharmonic" / NAME
    path.write_bytes((RESULTS / NAME).read_bytes())
    for given, words in (
        ([str(path), "--later", str(later), "--rows", "robust"], "must be among"),
        ([str(path), "--later", str(tmp_path / "robust.csv"), "--rows", "robust"], "must be named like"),
        ([str(path), "--later", str(RESULTS / OTHER), "--rows", "robust"], "must be a run of Table 2: fence"),
        ([str(path), "--later", str(tmp_path / NAME.replace("2", "1")), "--rows", "robust"], "no score"),
    ):
        (tmp_path / NAME.replace("2", "1")).write_text("row,region\n")
        assert joined_tables.main(given) == 2
        assert words in capsys.readouterr().err
    assert path.read_bytes() == (RESULTS / NAME).read_bytes()
