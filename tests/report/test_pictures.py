"""Pictures are looked at by people; machines check that they are whole, repeatable, the right way up and honest."""

import dataclasses
import os
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.image import imread

from doedesign.report.canvas import colour_label, depth_positions, length_text, line_colours, shrunk, spread
from doedesign.report.height import height_shares
from doedesign.report.pictures import (
    draw_encircled,
    draw_height,
    draw_history,
    draw_mtf,
    draw_pattern,
    draw_psfs,
)
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from sim.camera import Camera, Colour
from sim.material import full_wave_height_m
from sim.psf_bank import PsfBank, psf_bank
from sim.transfer import TransferBank

RGB = (Colour("656nm", (656e-9,), (1.0,)), Colour("589nm", (589e-9,), (1.0,)), Colour("486nm", (486e-9,), (1.0,)))
CAMERA = Camera(Grid((64, 64), 1.85e-6), 116e-6, "fused_silica", RGB, 1e-3, 1.85e-6, 32)
LEVELS = Levels(16, 75e-9)
NEAR, FAR = (2e-3, 4e-3), (0.5, np.inf)
DPI = 160


def random_bank(
    rng: np.random.Generator, window: int = 32, camera: Camera = CAMERA, depths: tuple[float, ...] = NEAR + FAR
) -> PsfBank:
    energy = rng.exponential(0.8 / window**2, (len(camera.colours), len(depths), window, window)).astype(np.float32)
    return PsfBank(energy, tuple(c.name for c in camera.colours), depths, camera.pixel_m)


def random_transfer(
    rng: np.random.Generator, camera: Camera = CAMERA, depths: tuple[float, ...] = (*NEAR, *FAR)
) -> TransferBank:
    transfer = rng.uniform(0, 1, (len(camera.colours), len(depths), 40))
    return TransferBank(transfer, np.linspace(0, 0.5 / camera.pixel_m, 40), depths)


def random_levels(rng: np.random.Generator) -> np.ndarray:
    return (rng.integers(0, 16, CAMERA.grid.shape) * LEVELS.step_m).astype(np.float32)


RECORDS = [{"step": i, "loss": 1 / (i + 1), "terms": [0.3, 0.9 / (i + 1)], "names": ["a", "my:b"]} for i in range(130)]


def draw_all(folder: Path, rng: np.random.Generator) -> dict[str, Path]:
    """One of each picture."""
    bank, lens = random_bank(rng), random_bank(rng)
    image = bank.energy[0, 0]
    files = {name: folder / f"{name}.png" for name in ("height", "psfs", "mtf", "encircled", "history", "pattern")}
    draw_height(files["height"], random_levels(rng), LEVELS, CAMERA, "a $name$ of one's own")
    draw_psfs(files["psfs"], CAMERA, bank, NEAR, FAR)
    draw_mtf(files["mtf"], CAMERA, random_transfer(rng), NEAR, FAR, random_transfer(rng))
    draw_encircled(files["encircled"], CAMERA, bank, NEAR, FAR, lens)
    draw_history(files["history"], RECORDS)
    draw_pattern(files["pattern"], CAMERA, image, image, efficiency=0.9, uniformity=0.8)
    return files


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return draw_all(tmp_path_factory.mktemp("pictures"), np.random.default_rng(5))


# Width and height in inches of what `draw_all` draws: four columns of 2.5 in and four rows, two columns of curves.
SIZES = {
    "height": (10.1, 5.35),
    "psfs": (0.85 + 4 * 2.6 + 0.4 + 0.1, 1.25 + 0.15 + 4 * 2.6 + 0.3),
    "mtf": (0.65 + 2 * 2.8, 2 * 2.45 + 0.35 + 0.15),
    "encircled": (0.65 + 2 * 2.8, 2 * 2.45 + 0.35 + 0.15),
    "history": (6.6, 3.4),
    "pattern": (8.3, 4.0),
}


@pytest.mark.parametrize("name", SIZES)
def test_a_picture_is_a_png_of_its_size_and_not_blank(pictures: dict[str, Path], name: str):
    assert pictures[name].read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    image = imread(pictures[name])
    width, height = SIZES[name]
    # Up to one line of notes more or less, and the rounding to whole dots.
    assert image.shape[1] == pytest.approx(width * DPI, abs=2)
    assert image.shape[0] == pytest.approx(height * DPI, abs=0.15 * DPI + 2)
    assert np.ptp(image[..., :3]) > 0.9
    # A white rim all round: nothing is cut off at the border.
    rim = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert np.all(rim == 1.0)


