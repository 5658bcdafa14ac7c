"""Memory that a compiler leaves behind.

Compiling a large step takes about a gigabyte and frees it, but the C library keeps it for later, beside what the step
itself takes: a third of the peak of a full-size training. glibc gives it back when asked; other systems are left alone.
"""

import ctypes
import sys
from functools import cache
from typing import Any

import jax

_COMPILED = "/jax/core/compile/backend_compile_duration"
_LEAST_S = 1.0  # what took less left little


@cache
def trim_after_compiling() -> None:
    """From now on, give memory back to the system after every compilation of a second and more."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is None:
        return

    def after(event: str, duration_secs: float, **_: Any) -> None:
        if event == _COMPILED and duration_secs >= _LEAST_S:
            trim(0)

    jax.monitoring.register_event_duration_secs_listener(after)
