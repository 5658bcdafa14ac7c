"""Pictures of light are looked at by people; machines check that they are whole, the right way up and honest."""

import dataclasses
import math
import os
import re
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure, FigureBase

from fab.errors import InputError
from fab.figure import png_bytes, save
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.material import full_wave_height_m
from sim.plots.colours import colour_label, depth_positions, line_colours
from sim.plots.curves import plot_encircled, plot_mtf
from sim.plots.leakage import plot_split
from sim.plots.pattern import plot_pattern
from sim.plots.psfs import plot_psfs
from sim.psf_bank import PsfBank, psf
from sim.surface.leakage import SplitPsf
from sim.transfer import TransferBank
from tests.pictures import panel, panel_dots, require_place_of_axes, require_whole

RGB = (Colour("656nm", (656e-9,), (1.0,)), Colour("589nm", (589e-9,), (1.0,)), Colour("486nm", (486e-9,), (1.0,)))
CAMERA = Camera(Grid((64, 64), 1.85e-6), 116e-6, "fused_silica", RGB, 1e-3, 1.85e-6, 32)
ONE_COLOUR = dataclasses.replace(CAMERA, colours=RGB[:1], window=40)
NEAR, FAR = (2e-3, 4e-3), (0.5, np.inf)


def random_bank(
    rng: np.random.Generator, window: int = 32, camera: Camera = CAMERA, depths: tuple[float, ...] = NEAR + FAR
) -> PsfBank:
    energy = rng.exponential(0.8 / window**2, (len(camera.colours), len(depths), window, window)).astype(np.float32)
    return PsfBank(energy, tuple(c.name for c in camera.colours), depths, camera.pixel_m)


def random_transfer(
    rng: np.random.Generator, camera: Camera = CAMERA, depths: tuple[float, ...] = (*NEAR, *FAR)
) -> TransferBank:
    transfer = rng.uniform(0, 1, (len(camera.colours), len(depths), 40))
    return TransferBank(transfer, np.linspace(0, 0.5 / camera.pixel_m, 40), depths, camera)


def plot(name: str, **more) -> FigureBase:
    """One of each picture."""
    rng = np.random.default_rng(5)
    bank, lens = random_bank(rng), random_bank(rng)
    energy = bank.energy
    splits = {(c, 0): SplitPsf(energy[c, 0], energy[c, 0] / 2, energy[c, 0] / 3) for c in range(3)}
    match name:
        case "psfs":
            return plot_psfs(bank, CAMERA, NEAR, FAR, **more)
        case "mtf":
            return plot_mtf(random_transfer(rng), CAMERA, NEAR, FAR, random_transfer(rng), **more)
        case "encircled":
            return plot_encircled(bank, CAMERA, NEAR, FAR, lens, **more)
        case "split":
            return plot_split(lens, splits, CAMERA, 0, [(0.1, 0.2)] * 3, **more)
        case _:
            return plot_pattern(energy[0, 0], energy[0, 1], CAMERA, efficiency=0.9, uniformity=0.8, **more)


