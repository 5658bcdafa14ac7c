"""A real Dask scheduler and real workers on this machine: every plate comes back, whoever is lost on the way."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from doedesign.tolerancing.cluster import evaluate_there
from doedesign.tolerancing.pool import DrawModel, Rows
from doedesign.tolerancing.studies import Study, study
from fab.draws import normal_keys
from fab.errors import InputError
from fab.process import Variation, variation_of

pytest.importorskip("distributed", reason="the cluster extra is not installed")

HERE = Path(__file__).parent
# A test that fails must not leave processes behind: they end by themselves after this many seconds.
LIFETIME_S = 120


class Cluster:
    """A scheduler with as many workers as were asked for."""

    def __init__(self, folder: Path, allowed_failures: int = 3) -> None:
        self.folder, self.allowed_failures = folder, allowed_failures
        self.workers: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self.scheduler = self._start(
            "scheduler", "--port", "0", "--scheduler-file", str(file), "--idle-timeout", f"{LIFETIME_S} s"
        )
        self._wait(lambda: file.exists() and file.stat().st_size > 0)
        self.address = json.loads(file.read_text())["address"]

    def _start(self, kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        allowed = str(self.allowed_failures)
        paths = os.pathsep.join([str(HERE), str(HERE.parents[1])])  # the fakes, and the packages under test
        settings = {"PYTHONPATH": paths, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": allowed}
        command = [sys.executable, "-m", "dask", kind, "--host", "127.0.0.1", "--no-dashboard", *arguments]
        with open(self.folder / f"{kind}{len(self.workers)}.log", "wb") as log:
            return subprocess.Popen(command, env={**os.environ, **settings}, stdout=log, stderr=log, cwd=self.folder)

    def _wait(self, ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 30
        while not ready():
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def hire(self) -> subprocess.Popen[bytes]:
        options = ("--nthreads", "1", "--no-nanny", "--memory-limit", "0", "--lifetime", f"{LIFETIME_S} s")
        self.workers.append(self._start("worker", self.address, *options, "--death-timeout", "30"))
        return self.workers[-1]

    def staff(self, count: int) -> list[subprocess.Popen[bytes]]:
        """So many workers that live."""
        self.workers = [worker for worker in self.workers if worker.poll() is None]
        while len(self.workers) < count:
            self.hire()
        return self.workers[:count]

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def fakes():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(HERE)
        yield import_module("tolerance_fakes")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    running = Cluster(tmp_path_factory.mktemp("cluster"))
    yield running
    running.close()


@pytest.fixture
def ask(fakes: ModuleType, cluster: Cluster) -> Callable[..., Study]:
    def make(**settings: Any) -> Study:
        usual = {"process": fakes.process(), "evaluate": fakes.slow_rows, "quiet": True, "scheduler": cluster.address}
        return study(fakes.design(), **{**usual, **settings})

    return make


def right(fakes: ModuleType, asked: Study, count: int) -> dict[str, Any]:
    plates = {key: fakes.rows(asked.design, asked.process, asked.variation(key)) for key in normal_keys(count)}
    return json.loads(json.dumps(plates))


@pytest.mark.slow
def test_a_lost_worker_loses_no_plate(ask: Callable[..., Study], fakes: ModuleType, cluster: Cluster, tmp_path: Path):
    first, _ = cluster.staff(2)
    asked = ask(out=tmp_path / "out")

    def lossy(model: DrawModel, plates: Mapping[str, Variation]) -> Iterator[tuple[str, Rows]]:
        for count, finished in enumerate(asked.run(model, plates)):
            yield finished
            if count == 9:
                first.kill()

    dataclasses.replace(asked, run=lossy).monte_carlo(60)
    assert first.wait(5) != 0
    assert asked.journal.finished == right(fakes, asked, 60)
    kept = [json.loads(line)["key"] for line in (tmp_path / "out" / "draws.jsonl").read_text().splitlines()]
    assert sorted(kept) == sorted(normal_keys(60))


@pytest.mark.slow
def test_the_loss_of_the_only_worker_is_made_good_by_a_new_one(
    ask: Callable[..., Study], fakes: ModuleType, cluster: Cluster
):
    (only,) = cluster.staff(1)
    asked = ask()

    def replaced(model: DrawModel, plates: Mapping[str, Variation]) -> Iterator[tuple[str, Rows]]:
        for count, finished in enumerate(asked.run(model, plates)):
            yield finished
            if count == 4:
                only.kill()  # with it goes the design that it held
                cluster.hire()

    dataclasses.replace(asked, run=replaced).monte_carlo(30)
    assert asked.journal.finished == right(fakes, asked, 30)


@pytest.mark.slow
def test_workers_are_set_up_and_mistakes_are_told(
    ask: Callable[..., Study], fakes: ModuleType, cluster: Cluster, monkeypatch: pytest.MonkeyPatch
):
    cluster.staff(1)
    set_up = ask(evaluate=fakes.settings)
    with pytest.raises(KeyError):  # these rows are no numbers of a plate
        set_up.monte_carlo(1).worst("strehl")
    found = set_up.journal.finished["normal/0"]
    assert isinstance(found, list)
    (row,) = found
    assert (row["JAX_PLATFORMS"], row["OMP_NUM_THREADS"]) == ("cpu", "1")
    refusing = ask(evaluate=fakes.refused)
    refusing.monte_carlo(20)
    assert set(refusing.beyond(normal_keys(20)).values()) == {"overlay_x: must stay below 0.5 um, but got more"}
    with pytest.raises(ZeroDivisionError):
        ask(evaluate=fakes.broken).monte_carlo(1)
    monkeypatch.setattr("doedesign.tolerancing.cluster.__version__", "0.0.0")
    with pytest.raises(InputError, match=r"worker: must have doedesign 0\.0\.0"):
        ask().monte_carlo(1)


@pytest.mark.slow
def test_a_plate_that_kills_its_workers_is_named(
    ask: Callable[..., Study], fakes: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    deadly = variation_of(2, {"overlay_x_m[0]": fakes.DEADLY})
    monkeypatch.setattr(Study, "variation", lambda self, key: deadly)
    strict = Cluster(tmp_path, allowed_failures=0)
    strict.staff(1)
    try:
        with pytest.raises(InputError, match=r"draw normal/0: a worker must live through a draw.*evaluate it alone"):
            ask(evaluate=fakes.rows_or_death, scheduler=strict.address).monte_carlo(1)
    finally:
        strict.close()


@pytest.mark.slow
def test_nobody_there_is_told(ask: Callable[..., Study], monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr("doedesign.tolerancing.cluster._PATIENCE_S", 1.0)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9: a Dask scheduler must answer there.*dask scheduler"):
        ask(scheduler="tcp://127.0.0.1:9").monte_carlo(1)
    with pytest.raises(InputError, match="a Dask scheduler must answer there"):
        ask(scheduler="nonsense://").monte_carlo(1)
    idle = Cluster(tmp_path)
    try:
        with pytest.raises(InputError, match=r"the cluster must have workers.*dask worker"):
            ask(scheduler=idle.address).monte_carlo(1)
    finally:
        idle.close()


@pytest.mark.parametrize(
    "refusal",
    [TimeoutError("out of time"), ConnectionRefusedError("no"), ValueError("nonsense"), ImportError("ucx")],
)
def test_a_refusal_is_told_in_the_words_of_dask(refusal: Exception, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: Any, **__: Any) -> None:
        raise refusal

    monkeypatch.setattr("distributed.Client", refuse)
    model: Any = None
    with pytest.raises(InputError, match=rf'tcp://there:9: a Dask scheduler must answer there.*"{refusal}"'):
        next(evaluate_there(model, {}, "tcp://there:9"))


@pytest.mark.slow
def test_without_dask_the_cure_is_told():
    script = f"""
