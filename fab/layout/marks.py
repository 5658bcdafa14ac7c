"""Alignment marks: how every mask finds the place of the first one, and how far off it landed.

All masks are aligned to the same marks (a star), those of the first one that is used: the chrome zero layer, or else
the mask that is etched first. Aligning each mask to the one before it would add up the errors.

Every other photomask has its own slot. There the first one draws what is looked at, and the slot's own what is laid
over it; no third one draws anything there, so no mark is ever worked on twice.

    finder      the wafer's cross between four squares of the photomask, for the first rough look
    boxes       a square of the photomask in a square frame of the wafer, with a gap of 25, 10, 5, 3 and 2 um all around
    verniers    lines 10 um apart on the wafer against lines 9.75 um apart on the photomask: where line n meets its
                partner, the mask lies n x 0.25 um toward +x (or +y)
    F           right-reading in the drawing; a photomask that is the wrong way round shows it mirrored

Squares are always the dark part of a photomask. A clear-field one draws just them, and the wafer is seen all around.
A dark-field one draws a window without them: light passes around a dark square, and the wafer's cross or frame is seen
in the window. What lies in a window is exposed and worked on together with the mark (`alignment_notes` says how).
Verniers have no window, because they are read in the developed resist, when the photomask is gone and the wafer's lines
are seen through the resist; so the lines of the wafer stay as they were made.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.layout.lettering import HEIGHT, letter_boxes, written
from fab.layout.part import Part, Photomask, block, centred, column, joined, moved, row, turned, without
from fab.units import NM, UM

Boxes = NDArray[np.float64]


class BoxMark(NamedTuple):
    """One box in a frame: edge of the box, gap to the frame, width of the frame's bars; micrometres."""

    box_um: float
    gap_um: float
    bar_um: float


BOXES = (BoxMark(200, 25, 40), BoxMark(100, 10, 20), BoxMark(50, 5, 10), BoxMark(20, 3, 5), BoxMark(10, 2, 4))
VERNIER_STEP_M = 0.25 * UM

# How far a window reaches beyond the wafer's mark, so that the mark stays in sight while it is brought in.
_MARGIN_UM = 20.0
_FINDER_MARGIN_UM = 80.0
_CROSS_UM, _ARM_UM, _QUADRANT_UM, _CROSS_GAP_UM = 400.0, 40.0, 60.0, 20.0
_PITCH_UM, _PLATE_PITCH_UM, _LINE_UM, _TIPS_UM = 10.0, 9.75, 4.0, 4.0
# Lines 0 to 12 on either side reach 3 um, which a contact aligner does not miss; every fourth is a whole micrometre.
_LAST, _LONG = 12, 4
# In fused silica a shallower step shows too little contrast in a microscope (a judgement, not a measurement).
_FAINT_M = 150 * NM
_SLOT_GAP_M = 80 * UM


def _square(side_um: float, x_um: float = 0.0, y_um: float = 0.0) -> tuple[float, float, float, float]:
    half = side_um / 2
    return x_um - half, y_um - half, x_um + half, y_um + half


def _cross(length_um: float, arm_um: float) -> Boxes:
    half, arm = length_um / 2, arm_um / 2
    return without([(-half, -arm, half, arm), (-arm, -half, arm, half)])


def _seen(
    name: str, first: Photomask, photomask: Photomask, wafer: Boxes, dark: Boxes, window_um: float, dbu_m: float
) -> Part:
    """Draw a mark that is seen through the photomask: the wafer's part, and the dark part or the window without it."""
    drawn = dark if photomask.tone == "dark" else without([_square(window_um)], dark)
    part = joined([block(first.on(1), wafer, dbu_m), block(photomask.on(1), drawn, dbu_m)])
    return Part(dbu_m, part.shapes, {f"{name}, {photomask.name}": (0.0, 0.0)})


def _finder(first: Photomask, photomask: Photomask, dbu_m: float) -> Part:
    """Draw a cross on the wafer and four squares between its arms on the photomask, centred."""
    off = _ARM_UM / 2 + _CROSS_GAP_UM + _QUADRANT_UM / 2
    dark = np.array([_square(_QUADRANT_UM, x, y) for x in (-off, off) for y in (-off, off)])
    window = _CROSS_UM + 2 * _FINDER_MARGIN_UM
    return _seen("finder", first, photomask, _cross(_CROSS_UM, _ARM_UM), dark, window, dbu_m)


def _box(mark: BoxMark, first: Photomask, photomask: Photomask, dbu_m: float) -> Part:
    """Draw a frame on the wafer and a box in it on the photomask, centred."""
    opening = mark.box_um + 2 * mark.gap_um
    outer = opening + 2 * mark.bar_um
    frame, dark = without([_square(outer)], [_square(opening)]), np.array([_square(mark.box_um)])
    return _seen(
        f"box {mark.gap_um:g} um", first, photomask, frame, dark, outer + 2 * max(mark.gap_um, _MARGIN_UM), dbu_m
    )


