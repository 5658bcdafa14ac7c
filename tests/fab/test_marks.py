"""Marks are tested as what they are for: looked at through a plate, shifted against each other, and read."""

import itertools

import numpy as np
import pytest

from fab.layout.marks import BOXES, VERNIER_STEP_M, alignment_notes, alignment_site, die_marks
from fab.layout.part import Part, Photomask, photomasks_of
from fab.levels import Levels
from fab.units import NM, UM
from tests.fab.parts import assert_sound, layers_of, region

SIXTEEN = Levels(16, 75 * NM)
SHALLOW, DEEP = (0, 1, 2, 3), (3, 2, 1, 0)
JOBS = {
    "deep first": photomasks_of(SIXTEEN, DEEP, "clear", "liftoff", False),
    "zero layer": photomasks_of(SIXTEEN, SHALLOW, "clear", "liftoff", True),
    "wet etch": photomasks_of(SIXTEEN, SHALLOW, "clear", "etch", True),
    "clear field": photomasks_of(SIXTEEN, DEEP, "dark", "etch", False),
    "2 levels": photomasks_of(Levels(2, 600 * NM), (0,), "clear", "liftoff", False),
    "64 levels": photomasks_of(Levels(64, 19 * NM), range(6), "clear", "etch", True),
}
DRAWINGS = {"site": alignment_site, "die": die_marks}
job = pytest.mark.parametrize("plates", JOBS.values(), ids=JOBS.keys())
drawing = pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS.keys())


def around(part: Part, plate: Photomask, place: str, half_m: float):
    """The marks of one plate in a square about a place, merged, with the place at the origin."""
    from klayout import db

    x, y = (round(v / part.dbu_m) for v in part.places[place])
    half = round(half_m / part.dbu_m)
    cut = region(part, plate.on(1)) & db.Region(db.Box(x - half, y - half, x + half, y + half))
    return cut.merged().moved(-x, -y)


def numbers_of(box) -> tuple[int, int, int, int]:
    return box.left, box.bottom, box.right, box.top


@drawing
@job
def test_marks_can_be_made(draw, plates):
    # 2 um is what ordinary contact lithography prints.
    assert_sound(draw(plates, NM), 2 * UM)


@drawing
@pytest.mark.parametrize("dbu_nm", [0.5, 0.25, 0.2, 0.1])
def test_a_finer_unit_draws_the_same_marks(draw, dbu_nm):
    fine, coarse = draw(JOBS["deep first"], dbu_nm * NM), draw(JOBS["deep first"], NM)
    # The middle of the box may fall on half a nanometre.
    assert np.allclose(np.array(fine.box) * dbu_nm, coarse.box, rtol=0, atol=1)
    for layer, shapes in coarse.shapes.items():
        size = np.diff(shapes.rectangles.reshape(-1, 2, 2), axis=1)
        assert np.allclose(np.diff(fine.shapes[layer].rectangles.reshape(-1, 2, 2), axis=1) * dbu_nm, size)


def test_the_site_has_all_marks_for_every_mask_and_lies_about_the_origin():
    part = alignment_site(JOBS["zero layer"], NM)
    expected = {"F, zero layer"}
    for plate in JOBS["zero layer"][1:]:
        marks = ("finder", "vernier x", "vernier y", "F", *(f"box {mark.gap_um:g} um" for mark in BOXES))
        expected |= {f"{mark}, {plate.name}" for mark in marks}
    assert set(part.places) == expected
    x0, y0, x1, y1 = part.box
    assert abs(x0 + x1) <= 1000
    assert abs(y0 + y1) <= 1000
    # What one field of a low objective and the rim of a 100 mm wafer leave room for.
    assert max(x1 - x0, y1 - y0) < 5_000_000


