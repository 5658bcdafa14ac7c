"""Arrays that may be traced by jax: sums run in double precision on the host, and in single precision under a trace."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def is_traced(*trees: Any) -> bool:
    """Whether any array in some pytrees is traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def in_jit() -> bool:
    """Whether `jax.jit` is tracing: then constants are traced like everything else."""
    return is_traced(jnp.zeros(()))


def on_host(array: Any) -> Any:
    """The array as numpy, or as it is where it is traced."""
    return array if isinstance(array, Tracer) else np.asarray(array)


def single(value: Any) -> Any:
    """A number or array in single precision: numpy's, or jax's where it is traced."""
    return (jnp if is_traced(value) else np).asarray(value, np.float32)


def total(array: Any) -> Any:
    """Sum of an array: a float, or a traced scalar."""
    return jnp.sum(array) if is_traced(array) else float(np.sum(np.asarray(array), dtype=np.float64))


def stacked(arrays: list[Any], axis: int = 0) -> Any:
    """`stack` of arrays or numbers that may be traced."""
    return (jnp if is_traced(arrays) else np).stack(arrays, axis)


def compiled_quickly() -> dict[str, Any]:
    """Options of `jax.jit` that compile at XLA's lowest optimising level on a CPU; a level in XLA_FLAGS stays."""
    level = "xla_backend_optimization_level"
    chosen = jax.default_backend() != "cpu" or level in os.environ.get("XLA_FLAGS", "")
    return {} if chosen else {level: 1}
