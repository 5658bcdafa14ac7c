"""Height maps a user brings: every kind of file, any shape, and the same way up in the GDS as in the file."""

import json
from pathlib import Path
from typing import Any

import gdstk
import numpy as np
import pytest
from PIL import Image
from tifffile import imwrite

from fab.levels import Levels, quantise
from sim.store import write_height
from tests.orders import named
from tests.pictures import leave_out_pictures_of_orders

LEVELS, STEP_M, PITCH_UM = 16, 75e-9, 2.0
FULL_M = (LEVELS - 1) * STEP_M


def write_map(path: Path, height_m: np.ndarray, kind: str) -> tuple[str, ...]:
    """Write heights (whole nanometres) as one kind of file; return the options it needs."""
    counts = np.rint(height_m * 1e9).astype(np.uint16)
    levels, pitch, scale = (
        ("--levels", str(LEVELS), "--step", "75 nm"),
        ("--pitch", f"{PITCH_UM} um"),
        ("--scale", "1 nm"),
    )
    if kind == "npy":
        np.save(path, height_m)
        return (*levels, *pitch)
    if kind == "npy counts":
        np.save(path, counts.astype(np.int64))
        return (*levels, *pitch, *scale)
    if kind == "npy float32, columns first":
        np.save(path, np.asfortranarray(height_m.astype(np.float32)))
        return (*levels, *pitch)
    if kind == "exr":
        write_height(path, height_m, PITCH_UM * 1e-6, min(height_m.shape) * PITCH_UM * 1e-6)
        return levels
    # Pictures are stored from the top row down, and +y is up.
    if kind == "tif metres":
        imwrite(path, height_m[::-1].astype(np.float32))
        return (*levels, *pitch)
    if kind == "tif":
        imwrite(path, counts[::-1], compression="zlib")
    else:
        Image.fromarray(counts[::-1].copy()).save(path)
    return (*levels, *pitch, *scale)


@pytest.fixture(autouse=True)
def _without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_pictures_of_orders(monkeypatch)


KINDS = ["npy", "npy counts", "npy float32, columns first", "exr", "tif", "tif metres", "png"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(21, 15), (16, 23)])
def test_a_marked_place_stays_where_it_is(cli, tmp_path, kind, shape):
    """One deep cell up and to the left of the centre, blank glass everywhere else."""
    up, left = 4, 3
    row, column = (shape[0] - 1) // 2 + up, shape[1] // 2 - left
    height = np.full(shape, FULL_M)
    height[row, column] = 0
    path = tmp_path / f"corner.{kind[:3]}"
    done = cli("masks", path, *write_map(path, height, kind), "--out", tmp_path / "order")
    assert done.code == 0, done.err
    cells: list[Any] = gdstk.read_oas(str(named(tmp_path / "order", "ALL.oas"))).cells
    (cell,) = [cell for cell in cells if cell.name.startswith("CORNER_A_") and cell.name.endswith("_DOE")]
    # The centre of the cell, from the centre of the map, in micrometres: half a cell off where the count is even.
    x, y = (column - (shape[1] - 1) / 2) * PITCH_UM, (row - (shape[0] - 1) / 2) * PITCH_UM
    assert x < 0 < y
    for layer in range(1, 5):
        (polygon,) = (p for p in cell.polygons if p.layer == layer)
        (x0, y0), (x1, y1) = polygon.bounding_box()
        assert (x0, x1) == pytest.approx((x - PITCH_UM / 2, x + PITCH_UM / 2), abs=1e-3)
        assert (y0, y1) == pytest.approx((y - PITCH_UM / 2, y + PITCH_UM / 2), abs=1e-3)
    assert cli("verify", tmp_path / "order").code == 0


