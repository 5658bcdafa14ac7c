"""The contact sheet: it is drawn, the same each time, and shows what it is given the right way up."""

from pathlib import Path

import numpy as np
from PIL import Image

from doedesign.report.contact import ContactRow, draw_contact


def row(label: str, side: int = 40) -> ContactRow:
    ramp = np.linspace(0, 1, side, dtype=np.float32)[:, None] * np.ones((1, side), np.float32)
    light = np.stack([ramp, 0 * ramp, 1 - ramp])  # red above, blue below
    return ContactRow(label, light, light / 2, 2 * light, ramp, ramp)


def test_sheet(tmp_path: Path):
    rows = [row("first"), row("second", 700)]
    for name in ("a.png", "b.png"):
        draw_contact(tmp_path / name, rows, "a title", "some words on what it was made with " * 5)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        values = np.asarray(image.convert("RGB")).astype(int)
    red = (values[..., 0] > 180) & (values[..., 1:].max(axis=2) < 90)
    blue = (values[..., 2] > 180) & (values[..., :2].max(axis=2) < 90)
    first = slice(0, values.shape[0] // 2)
    assert np.nonzero(red[first])[0].mean() < np.nonzero(blue[first])[0].mean()  # up is +y
    assert values.shape[1] > 1000


def test_many_rows_are_cut(tmp_path: Path):
    draw_contact(tmp_path / "few.png", [row(str(k), 8) for k in range(12)], "", "")
    draw_contact(tmp_path / "many.png", [row(str(k), 8) for k in range(30)], "", "")
    assert (tmp_path / "few.png").read_bytes() == (tmp_path / "many.png").read_bytes()
