"""Folders of results: what takes their place, and what stays."""

import json
from pathlib import Path

import pytest

from doedesign.runs.results import results_folder
from fab.errors import InputError


def test_a_result_takes_the_place_of_one_with_nothing_else_in_it(tmp_path: Path):
    for text in ("first", "second"):
        with results_folder(tmp_path / "psf", "plate") as folder:
            assert folder is not None
            (folder / "metrics.json").write_text(text)
    assert (tmp_path / "psf/metrics.json").read_text() == "second"
    (tmp_path / "psf/notes.txt").write_text("mine")
    with (
        pytest.raises(InputError, match=r"must hold nothing else, but got also 'notes\.txt'"),
        results_folder(tmp_path / "psf", "plate"),
    ):
        pytest.fail("opened")


@pytest.mark.parametrize("listed", [5, None, [["metrics.json"]], "metrics.json"])
def test_a_manifest_that_lists_no_files_vouches_for_none(tmp_path: Path, listed: object):
    (tmp_path / "psf").mkdir()
    (tmp_path / "psf/manifest.json").write_text(json.dumps({"results_sha256": listed}))
    (tmp_path / "psf/metrics.json").write_text("{}")
    with (
        pytest.raises(InputError, match=r"must hold nothing else, but got also 'metrics\.json'"),
        results_folder(tmp_path / "psf", "plate"),
    ):
        pytest.fail("opened")
