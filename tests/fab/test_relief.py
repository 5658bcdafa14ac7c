from functools import partial

import numpy as np
import pytest
import tifffile
from PIL import Image

from fab.errors import InputError
from fab.grid import Grid
from fab.height import read_height
from fab.levels import Levels, height_of
from fab.solids.columns import PixelWindow, whole
from fab.solids.height_files import write_greymap, write_npy, write_tiff, write_zemax_phase, write_zemax_sag
from fab.units import NM, UM
from tests.fab.maps import level_map_from

# Odd and even sides, so that a swap of the axes shows.
GRID = Grid((7, 10), 1.85 * UM)
SIXTEEN = Levels(16, 75 * NM)
COUNTS = [2, 4, 8, 16, 32, 64]


def some_map(levels=SIXTEEN):
    return level_map_from(np.random.default_rng(3).integers(0, levels.count, GRID.shape), levels, GRID.pitch_m)


@pytest.mark.parametrize("count", COUNTS)
def test_a_tiff_holds_every_level_exactly(tmp_path, count):
    # A step that is no round number: 552 nm / 16 / 0.46.
    level_map = some_map(Levels(count, 75.00123 * NM))
    scale_m = write_tiff(tmp_path / "h.tif", level_map)
    stored = tifffile.imread(tmp_path / "h.tif")
    assert stored.dtype == np.uint16
    assert stored.shape == GRID.shape
    # A count is a whole fraction of the step; the product is off by the last digit of float64 alone.
    assert np.allclose(stored[::-1] * scale_m, height_of(level_map.level, level_map.levels), rtol=1e-15, atol=0)
    assert np.array_equal(stored[::-1] % (65535 // (count - 1)), np.zeros(GRID.shape))


def test_a_tiff_says_scale_pitch_and_orientation_to_other_readers(tmp_path):
    scale_m = write_tiff(tmp_path / "h.tif", some_map())
    with tifffile.TiffFile(tmp_path / "h.tif") as file:
        page = file.pages.first
        assert len(file.pages) == 1
        said = page.description
        across, down = page.get_resolution(unit="CENTIMETER")
    assert f"count x {scale_m!r} m (exact)" in said
    assert "1.85 um" in said
    assert "first row is the one at the highest y" in said
    # A rational of two 32-bit integers.
    assert across == down == pytest.approx(0.01 / GRID.pitch_m, rel=1e-8)
    with Image.open(tmp_path / "h.tif") as image:
        assert np.array_equal(np.asarray(image), tifffile.imread(tmp_path / "h.tif"))


def test_our_own_reader_gives_the_map_back_from_every_kind(tmp_path):
    level_map = some_map()
    height = height_of(level_map.level, SIXTEEN)
    scale_m = write_tiff(tmp_path / "h.tif", level_map)
    assert np.allclose(read_height(tmp_path / "h.tif", GRID.pitch_m, scale_m).height_m, height, rtol=1e-15, atol=0)
    scale_m = write_greymap(tmp_path / "h.png", level_map, bits=16)
    assert np.allclose(read_height(tmp_path / "h.png", GRID.pitch_m, scale_m).height_m, height, rtol=1e-15, atol=0)
    assert write_npy(tmp_path / "h.npy", level_map) == 1.0
    # Single precision: a ten-thousandth of a nanometre in a micrometre.
    assert np.allclose(read_height(tmp_path / "h.npy", GRID.pitch_m).height_m, height, rtol=2**-24, atol=0)


def test_an_array_is_plain_metres_with_row_0_at_the_lowest_y(tmp_path):
    write_npy(tmp_path / "h.npy", some_map())
    stored = np.load(tmp_path / "h.npy", allow_pickle=False)
    assert stored.dtype == np.float32
    assert np.array_equal(stored, height_of(some_map().level, SIXTEEN).astype(np.float32))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("count", COUNTS)
def test_a_greymap_is_linear_from_black_floor_to_white_top(tmp_path, count, bits):
    levels = Levels(count, 75 * NM)
    ramp = np.arange(count, dtype=np.uint8)[None, :].repeat(3, axis=0)
    ramp[0] = 0  # the lowest y, so the last row of the picture
    scale_m = write_greymap(tmp_path / "g.png", level_map_from(ramp, levels), bits)
    with Image.open(tmp_path / "g.png") as image:
        stored, said = np.asarray(image).astype(np.int64), image.info["Description"]
        assert image.mode == {8: "L", 16: "I;16"}[bits]
    white = 2**bits - 1
    assert stored[0, 0] == 0
    assert stored[0, -1] == white
    assert not stored[-1].any()
    # Half a count is what rounding may take; it takes nothing where the steps divide white.
    wrong = np.abs(stored[0] - np.arange(count) * white / (count - 1)).max()
    assert wrong <= 0.5 if white % (count - 1) else wrong < 1e-9
    assert scale_m == pytest.approx(levels.heights_m()[-1] / white, rel=1e-15)
    assert f"count x {scale_m!r} m" in said
    assert ("exact" in said) == (white % (count - 1) == 0)


@pytest.mark.parametrize(("side", "sign"), [("exit", -1), ("entry", 1)])
def test_a_grid_sag_is_the_etch_depth_below_the_blank_surface(tmp_path, side, sign):
    level_map = some_map()
    write_zemax_sag(tmp_path / "s.DAT", level_map, side=side)
    with open(tmp_path / "s.DAT", encoding="ascii") as file:
        header = file.readline().split()
    assert [int(v) for v in header[:2]] == [10, 7]
    assert [float(v) for v in header[2:]] == [1.85e-3, 1.85e-3, 0, 0, 0]
    table = np.loadtxt(tmp_path / "s.DAT", skiprows=1)
    assert table.shape == (70, 5)
    assert not table[:, 1:].any()
    # From -x, +y along x and then down: reshaped, the first row is the highest y.
    sag_mm = table[:, 0].reshape(7, 10)[::-1]
    depth_mm = (15 - level_map.level.astype(float)) * 75e-6
    # Nine decimals of a millimetre hold whole picometres, which 75 nm steps are.
    assert np.allclose(sag_mm, sign * (depth_mm if side == "exit" else depth_mm[:, ::-1]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("side", ["exit", "entry"])
def test_a_grid_phase_is_positive_where_there_is_more_glass(tmp_path, side):
    level_map = some_map()
    write_zemax_phase(tmp_path / "p.DAT", level_map, 0.46 / 550e-9, side=side)
    with open(tmp_path / "p.DAT", encoding="ascii") as file:
        assert [float(v) for v in file.readline().split()] == [10, 7, 1.85e-3, 1.85e-3, 0, 0, 0]
    table = np.loadtxt(tmp_path / "p.DAT", skiprows=1)
    assert not table[:, 1:].any()
    radians = table[:, 0].reshape(7, 10)[::-1]
    if side == "entry":  # axes of Zemax are right-handed: +x is on the left along the light
        radians = radians[:, ::-1]
    # Nine decimals.
    assert np.allclose(radians, 2 * np.pi * 0.46 / 550e-9 * 75e-9 * level_map.level, rtol=0, atol=6e-10)
    with pytest.raises(InputError, match="DAT"):
        write_zemax_phase(tmp_path / "p.txt", level_map, 1e6)


@pytest.mark.parametrize("write", [write_zemax_sag, partial(write_zemax_phase, waves_per_metre=1e6)])
def test_a_relief_is_on_one_of_two_faces(tmp_path, write):
    with pytest.raises(InputError, match="side: the relief must be on one of the faces exit, entry, but got 'foo'"):
        write(tmp_path / "p.DAT", some_map(), side="foo")
    assert not (tmp_path / "p.DAT").exists()


def test_a_window_of_a_grid_sag_lies_where_it_is_on_the_plate(tmp_path):
    window = PixelWindow(1, 4, 6, 5)
    level_map = some_map()
    write_zemax_sag(tmp_path / "s.dat", level_map, window)
    header = np.loadtxt(tmp_path / "s.dat", max_rows=1)
    columns, rows, step_x, step_y, _, x_mm, y_mm = header
    points_x = x_mm + (np.arange(columns) - (columns - 1) / 2) * step_x
    points_y = y_mm + (np.arange(rows) - (rows - 1) / 2) * step_y
    # Twelve digits in the header.
    assert np.allclose(points_x * 1e-3, GRID.axis_m("x")[4:9], rtol=0, atol=1e-14)
    assert np.allclose(points_y * 1e-3, GRID.axis_m("y")[1:7], rtol=0, atol=1e-14)
    sag_mm = np.loadtxt(tmp_path / "s.dat", skiprows=1)[:, 0].reshape(6, 5)[::-1]
    assert np.allclose(sag_mm, (level_map.level[1:7, 4:9] - 15.0) * 75e-6, rtol=0, atol=1e-15)
    write_zemax_sag(tmp_path / "entry.dat", level_map, window, side="entry")
    assert np.loadtxt(tmp_path / "entry.dat", max_rows=1)[5:] == pytest.approx([-x_mm, y_mm], abs=1e-14)
    x_m, y_m = window.edges_m(GRID)
    assert np.allclose((x_m[1:] + x_m[:-1]) / 2, GRID.axis_m("x")[4:9], rtol=0, atol=1e-18)
    assert np.allclose((y_m[1:] + y_m[:-1]) / 2, GRID.axis_m("y")[1:7], rtol=0, atol=1e-18)


@pytest.mark.parametrize(
    ("window", "words"),
    [
        (PixelWindow(0, 0, 4, 10), "at least 5 points"),
        (PixelWindow(0, 6, 7, 4), "at least 5 points"),
        (PixelWindow(0, 0, 8, 10), "must be filled and lie on"),
        (PixelWindow(-1, 0, 5, 5), "must be filled and lie on"),
        (PixelWindow(0, 0, 0, 5), "must be filled and lie on"),
    ],
)
def test_windows_that_no_program_can_read_are_refused(tmp_path, window, words):
    with pytest.raises(InputError, match=words):
        write_zemax_sag(tmp_path / "s.DAT", some_map(), window)
    assert not list(tmp_path.iterdir())


def test_wrong_suffixes_are_refused(tmp_path):
    with pytest.raises(InputError, match="DAT"):
        write_zemax_sag(tmp_path / "s.txt", some_map())


def test_the_same_map_gives_the_same_bytes(tmp_path):
    def files(folder):
        folder.mkdir()
        write_tiff(folder / "h.tif", some_map())
        write_npy(folder / "h.npy", some_map())
        write_greymap(folder / "h.png", some_map())
        write_zemax_sag(folder / "h.DAT", some_map(), whole(GRID))
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    assert files(tmp_path / "a") == files(tmp_path / "b")
