"""A real Dask scheduler and real workers on this machine: every plate comes back, whoever is lost on the way."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from doedesign.runtime.cluster import evaluate_there
from doedesign.tolerancing.pool import DrawModel, Rows
from doedesign.tolerancing.studies import Study, study
from fab.draws import normal_keys
from fab.errors import InputError
from fab.process import Variation, variation_of
from tests.doedesign.local_cluster import Cluster

pytest.importorskip("distributed", reason="the cluster extra is not installed")

HERE = Path(__file__).parent


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
    monkeypatch.setattr("doedesign.runtime.cluster.__version__", "0.0.0")
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
    monkeypatch.setattr("doedesign.runtime.cluster._PATIENCE_S", 1.0)
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
