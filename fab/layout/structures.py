"""The process control monitor: test structures by which a lab measures what its process did.

    CD bars       lines and gaps of 1, 1.5, 2, 3 and 5 um, five side by side and one alone, along y and along x
    depth pads    etched squares of 20, 100 and 500 um, flat glass between them: the loss of depth in small openings
    staircases    all levels side by side, from the blank glass to the deepest floor, for one scan of a profilometer
    gratings      a binary grating of the deepest etch, a blazed one of all sets of etches (those of no level, too), and
                  an empty window beside them, each framed by chrome: the share of a laser beam that goes straight on
                  shows all depth errors at once

All is drawn on datatype 2 of each mask, words on datatype 3. Each mask has bars and pads of its own, apart from those
of the others; staircases and gratings are what all masks make together. A line is a polygon, a gap is the blank space
between two of them, so a clear polygon makes clear lines and dark gaps; both are there.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import fewest_pixels
from fab.layout.geometry import Layer, Shapes
from fab.layout.lettering import written
from fab.layout.part import Part, Photomask, block, centred, column, joined, moved, row, without
from fab.levels import Levels
from fab.units import UM, format_length

Boxes = NDArray[np.float64]

BAR_WIDTHS_UM = (1.0, 1.5, 2.0, 3.0, 5.0)
PAD_SIDES_UM = (20.0, 100.0, 500.0)
STEP_M = 60 * UM

_BARS, _BAR_UM, _BLOCK_MARGIN_UM = 5, 100.0, 20.0
_PAD_GAP_UM = 150.0
_STAIR_UM = 200.0
_GRATING_M, _FRAME_M, _OVERLAP_M = 1e-3, 200 * UM, 5 * UM
_FEWEST_PERIODS = 4


def _group(width_um: float, gaps: bool) -> list[Boxes]:
    """Draw five lines and one along y, then five and one along x, each in its own cell."""
    pitch = 2 * width_um
    dense = np.array([(i * pitch, 0, i * pitch + width_um, _BAR_UM) for i in range(_BARS)])
    lines = [dense, dense[:1], dense[:, [1, 0, 3, 2]], dense[:1, [1, 0, 3, 2]]]
    cells = []
    for bars, x in zip(lines, (50, 130, 240, 400), strict=True):
        low, high = bars[:, :2].min(axis=0), bars[:, 2:].max(axis=0)
        shift = np.array([x, _BAR_UM / 2]) - (low + high) / 2
        around = np.concatenate([low - _BLOCK_MARGIN_UM, high + _BLOCK_MARGIN_UM])
        drawn = without([around], bars) if gaps else bars
        cells.append(drawn + np.tile(shift, 2))
    return cells


def cd_bars(photomask: Photomask, dbu_m: float) -> Part:
    """Draw the bars by which line widths are measured, a row per width, thinnest on top: lines left, gaps right.

    Each is five side by side and one alone along y, then along x. Places: the middle of the lone one along y, "CD 2 um
    line, mask 3" and "CD 2 um gap, mask 3".
    """
    parts = []
    for number, width in enumerate(BAR_WIDTHS_UM):
        y = -160.0 * number
        parts.append(moved(written(photomask, f"{width:g}", 4, dbu_m), -90 * UM, (y + 36) * UM))
        for name, x in (("line", 0.0), ("gap", 520.0)):
            cells = np.concatenate(_group(width, name == "gap"))
            part = block(photomask.on(2), cells + np.array([x, y, x, y]), dbu_m)
            place = ((x + 130) * UM, (y + _BAR_UM / 2) * UM)
            parts.append(Part(dbu_m, part.shapes, {f"CD {width:g} um {name}, {photomask.name}": place}))
    return joined(parts)


def depth_pads(photomask: Photomask, dbu_m: float) -> Part:
    """Draw the squares by which a depth is measured, in a row on y = 0 with 0.15 mm of blank glass between them.

    Places: the middles, "depth pad 100 um, mask 3", and a flat spot beside them, "flat by the pads, mask 3".
    """
    boxes, places, x = [], {}, 0.0
    for side in PAD_SIDES_UM:
        boxes.append((x, -side / 2, x + side, side / 2))
        places[f"depth pad {side:g} um, {photomask.name}"] = ((x + side / 2) * UM, 0.0)
        x += side + _PAD_GAP_UM
    places[f"flat by the pads, {photomask.name}"] = ((boxes[-1][0] - _PAD_GAP_UM / 2) * UM, 0.0)
    return Part(dbu_m, block(photomask.on(2), boxes, dbu_m).shapes, places)


def codes_by_depth(levels: Levels, bits: Sequence[int]) -> list[int]:
    """Return all sets of masks that can etch together, shallowest first, as numbers whose bit k is mask k."""
    codes = [sum(1 << bit for i, bit in enumerate(bits) if pick >> i & 1) for pick in range(1 << len(bits))]
    depth = {code: sum(levels.etch_depth_m(bit) for bit in bits if code >> bit & 1) for code in codes}
    return sorted(codes, key=lambda code: (depth[code], code))


def _stripes(codes: Sequence[int], bits: Sequence[int], width: int, height: int, dbu_m: float) -> Part:
    """Draw stripes side by side along x, each etched by the masks of its code; sizes in database units."""
    shapes = {}
    for bit in bits:
        etched = np.array([0, *(code >> bit & 1 for code in codes), 0])
        # Stripes that touch become one rectangle.
        turns = np.flatnonzero(np.diff(etched)).reshape(-1, 2) * width
        boxes = [(x0, 0, x1, height) for x0, x1 in turns]
        shapes[Layer(bit + 1, 2, f"M{bit + 1}_TEST")] = Shapes(np.array(boxes, dtype=np.int32).reshape(-1, 4))
    return Part(dbu_m, shapes, {})


def staircase(levels: Levels, bits: Sequence[int], step_m: float, dbu_m: float) -> Part:
    """Draw all levels that some masks make together as one staircase down toward +x, 0.2 mm high, from the blank glass.

    Steps are `step_m` (metres) wide. Places: on the blank glass before the first step and behind the last one,
    "staircase 16 levels, start" and "..., end": a scan from one to the other crosses every step once.
    """
    codes = [code for code in codes_by_depth(levels, bits) if code < levels.count]
    step, height = round(step_m / dbu_m), round(_STAIR_UM * UM / dbu_m)
    name = f"staircase {len(codes)} levels"
    y = height * dbu_m / 2
    places = {f"{name}, start": (0.0, y), f"{name}, end": ((len(codes) + 1) * step * dbu_m, y)}
    return Part(dbu_m, _stripes(codes, bits, step, height, dbu_m).shapes, places)


def _stripe(pitch_m: float, dbu_m: float, minimum_line_m: float) -> int:
    """Return the width of the gratings' narrowest stripe in units: the fewest whole pixels that can be printed."""
    pixel = round(pitch_m / dbu_m)
    if pixel < 1:
        got = format_length(pitch_m)
        raise InputError("pixel pitch", "must be one database unit or more", got, "Check the unit of the pitch.")
    return pixel * fewest_pixels(minimum_line_m, pixel * dbu_m)


