"""Test structures are read here as a lab reads them: a bar across, a scan along a staircase."""

import itertools
import math
from typing import Literal

import numpy as np
import pytest

from fab.errors import InputError
from fab.layout.part import Part, Photomask, photomasks_of
from fab.layout.structures import (
    BAR_WIDTHS_UM,
    PAD_SIDES_UM,
    STEP_M,
    cd_bars,
    codes_by_depth,
    depth_pads,
    process_monitor,
    staircase,
)
from fab.levels import Levels
from fab.units import MM, NM, UM
from tests.fab.parts import assert_sound, layers_of, region

PITCH, LINE = 1.85 * UM, 2 * UM


def job(
    count: int, chrome: Literal["liftoff", "etch", "none"] = "liftoff", zero: bool = False
) -> tuple[Levels, tuple[Photomask, ...]]:
    levels = Levels(count, 1200 * NM / count)
    return levels, photomasks_of(levels, range(levels.bits), "clear", chrome, zero)


def runs(part: Part, plate: Photomask, at_m: tuple[float, float], axis: int = 0) -> list[tuple[int, int]]:
    """Where a line through a point along an axis crosses what a plate tests, from the point, in units."""
    point = [round(v / part.dbu_m) for v in at_m]
    boxes = part.shapes[plate.on(2)].rectangles
    other = 1 - axis
    crossed = boxes[(boxes[:, other] < point[other]) & (boxes[:, other + 2] > point[other])]
    spans = sorted((int(b[axis]) - point[axis], int(b[axis + 2]) - point[axis]) for b in crossed)
    joined = []
    for start, end in spans:
        if joined and joined[-1][1] == start:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined


def etched(part: Part, plates: tuple[Photomask, ...], at_m: tuple[float, float]) -> int:
    """Code of the masks that etch at a point."""
    x, y = (v / part.dbu_m for v in at_m)
    code = 0
    for plate in (plate for plate in plates if plate.bit is not None and plate.on(2) in part.shapes):
        x0, y0, x1, y1 = part.shapes[plate.on(2)].rectangles.T
        hits = int(np.count_nonzero((x0 < x) & (x < x1) & (y0 < y) & (y < y1)))
        assert hits <= 1
        code |= hits << (plate.layer - 1)
    return code


@pytest.mark.parametrize("count", [2, 4, 8, 16, 32, 64])
@pytest.mark.parametrize("chrome", ["liftoff", "none"])
def test_the_monitor_can_be_made(count, chrome):
    levels, plates = job(count, chrome, zero=True)
    part = process_monitor(levels, plates, PITCH, NM, LINE)
    # The bars that find the limit are 1 um wide.
    assert_sound(part, 1 * UM)
    assert 10 not in {layer.number for layer in part.shapes}
    assert {layer.datatype for layer in part.shapes} == {2, 3}
    x0, y0, x1, y1 = part.box
    assert max(x1 - x0, y1 - y0) < 7_000_000
    assert max(abs(x0 + x1), abs(y0 + y1)) <= 1


def test_all_but_the_bars_keeps_to_the_process():
    levels, plates = job(16)
    whole = process_monitor(levels, plates, PITCH, NM, LINE)
    for plate in plates:
        bars = [name for name in whole.places if name.startswith("CD") and name.endswith(f", {plate.name}")]
        assert len(bars) == 2 * len(BAR_WIDTHS_UM)
        from klayout import db

        drawn = region(whole, *layers_of(whole, plate.layer)).merged()
        for name in bars:
            x, y = (round(v / NM) for v in whole.places[name])
            drawn -= db.Region(db.Box(x - 140_000, y - 75_000, x + 360_000, y + 75_000))
        assert not drawn.is_empty()
        assert drawn.width_check(2000).is_empty()
        assert drawn.space_check(2000).is_empty()


