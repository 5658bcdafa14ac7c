"""Compilation of the steps of an optimisation or a training, so that they take little memory and keep what they take.

Two things raise the peak of a full-size step, and neither is needed. XLA's default schedule for a processor keeps the
buffers of all PSFs alive at once; first touching that much memory costs as much time as the transforms themselves. And
compiling takes about a gigabyte, which it frees, but which the C library keeps for later, beside the memory of the step
itself: a third of a training's peak. glibc gives it back on request.

What a step frees the next one needs again. glibc gives arrays of megabytes back to the system at once and has to ask
for them anew, page by page, which takes a fourth of a step's time; it is told to keep them. Other systems are left
alone.
"""

import ctypes
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import equinox as eqx
import jax

_COMPILED = "/jax/core/compile/backend_compile_duration"
_LEAST_S = 1.0  # a shorter compilation leaves little
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # of mallopt: free bytes that are given back, and number of arrays by mmap


def compiled_step(step: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Compile `step(constants, state)` on its first call; it reuses the memory of the state that it is given."""
    _keep_memory()
    options = {}
    if jax.default_backend() == "cpu":
        options = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
    # The overloads do not list jit's own options, which are passed on.
    return eqx.filter_jit(step, donate="all-except-first", compiler_options=options)  # pyright: ignore[reportCallIssue]


@cache
def _keep_memory() -> None:
    """From now on, have freed memory kept, but given back after every compilation of a second and more."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    if library is None or not hasattr(library, "mallopt"):
        return
    library.mallopt(_MMAP_MAX, 0)
    library.mallopt(_TRIM_THRESHOLD, 2**31 - 1)

    def after(event: str, duration_secs: float, **_: Any) -> None:
        if event == _COMPILED and duration_secs >= _LEAST_S:
            library.malloc_trim(0)

    jax.monitoring.register_event_duration_secs_listener(after)