@pytest.mark.parametrize(
    "kind", [kind if kind in ("npy", "exr") else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
)
def test_every_kind_draws_the_same_masks(cli, tmp_path, rng, kind):
    shape = (37, 52)
    counts = rng.integers(0, round(FULL_M * 1e9) + 1, shape)
    # No height in the middle between two levels, where float32 metres may round the other way.
    counts += (counts % 75 == 37).astype(int)
    path = tmp_path / f"map.{kind[:3]}"
    done = cli("masks", path, *write_map(path, counts * 1e-9, kind), "--out", tmp_path / "order", "--json")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert told["paths"][0] == str(tmp_path / "order")
    assert told["checks"] > 20
    level = np.load(named(tmp_path / "order", "LEVELS.npy"))
    y, x = np.indices(shape)
    inside = (y - 18) ** 2 + (x - 25.5) ** 2 <= (37 / 2) ** 2
    assert np.array_equal(level[inside], quantise(counts * 1e-9, Levels(LEVELS, STEP_M))[inside])
    assert (level[~inside] == LEVELS - 1).all()
    manifest = json.loads((tmp_path / "order" / "manifest.json").read_text())
    assert manifest["source"]["kind"] == "height map"
    assert manifest["source"]["name"] == path.name
    assert manifest["shape"] == [37, 52]
    assert manifest["aperture_mm"] == pytest.approx(37 * PITCH_UM * 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape", [(1, 1), pytest.param((2, 90), marks=pytest.mark.slow), pytest.param((90, 3), marks=pytest.mark.slow)]
)
def test_odd_shapes(cli, tmp_path, rng, shape):
    np.save(tmp_path / "odd.npy", rng.uniform(0, FULL_M, shape))
    options = ("--levels", LEVELS, "--step", "75 nm", "--pitch", "20 um", "--out", tmp_path / "order")
    done = cli("masks", tmp_path / "odd.npy", *options)
    assert done.code == 0, done.err
    assert cli("verify", tmp_path / "order").code == 0


@pytest.mark.parametrize(
    ("stem", "folder", "order_id"),
    [
        ("My lens (v2)", "My_lens__v2", "MY_LENS_V2"),
        pytest.param("Linse-Größe", "Linse_Gro_e", "LINSE_GRO_E", marks=pytest.mark.slow),
        pytest.param("плата", "height", "HEIGHT", marks=pytest.mark.slow),
        pytest.param("…", "height", "HEIGHT", marks=pytest.mark.slow),
    ],
)
def test_strange_names(cli, tmp_path, monkeypatch, stem, folder, order_id):
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / f"{stem}.npy", np.full((9, 9), FULL_M))
    done = cli("masks", f"{stem}.npy", "--levels", LEVELS, "--step", "75 nm", "--pitch", "9 um")
    assert done.code == 0, done.err
    assert done.out.splitlines()[0] == f"masks/{folder}"
    assert named(tmp_path / "masks" / folder, "ALL.oas").name.startswith(f"{order_id}_A_9_")


@pytest.mark.slow
def test_a_map_may_say_more_than_its_file(cli, tmp_path):
    write_height(tmp_path / "plate.exr", np.full((20, 20), FULL_M), 2e-6, 40e-6)
    levels = ("--levels", LEVELS, "--step", "75 nm", "--out", tmp_path / "order")
    assert cli("masks", tmp_path / "plate.exr", *levels, "--pitch", "3 um", "--aperture", "50 um").code == 0
    manifest = json.loads((tmp_path / "order" / "manifest.json").read_text())
    assert (manifest["pitch_um"], manifest["aperture_mm"]) == (3, 0.05)


FILE = """
[process]
levels = 16
level_step = "75 nm"
minimum_line = "3 um"
minimum_space = "3 um"

[process.errors.common_cd_bias]
mean = "-50 nm"

[wafer]
diameter = "150 mm"
blank = "7 in"
dies = [2, 2]
compensate = true
line_splits = ["-100 nm"]
"""


@pytest.mark.slow
def test_a_bare_map_may_have_a_process_and_a_wafer_of_its_own(cli, tmp_path):
    height = np.kron(np.random.default_rng(3).integers(0, LEVELS, (7, 8)), np.ones((2, 2))) * STEP_M
    options = write_map(tmp_path / "a.npy", height, "npy")
    (tmp_path / "lab.toml").write_text(FILE.replace('"7 in"', '"178 mm"'))
    lab = ("--process", tmp_path / "lab.toml", "--wafer", tmp_path / "lab.toml")
    done = cli("masks", tmp_path / "a.npy", *options, *lab, "--out", tmp_path / "order")
    assert done.code == 0, done.err
    manifest = json.loads((tmp_path / "order" / "manifest.json").read_text())
    assert manifest["wafer"]["diameter_mm"] == 150
    assert len(manifest["wafer"]["dies_mm"]) == 4
    assert [mask["edge_move_nm"] for mask in manifest["masks"]] == [50] * 4
    assert [layer["edge_move_nm"] for layer in manifest["splits"][0]["layers"]] == [-50] * 4
    # The rim of the aperture cuts blocks of 4 um down to single pixels.
    assert "narrower than the 3 um that the process prints" in done.err
    refused = cli("masks", tmp_path / "a.npy", "--levels", 8, "--step", "150 nm", "--pitch", "2 um", *lab)
    assert refused.code == 2
    assert "lab.toml: must be for 8 levels" in refused.err


