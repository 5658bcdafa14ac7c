"""An order of the released example has the bytes that were released, in every file that holds integers alone."""

import gzip
from pathlib import Path

import numpy as np
import pytest

import fab
from fab.manifest.records import read_manifest

EXAMPLE = Path(__file__).parents[2] / "masks" / "example"


def content(path):
    """The bytes of a file, unpacked: how close zlib packs depends on its version."""
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


@pytest.mark.skipif(not EXAMPLE.is_dir(), reason="a bare installation has no released masks")
def test_the_masks_of_the_released_example_come_out_the_same(tmp_path, monkeypatch):
    # The picture for people takes most of the time of an order this small.
    monkeypatch.setattr("fab.order.order.Order.plot", lambda *_: None)
    monkeypatch.setattr("fab.order.papers.png_bytes", lambda _: b"picture")
    released = read_manifest(EXAMPLE)
    level_map = released.level_map(np.load(EXAMPLE / released.level_map_file))
    made = fab.write_order(tmp_path / "example", level_map, process="contact_aligner")
    kinds = (".gz", ".npy", ".DAT")
    names = [entry.file for entry in made.manifest.files if Path(entry.file).suffix in kinds]
    assert len(names) == 8
    for name in names:
        assert content(made.folder / name) == content(EXAMPLE / name), name
    stated = ("masks", "chrome", "plates", "wafer", "rules", "levels", "level_map_sha256", "doe_cell", "conventions")
    for key in stated:
        assert getattr(made.manifest, key) == getattr(released, key), key
