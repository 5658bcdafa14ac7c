"""A small part of the campaign with a fixed seed (`make campaign` runs the whole), and that its oracles can fail."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.campaign.__main__ import FAMILIES, Campaign, table
from tests.campaign.field import Field, disturbed, said_badly
from tests.campaign.ground import SPEC
from tests.campaign.mutate import changed
from tests.campaign.mutations import MOST_BYTES
from tests.campaign.process import End, worker
from tests.campaign.shim import Fault, shimmed

SEED = 16
# The first commands of this seed are the resumed design, the pre-compensation and captures: no network is compiled.
QUICK_SEED, QUICK = 23, ("kills", "full_disk", "mutations")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Campaign]:
    one = Campaign(tmp_path_factory.mktemp("campaign"), jobs=2)
    yield one
    one.stop()


@pytest.mark.study
@pytest.mark.parametrize("family", [name for name, family in FAMILIES.items() if family.usual])
def test_nothing_is_lost_and_nothing_crashes(campaign: Campaign, family: str):
    found = campaign.run(family, SEED, 8 if family == "mutations" else 5)
    assert not [result for result in found if result.problems], table(found)


@pytest.mark.slow
@pytest.mark.parametrize("family", QUICK)
def test_nothing_is_lost_and_nothing_crashes_in_quick_commands(campaign: Campaign, family: str):
    found = campaign.run(family, QUICK_SEED, 3)
    assert not [result for result in found if result.problems], table(found)


@pytest.mark.slow
def test_changed_specs_in_a_warm_process(tmp_path: Path):
    """Whatever was changed, one message says what is wrong; the override is refused where nothing else is."""
    spec, rng = tmp_path / "work" / "spec.toml", np.random.default_rng(SEED)
    spec.parent.mkdir()
    with worker(tmp_path / "said") as process:
        for _ in range(30):
            data, done = changed(rng, spec.name, SPEC.read_bytes())
            spec.write_bytes(data)
            end = process.run(("optimize", "spec.toml", "--out", "out", "--set", "process.levels=65"), tmp_path)
            assert (end.code, said_badly(end)) == (2, []), (done, end.err)
            assert end.peak_bytes < MOST_BYTES
            assert [path.name for path in spec.parent.iterdir()] == ["spec.toml"]


@pytest.mark.slow
def test_the_oracles_see_a_command_that_writes_other_bytes(campaign: Campaign, tmp_path: Path):
    """A ground that expects something else than what the command writes, or loses."""
    field = Field(campaign.ground, tmp_path)
    expected = campaign.ground.after("masks-npy")
    written = next(name for name in expected if name.endswith(".png"))
    del expected[written]
    expected["out/more.gds"] = b"expected"
    try:
        problems = disturbed(field, "masks-npy", Fault(), ())
    finally:
        field.stop()
        campaign.ground.forget("masks-npy")
    wanted = ("exit 0, but", "finished according to its manifest", "the same command again")
    assert all(words in problem for words, problem in zip(wanted, problems, strict=True)), problems
    assert all("more.gds" in problem for problem in problems)
    assert written in problems[0]
    assert written in problems[2]


@pytest.mark.parametrize(
    ("end", "problem"),
    [
        (End(-11), "dies of signal 11"),
        (End(None, wall_s=60.0), "takes longer than 60 s"),
        (End(3, err="doedesign: what"), "exit code 3"),
        (End(1, err="Traceback (most recent call last)\ndoedesign: "), "a traceback"),
        (End(2, err="doedesign: \x1b[31m: must be text"), "control characters"),
        (End(2, err="must be text"), "without a message"),
        (End(0, err="x.py:3: UserWarning: what"), "meant for programmers"),
    ],
)
def test_what_no_command_may_do(end: End, problem: str):
    (found,) = said_badly(end)
    assert problem in found


def test_a_good_end_is_no_problem():
    assert not said_badly(End(0, "out\n", "39 checks passed\n"))
    assert not said_badly(End(2, err="doedesign: spec.toml: must be there"))


def test_every_way_to_write_is_counted_and_fails(tmp_path: Path):
    def write() -> None:
        (tmp_path / "a").write_text("1")  # opened, written
        (tmp_path / "a").rename(tmp_path / "b")
        (tmp_path / "c").mkdir()
        handle = os.open(tmp_path / "d", os.O_WRONLY | os.O_CREAT)
        os.write(handle, b"1")
        os.fsync(handle)
        os.close(handle)
        (tmp_path / "d").unlink()

    with shimmed(tmp_path, Fault()) as shim:
        write()
        Path(os.devnull).write_text("elsewhere")
    assert shim.calls == ["open", "write", "rename", "mkdir", "open", "write", "fsync", "unlink"]
    for call in range(1, len(shim.calls)):
        (tmp_path / "c").rmdir()
        with shimmed(tmp_path, Fault(call=call, error=28)), pytest.raises(OSError, match="No space left"):
            write()
        (tmp_path / "c").mkdir(exist_ok=True)