def _comb(pitch_um: float, direction: int) -> Boxes:
    """Draw lines side by side along x whose tips lie on one side of y = 0 and point at it."""
    numbers = range(-_LAST, _LAST + 1)
    lengths = [60.0 if n == 0 else 45.0 if n % _LONG == 0 else 30.0 for n in numbers]
    lines = []
    for n, length in zip(numbers, lengths, strict=True):
        near, far = sorted((direction * _TIPS_UM / 2, direction * (_TIPS_UM / 2 + length)))
        lines.append((n * pitch_um - _LINE_UM / 2, near, n * pitch_um + _LINE_UM / 2, far))
    return np.array(lines)


def _vernier(axis: str, first: Photomask, photomask: Photomask, dbu_m: float) -> Part:
    """Draw the two combs of a vernier, centred; the numbers count micrometres."""
    wafer, mask = _comb(_PITCH_UM, -1), _comb(_PLATE_PITCH_UM, 1)
    reach = f"{_LAST * VERNIER_STEP_M / UM:g}"
    parts = []
    for text, n in ((f"-{reach}", -_LAST), ("0", 0), (f"+{reach}", _LAST)):
        part = centred(written(first, text, 3, dbu_m))
        along, across = n * _PITCH_UM * UM, -90 * UM
        parts.append(moved(part, along, across) if axis == "x" else moved(part, across, along))
    for layer, comb in ((first.on(1), wafer), (photomask.on(1), mask)):
        parts.append(block(layer, comb if axis == "x" else turned(comb), dbu_m))
    part = joined(parts)
    return Part(dbu_m, part.shapes, {f"vernier {axis}, {photomask.name}": (0.0, 0.0)})


def _letter_f(photomask: Photomask, stroke_um: float, dbu_m: float) -> Part:
    """Draw the F and, below it, the photomask's code; the lower left corner of the F is the origin."""
    f = block(photomask.on(1), letter_boxes("F") * stroke_um, dbu_m)
    code = moved(written(photomask, photomask.code, stroke_um / 2, dbu_m), 0, -HEIGHT * stroke_um * UM)
    return Part(dbu_m, joined([f, code]).shapes, {f"F, {photomask.name}": (0.0, 0.0)})


def _at(part: Part, x_um: float, y_um: float) -> Part:
    return moved(part, x_um * UM, y_um * UM)


def _site_slot(first: Photomask, photomask: Photomask, dbu_m: float) -> Part:
    """Draw the slot of one photomask at a site of the wafer, 0.9 mm x 1 mm."""
    centres = ((200, 200), (500, 115), (460, 295), (572, 273), (572, 360))
    boxes = [_at(_box(mark, first, photomask, dbu_m), *at) for mark, at in zip(BOXES, centres, strict=True)]
    return joined(
        [
            *boxes,
            _at(_finder(first, photomask, dbu_m), 300, 700),
            _at(_vernier("x", first, photomask, dbu_m), 770, 115),
            _at(_vernier("y", first, photomask, dbu_m), 760, 370),
            _at(_letter_f(photomask, 16, dbu_m), 640, 680),
            _at(written(first, photomask.code, 12, dbu_m), 640, 880),
        ]
    )


def _die_slot(first: Photomask, photomask: Photomask, dbu_m: float) -> Part:
    """Draw the slot of one photomask beside a die, 0.55 mm x 0.3 mm."""
    centres = ((70, 250), (190, 250), (274, 250))
    boxes = [_at(_box(mark, first, photomask, dbu_m), *at) for mark, at in zip(BOXES[2:], centres, strict=True)]
    return joined(
        [
            *boxes,
            _at(_vernier("x", first, photomask, dbu_m), 132, 110),
            _at(_vernier("y", first, photomask, dbu_m), 475, 150),
            _at(_letter_f(photomask, 6, dbu_m), 320, 250),
            _at(written(first, photomask.code, 4, dbu_m), 290, 100),
        ]
    )


def _grid(slots: Sequence[Part]) -> Part:
    """Put slots into about as many rows as columns, first slot at the top left."""
    columns = math.ceil(math.sqrt(len(slots)))
    lines = [row(slots[i : i + columns], _SLOT_GAP_M) for i in range(0, len(slots), columns)]
    return column(lines, _SLOT_GAP_M)