@pytest.mark.slow
def test_a_process_file_may_leave_the_staircase_out_and_say_how_far_the_chrome_reaches(cli, tmp_path):
    height = np.random.default_rng(3).integers(0, LEVELS, (60, 60)) * STEP_M
    options = write_map(tmp_path / "a.npy", height, "npy")
    (tmp_path / "lab.toml").write_text('[process]\nchrome_overlap = "0 um"\n')
    for name, more in (("usual", ()), ("open", ("--process", tmp_path / "lab.toml"))):
        done = cli("masks", tmp_path / "a.npy", *options, *more, "--out", tmp_path / name)
        assert done.code == 0, done.err
    opened = [json.loads((tmp_path / name / "manifest.json").read_text())["chrome"] for name in ("usual", "open")]
    assert [one["opening_diameter_mm"] for one in opened] == [0.11, 0.12]


def test_a_map_one_pixel_wide(cli, tmp_path):
    options = write_map(tmp_path / "a.npy", np.arange(12.0)[None] * STEP_M, "npy")
    (tmp_path / "lab.toml").write_text('[process]\nchrome_overlap = "0 um"\n')
    done = cli("masks", tmp_path / "a.npy", *options, "--process", tmp_path / "lab.toml", "--out", tmp_path / "order")
    assert done.code == 0, done.err


def test_heights_within_one_wave_repeat_after_it(cli, tmp_path):
    """15.4 and 15.6 steps of 16: the top level, and the lowest one a wave higher."""
    height = np.array([[0.0, 1.0], [15.4, 15.6]]).repeat(20, 0).repeat(20, 1) * STEP_M
    options = write_map(tmp_path / "a.npy", height, "npy")
    done = cli("masks", tmp_path / "a.npy", *options, "--aperture", "40 um", "--out", tmp_path / "order")
    assert done.code == 0, done.err
    assert "heights repeat after one wave, 1.2 um: 25 % of the pixels lie above 1.1625 um" in done.err
    levels = np.load(named(tmp_path / "order", "LEVELS.npy"))
    assert [levels[18, 18], levels[18, 21], levels[21, 18], levels[21, 21]] == [0, 1, 15, 0]
    geometry = ("--levels", 8, "--step", "75 nm", "--pitch", "2 um")
    refused = cli("masks", tmp_path / "a.npy", *geometry, "--out", tmp_path / "two")
    assert refused.code == 2
    assert "more than half a step above the top level" in refused.err


def test_a_flat_map_is_ordered_with_a_warning(cli, tmp_path):
    options = write_map(tmp_path / "a.npy", np.full((30, 30), 3 * STEP_M), "npy")
    done = cli("masks", tmp_path / "a.npy", *options, "--out", tmp_path / "order")
    assert done.code == 0, done.err
    assert "warning: every pixel of a has level 3: it does to light what flat glass does" in done.err


def test_all_formats_are_named(cli, tmp_path):
    (tmp_path / "a.bmp").write_bytes(b"BM")
    done = cli("masks", tmp_path / "a.bmp", "--levels", 16, "--step", "75 nm", "--pitch", "2 um")
    assert done.code == 2
    assert "must be one of .exr, .npy, .tif, .tiff, .png, but got .bmp" in done.err


@pytest.mark.parametrize("option", ["--wafer", "--levels", "--out", "--probe"])
def test_what_an_order_has_is_no_part_of_what_was_built(cli, tmp_path, option: str):
    done = cli("masks", tmp_path, "--as-built", tmp_path / "a.json", option, 16)
    assert done.code == 2
    assert f"{option}: does not go with --as-built" in done.err


@pytest.mark.parametrize(
    "options",
    [["--on-violation", "fix"], ["--plates", "gds"], ["--mesh-cells", 9], ["--direct-write"], ["--overwrite"]],
    ids=lambda options: options[0],
)
def test_options_of_what_is_drawn_do_nothing_for_what_was_built(cli, tmp_path, options: list):
    done = cli("masks", tmp_path, "--as-built", tmp_path / "a.json", *options)
    assert done.code == 2
    assert f"{options[0]}: does not go with --as-built" in done.err


def test_a_bare_map_has_no_light_for_a_laser(cli, tmp_path):
    options = write_map(tmp_path / "a.npy", np.full((30, 30), 3 * STEP_M), "npy")
    done = cli("masks", tmp_path / "a.npy", *options, "--probe", "633 nm")
    assert done.code == 2
    assert "--probe: goes with a run" in done.err
