from math import cos, pi, radians
from typing import Any

import numpy as np
import pytest

from fab.errors import InputError
from sim.obstruction import CameraView, Fence
from sim.obstruction.fence import _FINISHES, _Lamp, _Wires, rods, seen, tilted_plane

VIEW = CameraView((256, 512), 12.9e-6, 50e-3)
GREY = np.full((3, 256, 512), 0.5, np.float32)
PLAIN: dict[str, Any] = {
    "tilt_rad": (0.0, 0.0),
    "sag_m": (0.0, 0.0),
    "bend_m": (0.0, 0.0),
    "rotation_rad": (0.0, 0.0),
}
LAMP = _Lamp(0.0, 0.0, 1.0, 1.0, 0.25)


def drawn_mask(fence: Fence, seed: int = 0, view: CameraView = VIEW) -> np.ndarray:
    grey = np.full((3, *view.shape), 0.5, np.float32)
    return np.asarray(fence.draw(np.random.default_rng(seed), view, grey).mask)


def test_a_wire_of_4_mm_at_60_cm_is_26_pixels_wide():
    mask = drawn_mask(Fence(patterns=("bars",), depth_m=(0.6, 0.6), mesh_m=(0.05, 0.05), **PLAIN))
    row = mask[7] > 0.5
    edges = np.flatnonzero(np.diff(row.astype(int)))
    whole = edges[1:-1] if row[0] else edges
    # Whole pixels of 25.84.
    assert {int(b - a) for a, b in zip(whole[::2], whole[1::2], strict=False)} <= {25, 26}
    # float32 coordinates of some 500 pixels, and slopes from their differences.
    assert np.ptp(mask, axis=0).max() < 1e-3


@pytest.mark.parametrize("pixels", [0.3, 1.0, 3.7, 20.0])
def test_the_area_of_bars_is_exact(pixels: float):
    # 64 pixels of mesh, so that the frame holds eight of them wherever they begin.
    mesh_m = 64 * VIEW.pixel_at_m(0.5)
    wire_m = pixels * VIEW.pixel_at_m(0.5)
    fence = Fence(patterns=("bars",), depth_m=(0.5, 0.5), mesh_m=(mesh_m, mesh_m), wire_m=(wire_m, wire_m), **PLAIN)
    # As above, relative to the width.
    np.testing.assert_allclose(drawn_mask(fence).sum(axis=1), 8 * pixels, rtol=1e-3)


def test_turned_bars_cover_as_much():
    mesh_m, wire_m = 20 * VIEW.pixel_at_m(0.5), 3 * VIEW.pixel_at_m(0.5)
    for angle in (0.3, 0.8, 1.5):
        turned: dict[str, Any] = PLAIN | {"rotation_rad": (angle, angle)}
        fence = Fence(
            patterns=("bars",), depth_m=(0.5, 0.5), mesh_m=(mesh_m, mesh_m), wire_m=(wire_m, wire_m), **turned
        )
        # The frame's edges cut the last of some twenty wires.
        assert drawn_mask(fence).mean() == pytest.approx(3 / 20, rel=0.05)


@pytest.mark.parametrize("pattern", ["grid", "chain_link"])
def test_two_families_cover_what_two_families_cover(pattern: Any):
    wide = CameraView((256, 256), 12.9e-6, 6e-3)
    fence = Fence(patterns=(pattern,), depth_m=(0.5, 0.5), mesh_m=(0.04, 0.04), diamond_rad=(0.8, 0.8), **PLAIN)
    alone = 4 / 40
    # Bends that reach past each other add a little to a chain-link fence, or take it from the crossing.
    assert drawn_mask(fence, 1, wide).mean() == pytest.approx(1 - (1 - alone) ** 2, rel=0.04)