def _brackets(first: Photomask, box: tuple[int, int, int, int], dbu_m: float) -> Part:
    """Draw an angle of two bars at each corner of a frame around a box of database units."""
    x0, y0, x1, y1 = (edge * dbu_m / UM for edge in box)
    away, long, wide = 250.0, 400.0, 60.0
    bars = []
    for x, inward in ((x0 - away, 1), (x1 + away, -1)):
        for y, upward in ((y0 - away, 1), (y1 + away, -1)):
            for dx, dy in ((long, wide), (wide, long)):
                (left, right), (low, high) = sorted((x, x + inward * dx)), sorted((y, y + upward * dy))
                bars.append((left, low, right, high))
    return block(first.on(1), without(bars), dbu_m)


def alignment_site(photomasks: Sequence[Photomask], dbu_m: float) -> Part:
    """Draw a site of the wafer where all masks are aligned; the first photomask in order of use makes the marks.

    Marks are on datatype 1 and lettering on datatype 3 of each photomask, centred on the origin; brackets, a cross and
    a title of the first one show where the site is. Places: the centre of every mark, such as "vernier x, mask 3",
    "box 5 um, chrome", "finder, mask 1", and the lower left corner of each "F, mask 2".
    """
    first, others = photomasks[0], photomasks[1:]
    title = f"REF {first.code} " + ("CHROME" if first.bit is None else first.depth.upper())
    f = block(first.on(1), letter_boxes("F") * 30.0, dbu_m)
    f = Part(dbu_m, f.shapes, {f"F, {first.name}": (0.0, 0.0)})
    head = row([block(first.on(1), _cross(600, 80), dbu_m), f, written(first, title, 16, dbu_m)], 150 * UM)
    slots = [_grid([_site_slot(first, photomask, dbu_m) for photomask in others])] if others else []
    body = centred(column([head, *slots], 150 * UM))
    return joined([body, _brackets(first, body.box, dbu_m)])


def die_marks(photomasks: Sequence[Photomask], dbu_m: float) -> Part:
    """Draw the smaller marks beside a die, to measure overlay there: boxes, verniers and F of `alignment_site`."""
    first, others = photomasks[0], photomasks[1:]
    slots = [_die_slot(first, photomask, dbu_m) for photomask in others]
    f = _letter_f(first, 16, dbu_m)
    return centred(row([f, _grid(slots)], 60 * UM) if slots else f)


def _what_happens(first: Photomask, photomask: Photomask) -> str:
    """Describe what working on a photomask does to the marks in its slot, and to the others."""
    dark_field = photomask.tone == "clear"
    others = "The slots of all other masks stay under resist."
    if photomask.makes == "etch":
        if not dark_field:
            place, kept = "in its squares", "the wafer's marks stay under resist"
        elif first.makes == "zero layer":
            place, kept = "in its windows", "the wafer's chrome marks shield the glass below them and stay"
        else:
            place, kept = "in its windows", "floor and rim of the wafer's marks go down together, so the steps stay"
        return f"The glass is etched {photomask.depth} {place}; {kept}. {others}"
    if photomask.makes == "liftoff":
        place = "in its windows, over the wafer's marks" if dark_field else "in its squares only"
        return f"Chrome is laid down {place}. Read the overlay in the resist, before the deposition. {others}"
    place = "in its windows, over the wafer's marks" if dark_field else "in its squares"
    lost = ", the marks of the zero layer included" if first.makes == "zero layer" else ""
    return (
        f"The wafer's marks are seen as steps in the chrome film. Chrome stays {place}; the etch takes all "
        f"other chrome off the wafer's marks{lost}. Read the overlay in the resist, before the etch."
    )


def faint_marks(photomasks: Sequence[Photomask]) -> str:
    """Return a warning if the marks that all masks are aligned to are etched too shallow to be seen well; else ""."""
    first = photomasks[0]
    if first.makes != "etch" or first.depth_m >= _FAINT_M or len(photomasks) == 1:
        return ""
    return (
        f"the alignment marks are etched {first.depth} deep, with {first.name}, and are hard to see: "
        "etch the deepest mask first, or add a zero layer of chrome marks"
    )


def alignment_notes(photomasks: Sequence[Photomask]) -> tuple[str, ...]:
    """Describe how each mask is aligned and what happens to the marks, a paragraph per photomask."""
    first = photomasks[0]
    etched = first.makes == "etch"
    made = f"etched {first.depth} deep" if etched else "of chrome"
    notes = [f"{first.name.capitalize()}: makes the marks that all other masks are aligned to, {made}."]
    if warning := faint_marks(photomasks):
        notes[0] += f" Warning: {warning}."
    for photomask in photomasks[1:]:
        if photomask.tone == "clear":
            seen = "dark field with clear windows: bring the wafer's crosses and frames around the dark squares in them"
        else:
            seen = "clear field: bring the wafer's crosses and frames around its dark squares"
        notes.append(
            f"{photomask.name.capitalize()}: aligned to the {first.code} marks in slot {photomask.code}. "
            f"The plate is {seen}. "
            f"{_what_happens(first, photomask)}"
        )
    return tuple(notes)
