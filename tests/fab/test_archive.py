"""Arrays on the disk: what comes back, the same bytes for the same content, and what is refused."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from fab.archive import read_archive, write_archive
from fab.errors import InputError

HEADER = {"format": "something 1", "list": [1, 2.5, None, "Å"]}
ARRAYS = {
    "floats": np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4),
    "number": np.array(7, np.int64),
    "nothing": np.zeros((0, 2)),
    "turned": np.arange(6).reshape(2, 3).T,
}


def test_what_is_written_comes_back_and_numpy_reads_it(tmp_path: Path):
    path = tmp_path / "some" / "file.npz"
    write_archive(path, HEADER, ARRAYS)
    header, arrays = read_archive(path, "file", "")
    assert (header, list(arrays)) == (HEADER, list(ARRAYS))
    with np.load(path, allow_pickle=False) as others:
        for name, array in ARRAYS.items():
            assert (arrays[name].dtype, arrays[name].shape) == (array.dtype, array.shape)
            np.testing.assert_array_equal(arrays[name], array)
            np.testing.assert_array_equal(others[name], array)


def test_the_same_content_gives_the_same_bytes(tmp_path: Path):
    for name in "ab":
        write_archive(tmp_path / name, dict(reversed(HEADER.items())) if name == "b" else HEADER, ARRAYS)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("change", ["number", "shape", "kind", "name", "one more", "one less"])
def test_arrays_that_are_not_those_written_are_refused(tmp_path: Path, change: str):
    """The archive is whole in each case, and its header the one that was written."""
    path = tmp_path / "file.npz"
    write_archive(path, HEADER, ARRAYS)
    with np.load(path) as stored:
        arrays = dict(stored)
    floats = arrays.pop("floats")
    others = {
        "number": {"floats": floats + 1},
        "shape": {"floats": floats.reshape(4, 3)},
        "kind": {"floats": floats.view(np.int32)},
        "name": {"float": floats},
        "one more": {"floats": floats, "more": np.zeros(1)},
        "one less": {},
    }
    np.savez(path, header=arrays.pop("header"), **others[change], **arrays)
    with pytest.raises(InputError, match="must be a whole file, but got a file changed since it was written"):
        read_archive(path, "file", "")


def test_what_is_compressed_is_not_unfolded(tmp_path: Path):
    """A few bytes could fill the memory; nothing of ours is compressed."""
    path = tmp_path / "file.npz"
    np.savez_compressed(path, header=np.zeros(10**6, np.uint8))
    with zipfile.ZipFile(path) as archive:
        assert archive.infolist()[0].compress_type == zipfile.ZIP_DEFLATED
    with pytest.raises(InputError, match="without a header"):
        read_archive(path, "file", "")