def test_chain_link_is_a_lattice_of_diamonds():
    # 45 degrees: a mesh of 40 mm repeats every 40 sqrt(2) mm along and across.
    period = 64
    mesh_m = period / 2**0.5 * VIEW.pixel_at_m(0.5)
    wire_m = 4 * VIEW.pixel_at_m(0.5)
    square: dict[str, Any] = PLAIN | {"patterns": ("chain_link",), "diamond_rad": (pi / 4, pi / 4)}
    mask = drawn_mask(Fence(depth_m=(0.5, 0.5), mesh_m=(mesh_m, mesh_m), wire_m=(wire_m, wire_m), **square))
    np.testing.assert_allclose(mask[:-period, :-period], mask[period:, period:], atol=2e-3)
    # Half a period on, a front bend meets the one behind it: the same lattice but for the hooks.
    assert np.abs(mask[:-32, :-32] - mask[32:, 32:]).mean() < 0.01
    assert np.abs(mask[:-16] - mask[16:]).mean() > 0.1


def test_a_tilted_fence_is_denser_but_its_wires_are_as_thick():
    mesh_m, wire_m, tilt = 40 * VIEW.pixel_at_m(0.5), 6 * VIEW.pixel_at_m(0.5), radians(50)
    plane = tilted_plane(VIEW, 0.5, tilt, 0.0)
    mask, _ = seen(rods(plane.u, mesh_m, along_u=False), plane, wire_m, LAMP)
    row = mask[128]
    middles = np.flatnonzero((np.diff((row > 0.5).astype(int))) == 1)
    near_axis = middles[np.abs(middles - 256) < 90]
    # Perspective changes the spacing by some per cent this far from the axis.
    assert np.diff(near_axis).mean() == pytest.approx(40 * cos(tilt), rel=0.05)
    start = near_axis[len(near_axis) // 2] - 4
    assert row[start : start + 16].sum() == pytest.approx(6, rel=0.03)
    # +x is the near side.
    assert plane.away[0, -1] < 1 < plane.away[0, 0]
    right, left = np.diff(middles[-3:]).mean(), np.diff(middles[:3]).mean()
    assert right > left


def test_a_wire_is_lit_as_a_cylinder():
    plane = tilted_plane(VIEW, 0.5, 0.0, 0.0)
    off = np.broadcast_to(np.linspace(-12, 12, 512, dtype=np.float32) * VIEW.pixel_at_m(0.5), VIEW.shape)
    wires = _Wires(off.astype(np.float32), 1.0, 0.0)
    _, light = seen(wires, plane, 20 * VIEW.pixel_at_m(0.5), LAMP)
    across = np.linspace(-12, 12, 512) / 10
    expected = 0.25 + 0.75 * np.sqrt(np.maximum(1 - across**2, 0))
    # float32, under a square root near the edge.
    np.testing.assert_allclose(light[0], expected, atol=2e-3)
    # From +x, the side at +x is bright.
    _, light = seen(wires, plane, 20 * VIEW.pixel_at_m(0.5), _Lamp(0.0, 1.0, 0.0, 1.0, 0.25))
    assert light[0, 400] > 0.5
    assert light[0, 100] == pytest.approx(0.25)


def test_a_level_wire_is_lit_from_above_as_an_upright_one_from_the_side():
    view = CameraView((96, 96), 12.9e-6, 50e-3)
    plane, pixel_m = tilted_plane(view, 0.5, 0.0, 0.0), view.pixel_at_m(0.5)
    light = {}
    for name, at, level in (("level", plane.v, True), ("upright", plane.u, False)):
        lamp = _Lamp(0.8, 0.0, 0.6, 0.9, 0.25) if level else _Lamp(0.0, 0.8, 0.6, 0.9, 0.25)
        light[name] = seen(rods(at, 0.1, along_u=level), plane, 60 * pixel_m, lamp)[1]
    np.testing.assert_allclose(light["level"], light["upright"].T, atol=2e-3)
    # Lambert's law on a cylinder 30 pixels thick on either side, +y up; its rim aside.
    across = (np.arange(24, 72) - 47.5) / 30
    facing = np.maximum(0.8 * across + 0.6 * np.sqrt(1 - across**2), 0)
    np.testing.assert_allclose(light["level"][24:72, 40], 0.9 * (0.25 + 0.75 * facing), atol=2e-3)


def test_crossings_of_a_grid_lie_anywhere():
    """A frame a third of a mesh high holds a level wire in one of three draws, and an upright one in all of them."""
    small = CameraView((64, 64), 12.9e-6, 50e-3)
    mesh_m = 192 * small.pixel_at_m(0.5)
    fence = Fence(patterns=("grid",), depth_m=(0.5, 0.5), mesh_m=(mesh_m, mesh_m), wire_m=(1e-3, 1e-3), **PLAIN)
    masks = [drawn_mask(fence, seed, small) for seed in range(40)]
    assert all(mask.min(axis=0).max() > 0.9 for mask in masks)
    # 40 throws, to three sigma.
    assert np.mean([mask.min(axis=1).max() > 0.9 for mask in masks]) == pytest.approx(1 / 3, abs=0.22)


def test_stains_are_no_finer_than_two_pixels():
    """Two wires too thin for stains of their own size have the same ones."""
    light = []
    for share in (0.3, 0.6):
        wire_m = share * VIEW.pixel_at_m(0.5)
        lamp: dict[str, Any] = {"ambient": (1.0, 1.0), "light": (0.8, 0.8)}
        fence = Fence(patterns=("bars",), depth_m=(0.5, 0.5), wire_m=(wire_m, wire_m), **lamp, **PLAIN)
        drawn = fence.draw(np.random.default_rng(4), VIEW, GREY)
        column = np.asarray(drawn.mask).min(axis=0).argmax()
        light.append(np.asarray(drawn.radiance)[0, :, column])
    np.testing.assert_allclose(light[0], light[1], rtol=1e-5)
    assert np.ptp(light[0]) > 0.1 * light[0].mean()


@pytest.mark.parametrize("pattern", ["chain_link", "bars", "grid"])
def test_no_frame_falls_into_a_gap(pattern: Any):
    small = CameraView((64, 64), 12.9e-6, 50e-3)
    fence = Fence(patterns=(pattern,), mesh_m=(0.4, 0.5))
    # Even with meshes a hundred times wider than the frame, the wire through its random pixel is seen.
    assert min(drawn_mask(fence, seed, small).max() for seed in range(20)) > 0.9


def test_sag_moves_wires_by_what_was_asked():
    view = CameraView((128, 128), 12.9e-6, 5e-3)
    fence = Fence(patterns=("bars",), sag_m=(5e-3, 5e-3), bend_m=(0.0, 0.0))
    plane = tilted_plane(view, 0.5, 0.0, 0.0)
    moved = [fence.bent(np.random.default_rng(s), view, plane, 0.04).u - plane.u for s in range(30)]
    # 30 frames of some ten cells.
    assert np.std(moved) == pytest.approx(5e-3, rel=0.15)


def test_a_view_too_wide_for_the_tilt_is_refused(rng: np.random.Generator):
    wide = CameraView((64, 64), 100e-6, 3e-3)
    with pytest.raises(InputError, match=r"fence: tilt_rad: must keep the whole frame's fence before the lens"):
        Fence(tilt_rad=(0.8, 0.8)).draw(rng, wide, np.full((3, 64, 64), 0.5, np.float32))


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"depth_m": (-0.4, 0.8)}, "depth_m"),
        ({"wire_m": (0.0, 4e-3)}, "wire_m"),
        ({"mesh_m": (3e-3, 50e-3)}, "mesh_m"),
        ({"tilt_rad": (0.0, 1.5)}, "tilt_rad"),
        ({"ambient": (0.0, 1.2)}, "ambient"),
        ({"patterns": ()}, "patterns"),
        ({"colour_jitter": -0.1}, "colour_jitter"),
    ],
)
def test_what_cannot_be_meant_is_refused(wrong: dict[str, Any], name: str):
    with pytest.raises(InputError, match=f"fence: {name}: must"):
        Fence(**wrong)


def test_finishes_reflect_a_share_of_the_light():
    for finish in _FINISHES:
        assert min(finish) > 0
        assert max(finish) < 1
