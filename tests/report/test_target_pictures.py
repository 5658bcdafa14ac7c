"""Pictures of areas and of foci: what they show of light wanted, and where their words lie."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import doedesign
from doedesign.areas.shape import area_table
from doedesign.areas.target import AreaTarget, camera_for
from doedesign.build import camera_from_spec
from doedesign.focus.foci import Foci
from doedesign.templates import template_text
from fab.pictures import write_pixels
from sim.optic import HeightOptic
from tests.pictures import require_whole


def area_of(tmp_path: Path, shape: str) -> Any:
    """Table of an area that a plate without relief lights."""
    text = template_text("diffuser").replace("samples = 512", "samples = 64").replace('"1.024 mm"', '"128 um"')
    path = tmp_path / "spec.toml"
    path.write_text(text.replace('shape = "rectangle"', shape))
    spec = doedesign.load_spec(path)
    area, camera = spec.areas[0], camera_from_spec(spec)
    picture = None if area.picture is None else tmp_path / area.picture
    return area_table(HeightOptic.of(camera), AreaTarget.of(area, camera_for(area, camera), picture))


def test_the_colours_of_a_picture_reach_beyond_its_brightest_part(tmp_path: Path):
    grey = np.zeros((64, 64), np.uint8)
    grey[20:44, 10:30], grey[24:40, 34:58] = 255, 160
    write_pixels(tmp_path / "sign.png", grey)
    table = area_of(tmp_path, 'shape = "picture"\npicture = "sign.png"')
    drawn = cast(Any, table.plot())
    low, high = drawn.axes[0].images[0].get_clim()
    wanted = table.target.wanted / table.target.wanted[table.target.flat].mean()
    assert wanted.max() > 1.4  # where a scale for even light would end
    assert (low, high) == (0.0, pytest.approx(1.4 * wanted.max()))
    require_whole(drawn)


@pytest.mark.parametrize("shape", ["rectangle", "line"])
def test_the_legend_lies_above_the_profiles(tmp_path: Path, shape: str):
    drawn = cast(Any, area_of(tmp_path, f'shape = "{shape}"').plot())
    axes = drawn.axes[1]
    highest = max(line.get_ydata().max() for line in axes.lines)
    drawn.canvas.draw()
    below = axes.get_legend().get_window_extent().y0
    assert axes.transData.transform((0.0, highest))[1] < below


def test_a_single_focus_shows_what_is_wanted_and_plain_numbers(tmp_path: Path):
    text = template_text("bifocal").replace("samples = 1000", "samples = 160").replace('"2 mm"', '"320 um"')
    path = tmp_path / "spec.toml"
    path.write_text(text)
    spec = doedesign.load_spec(path, ['focus.distances=["4 mm"]', "focus.weights=[1.0]"])
    camera = camera_from_spec(spec)
    assert spec.focus is not None
    radius = np.hypot(*np.meshgrid(*[(np.arange(160) - 79.5) * 2e-6] * 2))
    waves = -(np.hypot(radius, 4e-3) - 4e-3) / 532e-9
    lens = HeightOptic.of(camera, np.float32(np.mod(waves, 1) / camera.waves_per_metre(532e-9)))
    drawn = cast(Any, doedesign.focus_table(lens, Foci.shown(spec.focus, camera)).plot())
    drawn.canvas.draw()
    widths, shares = drawn.axes[:2]
    for line in (*widths.lines, *shares.lines):
        assert len(line.get_xdata()) == 1
        assert line.get_marker() not in ("", "None")
    ticks = shares.get_yticklabels("major") + shares.get_yticklabels("minor")
    labels = [tick.get_text() for tick in ticks if tick.get_text()]
    assert labels
    assert all(float(label) > 0 for label in labels)  # no powers of ten
    require_whole(drawn)
