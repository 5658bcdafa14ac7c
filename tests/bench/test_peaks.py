"""Peaks of memory that benchmarks print are those of what is measured."""

import numpy as np

from bench.masks import child
from doedesign.runtime.memory import peak_bytes


def test_a_task_does_not_answer_for_the_memory_of_who_starts_it():
    held = np.ones(100_000_000)
    assert peak_bytes() > held.nbytes
    assert child("peak", "ring", 64)["peak_gb"] < 0.9 * held.nbytes / 1e9