@pytest.mark.parametrize("plates", [JOBS["deep first"], JOBS["clear field"], JOBS["wet etch"]])
def test_boxes_have_the_same_exact_gap_on_all_sides(plates):
    part = alignment_site(plates, NM)
    first = plates[0]
    for plate, mark in [(plate, mark) for plate in plates[1:] for mark in BOXES]:
        place = f"box {mark.gap_um:g} um, {plate.name}"
        outer_um = mark.box_um / 2 + mark.gap_um + mark.bar_um
        frame = around(part, first, place, (outer_um + 15) * UM)
        drawn = around(part, plate, place, (outer_um + 15) * UM)
        dark = (drawn.extents() - drawn).merged() if plate.tone == "clear" else drawn
        opening = (frame.extents() - frame).merged()
        assert (dark.count(), opening.count(), frame.count()) == (1, 1, 1)
        half = round(mark.box_um * 500)
        assert numbers_of(dark.bbox()) == (-half, -half, half, half)
        half += round(mark.gap_um * 1000)
        assert numbers_of(opening.bbox()) == (-half, -half, half, half)
        half += round(mark.bar_um * 1000)
        assert numbers_of(frame.bbox()) == (-half, -half, half, half)
    assert [mark.gap_um for mark in BOXES] == [25, 10, 5, 3, 2]


# Places in micrometres from the first of these marks, the same in the slot of every mask.
SLOTS = {
    "site": {
        "box 25 um": (0, 0),
        "box 10 um": (300, -85),
        "box 5 um": (260, 95),
        "box 3 um": (372, 73),
        "box 2 um": (372, 160),
        "finder": (100, 500),
        "vernier x": (570, -85),
        "vernier y": (560, 170),
        "F": (440, 480),
    },
    "die": {
        "box 5 um": (0, 0),
        "box 3 um": (120, 0),
        "box 2 um": (204, 0),
        "vernier x": (62, -140),
        "vernier y": (405, -100),
        "F": (250, 0),
    },
}


@pytest.mark.parametrize("name", DRAWINGS)
@job
def test_every_slot_has_its_marks_in_the_same_places(name, plates):
    """A microscope that knows the places finds the marks of every mask."""
    part = DRAWINGS[name](plates, NM)
    origin = next(iter(SLOTS[name]))
    for plate in plates[1:]:
        x, y = part.places[f"{origin}, {plate.name}"]
        places = {mark: part.places[f"{mark}, {plate.name}"] for mark in SLOTS[name]}
        seen = {mark: ((at[0] - x) / UM, (at[1] - y) / UM) for mark, at in places.items()}
        assert seen == {mark: pytest.approx(at, abs=1e-3) for mark, at in SLOTS[name].items()}


@pytest.mark.parametrize("plates", [JOBS["deep first"], JOBS["clear field"]], ids=["dark field", "clear field"])
def test_the_finder_is_a_cross_of_400_um_between_four_squares_with_80_um_free_around_it(plates):
    from klayout import db

    part = alignment_site(plates, NM)
    arms, squares = db.Region(), db.Region()
    for box in (db.Box(-200_000, -20_000, 200_000, 20_000), db.Box(-20_000, -200_000, 20_000, 200_000)):
        arms.insert(box)
    # Squares of 60 um, 20 um off the arms.
    for x, y in itertools.product((-100_000, 40_000), repeat=2):
        squares.insert(db.Box(x, y, x + 60_000, y + 60_000))
    window = db.Region(db.Box(-280_000, -280_000, 280_000, 280_000))
    for plate in plates[1:]:
        wafer, drawn = (around(part, one, f"finder, {plate.name}", 290 * UM) for one in (plates[0], plate))
        assert (wafer ^ arms).is_empty()
        assert (drawn ^ (window - squares if plate.tone == "clear" else squares)).is_empty()


@job
def test_brackets_of_two_bars_of_400_um_by_60_um_stand_250_um_off_the_corners_of_the_site(plates):
    from klayout import db

    part = alignment_site(plates, NM)
    x0, y0, x1, y1 = part.box
    brackets = db.Region()
    for x, inward in ((x0, 1), (x1, -1)):
        for y, upward in ((y0, 1), (y1, -1)):
            brackets.insert(db.Box(x, y, x + inward * 400_000, y + upward * 60_000))
            brackets.insert(db.Box(x, y, x + inward * 60_000, y + upward * 400_000))
    # The first mask draws them; whatever else any mask draws lies further inside.
    drawn = {plate: region(part, *layers_of(part, plate.layer)).merged() for plate in plates}
    assert (brackets - drawn[plates[0]]).is_empty()
    drawn[plates[0]] -= brackets
    inside = sum(drawn.values(), db.Region())
    assert numbers_of(inside.bbox()) == (x0 + 250_000, y0 + 250_000, x1 - 250_000, y1 - 250_000)


