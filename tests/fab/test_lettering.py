import itertools

import numpy as np
import pytest

from fab.errors import InputError
from fab.layout.geometry import Layer, Shapes
from fab.layout.lettering import HEIGHT, Job, label_block, letter_boxes, lettering, mask_label, written
from fab.layout.part import Part, photomasks_of
from fab.levels import Levels
from fab.units import MM, NM, UM
from tests.fab.parts import assert_sound, region

ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-_/:+"
PLATES = photomasks_of(Levels(16, 75 * NM), (3, 2, 1, 0), "clear", "etch", zero_layer=True)


def raster(text: str) -> np.ndarray:
    plane = np.zeros((HEIGHT, 6 * len(text) - 1), dtype=int)
    for x0, y0, x1, y1 in letter_boxes(text):
        plane[y0:y1, x0:x1] += 1
    return plane


def test_text_stands_upright_and_reads_from_left_to_right():
    assert ["".join(" #"[value] for value in line) for line in raster("FL7")[::-1]] == [
        "##### #     #####",
        "#     #         #",
        "#     #        ##",
        "####  #        # ",
        "#     #       ## ",
        "#     #       #  ",
        "#     #####   #  ",
    ]


def test_all_letters_differ_also_from_mirrored_ones_where_it_matters():
    rasters = {letter: raster(letter) for letter in ALPHABET}
    for a, b in itertools.combinations(ALPHABET, 2):
        # One stroke may be lost to dust: similar letters differ in more, but for the dot of the zero.
        assert np.count_nonzero(rasters[a] != rasters[b]) >= (1 if {a, b} == {"0", "O"} else 2), (a, b)
    for mirrored in (rasters["F"][:, ::-1], rasters["F"][::-1], rasters["F"][::-1, ::-1]):
        assert not any(np.array_equal(mirrored, drawn) for drawn in rasters.values())


def test_letters_are_sound_shapes_of_whole_strokes():
    text = ALPHABET + " " + ALPHABET[::-1]
    part = Part(NM, {Layer(1, 3): lettering(text, 21 * UM, NM)}, {})
    assert_sound(part, 3 * UM)
    assert part.box[1] == 0
    assert part.box[3] == 21_000
    assert region(part, Layer(1, 3)).area() == raster(text).sum() * 3000**2


def test_a_touching_corner_would_be_found():
    kissing = Shapes(np.array([[0, 0, 3000, 3000], [3000, 3000, 6000, 6000]], dtype=np.int32))
    with pytest.raises(AssertionError):
        assert_sound(Part(NM, {Layer(1, 3): kissing}, {}), 3 * UM)


def test_blank_text_draws_nothing():
    assert len(lettering("  ", 21 * UM, NM)) == 0
    assert len(lettering("", 21 * UM, NM)) == 0


@pytest.mark.parametrize("text", ["mask", "50 %", "µ", "A\nB"])
def test_other_characters_are_refused(text):
    with pytest.raises(InputError, match="lettering: must hold A-Z"):
        lettering(text, 21 * UM, NM)


def test_letters_below_the_unit_are_refused():
    with pytest.raises(InputError, match="seven database units"):
        lettering("A", 3 * NM, NM)


def test_a_label_says_what_the_mask_is():
    zero, deep, *_, chrome = PLATES
    job = Job("AUTO_A_1P85_0123", "A", 1.85e-6, "0123456789abcdef" * 4)
    assert mask_label(job, deep, "right-reading chrome down") == [
        "AUTO_A_1P85_0123",
        "MASK 4 BIT 3 ETCH 600 NM",
        "POLYGONS CLEAR - DARK FIELD PLATE",
        "RIGHT-READING CHROME DOWN",
        "REV A - PITCH 1.85 UM",
        "GEOMETRY 01234567",
    ]
    assert mask_label(job, chrome, "x")[1:3] == ["CHROME APERTURE", "POLYGONS DARK - CLEAR FIELD PLATE"]
    assert mask_label(job, zero, "x")[1] == "ZERO LAYER - CHROME MARKS"


def test_labels_of_all_masks_stand_below_each_other():
    labels = [
        (plate, mask_label(Job("AUTO_A_1_0123", "A", 1e-6, f"{k}" * 64), plate, "right-reading chrome down"))
        for k, plate in enumerate(PLATES)
    ]
    part = label_block(labels, 0.7 * MM, NM)
    assert_sound(part, 0.1 * MM)
    assert part.box[:2] == (0, 0)
    boxes = {plate.name: part.shapes[plate.on(3)].box for plate in PLATES}
    assert set(part.shapes) == {plate.on(3) for plate in PLATES}
    for name, box in boxes.items():
        assert box is not None
        assert part.places[f"label, {name}"] == pytest.approx((box[0] * NM, box[1] * NM))
    for above, below in itertools.pairwise(boxes.values()):
        assert above is not None
        assert below is not None
        assert above[1] - below[3] >= 0.7 * MM / NM


def test_small_words_begin_at_the_origin():
    part = written(PLATES[1], "M4", 12, 0.5 * NM)
    assert part.box == (0, 0, 11 * 24_000, 7 * 24_000)
