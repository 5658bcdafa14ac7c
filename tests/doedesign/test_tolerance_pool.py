"""Worker processes and the folder of finished plates: nothing that was finished is lost, and numbers do not depend on
who computed them.

Plates here are a few sums, so that what is tested is the machinery around them.
"""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import pytest

from doedesign.runs.costs import measured
from doedesign.runtime.pool import default_workers, evaluate_here
from doedesign.tolerancing import studies as studies_module
from doedesign.tolerancing.pool import BYTES_PER_CELL, DrawModel
from doedesign.tolerancing.results import tolerance
from doedesign.tolerancing.studies import Study, study
from fab.aperture import RectangularAperture
from fab.draws import normal_keys
from fab.errors import InputError
from fab.files import sha256_bytes
from fab.process import variation_of

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def fakes():
    """Worker processes look for modules where this process does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(HERE)
        yield import_module("tolerance_fakes")


@pytest.fixture
def ask(fakes: ModuleType) -> Callable[..., Study]:
    def make(name: object = "fake", **settings: Any) -> Study:
        usual = {"process": fakes.process(), "evaluate": fakes.rows, "quiet": True, "workers": 1}
        return study(fakes.design(name), **{**usual, **settings})

    return make


@pytest.fixture(scope="module")
def right(fakes: ModuleType) -> dict[str, Any]:
    """The rows of 40 plates, computed here."""
    asked = study(fakes.design(), process=fakes.process(), evaluate=fakes.rows, quiet=True)
    return {
        key: json.loads(json.dumps(fakes.rows(asked.design, asked.process, asked.variation(key))))
        for key in normal_keys(40)
    }


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.mark.slow
def test_workers_find_what_is_right_each_with_one_thread(ask: Callable[..., Study], fakes: ModuleType, right: dict):
    main = sys.modules["__main__"]
    before = {name: vars(main).get(name) for name in ("__file__", "__spec__")}
    asked = ask(workers=2)
    asked.monte_carlo(40)
    assert asked.journal.finished == right
    set_up = ask(evaluate=fakes.settings, workers=2)
    with pytest.raises(KeyError):  # these rows are no numbers of a plate
        set_up.monte_carlo(8).worst("strehl")
    for found in set_up.journal.finished.values():
        assert isinstance(found, list)
        (row,) = found
        assert row["OMP_NUM_THREADS"] == "1"
        assert row["JAX_PLATFORMS"] == "cpu"
        assert "multi_thread_eigen=false" in row["XLA_FLAGS"]
        assert row["pid"] != os.getpid()
    assert os.environ.get("OMP_NUM_THREADS") is None  # this process is as it was
    assert {name: vars(main).get(name) for name in ("__file__", "__spec__")} == before


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_an_evaluation_is_sent_to_a_worker_once_not_with_every_item(fakes: ModuleType, workers: int):
    # Networks and PSFs are some 80 MB: sent with every item, a worker grew by as much from item to item.
    work = fakes.Heavy()
    found = dict(evaluate_here(work, {str(number): number for number in range(30)}, workers))
    assert {key: square for key, (square, _) in found.items()} == {str(number): number**2 for number in range(30)}
    # Whoever is told twice at first, or is busy then, leaves a few more for the other.
    assert work.sent == 1 if workers == 1 else work.sent <= 10
    assert len({process for _, process in found.values()}) <= workers


@pytest.mark.slow
def test_workers_say_what_they_took(fakes: ModuleType):
    """They live on when the command ends, and what the system says of their memory begins with that of this process."""
    held = np.ones(300_000_000)
    with measured(None, "tolerance") as taken:
        begun = time.process_time()
        list(evaluate_here(fakes.Busy(), {str(number): 0.5 for number in range(4)}, 2))
        own_s = time.process_time() - begun
    assert taken.cost is not None
    assert taken.cost.cpu_s > own_s + 4 * 0.5 - 0.05  # the clock of processes ticks every 0.01 s
    assert 1 << 20 < taken.cost.worker_peak_bytes < 0.9 * held.nbytes


@pytest.mark.slow
def test_a_worker_that_dies_loses_no_plate(ask: Callable[..., Study], fakes: ModuleType, right: dict, tmp_path: Path):
    asked = ask(tmp_path, evaluate=fakes.rows_or_death_once, workers=2, out=tmp_path / "out")
    asked.monte_carlo(12)
    assert asked.journal.finished == {key: right[key] for key in normal_keys(12)}
    assert sorted(line["key"] for line in lines(tmp_path / "out" / "draws.jsonl")) == sorted(normal_keys(12))
    # 12 plates, the one that died, and at most two others that were under way with it.
    assert 13 <= len((tmp_path / "plates").read_text().splitlines()) <= 15


@pytest.mark.slow
def test_a_plate_that_kills_its_worker_again_and_again_is_named(
    ask: Callable[..., Study], fakes: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    asked = ask(evaluate=fakes.rows_or_death, workers=2)
    deadly = variation_of(2, {"overlay_x_m[0]": fakes.DEADLY})
    real = Study.variation
    monkeypatch.setattr(Study, "variation", lambda self, key: deadly if key == "normal/4" else real(self, key))
    with pytest.raises(InputError, match=r"draw normal/4: a worker must live through a draw.*fewer workers"):
        asked.monte_carlo(10)
    assert set(asked.journal.finished) == set(normal_keys(10)) - {"normal/4"}


def test_a_plate_beyond_the_model_is_a_bad_plate(ask: Callable[..., Study], fakes: ModuleType, tmp_path: Path):
    asked = ask(evaluate=fakes.refused, limits=["strehl >= 0"], out=tmp_path / "out")
    plates = asked.monte_carlo(40)
    beyond = asked.beyond(normal_keys(40))
    assert 5 < len(beyond) < 40
    assert set(beyond.values()) == {"overlay_x: must stay below 0.5 um, but got more"}
    assert plates.yield_ is not None
    assert plates.yield_.good == 40 - len(beyond)
    assert plates.worst_draw not in beyond
    assert {row["key"] for row in plates.rows} == set(normal_keys(40)) - set(beyond)
    assert all(math.isfinite(found["max"]) for found in plates.statistics())
    # They are kept like the others.
    again = ask(evaluate=fakes.refused, limits=["strehl >= 0"], out=tmp_path / "out")
    assert again.monte_carlo(40).yield_ == plates.yield_
    assert again.beyond(normal_keys(40)) == beyond
    # Only a study that has no plate to show is none.
    with pytest.raises(InputError, match=r"draw normal/\d+: must be within what can be evaluated.*0.5 um.*Lower"):
        asked.sample(sorted(beyond)[:2])


def test_a_mistake_in_a_function_of_ones_own_is_named(
    ask: Callable[..., Study], fakes: ModuleType, right: dict, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    with pytest.raises(ZeroDivisionError) as caught:
        ask(evaluate=fakes.broken).monte_carlo(2)
    assert caught.value.__notes__ == ["in draw normal/0"]  # one worker takes them in their order
    with pytest.raises(InputError, match="evaluate: must be a function at the top of a module"):
        ask(evaluate=lambda *_: [], out=tmp_path / "out")
    # In memory it may stand anywhere; what workers cannot import is sent to them.
    monkeypatch.setattr(fakes.rows, "__module__", "not_there")
    asked = ask()
    asked.monte_carlo(1)
    assert asked.journal.finished == {"normal/0": right["normal/0"]}


def test_a_study_goes_on_where_it_was(ask: Callable[..., Study], fakes: ModuleType, right: dict, tmp_path: Path):
    ask(tmp_path, evaluate=fakes.marked_rows, out=tmp_path / "out").monte_carlo(3)
    path = tmp_path / "out" / "draws.jsonl"
    with open(path, "ab") as stream:
        stream.write(b'{"key": "normal/3", "rows": [{"col')  # a run that was killed while it wrote
    again = ask(tmp_path, evaluate=fakes.marked_rows, out=tmp_path / "out")
    again.monte_carlo(5)
    assert again.journal.finished == {key: right[key] for key in normal_keys(5)}
    assert [line["key"] for line in lines(path)] == normal_keys(5)
    assert len(lines(tmp_path / "plates")) == 5  # none was computed twice


def test_a_study_begun_by_an_earlier_version_goes_on(ask: Callable[..., Study], right: dict, tmp_path: Path):
    """Its lines have no digests."""
    ask(out=tmp_path / "out").monte_carlo(2)
    path = tmp_path / "out" / "draws.jsonl"
    told = [{key: value for key, value in line.items() if key != "sha256"} for line in lines(path)]
    path.write_text("".join(json.dumps(line) + "\n" for line in told))
    again = ask(out=tmp_path / "out")
    again.monte_carlo(3)
    assert again.journal.finished == {key: right[key] for key in normal_keys(3)}
    assert ["sha256" in line for line in lines(path)] == [False, False, True]


def test_a_folder_keeps_one_study(ask: Callable[..., Study], fakes: ModuleType, tmp_path: Path):
    out = tmp_path / "out"
    ask(out=out).monte_carlo(1)
    for other, what in (
        (ask(out=out, seed=1), "seed"),
        (ask(out=out, process=fakes.process(overlay_x_m=1e-6)), "process"),
        (ask("other", out=out), "design"),
        (ask(out=out, evaluate=fakes.slow_rows), "evaluate"),
    ):
        with pytest.raises(InputError, match=rf"one with another {what}.*Choose another folder"):
            other.monte_carlo(1)
    # Limits judge plates, they do not make them.
    assert ask(out=out, limits=["strehl >= 0"]).monte_carlo(1).yield_ is not None
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match=r"new or empty folder.*letter\.txt"):
        ask(out=tmp_path / "foreign").monte_carlo(1)
    with ask(out=out).journal.open(), pytest.raises(InputError, match="only one process"):
        ask(out=out).monte_carlo(2)


def test_a_study_that_was_refused_before_its_first_draw_gives_way(ask: Callable[..., Study], tmp_path: Path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="limit on on_target"):
        ask(out=out, limits=["on_target >= 0.5"]).monte_carlo(1)
    assert lines(out / "draws.jsonl") == []
    ask(out=out, seed=1).monte_carlo(1)
    assert json.loads((out / "study.json").read_text())["seed"] == 1
    with pytest.raises(InputError, match="one with another seed"):
        ask(out=out).monte_carlo(1)
    # Nor does anything else that lies there.
    (tmp_path / "b" / "external").mkdir(parents=True)
    (tmp_path / "b" / "study.json").write_text("{}")
    with pytest.raises(InputError, match="belong to this study"):
        ask(out=tmp_path / "b").monte_carlo(1)


DAMAGED = [
    b"[1]",
    b"[" * 100_000,
    b"1" * 5000,
    b'{"key": "normal/0", "rows": []}',
    b'{"key": 1, "beyond": "far"}',
    b'{"key": "normal/0", "rows": [{"colour": 7, "depth_m": 0.1}]}',
    b'{"key": "normal/0", "rows": [{"colour": "green", "depth_m": "near"}]}',
    b'{"key": "normal/0", "rows": [{"colour": "green", "depth_m": 0.1, "strehl": NaN}]}',
    b'{"key": "normal/0", "rows": [{"colour": "green", "depth_m": 0.1, "strehl": [1e999]}]}',
]


def with_digest(line: bytes) -> bytes:
    """A line as the journal writes it."""
    values = json.loads(line)
    digest = sha256_bytes(json.dumps(values, sort_keys=True).encode())[:16]
    return json.dumps({**values, "sha256": digest}).encode()


@pytest.mark.parametrize(
    ("errors", "name"), [({"overlay_x": 5e-7}, "overlay_x_m"), ({"sidewall": {"sigma": 0.01}}, "sidewall_rad")]
)
def test_a_number_without_a_unit_is_told_its_name(ask: Callable[..., Study], errors: dict[str, Any], name: str):
    with pytest.raises(InputError, match=f"a number goes by the name `{name}`"):
        ask(errors=errors)
    assert ask(errors={"overlay_x_m": 5e-7}).process.spreads["overlay_x_m[0]"].sigma == 5e-7


def test_a_sensitivity_of_an_unknown_name_is_refused(fakes: ModuleType):
    with pytest.raises(InputError, match="sensitivity: must be one of one_at_a_time, sobol, none, but got 'foo'"):
        tolerance(fakes.design(), process=fakes.process(), evaluate=fakes.rows, sensitivity=cast(Any, "foo"))


def test_draws_with_other_rows_are_refused(ask: Callable[..., Study], tmp_path: Path):
    """A line that is a draw by itself, but none of this study."""
    (tmp_path / "out").mkdir()
    ask(out=tmp_path / "out").monte_carlo(1)
    path = tmp_path / "out" / "draws.jsonl"
    path.write_bytes(with_digest(b'{"key": "normal/0", "rows": [{"colour": "green", "depth_m": 0.125}]}') + b"\n")
    with pytest.raises(InputError, match=r"draws\.jsonl: all draws must have the same rows.*normal/.*Remove"):
        ask(out=tmp_path / "out").monte_carlo(2)


def test_a_damaged_line_is_named(ask: Callable[..., Study], tmp_path: Path):
    (tmp_path / "out").mkdir()
    ask(out=tmp_path / "out").monte_carlo(1)
    path = tmp_path / "out" / "draws.jsonl"
    whole = path.read_bytes()
    changed = whole.replace(b'strehl": 0.', b'strehl": 0.0', 1)
    assert changed != whole
    signed = [with_digest(line) for line in DAMAGED if line.startswith(b"{")]
    for line in (*DAMAGED, *signed, b"7", changed.rstrip()):
        path.write_bytes(line + b"\n" + whole)
        with pytest.raises(InputError, match=r"draws\.jsonl, line 1: must be one finished draw.*Remove"):
            ask(out=tmp_path / "out").monte_carlo(2)


def test_draws_that_are_a_link_are_refused_and_left_alone(ask: Callable[..., Study], tmp_path: Path):
    ask(out=tmp_path / "out").monte_carlo(1)
    letter, path = tmp_path / "letter.txt", tmp_path / "out" / "draws.jsonl"
    letter.write_text("mine, without an end of line")
    path.unlink()
    path.symlink_to(letter)
    with pytest.raises(InputError, match=r"draws\.jsonl: must be a file of its own, but got a link"):
        ask(out=tmp_path / "out").monte_carlo(2)
    assert letter.read_text() == "mine, without an end of line"


SCRIPT = """
import sys
sys.path.insert(0, {here!r})
import tolerance_fakes as fakes
from doedesign.tolerancing.studies import study
asked = study(fakes.design({name!r}), process=fakes.process(), evaluate=fakes.marked_rows, workers=2, out={out!r})
asked.monte_carlo(400)
"""


@contextlib.contextmanager
def started(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A script of a user's, without `if __name__ == "__main__"`, that has finished a few plates with two workers."""
    script = folder / "script.py"
    script.write_text(SCRIPT.format(here=str(HERE), name=str(folder), out=str(folder / "out")))
    process = subprocess.Popen(
        [sys.executable, script],
        env={**os.environ, "TMPDIR": str(folder)},  # what a killed process leaves there goes with the test
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 60
        while len(lines_so_far(folder / "out" / "draws.jsonl")) < 8 or len(workers_of(folder)) < 2:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield process
    finally:
        process.kill()
        process.communicate()


def workers_of(folder: Path) -> set[int]:
    return {json.loads(line)["pid"] for line in lines_so_far(folder / "plates") if line.endswith(b"}")}


def lines_so_far(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines() if path.exists() else []


def alive(pid: int) -> bool:
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] not in ("Z", "X")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc to see which processes live")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["killed", "interrupted"])
def test_a_run_that_is_stopped_keeps_its_plates_and_its_workers_end(
    how: signal.Signals, ask: Callable[..., Study], fakes: ModuleType, right: dict, tmp_path: Path
):
    with started(tmp_path) as process:
        workers = workers_of(tmp_path)
        process.send_signal(how)
        _, said = process.communicate(timeout=30)
        assert process.returncode != 0
    assert ("KeyboardInterrupt" in said) == (how == signal.SIGINT)
    assert "SpawnProcess" not in said  # no worker cries out
    deadline = time.monotonic() + 10
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    kept = [json.loads(line)["key"] for line in lines_so_far(tmp_path / "out" / "draws.jsonl") if line.endswith(b"}")]
    assert len(kept) >= 8
    again = ask(tmp_path, evaluate=fakes.marked_rows, out=tmp_path / "out", workers=2)
    again.monte_carlo(20)
    assert {key: again.journal.finished[key] for key in normal_keys(20)} == {key: right[key] for key in normal_keys(20)}
    assert set(kept) <= set(again.journal.finished)


def test_only_few_small_plates_in_memory_go_without_workers(
    ask: Callable[..., Study], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    asked: list[int] = []
    monkeypatch.setattr("doedesign.tolerancing.studies.default_workers", lambda peak_bytes: 3)
    monkeypatch.setattr("doedesign.tolerancing.studies.evaluate_here", lambda *given: asked.append(given[-1]))
    model, plate = cast("DrawModel", None), variation_of(2, {})
    for out in (None, tmp_path / "out"):
        for count in (1, 50_000):  # plates of 64 cells
            ask(workers=None, out=out).run(model, dict.fromkeys(normal_keys(count), plate))
    # A study on disk has the same bytes whatever it is asked for next, so all of it comes from workers of one thread.
    assert asked == [0, 3, 3, 3]


def test_there_are_as_many_workers_as_cores_and_memory_allow(monkeypatch: pytest.MonkeyPatch):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    monkeypatch.setattr("doedesign.runtime.pool.free_gib", lambda: 1e3)
    assert default_workers(2400**2 * BYTES_PER_CELL) == cores
    monkeypatch.setattr("doedesign.runtime.pool.free_gib", lambda: 2.5)
    assert default_workers(2400**2 * BYTES_PER_CELL) == 1
    monkeypatch.setattr("doedesign.runtime.pool.free_gib", lambda: 0.1)
    assert default_workers(100 * BYTES_PER_CELL) == 1
    monkeypatch.setattr("doedesign.runtime.pool.free_gib", lambda: float("inf"))  # where the system does not say
    assert default_workers(100 * BYTES_PER_CELL) == cores


def test_a_study_knows_a_round_aperture_by_its_diameter_as_ever(fakes: ModuleType):
    record = studies_module._given(fakes.CAMERA)
    assert record["aperture_m"] == 1e-3
    assert "aperture" not in record
    slit = replace(fakes.CAMERA, aperture=RectangularAperture((0.5e-3, 1e-3)))
    assert studies_module._given(slit)["aperture_m"] == [1e-3, 0.5e-3]
