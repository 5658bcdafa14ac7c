"""A new kind of file in an order is a module of its own and one line in `fab.solids.write.KINDS`."""

from dataclasses import replace

import numpy as np
import pytest

from fab.manifest.records import read_manifest
from fab.order.verify import verify
from fab.order.write import write_order
from fab.solids import write
from fab.solids.model import ModelKind, model_entry
from tests.fab.maps import FEW, level_map_from
from tests.fab.mended import mend, restate, told
from tests.orders import named


def counts_entry(path, model):
    return model_entry(path, "how many pixels have each level")


def write_counts(path, model):
    path.write_text(" ".join(map(str, np.bincount(model.level_map.level.ravel()))))


def count_problems(path, entry, model):
    found = [int(word) for word in path.read_text().split()]
    return [] if found == np.bincount(model.level_map.level.ravel()).tolist() else ["other numbers of pixels"]


def not_for_this_doe(path, model):
    return None


@pytest.fixture
def order(tmp_path, monkeypatch):
    kinds = (
        ModelKind("_COUNTS.txt", counts_entry, write_counts, count_problems),
        ModelKind("_NONE.txt", not_for_this_doe, write_counts, count_problems),
    )
    monkeypatch.setattr(write, "KINDS", (*write.KINDS, *kinds))
    level = np.random.default_rng(0).integers(0, 16, (19, 18))
    return write_order(tmp_path / "o", level_map_from(level, aperture_m=18e-6, name="toy"), wafer=FEW)


def counts(order):
    return named(order.folder, "COUNTS.txt").name


def test_it_is_written_listed_and_proved(order):
    manifest = read_manifest(order.folder)
    listed = {entry.file: entry for entry in manifest.files}
    assert listed[counts(order)].format == "TXT"
    assert not any("NONE" in file for file in listed)
    assert {model.file: model.content for model in manifest.models}[counts(order)].startswith("how many")
    assert [c.passed for c in verify(order).checks if c.file == counts(order)] == [True, True]


def test_what_is_wrong_in_it_is_told(order):
    (order.folder / counts(order)).write_text("1 2 3")
    mend(order.folder, counts(order))
    assert "other numbers of pixels" in told(order.folder, counts(order))


def test_a_kind_that_nobody_knows_is_told(order, monkeypatch):
    monkeypatch.setattr(write, "KINDS", write.KINDS[:-2])
    assert f"models: {counts(order)} should not be there" in told(order.folder, "manifest.json")


def test_a_kind_of_another_version_is_told(order, monkeypatch):
    restate(order.folder, lambda manifest: replace(manifest, tools={**manifest.tools, "doedesign": "99.0"}))
    monkeypatch.setattr(write, "KINDS", write.KINDS[:-2])
    assert "a kind of file that this version does not know" in told(order.folder, counts(order))
