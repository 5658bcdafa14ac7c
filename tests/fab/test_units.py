import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab.units import format_length, parse_angle, parse_length


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("75 nm", 7.5e-8),
        ("1.85um", 1.85e-6),
        ("1.85 µm", 1.85e-6),  # micro sign
        ("1.85 μm", 1.85e-6),  # Greek mu
        ("4.44 mm", 4.44e-3),
        (" 0.4 m ", 0.4),
        ("1e-3 m", 1e-3),
        (".5 mm", 5e-4),
        ("4 in", 0.1016),
    ],
)
def test_lengths_come_out_in_metres_to_the_last_bit(text, metres):
    assert parse_length(text) == metres


@pytest.mark.parametrize(
    ("text", "radians"), [("180 deg", math.pi), ("5 mrad", 5e-3), ("2°", math.pi / 90), ("0.1 rad", 0.1)]
)
def test_angles_come_out_in_radians(text, radians):
    # Fifteen digits are kept.
    assert parse_angle(text) == pytest.approx(radians, rel=1e-14)


@pytest.mark.parametrize("text", ["75", "nm", "", "75 s", "3 m/m", "2 m**2", "nan nm", "inf m", "9**9**9 m", "5 deg"])
def test_what_is_no_length_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r'number with a unit such as "75 nm", but got'):
        parse_length(text)


@pytest.mark.parametrize("text", ["2", "2 nm", "5 percent", "5 steradian", "5 dimensionless"])
def test_what_is_no_angle_is_refused(text):
    with pytest.raises(ValueError, match=r'unit such as "2 deg", but got'):
        parse_angle(text)


@pytest.mark.parametrize("value", [75, 75e-9, None])
def test_bare_numbers_are_refused(value):
    with pytest.raises(ValueError, match="with a unit"):
        parse_length(value)


def test_overflow_is_refused():
    with pytest.raises(ValueError, match="finite"):
        parse_length("1e999 nm")


@pytest.mark.parametrize(
    ("metres", "text"),
    [(7.5e-8, "75 nm"), (4.44e-3, "4.44 mm"), (1.85e-6, "1.85 um"), (0, "0 nm"), (-2e-3, "-2 mm"), (1e-9, "1 nm")],
)
def test_lengths_are_written_in_the_largest_fitting_unit(metres, text):
    assert format_length(metres) == text


@given(st.floats(1e-10, 1e3))
def test_a_written_length_reads_back(metres):
    # Twelve digits are written.
    assert parse_length(format_length(metres)) == pytest.approx(metres, rel=1e-11)