def _framed(
    name: str, grating: Part, size: tuple[int, int], chrome: Photomask | None, words: Photomask, dbu_m: float
) -> Part:
    """Put a frame of chrome around a grating of some size in units, its name below, and a place in its middle."""
    width, height = size
    frame, overlap = round(_FRAME_M / dbu_m), round(_OVERLAP_M / dbu_m)
    below_m = _FRAME_M + 60 * UM
    pieces = [grating, moved(centred(written(words, name.upper(), 8, dbu_m)), width * dbu_m / 2, -below_m)]
    if chrome:
        outer = (-frame, -frame, width + frame, height + frame)
        # The chrome reaches a little inside, so that a slight misalignment bares no blank glass.
        opening = (overlap, overlap, width - overlap, height - overlap)
        boxes = without([outer], [opening]).astype(np.int32)
        pieces.append(Part(dbu_m, {chrome.on(2): Shapes(boxes)}, {}))
    return Part(dbu_m, joined(pieces).shapes, {f"grating {name}": (width * dbu_m / 2, height * dbu_m / 2)})


def _gratings(levels: Levels, photomasks: Sequence[Photomask], stripe: int, dbu_m: float) -> Part:
    """Draw the gratings, of 1 mm or a little more, and the empty window if there is chrome to frame it."""
    deepest = max(
        (photomask for photomask in photomasks if photomask.bit is not None), key=lambda photomask: photomask.depth_m
    )
    chrome = next((photomask for photomask in photomasks if photomask.name == "chrome"), None)
    bits = range(levels.bits)
    high = round(_GRATING_M / dbu_m)
    # The blazed grating rises toward +x, as heights do: the deepest floor of each period comes first.
    binary, blazed = [1 << (deepest.layer - 1)] * 2 + [0] * 2, codes_by_depth(levels, bits)[::-1]
    parts = []
    for name, period in (("binary", binary), ("blazed", blazed)):
        count = max(_FEWEST_PERIODS, math.ceil(high / (len(period) * stripe)))
        grating = _stripes(period * count, bits, stripe, high, dbu_m)
        size = (len(period) * count * stripe, high)
        parts.append(_framed(name, grating, size, chrome, deepest, dbu_m))
    if chrome:
        parts.append(_framed("blank", Part(dbu_m, {}, {}), (high, high), chrome, deepest, dbu_m))
    return row(parts, 100 * UM)


def process_monitor(
    levels: Levels, photomasks: Sequence[Photomask], pitch_m: float, dbu_m: float, minimum_line_m: float
) -> Part:
    """Draw all test structures of a job, centred on the origin, about 4.5 mm x 5 mm for 16 levels.

    The gratings are made of pixels of the DOE (`pitch_m`) and keep to the narrowest line of the process; the bars do
    not, since they are there to find it. Places: those of `cd_bars`, `depth_pads` and `staircase`, and the middles of
    "grating binary", "grating blazed" and "grating blank" (an empty window in the same chrome frame, if there is
    chrome).
    """
    tested = sorted(
        (photomask for photomask in photomasks if photomask.makes != "zero layer"),
        key=lambda photomask: photomask.layer,
    )
    cells = []
    for photomask in tested:
        title = f"{photomask.code} {photomask.depth.upper()}" if photomask.bit is not None else "CR"
        bars = column([written(photomask, title, 8, dbu_m), cd_bars(photomask, dbu_m)], 40 * UM)
        cells.append(row([bars, depth_pads(photomask, dbu_m)], _PAD_GAP_UM * UM))
    lines = [row(cells[i : i + 2], 150 * UM) for i in range(0, len(cells), 2)]
    deepest_first = sorted((p for p in tested if p.bit is not None), key=lambda photomask: -photomask.depth_m)
    bits = [photomask.bit for photomask in deepest_first if photomask.bit is not None]
    stairs = [staircase(levels, bits, STEP_M, dbu_m)]
    if levels.bits > 2:
        stairs.append(staircase(levels, bits[:2], 3 * STEP_M, dbu_m))
    for stair in stairs:
        name = next(iter(stair.places)).partition(",")[0].upper()
        lines.append(column([written(deepest_first[0], name, 6, dbu_m), stair], 40 * UM))
    lines.append(_gratings(levels, photomasks, _stripe(pitch_m, dbu_m, minimum_line_m), dbu_m))
    return centred(column(lines, 150 * UM))
