"""The contact sheet: it is drawn, the same each time, and shows what it is given the right way up."""

import numpy as np
import pytest

from doedesign.report.sheet import ContactRow, plot_contact
from fab.figure import png_bytes
from tests.pictures import dots_of, require_place_of_axes, require_whole


def row(label: str, side: int = 40) -> ContactRow:
    ramp = np.linspace(0, 1, side, dtype=np.float32)[:, None] * np.ones((1, side), np.float32)
    light = np.stack([ramp, 0 * ramp, 1 - ramp])  # red above, blue below
    return ContactRow(label, light, light / 2, 2 * light, ramp, ramp)


@pytest.mark.slow
def test_sheet():
    rows = [row("first"), row("second", 700)]

    def draw():
        return plot_contact(rows, "a title", "some words on how it was made " * 5)

    require_whole(draw())
    require_place_of_axes(lambda ax: plot_contact(rows, "a title", "some words on how it was made " * 5, ax))
    assert png_bytes(draw()) == png_bytes(draw())
    values = dots_of(draw())
    red = (values[..., 0] > 0.7) & (values[..., 1:].max(axis=2) < 0.35)
    blue = (values[..., 2] > 0.7) & (values[..., :2].max(axis=2) < 0.35)
    first = slice(0, values.shape[0] // 2)
    assert np.nonzero(red[first])[0].mean() < np.nonzero(blue[first])[0].mean()  # up is +y
    assert values.shape[1] > 1000


@pytest.mark.slow
def test_many_rows_are_cut():
    few, many = (plot_contact([row(str(k), 8) for k in range(count)], "", "") for count in (12, 30))
    assert png_bytes(few) == png_bytes(many)
