"""Time and memory of other processes that worked for this one.

The system tells that of a process only once it has ended, and begins its peak of memory with that of the one that
started it. Workers outlive the command that they work for, so they say it themselves, with every item that they return.
"""

from typing import NamedTuple


class Effort(NamedTuple):
    """Time and memory of a process that helps, since it last said so.

    Attributes:
        cpu_s: processor time, seconds.
        peak_bytes: the most memory that it held so far; 0 where it is not known.
    """

    cpu_s: float
    peak_bytes: int


_noted: list[Effort] = []


def note_effort(effort: Effort) -> None:
    """Keep what another process took.

    Args:
        effort: what it took.
    """
    _noted.append(effort)


def efforts() -> tuple[Effort, ...]:
    """All that was noted since this process began, in that order."""
    return tuple(_noted)
