"""Memory is given back after long compilations, and only then."""

import ctypes
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
    monkeypatch.setattr(compiling.ctypes, "CDLL", lambda _: SimpleNamespace(malloc_trim=counted.append))
    monkeypatch.setattr(jax.monitoring, "register_event_duration_secs_listener", found.append)
    compiling._trim_after_compiling.__wrapped__()
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