@drawing
@job
def test_the_operator_sees_the_wafers_marks(draw, plates):
    part, first = draw(plates, NM), plates[0]
    for plate in plates[1:]:
        seen = [name for name in part.places if name.endswith(f", {plate.name}") and name.startswith(("box", "finder"))]
        assert len(seen) == (6 if draw is alignment_site else 3)
        for name in seen:
            gap = 20 if name.startswith("finder") else float(name.split()[1])
            size = (
                200
                if name.startswith("finder")
                else next(m.box_um / 2 + m.gap_um + m.bar_um for m in BOXES if m.gap_um == gap)
            )
            wafer = around(part, first, name, size * UM)
            assert not wafer.is_empty()
            drawn = around(part, plate, name, (size + gap + 1) * UM)
            if plate.tone == "clear":
                # Off by nearly the gap, in any direction, all of the mark still lies in clear glass.
                assert (wafer.sized(round(gap * 1000) - 1) - drawn).is_empty()
                assert not (wafer.sized(round(gap * 1000) + 1) - drawn).is_empty()
            else:
                assert (wafer.sized(round(gap * 1000) - 1) & drawn).is_empty()
                assert not (wafer.sized(round(gap * 1000) + 1) & drawn).is_empty()


@drawing
@job
def test_no_mask_draws_in_the_slot_of_another_or_over_a_vernier(draw, plates):
    part, first = draw(plates, NM), plates[0]
    # All a mask draws, with a margin beyond any misalignment.
    drawn = {plate.name: region(part, *layers_of(part, plate.layer)) for plate in plates}
    slots = {plate.name: drawn[plate.name].extents().sized(20_000).merged() for plate in plates[1:]}
    for one, other in itertools.combinations(slots.values(), 2):
        assert (one & other).is_empty()
    for plate in plates[1:]:
        for axis in "xy":
            wafer = around(part, first, f"vernier {axis}, {plate.name}", 100 * UM)
            assert not wafer.is_empty()
            assert (wafer & around(part, plate, f"vernier {axis}, {plate.name}", 100 * UM)).is_empty()


def lines(part: Part, plate: Photomask, axis: str, place: str) -> np.ndarray:
    """Middles of the lines of one comb along an axis from the place, in units."""
    along, across = (0, 1) if axis == "x" else (1, 0)
    x, y = (round(v / part.dbu_m) for v in part.places[place])
    boxes = part.shapes[plate.on(1)].rectangles - np.array([x, y, x, y])
    width, length = boxes[:, along + 2] - boxes[:, along], boxes[:, across + 2] - boxes[:, across]
    near = (np.abs(boxes[:, along]) < 125_000) & (np.abs(boxes[:, across]) < 70_000) & (width == 4000)
    comb = boxes[near & (length >= 30_000)]
    return np.sort((comb[:, along] + comb[:, along + 2]) / 2)


@drawing
@job
def test_the_vernier_line_that_meets_its_partner_tells_the_shift(draw, plates):
    part, first = draw(plates, NM), plates[0]
    step = round(VERNIER_STEP_M / NM)
    assert step == 250
    for plate, axis in [(plate, axis) for plate in plates[1:] for axis in "xy"]:
        place = f"vernier {axis}, {plate.name}"
        wafer, mask = lines(part, first, axis, place), lines(part, plate, axis, place)
        assert len(wafer) == len(mask) == 25
        for n in range(-12, 13):
            meeting = np.flatnonzero(mask + n * step == wafer)
            assert meeting.tolist() == [n + 12]
        # Between two steps the two lines beside the shift are equally far off, on different sides.
        off = mask + 1.5 * step - wafer
        assert (off[13], off[14]) == (step / 2, -step / 2)


@drawing
def test_a_misplaced_line_would_be_read_wrongly(draw):
    plates = JOBS["deep first"]
    part = draw(plates, NM)
    mask = lines(part, plates[1], "x", "vernier x, mask 3")
    planted = mask + np.where(np.arange(25) == 16, 250, 0)
    assert np.flatnonzero(planted + 4 * 250 == lines(part, plates[0], "x", "vernier x, mask 3")).tolist() == []


def test_the_combs_face_each_other_without_meeting():
    plates = JOBS["deep first"]
    part = alignment_site(plates, NM)
    for plate, axis in [(plate, axis) for plate in plates[1:] for axis in "xy"]:
        both = [around(part, p, f"vernier {axis}, {plate.name}", 100 * UM).bbox() for p in (plates[0], plate)]
        low, high = (numbers_of(box) for box in both)
        side = 1 if axis == "x" else 0
        # Tips 4 um apart, more than the 3 um that the vernier reaches.
        assert (low[side + 2], high[side]) == (-2000, 2000)


