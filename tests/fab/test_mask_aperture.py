"""Apertures of any mask: their cells, areas, rims and records, against rasters that are fine enough to count."""

import json
import math

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from fab.aperture import MaskAperture, RectangularAperture, aperture_from, diameter_of
from fab.aperture.picture import read_mask
from fab.errors import InputError
from fab.grid import Grid
from fab.height import read_height
from fab.layout.geometry import Chrome
from fab.level_map import LevelMap, read_level_map, write_level_map
from fab.levels import Levels
from fab.pictures import write_pixels

UM = 1e-6
GRID = Grid((24, 40), 2 * UM)
FINE = 8  # per cell: a quarter of a micrometre


def drawn() -> np.ndarray:
    """A bar with an island of chrome, a block that touches it at a corner, and a lone cell in the highest row."""
    plane = np.zeros(GRID.shape, bool)
    plane[2:14, 3:20] = True
    plane[6:9, 8:12] = False
    plane[14:22, 20:36] = True
    plane[23, 39] = True
    return plane


def fine(plane: np.ndarray, moved: int) -> np.ndarray:
    """The plane on the fine raster, its rim moved inward by so many of its steps."""
    square = np.ones((2 * moved + 1, 2 * moved + 1), bool)
    return binary_erosion(np.kron(plane, np.ones((FINE, FINE), bool)), square)


MASK = MaskAperture.of(drawn(), GRID.pitch_m)


@pytest.mark.parametrize("moved", [0, 1, 3, 4, 8, 11, 16])
def test_a_rim_moves_as_counted_on_a_finer_raster(moved):
    mask, wanted = MASK.shrunk(moved * GRID.pitch_m / FINE), fine(drawn(), moved)
    step = GRID.pitch_m / FINE
    assert mask.area_m2 == pytest.approx(wanted.sum() * step**2, rel=1e-12)
    assert mask.area_in(step, 3) == pytest.approx(3 * wanted.sum())
    rows, columns = (np.flatnonzero(wanted.any(axis)) for axis in (1, 0))
    (low, left), (high, right) = ((rows[end], columns[end]) for end in (0, -1))
    assert mask.sizes_m == pytest.approx(((right - left + 1) * step, (high - low + 1) * step))
    edges_y, edges_x = ((np.arange(n * FINE + 1) - n * FINE / 2) * step for n in GRID.shape)
    assert mask.extent_m == pytest.approx(
        (2 * max(-edges_y[low], edges_y[high + 1]), 2 * max(-edges_x[left], edges_x[right + 1]))
    )
    assert mask.widest_m == max(mask.extent_m)
    farthest = [
        math.hypot(max(-edges_y[y], edges_y[y + 1]), max(-edges_x[x], edges_x[x + 1])) for y, x in np.argwhere(wanted)
    ]
    assert mask.reach_m == pytest.approx(max(farthest))
    inside = mask.inside(Grid(wanted.shape, step))
    np.testing.assert_array_equal(inside, wanted)
    assert mask.count_inside(Grid(wanted.shape, step)) == wanted.sum()


def test_cells_of_a_mask_are_its_own_and_points_on_its_rim_are_inside():
    np.testing.assert_array_equal(MASK.inside(GRID), drawn())
    np.testing.assert_array_equal(MASK.plane, drawn())
    corner = np.array([(2 - 12) * 2 * UM]), np.array([(3 - 20) * 2 * UM])
    assert MASK.contains(*corner).all()
    assert not MASK.contains(corner[0] - 1e-9, corner[1]).any()
    assert not MASK.contains(np.array([1.0]), np.array([0.0])).any()


def test_a_moved_rim_moves_on_by_the_sum():
    assert MASK.shrunk(1 * UM).shrunk(0.5 * UM) == MASK.shrunk(1.5 * UM)
    with pytest.raises(InputError, match="moves inward"):
        MASK.shrunk(-0.1 * UM)


def test_masks_are_compared_by_their_cells():
    again = MaskAperture.of(drawn(), GRID.pitch_m)
    assert again == MASK
    assert hash(again) == hash(MASK)
    other = drawn()
    other[0, 0] = True
    assert MaskAperture.of(other, GRID.pitch_m) != MASK
    with pytest.raises(AttributeError):
        MASK.pitch_m = 1.0  # type: ignore[misc]


def signed_area(loop: np.ndarray) -> float:
    x, y = loop.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


