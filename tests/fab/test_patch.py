import cadquery
import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels, height_of
from fab.solids.columns import BASE_M, PixelWindow
from fab.solids.patch import Patch, patch_body, patch_step
from fab.solids.step import step_bodies
from fab.units import NM, UM
from tests.fab.maps import level_map_from

SIXTEEN = Levels(16, 75 * NM)

PATCHES = {
    "one pixel": [[5]],
    "a row": [[0, 15, 15, 3]],
    "kissing corners": [[15, 0], [0, 15]],
    "empty plane": [[0] * 4] * 3,
    "full plane": [[15] * 3] * 5,
}


@pytest.mark.parametrize("level_map", PATCHES.values(), ids=PATCHES.keys())
def test_a_patch_has_the_volume_of_its_columns(tmp_path, level_map):
    level_map = level_map_from(level_map, SIXTEEN, 1.85 * UM)
    window = PixelWindow(0, 0, *level_map.shape)
    patch_step(tmp_path / "p.step", level_map, window)
    want = (height_of(level_map.level, SIXTEEN) + BASE_M).sum() * (1.85 * UM) ** 2
    assert patch_body(level_map, window).volume_m3 == pytest.approx(want, rel=1e-14)
    # Edges of 1e-3 mm are written with 15 digits.
    assert volumes(step_bodies(tmp_path / "p.step")) == pytest.approx({"PATCH": want}, rel=1e-11)


def volumes(bodies):
    return {name: body.volume_m3 for name, body in bodies.items()}


def test_a_patch_lies_where_its_window_does(tmp_path):
    level_map = np.random.default_rng(2).integers(0, 16, (20, 30)).astype(np.uint8)
    level_map[5, 8] = 15
    level_map, window = level_map_from(level_map), PixelWindow(5, 8, 4, 6)
    patch_step(tmp_path / "p.step", level_map, window)
    (shape,) = [shape for shape, *_ in cadquery.Assembly.importStep(str(tmp_path / "p.step"))]
    bounds = shape.BoundingBox(1e-9)
    box = [bounds.xmin, bounds.xmax, bounds.ymin, bounds.ymax, bounds.zmin, bounds.zmax]
    # From the blank surface down to the deepest floor and 10 um more.
    assert box == pytest.approx([-7e-3, -1e-3, -5e-3, -1e-3, -11.125e-3, 0], abs=1e-6)
    want, found = patch_body(level_map, window), step_bodies(tmp_path / "p.step")["PATCH"]
    assert found.volume_m3 == pytest.approx(want.volume_m3, rel=1e-11)
    # A hundredth of a nanometre, as in the proof of an order.
    assert found.centre_m == pytest.approx(want.centre_m, abs=1e-11)


def test_patches_too_large_for_step_are_refused_with_the_number_of_boxes(tmp_path):
    level_map = level_map_from(np.indices((50, 50)).sum(axis=0) % 2)
    with pytest.raises(InputError, match=r"at most 2000 boxes.*got 2500 in 50 x 50 pixels.*mesh"):
        patch_step(tmp_path / "p.step", level_map, PixelWindow(0, 0, 50, 50))
    with pytest.raises(InputError, match="window"):
        patch_step(tmp_path / "p.step", level_map, PixelWindow(0, 46, 5, 5))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("patch", "window"),
    [
        (Patch(0.0, 0.0, 4 * UM), PixelWindow(8, 13, 4, 4)),
        (Patch(-15 * UM, 10 * UM, 1 * UM), None),
        (Patch(-14.5 * UM, 9.5 * UM, 1 * UM), PixelWindow(19, 0, 1, 1)),
        (Patch(5 * UM, -4 * UM, 3.4 * UM), PixelWindow(4, 18, 3, 3)),
        (Patch(5 * UM, -4 * UM, 0.4 * UM), None),
        (Patch(0.0, 0.0, 21 * UM), None),
        (Patch(float("nan"), 0.0, 1 * UM), None),
        (Patch(0.0, 0.0, float("inf")), None),
    ],
)
def test_a_patch_is_the_pixels_nearest_to_what_was_asked_for(patch, window):
    grid = Grid((20, 30), UM)
    if window is None:
        with pytest.raises(InputError, match=r"patch|window"):
            patch.window(grid)
        return
    found = patch.window(grid)
    # Half a pixel either way where its middle cannot be that of whole pixels.
    assert (found.rows, found.columns) == (window.rows, window.columns)
    assert found.centre_m(grid) == pytest.approx((patch.x_m, patch.y_m), abs=0.5 * UM * (1 + 1e-9))
    assert abs(found.row - window.row) <= 1
    assert abs(found.column - window.column) <= 1


def test_a_patch_knows_what_is_too_large_for_its_files():
    level_map = level_map_from(np.indices((60, 60)).sum(axis=0) % 2)
    Patch(0.0, 0.0, 44 * UM).require(level_map)
    with pytest.raises(InputError, match=r"at most 2000 boxes.*got 2025 in 45 x 45 pixels.*take the mesh alone"):
        Patch(0.0, 0.0, 45 * UM).require(level_map)
    Patch(0.0, 0.0, 60 * UM, step=False).require(level_map)
    wide = level_map_from(np.zeros((1100, 1100)))
    with pytest.raises(InputError, match=r"at most 1000 x 1000 pixels.*got 1001 x 1001.*at most 1 mm"):
        Patch(0.0, 0.0, 1001 * UM).require(wide)
