"""Memory is kept from step to step, given back after long compilations, and only then."""

import ctypes
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from doedesign.runtime import compiling

glibc = pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="only glibc can be asked"
)


@pytest.fixture
def trims(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Counts how often memory is given back; listeners are cleared away afterwards."""
    counted: list[int] = []
    found: list[Any] = []
    library = SimpleNamespace(malloc_trim=counted.append, mallopt=lambda *_: 1)
    monkeypatch.setattr(compiling.ctypes, "CDLL", lambda _: library)
    monkeypatch.setattr(jax.monitoring, "register_event_duration_secs_listener", found.append)
    compiling._keep_memory.__wrapped__()
    monkeypatch.undo()
    for listener in found:
        jax.monitoring.register_event_duration_secs_listener(listener)
    yield counted
    for listener in found:
        jax.monitoring.unregister_event_duration_listener(listener)


def compile_something_new(width: int) -> None:
    jax.jit(lambda x: jnp.sin(x) + width).lower(jnp.zeros(width)).compile()


@glibc
def test_a_long_compilation_is_cleared_away_after(trims: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "_LEAST_S", 0.0)
    compile_something_new(1237)  # jax itself says when it has compiled
    assert trims


@glibc
def test_short_ones_and_other_events_are_not(trims: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "_LEAST_S", 1e9)
    compile_something_new(1249)
    monkeypatch.setattr(compiling, "_LEAST_S", 0.0)
    jax.monitoring.record_event_duration_secs("/jax/core/compile/jaxpr_trace_duration", 5.0)
    assert not trims


@glibc
def test_the_system_has_what_is_called() -> None:
    assert ctypes.CDLL(None).malloc_trim(0) in (0, 1)


_PAGES = """
import resource
import sys
import numpy as np
from doedesign.runtime import compiling

if sys.argv[1] == "kept":
    compiling._keep_memory()
np.ones(2**22)  # 32 MiB, as much as glibc's threshold ever grows to
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    np.ones(2**23)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.slow
@glibc
def test_freed_memory_is_used_again_without_asking_the_system() -> None:
    found = [
        int(subprocess.run([sys.executable, "-c", _PAGES, way], capture_output=True, text=True, check=True).stdout)
        for way in ("left alone", "kept")
    ]
    # Ten times 64 MiB; in pages of 2 MiB, the largest there are by default, that is 320 faults. Kept, one time is left.
    assert found[0] > 300
    assert found[1] < found[0] / 5