import sys
sys.modules["distributed"] = None
sys.path.insert(0, {str(HERE)!r})
import tolerance_fakes as fakes
from doedesign.tolerancing.studies import study
study(fakes.design(), process=fakes.process(), evaluate=fakes.rows, scheduler="tcp://127.0.0.1:9").monte_carlo(1)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "a cluster is reached through Dask" in done.stderr
    assert 'pip install "doedesign[cluster]"' in done.stderr


@pytest.mark.slow
def test_a_scheduler_that_ends_keeps_what_was_finished(ask: Callable[..., Study], tmp_path: Path):
    short = Cluster(tmp_path)
    short.staff(1)
    asked = ask(scheduler=short.address, out=tmp_path / "out")

    def cut(model: DrawModel, plates: Mapping[str, Variation]) -> Iterator[tuple[str, Rows]]:
        for count, finished in enumerate(asked.run(model, plates)):
            yield finished
            if count == 2:
                short.scheduler.kill()

    try:
        with pytest.raises(InputError, match=r"the scheduler must stay reachable.*Finished draws are kept"):
            dataclasses.replace(asked, run=cut).monte_carlo(100)
    finally:
        short.close()
    assert 3 <= len((tmp_path / "out" / "draws.jsonl").read_text().splitlines()) < 100
