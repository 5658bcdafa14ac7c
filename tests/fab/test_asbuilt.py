"""A filled run sheet, read back: what may be left out, and what cannot be."""

import json
import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

from fab.errors import InputError
from fab.runsheet.as_built import AsBuilt, read_as_built
from fab.runsheet.write import record
from fab.units import NM, UM
from tests.fab.sheets import doe, predictions, sheet


@cache
def unfilled() -> str:
    return json.dumps(record(sheet(predictions=predictions(), moves_m=(-30 * NM, 0.0, 0.0, 10 * NM))))


def filled(path: Path, changes: Mapping[str, object], **about: object) -> Path:
    """Write the sheet with some blanks filled in, {"mask 1/depth_nm": 74.0}, and other parts of it changed."""
    data = json.loads(unfilled())
    for keys, value in changes.items():
        *parents, last = keys.split("/")
        table = data["measured"]
        for key in parents:
            table = table[key]
        table[last] = value
    file = path / "filled.json"
    file.write_text(json.dumps(data | about))
    return file


def read(path: Path, changes: Mapping[str, object], **about: object) -> AsBuilt:
    return read_as_built(filled(path, changes, **about), doe())


def test_a_sheet_that_nobody_filled_in_measures_nothing(tmp_path):
    found = read(tmp_path, {})
    assert [mask.depths_m for mask in found.masks] == [()] * 4
    assert {mask[:3] + mask[4:5] for mask in found.masks} == {(None,) * 4}
    assert found.chrome == (None, None, None)
    assert (found.corner_radius_m, found.sidewall_rad, found.grating_binary, found.grating_blazed) == (None,) * 4
    assert found.notes == {}
    # What the masks were drawn with is not measured, but known.
    assert [mask.edge_move_m for mask in found.masks] == pytest.approx([-30 * NM, 0, 0, 10 * NM])
    assert found.predicted is not None
    assert found.predicted["probe_wavelength_nm"] == 520


def test_tables_may_be_left_out_altogether(tmp_path):
    assert read(tmp_path, {}, measured={}).masks[0].depths_m == ()
    assert read(tmp_path, {}, measured={"mask 2": {"depth_nm": 151}}).masks[1].depths_m == ((math.inf, 151 * NM),)


def test_numbers_come_in_si(tmp_path):
    found = read(
        tmp_path,
        {
            "mask 3/depth_by_pad_nm/20 um": 290,
            "mask 3/depth_by_pad_nm/500 um": 297.5,
            "mask 3/overlay_x_um": -0.75,
            "mask 3/overlay_y_um": 0.25,
            "mask 4/times_etched": 2,
            "mask 4/depth_nm": 1180.0,
            "chrome/overlay_x_um": 1,
            "chrome/opening_diameter_um": 4428.0,
            "plate/corner_radius_um": 0.4,
            "plate/sidewall_deg": 6,
            "plate/grating_blazed": 0.02,
            "notes/wafer": 7,
            "notes/remarks": "mask 2 printed twice",
        },
    )
    assert dict(found.masks[2].depths_m) == {20 * UM: pytest.approx(290 * NM), 500 * UM: pytest.approx(297.5 * NM)}
    assert (found.masks[2].overlay_x_m, found.masks[2].overlay_y_m) == pytest.approx((-0.75 * UM, 0.25 * UM))
    assert found.masks[3].times_etched == 2
    assert found.masks[3].depths_m[0][1] == pytest.approx(1180 * NM)
    assert found.chrome.overlay_x_m == pytest.approx(1 * UM)
    assert found.chrome.wider_m == pytest.approx(-2 * UM)
    assert found.corner_radius_m == pytest.approx(0.4 * UM)
    assert found.sidewall_rad == pytest.approx(math.radians(6))
    assert (found.grating_binary, found.grating_blazed) == (None, 0.02)
    assert found.notes == {"wafer": "7", "remarks": "mask 2 printed twice"}