@pytest.mark.parametrize("seed", range(6))
def test_outlines_enclose_what_is_open_on_their_left(seed):
    plane = np.random.default_rng(seed).random((9, 11)) < 0.5  # with many parts that touch at corners
    mask = MaskAperture.of(plane, UM)
    loops = mask.outlines_m(4)
    assert sum(map(signed_area, loops)) == pytest.approx(mask.area_m2, rel=1e-12)
    for loop in loops:
        sides = np.roll(loop, -1, axis=0) - loop
        assert ((sides == 0).sum(axis=1) == 1).all()  # along one axis
        assert ((sides[:, 0] == 0) != (np.roll(sides, 1, axis=0)[:, 0] == 0)).all()  # a turn at every corner
        left = (
            loop + sides / 2 + 1e-9 * np.stack([-sides[:, 1], sides[:, 0]], axis=1) / np.abs(sides).sum(axis=1)[:, None]
        )
        assert mask.contains(left[:, 1], left[:, 0]).all()


@pytest.mark.parametrize(("unit_m", "digits"), [(1.0, None), (1e-3, 9)])
def test_a_record_is_json_and_comes_back(unit_m, digits):
    mask = MASK.shrunk(1.25e-6)
    record = json.loads(json.dumps(mask.record(unit_m, digits)))
    assert aperture_from(record, unit_m, None if digits is None else 18) == mask
    # Rows that are alike stand there once.
    assert len(record["rows"]) == 7
    assert sum(row[0] for row in record["rows"]) == 24


def test_a_record_of_a_large_plate_is_small():
    y, x = np.ogrid[-1000:1000, -1000:1000]
    ring = (np.hypot(y, x) < 990) & (np.hypot(y, x) > 700)
    assert len(json.dumps(MaskAperture.of(ring, UM).record())) < 60_000


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [10**9, 10**9]},
        {"shape": [24, 40.0]},
        {"shape": [24]},
        {"shape": "24"},
        {"shape": [24, 39]},
        {"shape": [0, 40]},
        {"pitch": 0.0},
        {"pitch": -1e-6},
        {"pitch": "nan"},
        {"pitch": None},
        {"inset": -1e-6},
        {"inset": 1e400},
        {"rows": None},
        {"rows": []},
        {"rows": [[24, 3, 2]]},
        {"rows": [[24, 3]]},
        {"rows": [[24, 3, 41]]},
        {"rows": [[24, -1, 3]]},
        {"rows": [[23, 1, 3]]},
        {"rows": [[10**12, 1, 3]]},
        {"rows": [[24, 1, 3.5]]},
        {"rows": [[24, True, 3]]},
        {"rows": [[]]},
        {"rows": [3]},
        {"rows": {"24": 1}},
    ],
    ids=str,
)
def test_damaged_and_hostile_records_are_refused(change):
    record = {**MASK.record(), **change}
    with pytest.raises(InputError, match="here: must hold shape, pitch, inset and rows of a mask"):
        aperture_from(record, where="here")
    del record["rows"]
    with pytest.raises(InputError, match="rows of a mask"):
        aperture_from(record)


def test_a_level_map_is_blank_where_the_mask_is_closed_and_comes_back(tmp_path):
    levels = Levels(4, 0.3 * UM)
    made = LevelMap(np.zeros(GRID.shape, np.uint8), levels, GRID, MASK)
    np.testing.assert_array_equal(made.level == 0, drawn())
    assert (made.level[~drawn()] == 3).all()
    write_level_map(tmp_path / "map.npz", made)
    again = read_level_map(tmp_path / "map.npz")
    assert (again.relief, again.digest) == (MASK, made.digest)
    with pytest.raises(InputError, match="must be round here, but got mask of 74 um x 44 um"):
        diameter_of(MASK)


@pytest.mark.parametrize("grid", [Grid((40, 24), 2 * UM), Grid((24, 40), 1 * UM)])
def test_a_mask_of_another_raster_is_refused(grid):
    with pytest.raises(InputError, match=r"aperture: (must lie on the raster|a mask must have the raster)"):
        LevelMap(np.zeros(grid.shape, np.uint8), Levels(4, 0.3 * UM), grid, MASK)


def test_a_mask_that_is_open_nowhere_is_no_relief_and_an_overlap_must_leave_some_of_one():
    nothing = MaskAperture.of(np.zeros(GRID.shape, bool), GRID.pitch_m)
    assert (nothing.area_m2, nothing.extent_m, nothing.reach_m, nothing.sizes_m) == (0.0, (0.0, 0.0), 0.0, (0.0, 0.0))
    assert not nothing.inside(GRID).any()
    assert nothing.outlines_m(4) == []
    with pytest.raises(InputError, match="aperture"):
        LevelMap(np.zeros(GRID.shape, np.uint8), Levels(4, 0.3 * UM), GRID, nothing)
    # All parts close but for the block, 32 x 16 um, and the bar right of its island, 16 x 24 um.
    left = (32 - 15) * (16 - 15) + (16 - 15) * (24 - 15)
    assert Chrome(overlap_m=7.5 * UM).opening(MASK).area_m2 == pytest.approx(left * UM**2)
    with pytest.raises(InputError, match="leave an opening in an aperture of mask of 74 um x 44 um"):
        Chrome(overlap_m=8 * UM).opening(MASK)


