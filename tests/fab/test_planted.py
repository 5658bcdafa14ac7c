"""Defects planted in an order are caught, and changes that mean nothing are not (`tests.campaign.planted`)."""

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fab.errors import InputError
from fab.manifest.records import read_manifest
from fab.order.request import order_from, request_of
from fab.order.verify import verify
from fab.verification.papers import paper_problems
from fab.verification.values import differences
from tests.campaign.planted import Defect, defects, outcome, write_base
from tests.fab.mended import restate

DEFECTS = defects()


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("planted") / "base"
    write_base(folder)
    return folder


@pytest.mark.parametrize("defect", random.Random(16).sample(DEFECTS, 8), ids=lambda defect: defect.name)
def test_a_sample_of_the_defects(base, tmp_path, defect):
    found = outcome(defect, base, tmp_path / "order")
    assert found.right, found.line
    assert "\n" not in found.line


@pytest.mark.study
def test_a_larger_sample_of_the_defects(base, tmp_path):
    """The campaign plants all of them."""
    chosen = [defect for defect in DEFECTS if not defect.meaningful] + random.Random(17).sample(DEFECTS, 30)
    wrong = [d.name for d in chosen if not outcome(d, base, tmp_path / "order").right]
    assert wrong == []


def test_defects_are_named_once_and_there_are_hundreds():
    names = [defect.name for defect in DEFECTS]
    assert len(set(names)) == len(names)
    assert sum(defect.meaningful for defect in DEFECTS) >= 222


def test_a_defect_that_changes_nothing_is_lost(base, tmp_path):
    """The campaign itself can fail."""
    assert not outcome(Defect("nothing", lambda folder: None), base, tmp_path / "order").right


def test_a_request_comes_back_from_the_manifest(base):
    manifest = read_manifest(base)
    level = np.load(base / manifest.level_map_file)
    order = order_from(manifest.request, level, "here")
    assert request_of(order) == manifest.request
    assert order.process.spreads
    assert order.wafer.line_splits_m == (1e-7,)
    assert order.light is not None
    with pytest.raises(InputError, match="here: request"):
        order_from({**manifest.request, "more": 1}, level, "here")
    with pytest.raises(InputError, match="here: request"):
        order_from({**manifest.request, "wafer": {}}, level, "here")
    with pytest.raises(InputError, match="must hold the keys and values"):
        order_from(manifest.request, level[1:], "here")


@pytest.mark.parametrize("length", ["pitch_m", "aperture_m"])
def test_a_request_with_a_word_for_a_length_is_refused(base, length):
    manifest = read_manifest(base)
    drawn = {**manifest.request["level_map"], length: "wide"}
    with pytest.raises(
        InputError, match=r"here: request: (must be whole|aperture: must be a diameter).*, but got .*'wide'"
    ):
        order_from({**manifest.request, "level_map": drawn}, np.load(base / manifest.level_map_file), "here")


@pytest.mark.slow
def test_an_order_of_another_version_is_proved_as_far_as_it_can_be(order_folder):
    def older(manifest):
        return replace(manifest, conventions={"axes": "said otherwise"}, tools={**manifest.tools, "doedesign": "0.0"})

    restate(order_folder, older)
    report = verify(order_folder)
    assert report.passed, report.differences
    assert "written by doedesign 0.0" in report.notes[0]
    restate(order_folder, lambda manifest: replace(manifest, step_nm=76.0))
    assert "manifest.json: as was asked for: step_nm is 76.0 instead of 75.0" in verify(order_folder).differences


def test_differences_are_named_by_their_place():
    wanted = {"masks": [{"file": "a", "depth": 1.0}, {"file": "b", "depth": 2.0}], "name": "x"}
    assert differences(wanted, wanted) == []
    assert differences({**wanted, "name": 1}, wanted) == ["name is 1 instead of 'x'"]
    assert differences({"masks": wanted["masks"]}, wanted) == ["name is missing"]
    assert differences({**wanted, "more": 1}, wanted) == ["more should not be there"]
    deeper = {**wanted, "masks": [wanted["masks"][0], {"file": "b", "depth": 2}]}
    assert differences(deeper, wanted) == ["masks[b].depth is 2 instead of 2.0"]
    assert differences({**wanted, "masks": wanted["masks"][::-1]}, wanted) == [
        "masks stand in the order b, a instead of a, b"
    ]
    assert differences({**wanted, "masks": wanted["masks"] * 2}, wanted) == [
        "masks: a stands there 2 times", "masks: b stands there 2 times"
    ]  # fmt: skip
    assert differences({**wanted, "masks": []}, wanted) == ["masks: a is missing", "masks: b is missing"]
    assert differences({str(n): n for n in range(9)}, {})[-1] == "and 4 more differences"


def test_pages_differ_by_line(tmp_path):
    path = tmp_path / "page.html"
    path.write_text("<p>one</p>  \n<p>two</p>\n")
    assert paper_problems(path, b"<p>one</p>\n<p>two</p>\n") == []
    assert paper_problems(path, b"<p>one</p>\n<p>too</p>\n") == ["line 2 says '<p>two</p>' instead of '<p>too</p>'"]
    assert paper_problems(path, b"<p>one</p>\n") == ["it has 2 lines instead of 1"]
    path.write_bytes(b"\xff")
    assert paper_problems(path, b"text") == ["it is no text in UTF-8"]