def test_edges_are_half_of_what_lines_grew_and_gaps_lost(tmp_path):
    # Edges 0.1 um outward: lines 0.2 um wider, gaps 0.2 um narrower.
    bars = {"mask 2/cd_um/2 um line": 2.2, "mask 2/cd_um/2 um gap": 1.8, "mask 2/cd_um/1.5 um line": 1.7}
    assert read(tmp_path, bars).masks[1].edges_m == pytest.approx(0.1 * UM)
    one = {"mask 2/cd_um/2 um line": 2.2, "mask 2/cd_um/5 um gap": 5.0}
    assert read(tmp_path, one).masks[1].edges_m == pytest.approx(0.05 * UM)
    assert read(tmp_path, {"mask 2/cd_bias_um": -0.07}).masks[1].edges_m == pytest.approx(-0.07 * UM)
    # On the chrome a line is chrome: where it grows, the opening closes from two sides.
    assert read(tmp_path, {"chrome/cd_um/3 um line": 3.4}).chrome.wider_m == pytest.approx(-0.4 * UM)
    both = {"chrome/cd_um/3 um line": 3.4, "chrome/opening_diameter_um": 4431.0}
    assert read(tmp_path, both).chrome.wider_m == pytest.approx(1 * UM)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("mask 1/depth_nm", 0.075, "nanometres"),
        ("mask 1/depth_nm", 150, "times_etched"),
        ("mask 1/depth_nm", "75", "must be a number"),
        ("mask 1/depth_nm", True, "must be a number"),
        ("mask 1/depth_nm", float("nan"), "must be a finite number"),
        ("mask 1/depth_nm", 10**400, "must be a finite number"),
        ("mask 1/depth_by_pad_nm/20 um", -75, "must lie between"),
        ("mask 1/depth_by_pad_nm", 75, "group of blanks"),
        ("mask 2/overlay_x_um", 500, "must lie between"),
        ("mask 1/overlay_y_um", 0.25, "aligned to the marks of this mask"),
        ("mask 2/cd_um/2 um line", 2000, "micrometres"),
        ("mask 2/cd_um/1 um gap", 0, "lost"),
        ("mask 2/cd_um/7 um line", 7.1, "Perhaps it is"),
        ("mask 2/cd_bias_um", 3.0, "per edge"),
        ("mask 4/times_etched", 0.5, "whole number"),
        ("mask 4/depht_nm", 600, "'depth_nm'"),
        ("mask 5", {"depth_nm": 1200}, "Perhaps it is 'mask "),
        ("chrome/opening_diameter_um", 4.43, "must lie between"),
        ("plate/sidewall_deg", 85, "upright"),
        ("plate/corner_radius_um", -1, "must lie between"),
        ("plate/grating_binary", 5, "0.05"),
        ("notes/remarks", ["a", "b"], "text"),
    ],
)
def test_what_cannot_be_is_refused_by_its_key(tmp_path, key, value, words):
    with pytest.raises(InputError) as caught:
        read(tmp_path, {key: value})
    said = str(caught.value)
    assert "filled.json: measured." in said
    assert key.replace("/", ".") in said
    assert words in said


def test_one_number_is_not_given_twice(tmp_path):
    with pytest.raises(InputError, match="depth_by_pad_nm"):
        read(tmp_path, {"mask 1/depth_nm": 75, "mask 1/depth_by_pad_nm/20 um": 74})
    with pytest.raises(InputError, match="cd_um"):
        read(tmp_path, {"mask 1/cd_bias_um": 0.1, "mask 1/cd_um/3 um line": 3.2})


def test_a_missed_etch_has_no_depth(tmp_path):
    assert read(tmp_path, {"mask 1/times_etched": 0, "mask 1/depth_nm": 0}).masks[0].times_etched == 0
    with pytest.raises(InputError, match="times_etched"):
        read(tmp_path, {"mask 1/times_etched": 0, "mask 1/depth_nm": 70})


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({"format": "something else"}, "format"),
        ({"level_map_sha256": "ff" * 32}, "this design"),
        ({"measured": [1, 2]}, "measured"),
        ({"measured": None}, "measured"),
        ({"opening_um": None}, "opening_um"),
        ({"order": [{"plate": "mask 1", "edge_move_nm": "0"}]}, "edge_move_nm"),
    ],
)
def test_another_file_is_refused(tmp_path, about, words):
    with pytest.raises(InputError, match=words):
        read(tmp_path, {}, **about)


def test_a_file_that_is_no_json_is_refused(tmp_path):
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        read_as_built(tmp_path / "x.json", doe())
