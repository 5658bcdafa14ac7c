"""Mutants: what is changed, which tests are meant for a file, and the list of those that harm nothing."""

import subprocess
import tomllib

import pytest

from tests.mutants import COPIED, HARMLESS, ROOT, Coverage, chosen, mutant_of, places
from tests.mutants import tests_for as meant_for


def test_tests_are_found_by_name_first_and_by_what_they_import():
    found = meant_for("sim/sensor/noise.py")
    assert "tests/sim/test_noise.py" in found[:2]
    assert all((ROOT / test).is_file() for test in found)
    assert meant_for("doedesign/design/patterns.py")[0] == "tests/doedesign/test_objectives.py"


def test_tests_that_run_a_line_come_the_quickest_first():
    file, lines = "doedesign/runs/results.py", (ROOT / "doedesign/runs/results.py").read_text().splitlines()
    (raised,) = (k for k, line in enumerate(lines, 1) if "raise InputError(" in line)
    known = Coverage({"a::slow": 9.0, "a::quick": 0.1, "b::other": 1.0}, {file: {raised: ["a::slow", "", "a::quick"]}})
    assert known.tests(file, raised) == ["a::quick", "a::slow"]
    assert known.tests(file, 1) == []
    assert known.of_file("a") == 9.1
    # A line of a statement that another line stands for.
    first = next(k for k, line in enumerate(lines, 1) if line.startswith("def "))
    body = Coverage({}, {file: {first: ["a::quick"]}})
    assert body.tests(file, first + 1) == ["a::quick"]


def test_a_place_is_changed_in_every_way_and_annotations_are_left_alone():
    file = "doedesign/runs/results.py"
    found = [mutant_of(change) for changes in places(file) for change in changes]
    lines = (ROOT / file).read_text().splitlines()
    assert found
    assert all(mutant.was in lines[mutant.line - 1] for mutant in found)
    assert not any(mutant.was.startswith("def ") and "| None" in mutant.was for mutant in found)
    assert len({mutant.code for mutant in found}) == len(found)
    assert [mutant.code for mutant in chosen([file], 2, 5)] == [mutant.code for mutant in chosen([file], 2, 5)]


def test_what_is_harmless_is_still_there_and_says_why():
    for mutant in tomllib.loads(HARMLESS.read_text())["mutant"]:
        lines = [line.strip() for line in (ROOT / mutant["file"]).read_text().splitlines()]
        assert mutant["was"] in lines, mutant
        assert mutant["was"] != mutant["now"]
        assert len(mutant["why"]) > 20


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="git knows what belongs to the project")
def test_the_whole_project_is_copied():
    """Tests of its pages and of its release need more than the code."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    assert {path.split("/")[0] for path in listed.stdout.decode().split("\0") if path} == set(COPIED)
