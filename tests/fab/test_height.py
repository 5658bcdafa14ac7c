import numpy as np
import pytest
import tifffile
from PIL import Image

from fab.aperture import RoundAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.height import HeightMap, read_height
from fab.units import NM, UM

HEIGHTS = np.linspace(0, 1.1e-6, 12).reshape(3, 4)
COUNTS = np.arange(12, dtype=np.uint16).reshape(3, 4)


def test_a_bare_array_is_metres_with_row_zero_lowest(tmp_path):
    np.save(tmp_path / "h.npy", HEIGHTS)
    found = read_height(tmp_path / "h.npy", pitch=UM)
    assert np.array_equal(found.height_m, HEIGHTS)
    assert found.grid == Grid((3, 4), UM)
    assert found.relief == RoundAperture(3 * UM)
    assert read_height(tmp_path / "h.npy", pitch=UM, aperture=2 * UM).relief == RoundAperture(2 * UM)


def test_single_precision_stays_single(tmp_path):
    np.save(tmp_path / "h.npy", HEIGHTS.astype(np.float32))
    assert read_height(tmp_path / "h.npy", pitch=UM).height_m.dtype == np.float32
    np.save(tmp_path / "h.npy", np.asfortranarray(HEIGHTS))
    assert read_height(tmp_path / "h.npy", pitch=UM).height_m.flags.c_contiguous


def test_counts_are_scaled(tmp_path):
    np.save(tmp_path / "h.npy", COUNTS)
    found = read_height(tmp_path / "h.npy", pitch=UM, scale=75 * NM)
    assert np.array_equal(found.height_m, COUNTS * (75 * NM))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_png_is_turned_so_that_its_top_is_plus_y(tmp_path, kind):
    Image.fromarray(COUNTS.astype(kind)).save(tmp_path / "h.png")
    found = read_height(tmp_path / "h.png", pitch=UM, scale=NM)
    assert np.array_equal(found.height_m, COUNTS[::-1] * NM)


@pytest.mark.parametrize("values", [HEIGHTS.astype(np.float32), HEIGHTS], ids=["float32", "float64"])
@pytest.mark.parametrize("suffix", ["tif", "TIFF"])
def test_a_tiff_of_floats_is_metres_and_turned(tmp_path, values, suffix):
    tifffile.imwrite(tmp_path / f"h.{suffix}", values)
    found = read_height(tmp_path / f"h.{suffix}", pitch=UM)
    assert np.array_equal(found.height_m, values[::-1])


def test_a_tiff_of_counts_is_scaled(tmp_path):
    tifffile.imwrite(tmp_path / "h.tif", COUNTS)
    assert np.array_equal(read_height(tmp_path / "h.tif", 1e-6, 1e-9).height_m, COUNTS[::-1] * 1e-9)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.where(HEIGHTS > 1e-6, np.nan, HEIGHTS), "finite number.*2 wrong pixels, the first at row 2, column 2"),
        (HEIGHTS - 1e-7, "negative.*1 wrong pixel, the first at row 0, column 0"),
        (HEIGHTS.astype(complex), "real numbers"),
        (HEIGHTS > 1e-7, "real numbers"),
        (HEIGHTS[0], "two axes"),
        (HEIGHTS[None], "two axes"),
        (COUNTS, "integers need a scale"),
        (np.array([["a", "b"]]), "real numbers"),
        (np.zeros((0, 4)), "plain numbers"),
    ],
)
def test_bad_arrays_are_refused_by_file_rule_and_cure(tmp_path, values, message):
    np.save(tmp_path / "h.npy", values)
    with pytest.raises(InputError, match=f"h.npy: .*{message}"):
        read_height(tmp_path / "h.npy", pitch=UM)


@pytest.mark.parametrize("name", ["h.npy", "h.tif", "h.png"])
def test_cut_empty_and_missing_files_are_refused(tmp_path, name):
    path = tmp_path / name
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 65535, (40, 40)).astype(np.uint16)
    if name == "h.npy":
        np.save(path, noise)
    elif name == "h.tif":
        tifffile.imwrite(path, noise)
    else:
        Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    for data in (whole[: len(whole) // 2], whole[:20], b"", b"not an image at all"):
        path.write_bytes(data)
        with pytest.raises(InputError, match=name):
            read_height(path, UM, NM)
    path.unlink()
    with pytest.raises(InputError, match="must exist"):
        read_height(path, UM, NM)


def test_other_kinds_and_colours_are_refused(tmp_path):
    (tmp_path / "h.csv").write_text("1,2")
    with pytest.raises(InputError, match=r"one of \.npy, \.png, \.tif, \.tiff, but got \.csv"):
        read_height(tmp_path / "h.csv", UM)
    Image.new("RGB", (4, 4)).save(tmp_path / "h.png")
    with pytest.raises(InputError, match="colours"):
        read_height(tmp_path / "h.png", UM, NM)
    tifffile.imwrite(tmp_path / "h.tif", np.zeros((3, 40, 40), dtype=np.float32), photometric="minisblack")
    with pytest.raises(InputError, match="3 pages"):
        read_height(tmp_path / "h.tif", UM)


def test_pitch_and_scale_are_asked_for(tmp_path):
    np.save(tmp_path / "h.npy", HEIGHTS)
    with pytest.raises(InputError, match="Give the pitch"):
        read_height(tmp_path / "h.npy")
    assert read_height(tmp_path / "h.npy", "1.85 um", aperture="3 um").grid.pitch_m == 1.85e-6
    with pytest.raises(InputError, match="pitch: must be metres or text with a unit"):
        read_height(tmp_path / "h.npy", "1.85")
    with pytest.raises(InputError, match="scale must be positive"):
        read_height(tmp_path / "h.npy", UM, 0.0)
    with pytest.raises(InputError, match="pitch"):
        read_height(tmp_path / "h.npy", -UM)


def test_what_the_usual_aperture_cuts_off_is_said(tmp_path, caplog):
    np.save(tmp_path / "h.npy", HEIGHTS)
    read_height(tmp_path / "h.npy", pitch=UM)
    assert "no aperture was given, so 33 % of it, beyond a circle of 3 um, stay blank glass" in caplog.text
    caplog.clear()
    read_height(tmp_path / "h.npy", pitch=UM, aperture="3 um")
    rim = np.where(Grid((3, 4), UM).inside_circle(3 * UM), HEIGHTS, 0.0)
    np.save(tmp_path / "h.npy", rim)
    read_height(tmp_path / "h.npy", pitch=UM)
    assert not caplog.text


def test_a_height_map_belongs_to_its_grid():
    with pytest.raises(InputError, match="grid's shape"):
        HeightMap(HEIGHTS, Grid((4, 3), UM), UM)
    with pytest.raises(InputError, match="aperture"):
        HeightMap(HEIGHTS, Grid((3, 4), UM), 0.0)
    with pytest.raises(InputError, match="float32 or float64"):
        HeightMap(HEIGHTS.astype(np.float16), Grid((3, 4), UM), UM)
