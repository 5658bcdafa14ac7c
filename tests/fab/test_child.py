"""Work in a child process: its result, and what becomes of work that never ends, grows without bounds or crashes."""

import os
import signal
import time

import pytest

from fab.verification import child as module
from fab.verification.child import ChildFailed, TooMuch, child_process, limited


def test_results_come_back_one_after_another():
    with child_process() as child:
        begun = [child.begin(limited, 0, pow, 2, power) for power in range(3)]
        assert [child.result(one, 0) for one in begun] == [1, 2, 4]


@pytest.mark.slow
def test_what_goes_wrong_is_told_and_the_next_work_is_done(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_SECONDS", 1.0)
    monkeypatch.setattr(module, "_PATIENCE", 1.0)
    with child_process() as child:
        with pytest.raises(ChildFailed, match="crashes"):
            child.result(child.begin(limited, 0, os._exit, 3), 0)
        with pytest.raises(ChildFailed, match="too long"):
            child.result(child.begin(limited, 0, time.sleep, 60), 0)
        with pytest.raises(ChildFailed, match="too much memory"):
            child.result(child.begin(limited, 0, bytearray, 3 << 30), 0)
        with pytest.raises(ChildFailed, match="invalid literal"):
            child.result(child.begin(limited, 0, int, "x"), 0)
        assert child.result(child.begin(limited, 0, pow, 3, 2), 0) == 9


def test_a_child_that_was_ended_while_it_had_nothing_to_do_is_replaced():
    with child_process() as child:
        process = child.result(child.begin(os.getpid), 0)
        os.kill(process, signal.SIGKILL)
        time.sleep(0.5)  # until it is noticed
        assert child.result(child.begin(limited, 0, pow, 3, 2), 0) == 9


@pytest.mark.slow
def test_work_that_keeps_the_processor_busy_is_ended_by_its_own_time():
    with child_process() as child:
        begun, start = child.begin(limited, 0, sum, range(10**12)), time.monotonic()
        with pytest.raises(TooMuch, match="too long"):
            child.result(begun, 0)
        # Not by the clock, which allows a minute.
        assert time.monotonic() - start < module._PATIENCE * module._SECONDS