@pytest.mark.parametrize("plate", job(16, "etch")[1], ids=lambda plate: plate.name)
def test_bars_have_their_width_in_both_tones(plate):
    part = cd_bars(plate, NM)
    assert BAR_WIDTHS_UM == (1, 1.5, 2, 3, 5)
    for width in BAR_WIDTHS_UM:
        w = round(1000 * width)
        # Alone along y: the five lines end 36 um or more to the left, the next begins 40 um or more to the right.
        line = runs(part, plate, part.places[f"CD {width:g} um line, {plate.name}"])
        at = line.index((-w // 2, w // 2))
        assert [b - a for a, b in line[:at]] == [w] * 5
        assert [b[0] - a[0] for a, b in itertools.pairwise(line[:at])] == [2 * w] * 4
        assert line[at - 1][1] <= -w // 2 - 36_000
        assert line[at + 1][0] >= w // 2 + 40_000
        # The gap alone in a block whose walls are 20 um wide.
        gap = runs(part, plate, part.places[f"CD {width:g} um gap, {plate.name}"])
        at = gap.index((w // 2, w // 2 + 20_000))
        assert gap[at - 1] == (-w // 2 - 20_000, -w // 2)
        # Before it the five: walls, and four lines between them.
        block = gap[at - 7 : at - 1]
        assert [b - a for a, b in block] == [20_000, w, w, w, w, 20_000]
        assert [b[0] - a[1] for a, b in itertools.pairwise(block)] == [w] * 5
        # All bars are 0.1 mm long.
        assert runs(part, plate, part.places[f"CD {width:g} um line, {plate.name}"], axis=1)[0][0] < 0
        high = [s for s in runs(part, plate, part.places[f"CD {width:g} um line, {plate.name}"], 1) if s[0] < 0 < s[1]]
        assert high == [(-50_000, 50_000)]


def test_bars_along_x_are_the_same_as_along_y():
    plate = job(4)[1][0]
    boxes = cd_bars(plate, NM).shapes[plate.on(2)].rectangles
    size = boxes[:, 2:] - boxes[:, :2]
    for width in BAR_WIDTHS_UM:
        w = round(1000 * width)
        along_y, along_x = ((size == (w, 100_000)).all(axis=1), (size == (100_000, w)).all(axis=1))
        # Five and one as lines; four more stand between the gaps of a block, cut off from its walls.
        assert np.count_nonzero(along_y) >= 6
        assert np.count_nonzero(along_x) >= 6


def test_pads_lie_in_a_row_beside_flat_glass():
    plate = job(16)[1][2]
    part = depth_pads(plate, NM)
    scan = runs(part, plate, part.places["flat by the pads, mask 3"])
    assert [b - a for a, b in scan] == [20_000, 100_000, 500_000]
    assert scan[1][1] == -75_000
    assert scan[2][0] == 75_000
    for side, (start, end) in zip(PAD_SIDES_UM, scan, strict=True):
        x, y = part.places[f"depth pad {side:g} um, mask 3"]
        flat = part.places["flat by the pads, mask 3"][0]
        assert (x - flat) / NM == pytest.approx((start + end) / 2)
        assert runs(part, plate, (x, y), axis=1) == [(-round(500 * side), round(500 * side))]


def test_no_mask_etches_the_bars_and_pads_of_another():
    levels, plates = job(16)
    part = process_monitor(levels, plates, PITCH, NM, LINE)
    for plate in plates:
        for name in (name for name in part.places if name.startswith(("depth pad", "flat"))):
            if not name.endswith(f", {plate.name}"):
                x, y = part.places[name]
                assert not [s for s in runs(part, plate, (x, y)) if s[0] < 10_000 and s[1] > -10_000]
    from klayout import db

    cells = db.Region()
    for plate in plates:
        own = db.Region()
        for name in (n for n in part.places if n.startswith(("CD", "depth pad")) and n.endswith(f", {plate.name}")):
            x, y = (round(v / NM) for v in part.places[name])
            reach = 60_000 if name.startswith("CD") else 250_000
            own.insert(db.Box(x - reach, y - reach, x + reach, y + reach))
        for other in plates:
            if other is not plate:
                assert (own & region(part, *layers_of(part, other.layer))).is_empty()
        cells += own
    assert cells.count() == 13 * len(plates)


def test_cells_of_the_masks_stand_in_rows_of_two_with_150_um_of_blank_glass_between_them():
    levels, plates = job(64)
    part = process_monitor(levels, plates, PITCH, NM, LINE)
    places = [np.array(part.places[f"CD 1 um line, {plate.name}"]) / UM for plate in plates[:6]]
    # A cell with its words is 2.15 mm wide and 0.876 mm high.
    for number, place in enumerate(places):
        right, down = number % 2, number // 2
        assert place - places[0] == pytest.approx([2300 * right, -1026 * down], abs=1e-3)
    # From the edge of the largest pad to the first word of the next mask in the row.
    for one, other in zip(plates[0:6:2], plates[1:6:2], strict=True):
        x, y = (round(v / NM) for v in part.places[f"depth pad 500 um, {one.name}"])
        words = part.shapes[other.on(3)].rectangles
        beside = words[np.abs(words[:, 1] - y) < 500_000]
        assert beside[:, 0].min() - (x + 250_000) == 150_000


@pytest.mark.parametrize("count", [2, 3, 4, 6, 8, 16, 32, 63, 64])
def test_one_scan_of_the_staircase_meets_every_level_once_in_order(count):
    levels, plates = job(count)
    part = process_monitor(levels, plates, PITCH, NM, LINE)
    (x0, y), (x1, y1) = (part.places[f"staircase {count} levels, {end}"] for end in ("start", "end"))
    assert y == y1
    # A sample every tenth of a step.
    scan = [etched(part, plates, (x, y)) for x in np.arange(x0 + 0.05 * STEP_M, x1, STEP_M / 10)]
    steps = [(code, len(list(same))) for code, same in itertools.groupby(scan)]
    # Blank glass, each deeper floor in its turn, blank glass: level L - 1 - code.
    assert [code for code, _ in steps] == [*range(count), 0]
    assert {length for _, length in steps} == {10}
    assert STEP_M >= 50 * UM


def test_the_deepest_two_masks_make_a_wider_staircase():
    levels, plates = job(16)
    part = process_monitor(levels, plates, PITCH, NM, LINE)
    (x0, y), (x1, _) = (part.places[f"staircase 4 levels, {end}"] for end in ("start", "end"))
    codes = [etched(part, plates, (x, y)) for x in np.arange(x0 + 1.5 * STEP_M, x1, 3 * STEP_M)]
    assert codes == [0, 4, 8, 12, 0]
    assert "staircase 4 levels, start" in process_monitor(*job(4), PITCH, NM, LINE).places
    # Both of them together make no level of six.
    assert "staircase 3 levels, start" in process_monitor(*job(6), PITCH, NM, LINE).places


class Uneven(Levels):
    def etch_depth_m(self, bit: int) -> float:
        return (300e-9, 130e-9, 90e-9)[bit]


def test_depths_that_are_no_binary_steps_are_sorted_by_depth():
    levels = Uneven(8, 75 * NM)
    # 0, 90, 130, 220, 300, 390, 430, 520 nm
    assert codes_by_depth(levels, range(3)) == [0, 4, 2, 6, 1, 5, 3, 7]
    part = staircase(levels, (0, 1, 2), STEP_M, NM)
    plates = photomasks_of(levels, (0, 1, 2), "clear", "none", False)
    x, y = part.places["staircase 8 levels, start"]
    assert [etched(part, plates, (x + (n + 0.5) * STEP_M, y)) for n in range(9)] == [0, 4, 2, 6, 1, 5, 3, 7, 0]


@pytest.mark.parametrize(
    ("count", "pitch_um", "line_um"), [(2, 1.85, 2), (6, 1.85, 2), (16, 1.85, 2), (16, 6.45, 2), (64, 1.0, 3)]
)
def test_gratings_are_whole_periods_of_printable_pixels(count, pitch_um, line_um):
    levels, plates = job(count)
    pitch = pitch_um * UM
    part = process_monitor(levels, plates, pitch, NM, line_um * UM)
    stripe = math.ceil(line_um / pitch_um) * pitch
    sets = 2**levels.bits
    binary, blazed = 4 * stripe, sets * stripe
    deepest = plates[levels.bits - 1]
    lines = runs(part, deepest, part.places["grating binary"])
    near = [(a, b) for a, b in lines if abs(a) <= 800_000 and abs(b) <= 800_000]
    extent = round(near[-1][0] - near[0][0] + binary / NM)
    assert extent >= 1_000_000
    assert {b - a for a, b in near} == {round(binary / 2 / NM)}
    assert {b[0] - a[0] for a, b in itertools.pairwise(near)} == {round(binary / NM)}
    # Along the blazed grating: all sets of masks, rising from the deepest.
    x, y = part.places["grating blazed"]
    periods = max(4, math.ceil(1 * MM / blazed * (1 - 1e-9)))
    start = x - periods * blazed / 2
    codes = [etched(part, plates, (start + (n + 0.5) * stripe, y)) for n in range(periods * sets)]
    assert codes == [*range(sets)][::-1] * periods
    assert etched(part, plates, (start - 0.5 * stripe, y)) == 0


def test_chrome_frames_the_gratings_and_an_empty_window():
    levels, plates = job(16)
    part = process_monitor(levels, plates, PITCH, NM, LINE)
    chrome = plates[-1]
    widths = {}
    for name in ("binary", "blazed", "blank"):
        for axis in (0, 1):
            walls = runs(part, chrome, part.places[f"grating {name}"], axis)
            left = max(wall for wall in walls if wall[1] < 0)
            right = min(wall for wall in walls if wall[0] > 0)
            # 0.2 mm of chrome, and 5 um that lie on the grating.
            assert left[1] - left[0] == right[1] - right[0] == 205_000
            widths[name, axis] = right[0] - left[1]
    # One period, or the rounding of the middle to a unit, is the most that windows differ by.
    assert widths["blank", 0] == widths["blank", 1] == 990_000
    assert 990_000 <= widths["blazed", 0] < 990_000 + 16 * 3700
    assert etched(part, plates, part.places["grating blank"]) == 0
    bare = process_monitor(levels, photomasks_of(levels, range(4), "clear", "none", False), PITCH, NM, LINE)
    assert "grating blank" not in bare.places
    assert "grating blazed" in bare.places


def test_a_pixel_below_the_unit_is_refused():
    levels, plates = job(4)
    with pytest.raises(InputError, match="pixel pitch"):
        process_monitor(levels, plates, 0.1 * NM, NM, LINE)