def test_the_same_input_gives_the_same_bytes_whatever_the_user_has_set(pictures: dict[str, Path], tmp_path: Path):
    with mpl.rc_context({"font.size": 20, "savefig.dpi": 50, "image.origin": "upper", "axes.grid": True}):
        again = draw_all(tmp_path, np.random.default_rng(5))
        assert mpl.rcParams["font.size"] == 20  # and the user's settings are left as they were
    for name, path in again.items():
        assert path.read_bytes() == pictures[name].read_bytes(), name


def test_a_picture_names_no_library_and_no_time(pictures: dict[str, Path]):
    for path in pictures.values():
        data = path.read_bytes()
        assert b"Matplotlib" not in data
        assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME"))


def brightness(image: np.ndarray, box_in: tuple[float, float, float, float]) -> np.ndarray:
    """Sum of the colours in a box given by left, bottom, width and height in inches."""
    left, bottom, width, height = (round(edge * DPI) for edge in box_in)
    rows = slice(len(image) - bottom - height, len(image) - bottom)
    return image[rows, left : left + width, :3].sum(axis=2)


def test_height_and_light_of_a_wedge_that_thickens_upward_are_drawn_on_top(tmp_path: Path):
    wave = full_wave_height_m("fused_silica", 589e-9)
    rise = np.linspace(0, 3 * wave, 64, dtype=np.float32)
    draw_height(tmp_path / "height.png", np.tile(rise[:, None], 64), None, CAMERA, "wedge")
    whole = brightness(imread(tmp_path / "height.png"), (0.75, 0.55, 4.2, 4.2))
    column = whole[:, whole.shape[1] // 4]
    inside = column[120:-120]  # away from the chrome
    assert inside[:80].mean() > inside[-80:].mean() + 0.5  # viridis is brighter where the plate is higher

    bank = psf_bank(CAMERA, np.tile(rise[:, None], 64), (np.inf,))
    draw_psfs(tmp_path / "psfs.png", CAMERA, bank, (), (np.inf,))
    image = imread(tmp_path / "psfs.png")
    # The first row begins 0.4 in below the upper edge; the strip lies between the words and the inset.
    panel = brightness(image, (0.85 + 1.0, len(image) / DPI - 0.4 - 3.2, 1.25, 3.2))
    # Three waves of 589 nm over 118 um turn the light by 15 mrad, 15 of the 30 um above the middle.
    bright = np.nonzero(panel > 0.8 * panel.max())[0]
    assert bright.mean() / len(panel) == pytest.approx(0.25, abs=0.03)  # a pixel is 0.03 of the panel


def test_a_pattern_in_the_upper_half_is_drawn_on_top(tmp_path: Path):
    target = np.zeros((32, 32), np.float32)
    target[20:28, 4:10] = 1 / 48
    draw_pattern(tmp_path / "p.png", CAMERA, target, target, efficiency=1.0, uniformity=1.0)
    for left in (0.75, 4.05):
        panel = brightness(imread(tmp_path / "p.png"), (left + 0.02, 0.52, 3.16, 3.16))
        rows, columns = np.nonzero(panel > 0.8 * panel.max())
        assert rows.mean() / len(panel) == pytest.approx(1 - 24 / 32, abs=0.02)
        assert columns.mean() / len(panel) == pytest.approx(7 / 32, abs=0.02)


@pytest.mark.parametrize("blocked", ["read-only folder", "file in the way"])
def test_a_place_that_cannot_be_written_is_the_users_mistake(tmp_path: Path, blocked: str, rng: np.random.Generator):
    folder = tmp_path / "locked"
    if blocked == "file in the way":
        folder.write_text("not a folder")
    else:
        folder.mkdir(mode=0o500)
        if os.access(folder, os.W_OK):
            pytest.skip("the superuser may write anywhere")
    for draw in (
        lambda path: draw_height(path, random_levels(rng), LEVELS, CAMERA, ""),
        lambda path: draw_mtf(path, CAMERA, random_transfer(rng), NEAR, FAR),
        lambda path: draw_history(path, RECORDS),
    ):
        with pytest.raises(InputError, match="locked"):
            draw(folder / "picture.png")


def test_programmers_mistakes_are_named(tmp_path: Path, rng: np.random.Generator):
    bank, path = random_bank(rng), tmp_path / "x.png"
    with pytest.raises(ValueError, match="grid's shape"):
        draw_height(path, np.zeros((8, 8)), LEVELS, CAMERA, "")
    transfer = random_transfer(rng)
    draws = (partial(draw_psfs, path, CAMERA, bank), partial(draw_mtf, path, CAMERA, transfer))
    for draw in (*draws, partial(draw_encircled, path, CAMERA, bank)):
        with pytest.raises(ValueError, match="at least one depth"):
            draw((), ())
        with pytest.raises(ValueError, match="must be in the bank"):
            draw((0.123,), ())
    with pytest.raises(ValueError, match="target's shape"):
        draw_pattern(path, CAMERA, np.zeros((4, 4)), np.zeros((5, 5)), efficiency=0.0, uniformity=0.0)
    with pytest.raises(ValueError, match="at least one step"):
        draw_history(path, [])
    assert not path.exists()


def test_unusual_plates_and_banks_are_drawn(tmp_path: Path, rng: np.random.Generator):
    """An odd window of few pixels, one and five colours, many depths, a dark bank, a flat plate of few cells."""
    five = tuple(Colour(f"c{i}", (450e-9 + 50e-9 * i, 460e-9 + 50e-9 * i), (0.5, 0.5)) for i in range(5))
    many = (*(1e-3 * i for i in range(1, 8)), 1.0)
    for colours, depths, window in ((RGB[:1], (1e-3, np.inf), 9), (five, many, 8)):
        camera = dataclasses.replace(CAMERA, colours=colours, window=window)
        bank = random_bank(rng, window, camera, depths)
        transfer = random_transfer(rng, camera, depths)
        name = tmp_path / f"{len(colours)}"
        draw_psfs(f"{name}psf.png", camera, bank, depths[:-1], depths[-1:])
        draw_mtf(f"{name}mtf.png", camera, transfer, depths[:-1], depths[-1:])
        draw_encircled(f"{name}encircled.png", camera, bank, depths[:-1], depths[-1:])
    dark = PsfBank(np.zeros((3, 1, 8, 8), np.float32), ("656nm", "589nm", "486nm"), (1.0,), CAMERA.pixel_m)
    draw_psfs(tmp_path / "dark.png", CAMERA, dark, (), (1.0,))
    tiny = dataclasses.replace(CAMERA, grid=Grid((7, 7), 1e-6), aperture_m=5e-6)
    draw_height(tmp_path / "flat.png", np.zeros((7, 7)), None, tiny, "t" * 500)
    draw_height(tmp_path / "two.png", np.full((7, 7), 1e-6), Levels(2, 5e-7), tiny, "above the staircase")
    assert len(list(tmp_path.iterdir())) == 9


def test_shares_of_area_are_counted_once_each(rng: np.random.Generator):
    heights = random_levels(rng).ravel()
    edges, shares = height_shares(heights, LEVELS, (-0.5 * LEVELS.step_m, 15.5 * LEVELS.step_m))
    assert len(shares) == 16
    np.testing.assert_allclose(edges, (np.arange(17) - 0.5) * 75e-9, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(shares, np.bincount(np.rint(heights / 75e-9).astype(int), minlength=16) / 64**2)
    smooth = rng.uniform(0, 1.2e-6, 5000).astype(np.float32)
    for levels in (None, LEVELS):
        _, shares = height_shares(smooth, levels, (float(smooth.min()), float(smooth.max())))
        assert len(shares) > 16  # what stands between levels is not rounded to them
        assert shares.sum() == pytest.approx(1.0)
    _, beyond = height_shares(np.array([0.0, 20 * 75e-9]), LEVELS, (0.0, 21 * 75e-9))
    assert beyond[0] == beyond[20] == 0.5


def test_shrinking_keeps_the_mean_and_makes_no_moire():
    x = np.arange(2400)
    even = np.linspace(0, 1, 101 * 67, dtype=np.float32).reshape(101, 67)
    assert shrunk(even, 30).shape == (30, 30)
    assert shrunk(even, 30).mean() == pytest.approx(even.mean(), rel=1e-5)  # float32
    assert shrunk(even, 200) is not None
    np.testing.assert_array_equal(shrunk(even, 200), even)
    # Rings of 3.12 cells on dots of 3.6: plain averages beat with the dots, the smooth one hardly.
    grating = (np.sin(2 * np.pi * x / 3.12) * np.ones((2400, 1))).astype(np.float32)
    assert np.ptp(shrunk(grating, 672, "smooth")[300, 10:-10]) < 0.01 < np.ptp(shrunk(grating, 672)[300, 10:-10])


def test_labels():
    assert length_text(1.85e-6) == "1.85 µm"
    assert length_text(np.inf) == "∞"
    assert colour_label(RGB[0]) == "656 nm"
    assert colour_label(Colour("532p5nm", (532.5e-9,), (1.0,))) == "532.5 nm"
    assert colour_label(Colour("green", (500e-9, 540e-9), (0.5, 0.5))) == "green, mean 520 nm"
    assert line_colours(RGB) == line_colours(RGB[::-1])[::-1]  # by wavelength, not by place
    assert spread(9, 3) == [0, 4, 8]
    assert spread(2, 3) == [0, 1]
    bank = PsfBank(np.zeros((1, 2, 2, 2), np.float32), ("g",), (0.05, np.inf), 1e-6)
    assert depth_positions(bank, (np.inf, 0.05 * (1 + 1e-8)), 3) == [1, 0]
