"""The floor that a training step is measured against counts every convolution and filter of the network."""

from collections import Counter

import pytest

import bench.train
from doedesign.recon.network import Network, NetworkShape


def test_the_floor_of_a_step_has_every_part_of_the_network(monkeypatch: pytest.MonkeyPatch):
    """It watches functions by name, and would miss those that moved to another module."""
    counted: Counter[str] = Counter()
    for name in ("bare_convolution", "bare_doubled", "transforms"):
        monkeypatch.setattr(bench.train, name, lambda *_, name=name, **__: counted.update([name]) or [name])
    layout = NetworkShape(width=3)
    filters, convolved = bench.train.network_floor(Network.make(layout, 0), 64, 33)
    scales = len(layout.widths)
    assert counted["bare_doubled"] == scales - 1  # one on every way up
    assert counted["bare_convolution"] > scales
    assert counted["transforms"] >= 2 * scales
    assert filters
    assert convolved
