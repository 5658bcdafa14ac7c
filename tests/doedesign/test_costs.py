"""The cost of commands: kept beside the results, never among them, and never a reason to fail."""

import json
import math
import platform
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from doedesign.evaluation.external import ExternalMethod, run_program
from doedesign.runs.costs import Cost, costs_of, elapsed_text, measured, together
from doedesign.runs.folder import COST_NAME
from tests.doedesign.small_runs import SPEC, call, finished_run


def run_folder(tmp_path: Path, form: str = "doedesign run 1") -> Path:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "manifest.json").write_text(json.dumps({"format": form}))
    return tmp_path / "run"


def stopped(run: Path, error: BaseException) -> None:
    """A command that ends by an error after it has written something."""
    with measured(run, "optimize"):
        (run / "checkpoint.npz").touch()
        raise error


def test_what_a_command_took_is_kept(tmp_path: Path):
    run = run_folder(tmp_path)
    with measured(run, "optimize") as taken:
        (run / "result").touch()
    (cost,) = costs_of(run)
    assert cost == taken.cost
    assert cost.commands == ("optimize",)
    assert cost.host == platform.node()
    assert cost.done
    assert cost.peak_bytes > 1 << 20  # an interpreter takes more than a megabyte


def test_a_run_that_was_stopped_and_resumed_adds_up(tmp_path: Path):
    run = run_folder(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        stopped(run, KeyboardInterrupt())
    with measured(run, "optimize"):
        (run / "result").touch()
    costs = costs_of(run)
    assert [one.done for one in costs] == [False, True]
    whole = together(costs)
    assert whole is not None
    assert whole.seconds == pytest.approx(sum(one.seconds for one in costs))
    assert whole.commands == ("optimize", "optimize")


def test_the_memory_of_who_starts_a_command_is_not_its_own():
    held = np.ones(100_000_000)
    code = (
        "from doedesign.runs.costs import measured\nwith measured(None, 'psf') as it: pass\nprint(it.cost.peak_bytes)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 < int(done.stdout) < 0.9 * held.nbytes


def test_the_time_of_other_programs_counts(tmp_path: Path):
    burning = "import time\nwhile time.process_time() < 0.4: pass"
    program = ExternalMethod("other", (sys.executable, "-c", burning), "conventional")
    with measured(None, "evaluate") as taken:
        begun = time.process_time()
        run_program(program, tmp_path, tmp_path / "out")
        own_s = time.process_time() - begun
    assert taken.cost is not None
    assert taken.cost.cpu_s > own_s + 0.4 - 0.05  # the clock of processes ticks every 0.01 s
    assert taken.cost.worker_peak_bytes == 0


def test_nothing_is_kept_of_nothing(tmp_path: Path):
    run = run_folder(tmp_path)
    with measured(run, "optimize"):
        pass  # it found its work done
    with pytest.raises(OSError, match="full"):
        stopped(run, OSError("full"))
    with measured(None, "reconstruct") as taken:
        pass
    assert taken.cost is not None
    assert not (run / COST_NAME).exists()


def test_only_a_run_keeps_costs(tmp_path: Path):
    run = run_folder(tmp_path, "doedesign released model 1")
    with measured(run, "simulate"):
        (run / "new").touch()
    with measured(tmp_path / "none", "masks"):
        pass
    assert not (run / COST_NAME).exists()
    assert not (tmp_path / "none").exists()


def test_results_elsewhere_count_for_the_run(tmp_path: Path):
    run = run_folder(tmp_path)
    with measured(run, "tolerance", writes=tmp_path / "study"):
        (tmp_path / "study").mkdir()
    assert [one.commands for one in costs_of(run)] == [("tolerance",)]


def test_a_place_that_cannot_be_written_is_no_reason_to_fail(tmp_path: Path):
    run = run_folder(tmp_path)
    (run / COST_NAME).mkdir()
    with measured(run, "psf"):
        (run / "new").touch()
    assert costs_of(run) == ()


def test_lines_that_are_none_are_left_out(tmp_path: Path):
    run = run_folder(tmp_path)
    with measured(run, "optimize"):
        (run / "result").touch()
    text = (run / COST_NAME).read_text()
    lines = ['{"commands": 3}', "[]", "no JSON", "", "[" * 100_000]
    # Numbers that no sum or text can be made of.
    lines += [json.dumps(json.loads(text) | {"seconds": value}) for value in (math.nan, math.inf, 1e308, -1.0)]
    lines += [json.dumps(json.loads(text) | {key: 10**400}) for key in ("cpu_s", "peak_bytes", "cores")]
    (run / COST_NAME).write_text("\n".join(lines) + "\n" + text + text[:20])
    assert len(costs_of(run)) == 1


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(4.06, "4.1 s"), (40.2, "40 s"), (100, "2 min"), (719, "12 min"), (3600, "1 h 0 min"), (7500, "2 h 5 min")],
)
def test_durations(seconds: float, text: str):
    assert elapsed_text(seconds) == text


def test_a_cost_in_words():
    one = Cost(("tolerance",), 12.0, 20.0, 3 << 29, 1 << 28, "bench", 2, "")
    words = "12 s (20 s of processor time), 1.5 GiB and 256 MiB per worker of memory, on bench"
    assert one.text() == words
    assert together([]) is None
    other = one._replace(host="cluster", peak_bytes=1)
    both = together([one, other])
    assert both is not None
    assert both.text().endswith("on bench, cluster")
    assert "in 2 commands" in both.text()


@pytest.mark.slow
def test_the_cost_of_a_run_is_in_no_digest(tmp_path: Path):
    run = finished_run(tmp_path, SPEC)
    (cost,) = costs_of(run)
    assert cost.commands == ("optimize",)
    assert COST_NAME not in (run / "manifest.json").read_text()
    before = (run / COST_NAME).read_bytes()
    code, _, said = call("optimize", tmp_path / "small.toml", "--out", run)
    assert code == 0
    assert "already holds" in said
    assert (run / COST_NAME).read_bytes() == before
    assert f"everything done with {run}" in said
    code, out, _ = call("runs", run, "--json")
    assert json.loads(out)["results"][0]["cost"]["seconds"] == cost.seconds