SLOW = ("psfs", "mtf", "split")
NAMES = ("encircled", "pattern", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_picture_is_whole_and_the_same_whatever_the_user_has_set(name: str):
    drawn = plot(name)
    data = png_bytes(drawn)
    assert isinstance(drawn, Figure)
    require_whole(drawn)
    with mpl.rc_context({"font.size": 20, "savefig.dpi": 50, "image.origin": "upper", "axes.grid": True}):
        assert png_bytes(plot(name)) == data
    assert b"Matplotlib" not in data
    assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME"))


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_takes_the_place_of_given_axes(name: str):
    require_place_of_axes(lambda ax: plot(name, ax=ax))


def spots_at(*places: tuple[float, float]) -> PsfBank:
    """A far PSF with spots at shares (across, up) of its window, on a faint ground."""
    energy = np.full((1, 1, 40, 40), 1e-7, np.float32)
    for across, up in places:
        energy[0, 0, int(40 * up), int(40 * across)] = 0.1
    return dataclasses.replace(random_bank(np.random.default_rng(1), 40, ONE_COLOUR, (np.inf,)), energy=energy)


@pytest.mark.parametrize(
    ("places", "aside"),
    [
        ([(0.5, 0.5)], False),
        ([(0.5, 0.5), (0.8, 0.8)], True),  # under the inset
        ([(0.5, 0.5), (0.2, 0.1)], True),  # under the words
        ([(0.5, 0.5), (0.8, 0.1), (0.2, 0.8)], False),
    ],
)
def test_inset_and_words_hide_no_spot(places: list[tuple[float, float]], aside: bool):
    figure = plot_psfs(spots_at(*places), ONE_COLOUR, (), (np.inf,))
    axes: Any = panel(figure, "far")
    (inset,) = axes.child_axes
    (words,) = (text for text in axes.texts if "window" in text.get_text())
    frame = axes.get_window_extent()
    for part in (inset.get_window_extent(), words.get_window_extent()):
        assert (part.x0 >= frame.x1) == aside
        assert part.overlaps(frame) == (not aside)
    require_whole(figure)


@pytest.mark.slow
def test_light_of_a_wedge_that_thickens_upward_is_drawn_on_top():
    wave = full_wave_height_m("fused_silica", 589e-9)
    rise = np.linspace(0, 3 * wave, 64, dtype=np.float32)
    bank = psf(np.tile(rise[:, None], 64), CAMERA, (np.inf,))
    dots = panel_dots(panel(plot_psfs(bank, CAMERA, (), (np.inf,)), "far")).sum(axis=2)
    # A strip left of the inset and above the words.
    strip = dots[: int(0.8 * len(dots)), int(0.35 * dots.shape[1]) : int(0.6 * dots.shape[1])]
    # Three waves of 589 nm over 118 um turn the light by 15 mrad, 15 of the 30 um above the middle.
    bright = np.nonzero(strip > 0.8 * strip.max())[0]
    assert bright.mean() / len(dots) == pytest.approx(0.25, abs=0.03)  # a pixel is 0.03 of the panel


def test_a_pattern_in_the_upper_half_is_drawn_on_top():
    target = np.zeros((32, 32), np.float32)
    target[20:28, 4:10] = 1 / 48
    drawn = plot_pattern(target, target, CAMERA, efficiency=1.0, uniformity=1.0)
    for title in ("target", "achieved"):
        dots = panel_dots(panel(drawn, title)).sum(axis=2)
        rows, columns = np.nonzero(dots > 0.8 * dots.max())
        assert rows.mean() / len(dots) == pytest.approx(1 - 24 / 32, abs=0.02)
        assert columns.mean() / len(dots) == pytest.approx(7 / 32, abs=0.02)


@pytest.mark.parametrize("blocked", ["read-only folder", "file in the way"])
def test_a_place_that_cannot_be_written_is_the_users_mistake(tmp_path: Path, blocked: str):
    folder = tmp_path / "locked"
    if blocked == "file in the way":
        folder.write_text("not a folder")
    else:
        folder.mkdir(mode=0o500)
        if os.access(folder, os.W_OK):
            pytest.skip("the superuser may write anywhere")
    with pytest.raises(InputError, match="locked"):
        save(plot("pattern"), folder / "picture.png")


def test_programmers_mistakes_are_named(rng: np.random.Generator):
    bank, transfer = random_bank(rng), random_transfer(rng)
    for draw in (partial(plot_psfs, bank), partial(plot_mtf, transfer), partial(plot_encircled, bank)):
        with pytest.raises(ValueError, match="at least one depth"):
            draw(CAMERA, (), ())
        with pytest.raises(ValueError, match="must be in the bank"):
            draw(CAMERA, (0.123,), ())
    with pytest.raises(ValueError, match="target's shape"):
        plot_pattern(np.zeros((4, 4)), np.zeros((5, 5)), CAMERA, efficiency=0.0, uniformity=0.0)


@pytest.mark.slow
def test_unusual_banks_are_drawn(rng: np.random.Generator):
    """An odd window of few pixels, one and five colours, many depths, a dark bank."""
    five = tuple(Colour(f"c{i}", (450e-9 + 50e-9 * i, 460e-9 + 50e-9 * i), (0.5, 0.5)) for i in range(5))
    many = (*(1e-3 * i for i in range(1, 8)), 1.0)
    for colours, depths, window in ((RGB[:1], (1e-3, np.inf), 9), (five, many, 8)):
        camera = dataclasses.replace(CAMERA, colours=colours, window=window)
        bank = random_bank(rng, window, camera, depths)
        transfer = random_transfer(rng, camera, depths)
        require_whole(plot_psfs(bank, camera, depths[:-1], depths[-1:]))
        require_whole(plot_mtf(transfer, camera, depths[:-1], depths[-1:]))
        require_whole(plot_encircled(bank, camera, depths[:-1], depths[-1:]))
    dark = PsfBank(np.zeros((3, 1, 8, 8), np.float32), ("656nm", "589nm", "486nm"), (1.0,), CAMERA.pixel_m)
    require_whole(plot_psfs(dark, CAMERA, (), (1.0,)))


@pytest.mark.parametrize("name", ["mtf", "encircled"])
def test_every_curve_and_mark_has_a_width(name: str):
    figure: Any = plot(name)
    panels = [axes for axes in figure.axes if axes.lines]
    assert len(panels) == len(NEAR + FAR)
    # Three colours of the DOE and of the lens, and the marks: one of the disc, or one far spot per colour.
    marks = {"mtf": [0, 0, 0, 0], "encircled": [3, 3, 1, 1]}[name]
    assert [len(axes.lines) for axes in panels] == [6 + more for more in marks]
    drawn = [line for axes in panels for line in (*axes.lines, *axes.get_xgridlines())]
    keys = [line for legend in figure.legends for line in legend.get_lines()]
    assert len(keys) == 4
    assert min(line.get_linewidth() for line in drawn + keys) > 0


@pytest.mark.parametrize(
    ("near", "far", "shown"), [(5, 1, (5, 1)), (3, 3, (3, 3)), (6, 0, (6, 0)), (6, 1, (3, 1)), (4, 4, (3, 3))]
)
def test_six_depths_are_shown_and_of_more_an_even_choice(rng: np.random.Generator, near: int, far: int, shown):
    camera = dataclasses.replace(CAMERA, colours=RGB[:1], window=8)
    depths = tuple(1e-3 * (1 + i) for i in range(near)), tuple(1.0 + i for i in range(far))
    drawn: Any = plot_psfs(random_bank(rng, 8, camera, depths[0] + depths[1]), camera, *depths)
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert tuple(sum(title.startswith(f"{name}, ") for title in titles) for name in ("near", "far")) == shown


def test_shares_of_the_light_are_told_for_each_colour_alone():
    """Of near depths that of the window, of far ones also that of the spot; none where three colours lie together."""
    drawn: Any = plot("psfs")
    panels = [axes for axes in drawn.axes if axes.images and axes.get_subplotspec() is not None]
    told = [[text.get_text() for text in axes.texts] for axes in panels]
    assert len(told) == 4 * 4
    of_colours, together = told[:12], told[12:]
    assert together == [[]] * 4
    words = [re.fullmatch(r"window [\d.]+ %(\nspot [\d.]+ %)?", text) for (text,) in of_colours]
    assert [found is not None and bool(found[1]) for found in words] == [False, False, True, True] * 3
    assert all(words)


def test_without_a_lens_the_aperture_is_compared_with(rng: np.random.Generator):
    """A plate alone before a sensor has no lens beside which it could be drawn."""
    bare = dataclasses.replace(CAMERA, focal_length_m=math.inf, distance_m=20e-3)
    for camera, label in ((CAMERA, "lens alone"), (bare, "aperture alone")):
        drawn: Any = plot_encircled(random_bank(rng), camera, NEAR, FAR, random_bank(rng))
        told = [text.get_text() for legend in drawn.legends for text in legend.get_texts()]
        assert told[-1] == label


def test_labels():
    assert colour_label(RGB[0]) == "656 nm"
    assert colour_label(Colour("532p5nm", (532.5e-9,), (1.0,))) == "532.5 nm"
    assert colour_label(Colour("1064nm", (1064e-9,), (1.0,))) == "1.064 µm"
    assert colour_label(Colour("green", (500e-9, 540e-9), (0.5, 0.5))) == "green, mean 520 nm"
    assert line_colours(RGB) == line_colours(RGB[::-1])[::-1]  # by wavelength, not by place
    assert depth_positions((0.05, np.inf), (np.inf, 0.05 * (1 + 1e-8)), 3) == [1, 0]
