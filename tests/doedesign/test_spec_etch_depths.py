"""`[process] etch_depths`: a list of depths, "optimize", or nothing for 2^k level steps."""

from pathlib import Path

import pytest

from doedesign.build import levels_from_spec, process_from_spec, resolve_process, spec_from_process
from doedesign.spec import (
    ProcessSpec,
    load_process,
    load_spec,
    process_to_toml,
    spec_digest,
    spec_from_json,
    spec_to_json,
    spec_to_toml,
)
from fab.errors import InputError
from fab.levels import Levels
from fab.process import Process

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
IDEAL = 'process={levels = 16, level_step = "75 nm"}'
DEPTHS = 'process.etch_depths=["80 nm", "150.5 nm", "301 nm", "590 nm"]'
LEVELS = Levels(16, 75e-9, (80e-9, 150.5e-9, 301e-9, 590e-9))


@pytest.mark.parametrize("given", [DEPTHS, "process.etch_depths=optimize"])
def test_they_are_read_and_written(given: str, tmp_path: Path):
    spec = load_spec(QUICK, [given])
    path = tmp_path / "again.toml"
    path.write_text(spec_to_toml(spec), "utf-8")
    assert load_spec(path) == spec == spec_from_json(spec_to_json(spec), "manifest.json")
    path.write_text(process_to_toml(spec.process), "utf-8")
    assert load_process(path) == spec.process
    assert spec_digest(spec) != spec_digest(load_spec(QUICK))


def test_a_spec_without_them_keeps_its_digest():
    assert "etch_depths" not in str(spec_to_json(load_spec(QUICK)))
    assert "etch_depths" not in spec_to_toml(load_spec(QUICK))


def test_they_make_the_staircase_and_the_process():
    process = load_spec(QUICK, [IDEAL, DEPTHS]).process
    assert levels_from_spec(process) == LEVELS
    assert process_from_spec(process) == Process(LEVELS)
    assert levels_from_spec(load_spec(QUICK).process) == Levels(16, 75e-9)
    even = 'process.etch_depths=["75 nm", "150 nm", "300 nm", "600 nm"]'
    assert levels_from_spec(load_spec(QUICK, [even]).process) == Levels(16, 75e-9)


def test_etches_go_from_shallow_to_deep_unless_an_order_is_given():
    swapped = [IDEAL, "process.levels=4", "process.level_step=300 nm", 'process.etch_depths=["500 nm", "150 nm"]']
    spec = load_spec(QUICK, swapped)
    assert process_from_spec(spec.process).order == (1, 0)
    said = load_spec(QUICK, [*swapped, "process.etches=[{mask = 0, depth = '500 nm'}, {mask = 1}]"])
    assert process_from_spec(said.process).order == (0, 1)
    # And back to a spec, order and all.
    for one in (spec, said):
        process = process_from_spec(one.process)
        assert process_from_spec(spec_from_process(process, one.process)) == Process(
            process.levels, process.order, name="ideal"
        )


def test_what_is_to_be_chosen_must_be_known_where_it_is_needed():
    process = load_spec(QUICK, ["process.etch_depths=optimize"]).process
    assert process.chooses_depths
    with pytest.raises(InputError, match=r"process\.etch_depths: the depths must be known here"):
        process_from_spec(process)
    # A process file that leaves the choice to the optimisation goes with whatever the design chose.
    assert resolve_process(process, LEVELS).levels == LEVELS


def test_a_process_of_other_depths_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"must be for 16 levels by etches of 80 nm, 150\.5 nm, 301 nm and 590 nm"):
        resolve_process(ProcessSpec(levels=16, level_step_m=75e-9), LEVELS)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (['process.etch_depths=["80 nm"]'], r"process\.etch_depths: 16 levels must have 4 etches, but got 1 depths"),
        (["process.etch_depths=[]"], r"process\.etch_depths"),
        (["process.etch_depths=best"], r'etch_depths: must be a list of depths or "optimize", but got "best"'),
        (["process.etch_depths=[80, 150, 300, 600]"], r"etch_depths\[0\]: must be a number with a unit"),
        (
            ['process.etch_depths=["75 nm", "-150 nm", "300 nm", "600 nm"]'],
            r"etch_depths\[1\]: must lie between 0\.1 nm and 1 mm",
        ),
        (
            ['process.etch_depths=["75 nm", "150 nm", "225 nm", "600 nm"]'],
            r"etch_depths: no two levels may have the same height, but got 225 nm deep both",
        ),
        (
            [DEPTHS, "process.etches=[{mask=0, depth='75 nm'}, {mask=1}, {mask=2}, {mask=3}]"],
            r"etches\[0\]\.depth: mask 0 must etch as deep as in process\.etch_depths, 80 nm, but got 75 nm",
        ),
        (
            ["process.etch_depths=optimize", "process.etches=[{mask=0, depth='75 nm'}, {mask=1}, {mask=2}, {mask=3}]"],
            r"etches\[0\]\.depth: must not be given where process\.etch_depths is to be chosen",
        ),
    ],
)
def test_mistakes_are_told(overrides: list[str], message: str):
    with pytest.raises(InputError, match=message):
        load_spec(QUICK, overrides)
