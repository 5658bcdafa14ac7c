"""Lettering: text as rectangles, and what is written on a mask.

Letters stand on a raster of 5 x 7 strokes, one stroke apart. They are drawn square, and a slope is a stair whose steps
overlap, so that no two rectangles touch at a corner only. Every line and every gap is one stroke wide or more; a zero
has a dot, unlike an O.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.layout.geometry import Shapes
from fab.layout.part import Part, Photomask, column, joined, moved
from fab.layout.polygons import rectangles
from fab.units import UM, format_length

# Strokes in the height of a letter, and from one letter to the next.
HEIGHT, _ADVANCE = 7, 6
# From one line of text to the next, and from one label to the next.
_LINE, _BLOCK = 11, 18

_FONT = """
A ..#.. .###. ##.## #...# ##### #...# #...#
B ####. #..#. #..#. ##### #...# #...# #####
C ##### #.... #.... #.... #.... #.... #####
D ###.. #.##. #..## #...# #..## #.##. ###..
E ##### #.... #.... ####. #.... #.... #####
F ##### #.... #.... ####. #.... #.... #....
G ##### #.... #.... #.### #...# #...# #####
H #...# #...# #...# ##### #...# #...# #...#
I ##### ..#.. ..#.. ..#.. ..#.. ..#.. #####
J ..### ....# ....# ....# #...# #...# #####
K #..## #..#. #.##. ###.. #.##. #..#. #..##
L #.... #.... #.... #.... #.... #.... #####
M #...# ##.## ##### #.#.# #...# #...# #...#
N #...# ##..# ###.# #.### #..## #...# #...#
O ##### #...# #...# #...# #...# #...# #####
P ##### #...# #...# ##### #.... #.... #....
Q ####. #..#. #..#. #..#. #..#. ##### ...##
R ##### #...# #...# ##### #.##. #..## #...#
S .#### ##... ##... .###. ...## ...## ####.
T ##### ..#.. ..#.. ..#.. ..#.. ..#.. ..#..
U #...# #...# #...# #...# #...# #...# #####
V #...# #...# #...# ##.## .#.#. .###. ..#..
W #...# #...# #...# #.#.# ##### ##.## #...#
X #...# ##.## .###. ..#.. .###. ##.## #...#
Y #...# #...# ##.## .###. ..#.. ..#.. ..#..
Z ##### ...## ..##. ..#.. .##.. ##... #####
0 ##### #...# #...# #.#.# #...# #...# #####
1 ..#.. .##.. ..#.. ..#.. ..#.. ..#.. #####
2 ##### ....# ....# ##### #.... #.... #####
3 ##### ....# ....# .#### ....# ....# #####
4 #...# #...# #...# ##### ....# ....# ....#
5 ##### #.... #.... ##### ....# ....# #####
6 ###.. #.... #.... ##### #...# #...# #####
7 ##### ....# ...## ...#. ..##. ..#.. ..#..
8 ##### #...# #...# ##### #...# #...# #####
9 ##### #...# #...# ##### ....# ....# ..###
. ..... ..... ..... ..... ..... ..... ..#..
- ..... ..... ..... .###. ..... ..... .....
_ ..... ..... ..... ..... ..... ..... #####
/ ....# ...## ..##. ..#.. .##.. ##... #....
: ..... ..... ..#.. ..... ..... ..#.. .....
+ ..... ..#.. ..#.. ##### ..#.. ..#.. .....
"""
_GLYPHS = {line[0]: line[2:].split() for line in _FONT.strip().splitlines()} | {" ": ["....."] * HEIGHT}


class Job(NamedTuple):
    """Identity of a job: beginning of its names, revision, pixel pitch (metres), digest of its geometry."""

    stem: str
    revision: str
    pitch_m: float
    geometry: str


def letter_boxes(text: str) -> NDArray[np.int32]:
    """Return the disjoint rectangles ``(n, 4)`` x0, y0, x1, y1, in strokes, of text that stands on y = 0 from x = 0."""
    odd = sorted(set(text) - set(_GLYPHS))
    if odd:
        rule = "must hold A-Z, 0-9, . - _ / : + and spaces only"
        raise InputError("lettering", rule, repr("".join(odd)), "Choose plainer words.")
    lines = [".".join(_GLYPHS[letter][line] for letter in text) for line in reversed(range(HEIGHT))]
    return rectangles(np.array([[mark == "#" for mark in line] for line in lines], dtype=np.uint8).reshape(HEIGHT, -1))


def lettering(text: str, height_m: float, dbu_m: float) -> Shapes:
    """Draw text that stands on y = 0 from x = 0, letters `height_m` high, a stroke a seventh of it in whole units."""
    stroke = round(height_m / HEIGHT / dbu_m)
    if stroke < 1:
        rule = "letters must be seven database units high or more"
        raise InputError("lettering", rule, format_length(height_m), "Choose a larger height.")
    return Shapes(letter_boxes(text) * np.int32(stroke))


def mask_label(job: Job, photomask: Photomask, reading: str) -> list[str]:
    """Return what is written on a mask, in capitals, line by line from the top, with 8 digits of the digest."""
    if photomask.bit is not None:
        what = f"mask {photomask.bit + 1} bit {photomask.bit} etch {photomask.depth}"
    else:
        what = "zero layer - chrome marks" if photomask.makes == "zero layer" else "chrome aperture"
    field = "dark" if photomask.tone == "clear" else "clear"
    tone = f"polygons {photomask.tone} - {field} field plate"
    issue, geometry = f"rev {job.revision} - pitch {format_length(job.pitch_m)}", f"geometry {job.geometry[:8]}"
    return [line.upper() for line in (job.stem, what, tone, reading, issue, geometry)]


def label_block(labels: Sequence[tuple[Photomask, Sequence[str]]], height_m: float, dbu_m: float) -> Part:
    """Write the labels of masks (photomask and lines), the first on top, on datatype 3 of each, so that no two meet.

    The lower left corner is (0, 0), letters are `height_m` high. Places: "label, mask 3", the lower left corner of
    each.
    """
    stroke_m = height_m / HEIGHT
    blocks = []
    for photomask, lines in labels:
        drawn = [Part(dbu_m, {photomask.on(3): lettering(line, height_m, dbu_m)}, {}) for line in lines]
        placed = [moved(p, 0, (len(lines) - 1 - i) * _LINE * stroke_m) for i, p in enumerate(drawn)]
        part = joined(placed)
        blocks.append(
            Part(dbu_m, part.shapes, {f"label, {photomask.name}": (part.box[0] * dbu_m, part.box[1] * dbu_m)})
        )
    return column(blocks, (_BLOCK - HEIGHT) * stroke_m)


def written(photomask: Photomask, text: str, stroke_um: float, dbu_m: float) -> Part:
    """Write a line of text on datatype 3 of a photomask, from the origin on, with strokes of whole database units."""
    return Part(dbu_m, {photomask.on(3): lettering(text, HEIGHT * stroke_um * UM, dbu_m)}, {})
