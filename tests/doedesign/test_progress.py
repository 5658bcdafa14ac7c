"""Progress where stderr is no terminal: when a line is due, and what it says."""

import pytest

from doedesign.runtime import progress


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def lines_of(capsys, clock, total, pieces, start=0):
    """What is said of pieces that end at given times, `(seconds, done)`."""
    with progress.meter("working", total, start) as meter:
        for clock[0], done in pieces:
            meter.advance(done, "loss 0.5")
    captured = capsys.readouterr()
    assert not captured.out
    return captured.err.splitlines()


def test_a_line_in_ten_seconds_and_one_at_the_end(capsys, clock):
    pieces = [(second, second) for second in range(1, 27)]
    assert lines_of(capsys, clock, 26, pieces) == [
        "working: 10/26, 1.00/s, 16 s left, loss 0.5",
        "working: 20/26, 1.00/s, 6 s left, loss 0.5",
        "working: 26/26, 1.00/s, 0 s left, loss 0.5",
    ]


def test_a_slow_first_piece_is_told_without_a_rate(capsys, clock):
    # It pays for compilation, so that no rate follows from it.
    assert lines_of(capsys, clock, 400, [(60, 1), (80, 21)]) == [
        "working: 1/400, loss 0.5",
        "working: 21/400, 1.00/s, 6 min left, loss 0.5",
    ]


def test_work_that_goes_on_is_timed_from_where_it_goes_on(capsys, clock):
    assert lines_of(capsys, clock, 20000, [(5, 5001), (15, 5011)], start=5000) == [
        "working: 5011/20000, 1.00/s, 4 h 10 min left, loss 0.5"
    ]
