"""Shipped tables of edge widths are those that would be computed, and those that the stock process asks for."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import doedesign
from doedesign.build import camera_from_spec, process_from_spec
from fab.deviations import Variation
from fab.levels import height_of
from sim.rigorous.edge_optic import with_edges
from sim.rigorous.width_tables import WidthKey, edge_table, shipped_tables, stock_keys
from sim.surface.lines import wall_numbers
from sim.surface.plate import as_fabricated

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_every_shipped_table_is_one_of_the_stock_process():
    assert list(shipped_tables()) == stock_keys()


@pytest.mark.parametrize("key", stock_keys()[::4], ids=str)
def test_a_shipped_table_is_the_computed_one(key: WidthKey):
    # Another order of the same sums; the widths themselves are good to 2 nm.
    for shipped, computed in zip(shipped_tables()[key], key.computed(), strict=True):
        np.testing.assert_allclose(shipped, computed, atol=1e-14)


@pytest.mark.study
def test_the_example_for_the_fab_takes_its_tables_from_the_shipped_file(monkeypatch: pytest.MonkeyPatch):
    """As drawn, as fabricated, and while its heights are sought."""
    spec = doedesign.load_spec(EXAMPLES / "quick.toml", ["optics.light=edges"])
    camera, process = camera_from_spec(spec), process_from_spec(spec.process)

    def refused(key: WidthKey) -> None:
        raise AssertionError(f"{key} is computed")

    monkeypatch.setattr(WidthKey, "computed", refused)
    edge_table.cache_clear()
    wall_numbers.cache_clear()
    codes = np.zeros(camera.grid.shape, np.uint8)
    codes[0, 0] = 15
    height = height_of(codes, process.levels)
    with_edges(height, camera)
    jax.eval_shape(lambda heights: with_edges(heights, camera).transmission, jnp.asarray(height, jnp.float32))
    as_fabricated(codes, camera, process, Variation(chrome_y_m=1e-6, depth_scale=(0.01,) * 4))


def test_other_walls_are_computed_and_kept():
    edge_table.cache_clear()
    one, same = (edge_table(0.2e-6, 1e-6, 1.5, "y", "x") for _ in range(2))
    assert one is same
    for kept, computed in zip(one, WidthKey(0.2e-6, 1e-6, 1.5, "along").computed(), strict=True):
        np.testing.assert_array_equal(kept, computed)
