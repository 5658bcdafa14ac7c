"""Figures: house style whatever the user has set, the same bytes, sub-figures, files, and HTML for notebooks."""

import base64
import io
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from PIL import Image

from fab.errors import InputError
from fab.figure import (
    drawn_beside,
    evenly_spaced,
    html_of,
    length_text,
    panels,
    png_bytes,
    save,
    scale_bar,
    shrunk,
    single,
)
from tests.pictures import require_whole


def plot_two(seed: int = 0, ax: Axes | None = None) -> FigureBase:
    """Two maps with scale bars, a title and a long note."""
    with panels(ax, (5, 3.4), "a $title$ of one's own", "words " * 60, "compressed") as figure:
        for axes in figure.subplots(1, 2):
            axes.imshow(np.random.default_rng(seed).normal(size=(9, 9)))
            scale_bar(axes, 1e-3)
    return figure


def plot_line(ax: Axes | None = None) -> Axes:
    with single(ax, (3, 2), "a line") as axes:
        axes.plot([0, 1, 2], [2, 0, 1])
        axes.set_xlabel("x (mm)")
    return axes


def test_a_new_figure_is_whole_and_shows_itself_in_a_notebook():
    figure = plot_two()
    assert isinstance(figure, Figure)
    require_whole(figure)
    require_whole(plot_line())
    with Image.open(io.BytesIO(plot_two()._repr_png_())) as image:  # pyright: ignore[reportAttributeAccessIssue]
        assert image.size == (800, 544)
        assert not image.info.keys() - {"dpi"}  # no version, no time


def test_a_picture_takes_the_place_of_the_axes_that_it_is_given():
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    drawn = plot_two(ax=left)
    assert isinstance(drawn, SubFigure)
    assert drawn.get_figure(root=True) is figure
    assert left not in figure.axes
    assert plot_line(right) is right
    assert right.get_title() == "a line"
    require_whole(figure)
    assert drawn.bbox.x1 <= right.bbox.x0
    with pytest.raises(ValueError, match="subplot"):
        plot_two(ax=figure.add_axes((0, 0, 1, 1)))


def test_the_users_settings_change_neither_the_bytes_nor_are_they_changed():
    plain = png_bytes(plot_two())
    with mpl.rc_context({"font.size": 20, "savefig.dpi": 50, "image.origin": "upper", "axes.grid": True}):
        assert png_bytes(plot_two()) == plain
        assert mpl.rcParams["font.size"] == 20


@pytest.mark.slow
def test_threads_draw_the_same_pictures():
    wanted = [png_bytes(plot_two(seed)) for seed in range(4)]
    before = dict(mpl.rcParams)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda seed: png_bytes(plot_two(seed)), range(4)))
    assert found == wanted
    assert dict(mpl.rcParams) == before


def test_a_file_is_written_whole_or_refused(tmp_path):
    save(plot_line(), tmp_path / "line.png")
    assert (tmp_path / "line.png").read_bytes() == png_bytes(plot_line())
    (tmp_path / "locked").write_text("not a folder")
    with pytest.raises(InputError, match="locked"):
        save(plot_line(), tmp_path / "locked" / "line.png")


def test_html_holds_the_table_and_the_picture():
    page = html_of("a <map>", {"pitch": "1.85 µm", "cells": 9}, plot_line())
    assert "a &lt;map&gt;" in page
    assert "<tr><th>pitch</th><td>1.85 µm</td></tr><tr><th>cells</th><td>9</td></tr>" in page
    encoded = page.partition("base64,")[2].partition('"')[0]
    assert base64.b64decode(encoded) == png_bytes(plot_line())
    assert "img" not in html_of("none", {})


def test_shrinking_keeps_the_mean_and_makes_no_moire():
    even = np.linspace(0, 1, 101 * 67, dtype=np.float32).reshape(101, 67)
    assert shrunk(even, 30).shape == (30, 30)
    assert shrunk(even, 30).mean() == pytest.approx(even.mean(), rel=1e-5)  # float32
    np.testing.assert_array_equal(shrunk(even, 200), even)
    values = np.random.default_rng(1).integers(0, 16, (1200, 900)).astype(np.float32)
    assert shrunk(values, 300)[0, 0] == pytest.approx(values[:4, :3].mean())
    # Rings of 3.12 cells on dots of 3.6: plain averages beat with the dots, the smooth one hardly.
    grating = (np.sin(2 * np.pi * np.arange(2400) / 3.12) * np.ones((2400, 1))).astype(np.float32)
    assert np.ptp(shrunk(grating, 672, "smooth")[300, 10:-10]) < 0.01 < np.ptp(shrunk(grating, 672)[300, 10:-10])


def test_small_helpers():
    assert length_text(1.85e-6) == "1.85 µm"
    assert length_text(np.inf) == "∞"
    assert evenly_spaced(9, 3) == [0, 4, 8]
    assert evenly_spaced(2, 3) == [0, 1]


@pytest.mark.parametrize("width_m", [1e-3, 3.9e-3, 4.0e-3, 7.99e-3, 8e-3, 19e-3, 20e-3, 123e-6])
def test_a_scale_bar_is_the_longest_round_length_within_a_quarter(width_m: float):
    axes = Figure().subplots()
    scale_bar(axes, width_m)
    (line,), (words,) = axes.lines, axes.texts
    round_ones = [m * 10.0**n for n in range(-6, 0) for m in (1, 2, 5)]
    wanted = max(length for length in round_ones if length <= width_m / 4 * (1 + 1e-9))
    assert np.asarray(line.get_xdata()) == pytest.approx([0, wanted / width_m])
    assert words.get_text() == length_text(wanted)


def square(side: float, title: str = "") -> Any:
    with single(None, (side, side), title) as axes:
        axes.plot([0, 1])
    return axes


def test_pictures_drawn_beside_are_those_drawn_here(tmp_path: Path) -> None:
    with drawn_beside() as draw:
        for side in (1.0, 1.5):
            draw(tmp_path / f"{side}.png", square, side, title="a square")
    for side in (1.0, 1.5):
        assert (tmp_path / f"{side}.png").read_bytes() == png_bytes(square(side, "a square"))


def test_an_error_of_a_picture_is_raised_at_the_end(tmp_path: Path) -> None:
    def fails() -> Any:
        raise ValueError("nothing to draw")

    done = []

    def draw_and_go_on() -> None:
        with drawn_beside() as draw:
            draw(tmp_path / "none.png", fails)
            done.append("what follows it here")

    with pytest.raises(ValueError, match="nothing to draw"):
        draw_and_go_on()
    assert done
    assert not (tmp_path / "none.png").exists()


def test_an_error_beside_leaves_out_pictures_that_have_not_begun(tmp_path: Path) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def waits() -> Any:
        begun.set()
        assert go_on.wait(60)
        return square(1.0)

    def draw_until_stopped() -> None:
        with drawn_beside() as draw:
            draw(tmp_path / "first.png", waits)
            draw(tmp_path / "second.png", square, 1.0)
            assert begun.wait(60)
            raise KeyboardInterrupt

    threading.Timer(0.5, go_on.set).start()
    with pytest.raises(KeyboardInterrupt):
        draw_until_stopped()
    assert (tmp_path / "first.png").exists()
    assert not (tmp_path / "second.png").exists()