# Pictures.


def test_up_in_a_picture_is_up_on_the_plate_and_row_0_of_an_array_is_the_lowest(tmp_path):
    from PIL import Image

    plane = drawn()
    Image.fromarray(plane[::-1].astype(np.uint8) * 255).save(tmp_path / "mask.png")
    np.save(tmp_path / "mask.npy", plane)
    for name in ("mask.png", "mask.npy"):
        np.testing.assert_array_equal(read_mask(tmp_path / name, GRID.shape), plane)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("grey.png", lambda p: np.where(p, 128, 127).astype(np.uint8)),
        ("deep.png", lambda p: np.where(p, 32768, 32767).astype(np.uint16)),
        ("deep.tif", lambda p: np.where(p, 65535, 0).astype(np.uint16)),
        ("share.tif", lambda p: np.where(p, 0.51, 0.5).astype(np.float32)),
        ("colour.png", lambda p: np.where(p[..., None], [255, 255, 0], [0, 0, 255]).astype(np.uint8)),
        ("share.npy", lambda p: np.where(p, 0.51, 0.5)),
        ("whole.npy", lambda p: p.astype(np.int64)),
    ],
)
def test_what_is_brighter_than_half_of_white_is_open(tmp_path, name, values):
    made = values(drawn())
    np.save(tmp_path / name, made) if name.endswith(".npy") else write_pixels(tmp_path / name, made)
    np.testing.assert_array_equal(read_mask(tmp_path / name, GRID.shape), drawn())


def test_transparent_pixels_are_closed_and_single_bits_count(tmp_path):
    from PIL import Image

    plane = drawn()[::-1]
    clear = np.full((*GRID.shape, 4), 255, np.uint8)
    clear[..., 3] = plane * 255
    Image.fromarray(clear).save(tmp_path / "clear.png")
    Image.fromarray(plane).save(tmp_path / "bits.png")
    for name in ("clear.png", "bits.png"):
        np.testing.assert_array_equal(read_mask(tmp_path / name, GRID.shape), drawn())


def test_a_picture_is_stretched_with_its_proportions(tmp_path):
    small = drawn()[::4, ::4]
    np.save(tmp_path / "small.npy", small)
    np.testing.assert_array_equal(read_mask(tmp_path / "small.npy", GRID.shape), np.kron(small, np.ones((4, 4), bool)))
    np.save(tmp_path / "large.npy", np.kron(drawn(), np.ones((3, 3))))
    np.testing.assert_array_equal(read_mask(tmp_path / "large.npy", GRID.shape), drawn())


def bomb(path):
    """A picture of 10000 x 10000 pixels in some kilobytes."""
    from PIL import Image

    Image.new("L", (10_000, 10_000)).save(path, compress_level=9)


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("mask.png", lambda path: write_pixels(path, np.full((24, 40), 127, np.uint8)), "open, brighter than half"),
        (
            "mask.png",
            lambda path: write_pixels(path, np.full((40, 24), 255, np.uint8)),
            "proportions of the DOE's 40 x 24",
        ),
        ("mask.png", lambda path: path.write_bytes(b"no picture"), "whole and of its kind"),
        ("mask.png", bomb, "a picture must have from 1 to"),
        ("mask.npy", lambda path: np.save(path, np.full((24, 40), np.nan)), "finite values"),
        ("mask.npy", lambda path: np.save(path, np.zeros((24, 40, 5))), "grey values or colours"),
        ("mask.npy", lambda path: np.save(path, np.zeros((24, 40), complex)), "grey values or colours"),
        ("mask.npy", lambda path: np.save(path, np.zeros(40)), "grey values or colours"),
        ("mask.jpg", lambda path: path.write_bytes(b""), "must be a file of"),
        ("mask.png", lambda path: None, "mask.png"),
    ],
    ids=["grey", "turned", "text", "bomb", "nan", "planes", "complex", "line", "kind", "missing"],
)
def test_what_is_no_mask_is_refused_by_its_file(tmp_path, name, write, words):
    write(tmp_path / name)
    with pytest.raises(InputError, match=words) as error:
        read_mask(tmp_path / name, GRID.shape)
    assert name in str(error.value)


def test_a_bare_height_map_takes_the_picture_of_its_relief(tmp_path):
    np.save(tmp_path / "map.npy", np.full(GRID.shape, 1e-7))
    np.save(tmp_path / "mask.npy", drawn())
    height = read_height(tmp_path / "map.npy", GRID.pitch_m, aperture=str(tmp_path / "mask.npy"))
    assert height.relief == MASK
    whole = RectangularAperture(GRID.extent_m)
    assert MaskAperture.of(np.ones(GRID.shape, bool), GRID.pitch_m).area_m2 == pytest.approx(whole.area_m2)
