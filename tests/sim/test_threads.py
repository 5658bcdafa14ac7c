"""Work side by side: in order, no more than there are cores, and to the same bits as one after another."""

import threading
from collections.abc import Sequence

import jax
import numpy as np
import pytest

from bench.reference import make_camera, wrapped_map
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.threads import at_once, side_by_side


def test_results_come_in_order_whichever_is_ready_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NPROC", "2")
    second_done = threading.Event()

    def work(item: int) -> int:
        if item == 0:
            assert second_done.wait(60)  # the first ends after the second, which runs beside it
        if item == 1:
            second_done.set()
        return item * item

    assert list(at_once(work, range(5))) == [0, 1, 4, 9, 16]


def test_what_works_side_by_side_is_not_divided_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NPROC", "2")
    assert list(at_once(lambda _: side_by_side(), range(4))) == [1, 1, 1, 1]
    assert side_by_side() == 2


def test_an_error_keeps_what_has_not_begun_from_beginning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NPROC", "2")
    begun: list[int] = []
    go_on = threading.Event()

    def work(item: int) -> None:
        begun.append(item)
        if item == 0:
            raise ValueError("the first one")
        assert go_on.wait(60)

    def all_of(items: Sequence[int]) -> None:
        for _ in at_once(work, items):
            pass

    threading.Timer(0.5, go_on.set).start()
    with pytest.raises(ValueError, match="the first one"):
        all_of(range(50))
    assert len(begun) < 10  # the two threads took a few before the error was seen


def test_an_error_beside_a_long_item_does_so_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NPROC", "2")
    begun: list[int] = []
    failed = threading.Event()

    def work(item: int) -> None:
        begun.append(item)
        if item == 0:
            assert failed.wait(60)
        if item == 1:
            threading.Timer(0.2, failed.set).start()
            raise ValueError("the second one")

    with pytest.raises(ValueError, match="the second one"):
        for _ in at_once(work, range(30)):
            pass
    assert sorted(begun) == [0, 1]  # side by side, so either may come first


@pytest.mark.parametrize(("told", "count"), [("1", 1), ("3", 3), ("64", 8)])
def test_as_many_as_xla_was_told(monkeypatch: pytest.MonkeyPatch, told: str, count: int) -> None:
    monkeypatch.setenv("NPROC", told)
    assert side_by_side() == count


@pytest.mark.parametrize("told", ["", "0", "many"])
def test_else_as_many_as_there_are_cores(monkeypatch: pytest.MonkeyPatch, told: str) -> None:
    monkeypatch.setenv("NPROC", told)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3, 5, 6}, raising=False)
    assert side_by_side() == 3


def test_on_another_device_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert side_by_side() == 2  # one is prepared while the other is computed


def test_psfs_have_the_same_bits_one_by_one_and_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, height, found = make_camera(128, 0.3e-3, 0.54e-3, 1.85e-6, 32), wrapped_map(128), []
    for told in ("1", "3"):
        monkeypatch.setenv("NPROC", told)
        found.append(psf(HeightOptic.of(camera, height), depths=(0.02, 0.5, np.inf)).energy)
    assert np.array_equal(*found)
