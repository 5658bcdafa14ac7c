"""How much memory a process held."""

import resource
import sys
from contextlib import suppress

_KIB = 1 if sys.platform == "darwin" else 1024  # what getrusage counts memory in


def peak_bytes() -> int:
    """The most memory that this process held so far, in bytes.

    On Linux it is that of this program alone: what `getrusage` says of a process begins with the peak of the one that
    started it.
    """
    with suppress(OSError, StopIteration, ValueError, IndexError), open("/proc/self/status") as stream:
        line = next(line for line in stream if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIB
