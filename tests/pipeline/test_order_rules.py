"""What `doedesign masks` does where the process cannot print a mask, on a spec whose process prints 3 um."""

import json

import numpy as np
import pytest

from fab.manifest.records import read_manifest
from fab.rules.check import Rules, check
from tests.orders import named


@pytest.fixture(scope="module")
def coarse(tiny, cli, tmp_path_factory):
    run = tmp_path_factory.mktemp("coarse") / "run"
    limits = ("--set", "process.minimum_line=3 um", "--set", "process.minimum_space=3 um")
    done = cli("optimize", tiny, "--out", run, *limits)
    assert done.code == 0, done.err
    return run


def test_a_process_that_prints_the_masks_says_nothing(finished):
    record = read_manifest(finished.order).rules
    assert record["clean"]
    assert record["headlines"] == []
    # Its first etch is 75 nm, which is faint; of the masks nothing is said.
    (warning,) = [line for line in finished.said["masks"].err.splitlines() if line.startswith("warning")]
    assert warning.endswith("add a zero layer of chrome marks (`[wafer] zero_layer = true`)")
    assert "the alignment marks are etched 75 nm deep" in warning


@pytest.mark.slow
def test_by_default_it_warns_and_shows_where(coarse, cli, tmp_path):
    done = cli("masks", coarse, "--out", tmp_path / "order")
    assert done.code == 0
    assert "narrower than the 3 um that the process prints" in done.err
    manifest = read_manifest(tmp_path / "order")
    assert not manifest.rules["clean"]
    assert manifest.rules["headlines"][0] in done.err
    assert named(tmp_path / "order", "RULES.png").stat().st_size > 10_000


def test_on_request_it_refuses_and_leaves_nothing(coarse, cli, tmp_path):
    done = cli("masks", coarse, "--out", tmp_path / "order", "--on-violation", "fail")
    assert done.code == 2
    assert "the process must be able to print them" in done.err
    assert "--on-violation fix" in done.err
    assert not (tmp_path / "order").exists()


@pytest.mark.slow
def test_on_request_it_mends_the_map_and_says_what_that_costs(coarse, cli, tmp_path):
    done = cli("masks", coarse, "--out", tmp_path / "order", "--on-violation", "fix")
    assert done.code == 0, done.err
    assert "% of the pixels changed" in done.err
    manifest = read_manifest(tmp_path / "order")
    cost = manifest.source["repair"]
    assert 0 < cost["changed_share"] < 1
    assert 0 < cost["efficiency"] < 1
    level = np.load(tmp_path / "order" / manifest.level_map_file)
    report = check(manifest.level_map(level), Rules(3e-6, 3e-6))
    assert report.printable
    # The light is predicted before and after: the far spot is not what it was.
    (far,) = (row for row in cost["psf"] if "far_spot" in row)
    assert far["far_spot"][0] != pytest.approx(far["far_spot"][1], rel=1e-3)
    assert json.loads((tmp_path / "order" / "manifest.json").read_text())["source"]["repair"] == cost