@drawing
@job
def test_every_mask_carries_an_f_that_reads_right_only_from_one_side(draw, plates):
    part = draw(plates, NM)
    for plate in plates:
        x, y = (round(v / NM) for v in part.places[f"F, {plate.name}"])
        boxes = part.shapes[plate.on(1)].rectangles - np.array([x, y, x, y])
        stroke = int(boxes[(boxes[:, 0] == 0) & (boxes[:, 1] == 0)][0, 2])
        near = (boxes[:, :2] >= 0).all(axis=1) & (boxes[:, 2] <= 5 * stroke) & (boxes[:, 3] <= 7 * stroke)
        plane = np.zeros((7, 5), dtype=int)
        for x0, y0, x1, y1 in boxes[near] // stroke:
            plane[y0:y1, x0:x1] += 1
        upright = ["#####", "#    ", "#    ", "#### ", "#    ", "#    ", "#    "]
        assert ["".join(" #"[v] for v in line) for line in plane[::-1]] == upright
        mirrored = ["".join(" #"[v] for v in line) for line in plane[::-1, ::-1]]
        assert mirrored != upright


def test_all_masks_are_aligned_to_the_first_one_used():
    for plates in (JOBS["deep first"], JOBS["zero layer"]):
        part = alignment_site(plates, NM)
        combs = [len(lines(part, plates[0], a, f"vernier {a}, {p.name}")) for p in plates[1:] for a in "xy"]
        assert set(combs) == {25}
        assert all(f"vernier x, {plates[0].name}" not in name for name in part.places)


def test_a_job_of_one_mask_has_only_its_own_marks():
    plates = photomasks_of(Levels(2, 600 * NM), (0,), "clear", "none", False)
    for draw in DRAWINGS.values():
        part = draw(plates, NM)
        assert_sound(part, 2 * UM)
        assert set(part.places) == {"F, mask 1"}
    assert alignment_notes(plates) == (
        "Mask 1: makes the marks that all other masks are aligned to, etched 600 nm deep.",
    )


def test_notes_say_what_is_done_in_each_window():
    deep = alignment_notes(JOBS["deep first"])
    assert len(deep) == 5
    assert "Warning" not in "".join(deep)
    assert deep[1].startswith("Mask 3: aligned to the M4 marks in slot M3. The plate is dark field with clear windows")
    assert "etched 300 nm in its windows" in deep[1]
    assert "so the steps stay" in deep[1]
    assert "before the deposition" in deep[-1]
    shallow = alignment_notes(photomasks_of(SIXTEEN, SHALLOW, "clear", "liftoff", False))
    assert "etched 75 nm deep. Warning: the alignment marks are etched 75 nm deep, with mask 1" in shallow[0]
    wet = alignment_notes(JOBS["wet etch"])
    assert wet[0] == "Zero layer: makes the marks that all other masks are aligned to, of chrome."
    assert "shield the glass" in wet[1]
    assert "clear field" in wet[-1]
    assert "the marks of the zero layer included" in wet[-1]
    light = alignment_notes(JOBS["clear field"])
    assert "the wafer's marks stay under resist" in light[1]


def test_the_middle_of_a_vernier_has_the_longest_line_and_every_fourth_one_is_longer():
    """So that the line that meets its partner can be counted from the middle."""
    plates = JOBS["deep first"]
    part = alignment_site(plates, NM)
    for plate in plates[:2]:
        x, y = (round(v / part.dbu_m) for v in part.places[f"vernier x, {plates[1].name}"])
        boxes = part.shapes[plate.on(1)].rectangles - np.array([x, y, x, y])
        thin = (boxes[:, 2] - boxes[:, 0] == 4000) & (abs(boxes[:, 0]) < 125_000) & (abs(boxes[:, 1]) < 70_000)
        comb = boxes[thin & (boxes[:, 3] - boxes[:, 1] >= 30_000)]
        heights = (comb[:, 3] - comb[:, 1])[np.argsort(comb[:, 0])]
        assert len(heights) == 25
        assert np.flatnonzero(heights == heights.max()).tolist() == [12]
        assert np.flatnonzero(heights > heights.min()).tolist() == [0, 4, 8, 12, 16, 20, 24]
