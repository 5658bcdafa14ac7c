import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab.layout.geometry import Layer, Shapes
from fab.layout.part import Part, block, centred, column, joined, moved, photomasks_of, prefixed, row, turned, without
from fab.levels import Levels
from fab.units import MM, NM, UM
from tests.fab.parts import kissing_corners

A, B = Layer(1, 1), Layer(2, 1)
SIXTEEN = Levels(16, 75 * NM)

boxes = st.lists(
    st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 6), st.integers(1, 6)).map(
        lambda v: (v[0], v[1], v[0] + v[2], v[1] + v[3])
    ),
    max_size=6,
)


def painted(some: np.ndarray | list, value: int = 1) -> np.ndarray:
    plane = np.zeros((16, 16), dtype=int)
    for x0, y0, x1, y1 in np.asarray(some, dtype=int).reshape(-1, 4):
        plane[y0:y1, x0:x1] += value
    return plane


@given(boxes, boxes)
def test_without_covers_what_is_left_once(areas, holes):
    drawn = without(areas, holes)
    assert np.array_equal(painted(drawn), (painted(areas) > 0) & (painted(holes) == 0))


def test_a_block_is_drawn_in_whole_units():
    part = block(A, [(0, -0.25, 9.75, 4)], 0.2 * NM)
    assert part.shapes[A].rectangles.tolist() == [[0, -1250, 48750, 20000]]
    assert part.box == (0, -1250, 48750, 20000)
    with pytest.raises(ValueError, match="whole units"):
        block(A, [(0, 0, 1, 0.0003)], 1 * NM)


def test_a_part_moves_with_its_places_and_its_polygons():
    triangle = np.array([[0, 0], [4, 0], [0, 4]], dtype=np.int32)
    part = Part(NM, {A: Shapes(np.array([[0, 0, 2, 2]], dtype=np.int32), (triangle,))}, {"spot": (1 * NM, 2 * NM)})
    there = moved(part, 3.4 * NM, -35 * MM)
    assert there.shapes[A].rectangles.tolist() == [[3, -35_000_000, 5, -34_999_998]]
    assert there.shapes[A].polygons[0].tolist() == [[3, -35_000_000], [7, -35_000_000], [3, -34_999_996]]
    # 1e-18 m: rounding of float64 sums of 35 mm.
    assert there.places["spot"] == pytest.approx((4 * NM, -35 * MM + 2 * NM), abs=1e-17)
    assert part.places["spot"] == (1 * NM, 2 * NM)
    with pytest.raises(ValueError, match="32-bit"):
        moved(part, 2.2, 0)


def test_parts_are_joined_by_layer_and_every_place_keeps_its_own_name():
    one = Part(NM, block(B, [(0, 0, 1, 1)], NM).shapes, {"spot": (0.0, 0.0)})
    both = joined([one, block(A, [(2, 0, 3, 1)], NM), prefixed(moved(one, 5 * UM, 0), "right: ")])
    assert list(both.shapes) == [A, B]
    assert len(both.shapes[B]) == 2
    assert both.places == {"spot": (0.0, 0.0), "right: spot": (pytest.approx(5 * UM), 0.0)}
    with pytest.raises(ValueError, match="'spot' comes twice"):
        joined([one, one])
    with pytest.raises(ValueError, match="one database unit"):
        joined([one, block(A, [(0, 0, 1, 1)], 0.5 * NM)])
    assert block(A, [], NM).box == (0, 0, 0, 0)


def test_rows_columns_and_the_middle():
    small, large = block(A, [(5, 5, 6, 7)], NM), block(B, [(-3, 0, 0, 4)], NM)
    side = row([small, large], 2 * UM)
    assert side.shapes[A].box == (0, 0, 1000, 2000)
    assert side.shapes[B].box == (3000, 0, 6000, 4000)
    tower = column([small, large], 2 * UM)
    assert tower.shapes[A].box == (0, 6000, 1000, 8000)
    assert tower.shapes[B].box == (0, 0, 3000, 4000)
    assert centred(tower).box == (-1500, -4000, 1500, 4000)
    assert turned(np.array([[1.0, 2.0, 3.0, 5.0]])).tolist() == [[2, 1, 5, 3]]


def test_touching_corners_are_found():
    assert kissing_corners(np.array([[0, 0, 1, 1], [1, 1, 2, 2]])) == 1
    assert kissing_corners(np.array([[0, 0, 1, 1], [1, 1, 2, 2], [1, 0, 2, 1]])) == 0


def test_plates_come_in_the_order_of_use():
    plates = photomasks_of(SIXTEEN, (3, 2, 0, 1), "clear", "liftoff", zero_layer=True)
    assert [plate.name for plate in plates] == ["zero layer", "mask 4", "mask 3", "mask 1", "mask 2", "chrome"]
    assert [plate.code for plate in plates] == ["Z0", "M4", "M3", "M1", "M2", "CR"]
    assert [plate.layer for plate in plates] == [10, 4, 3, 1, 2, 5]
    assert [plate.depth for plate in plates[1:3]] == ["600 nm", "300 nm"]
    assert plates[1].on(2) == Layer(4, 2)
    assert [p.name for p in photomasks_of(SIXTEEN, (0, 1, 2, 3), "clear", "none", False)] == [
        f"mask {k}" for k in (1, 2, 3, 4)
    ]


@pytest.mark.parametrize(
    ("tone", "chrome", "expected"),
    [
        ("clear", "liftoff", "clear"),
        ("clear", "etch", "dark"),
        ("dark", "liftoff", "dark"),
        ("dark", "etch", "clear"),
    ],
)
def test_chrome_that_is_etched_needs_the_other_tone(tone, chrome, expected):
    # Positive resist goes where light was: glass is etched there, and lifted-off chrome stays there, but a chrome film
    # is etched there, and its polygons say where chrome stays.
    plates = photomasks_of(Levels(4, 75 * NM), (0, 1), tone, chrome, False)
    assert [plate.tone for plate in plates] == [tone, tone, expected]
