"""Signals that end a command, and what goes wrong because of them."""

import signal
import time

import pytest

from doedesign.runtime.stopping import interruptible
from fab.errors import InputError


def cut_off(error: Exception) -> None:
    """Be interrupted, and fail while cleaning up."""
    with interruptible():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            raise error


def test_a_fault_that_follows_an_interruption_is_the_interruption():
    """A library that is cut off while it is imported may be found half there by what cleans up."""
    with pytest.raises(KeyboardInterrupt):
        cut_off(NameError("half imported"))


def test_a_fault_of_its_own_stays_one():
    with pytest.raises(NameError), interruptible():
        raise NameError("typed wrongly")


def test_a_mistake_while_cleaning_up_is_told():
    with pytest.raises(InputError, match="room"):
        cut_off(InputError("out", "the disk must have room", "none", "Free some."))


def test_an_interruption_is_not_lost_where_python_swallows_it(capfd):
    class Removed:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def remove() -> None:
        with interruptible():
            Removed()
            time.sleep(30)

    with pytest.raises(KeyboardInterrupt):
        remove()
    assert "Traceback" not in capfd.readouterr().err


def test_an_interruption_does_not_come_when_the_work_is_over():
    class Removed:
        def __del__(self) -> None:
            raise KeyboardInterrupt

    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        with interruptible():
            Removed()
        time.sleep(0.1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert came == []
