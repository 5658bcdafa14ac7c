"""A measurement's TOML file and the images it names: every mistake is told by name, every picture is on its axes."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from doedesign.calibration.measurement import load_measurement, read_measurement
from fab.errors import InputError
from tests.doedesign.calibration_fakes import (
    PIXEL_M,
    exposed,
    light_of,
    photograph,
    plate_drawn,
    usual_process,
    write_frame,
)

HEAD = 'probe = "520 nm"\npixel = "1.85 um"\ngain = 2.0\nread_noise = 4.0\n'
IMAGE = '[[image]]\ndepth = "6 mm"\nfiles = ["a.tiff"]\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "measurement.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD, r"measurement\.toml: image: must be given"),
        (HEAD + IMAGE.replace('depth = "6 mm"\n', ""), r"image\[0\]\.depth: must be given"),
        (HEAD + IMAGE + 'expsures = ["1 ms"]', r"must be a known key of \[image\[0\]\].*Did you mean `exposures`"),
        (HEAD + "gian = 2\n" + IMAGE, "must be a known key of the spec, but got `gian`"),
        (HEAD.replace("gain = 2.0\n", "") + IMAGE, "gain: must be given"),
        (HEAD.replace("2.0", "-2.0") + IMAGE, "gain: must be greater than 0"),
        (HEAD + IMAGE + 'exposures = ["1"]', "must be a time with its unit"),
        (HEAD + IMAGE + 'exposures = ["1 ms", "2 ms"]', "must have one entry per file, 1 here, but got 2"),
        (HEAD + IMAGE + 'dark = ["d", "e"]', "must name one dark frame per file, 1 here, or one for all, but got 2"),
        (HEAD + IMAGE + 'dark = ["d"]\nblack_level = 64.0', "must be left out beside `dark`"),
        (HEAD + IMAGE + IMAGE, 'every image must have its own name, but got "a" twice'),
        (HEAD + IMAGE + "incident = 1e7", "counts per second mean nothing without an exposure"),
        ('collimator = "100 mm"\n' + HEAD + IMAGE, "goes with a mode_field, but got 100 mm"),
        ('mode_field = "3.5"\n' + HEAD + IMAGE, "mode_field"),
        # 30 pi (50 um)^2 over the wavelength.
        ('mode_field = "100 um"\n' + HEAD + IMAGE, r"image\[0\]\.depth: must be at least 4\d\d.* but got 6 mm"),
        (HEAD + IMAGE.replace("6 mm", "6"), "must be a number with a unit"),
        (HEAD + 'channel = "violet"\n' + IMAGE, "must be one of red, green, blue"),
        ("probe = 520 nm", "a measurement must be valid TOML"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, text: str, message: str):
    with pytest.raises(InputError, match=message):
        load_measurement(written(tmp_path, text))


def test_times_have_units(tmp_path: Path):
    text = HEAD + IMAGE.replace('["a.tiff"]', '["a", "b", "c"]') + 'exposures = ["1.5 ms", "20 us", "0.3 s"]'
    assert load_measurement(written(tmp_path, text)).image[0].exposures == (1.5e-3, 2e-5, 0.3)
    with pytest.raises(InputError, match="the file must exist"):
        load_measurement(tmp_path / "nothing.toml")


def spot(shape: tuple[int, int] = (60, 70), centre: tuple[float, float] = (33.0, 30.0)) -> np.ndarray:
    y, x = np.indices(shape)
    return np.exp(-((y - centre[0]) ** 2 + (x - centre[1]) ** 2) / 8) / 25 + np.exp(-((x - 40) ** 2 + y**2) / 8) / 100


def photographed(folder: Path, light: np.ndarray, extra: str = "", image_extra: str = "") -> Path:
    counts = exposed(light, 1e5, 1.0, np.random.default_rng(3), background=20.0)
    write_frame(folder / "a.tiff", counts)
    return written(folder, f"{HEAD}saturation = 4095.0\n{extra}\n{IMAGE}black_level = 64.0\n{image_extra}")


def test_images_that_cannot_be_used_are_refused_by_name(tmp_path: Path):
    camera = plate_drawn(32, 4, window=24).camera
    with pytest.raises(InputError, match=r"a\.tiff: the file must exist"):
        read_measurement(written(tmp_path, HEAD + IMAGE), camera)
    path = photographed(tmp_path, spot(), "window = 64")
    with pytest.raises(InputError, match=r"image a: an image must have at least the window's 64 pixels"):
        read_measurement(path, camera)
    path = photographed(tmp_path, 0 * spot())
    with pytest.raises(InputError, match=r"image a: there must be light above the noise"):
        read_measurement(path, camera)
    tifffile.imwrite(tmp_path / "a.tiff", np.zeros((60, 70), np.uint8))
    with pytest.raises(InputError, match="16 bits per pixel"):
        read_measurement(path, camera)
    tifffile.imwrite(tmp_path / "a.tiff", np.full((60, 70), 4095, np.uint16))
    with pytest.raises(InputError, match=r"\.toml: a\.tiff: some pixels must not be saturated"):
        read_measurement(path, camera)


@pytest.mark.parametrize(("turns", "mirrored"), [(0, False), (1, False), (2, False), (3, True), (0, True)])
def test_pictures_are_turned_to_the_plates_axes(tmp_path: Path, turns: int, mirrored: bool):
    """A picture that was mirrored and turned right is brought back by turning it left, and so is a stated centre."""
    light = spot((60, 60), (33.0, 26.0))
    # As a viewer shows it, the top row first; numpy turns left there.
    shown = np.rot90(light[::-1], -turns)
    shown = shown[:, ::-1] if mirrored else shown
    mark = np.zeros((60, 60))
    mark[33, 26] = 1
    place = np.rot90(mark[::-1], -turns)
    place = place[:, ::-1] if mirrored else place
    row, column = (int(i) for i in np.argwhere(place > 0)[0])
    extra = f"quarter_turns = {turns}\nmirrored = {str(mirrored).lower()}\nwindow = 20"
    camera = plate_drawn(32, 4, window=24).camera
    shots = []
    for image_extra in ("", f"centre = [{row}.0, {column}.0]"):
        path = photographed(tmp_path, shown[::-1], extra, image_extra)
        (shot,) = read_measurement(path, camera).images
        shots.append(shot)
    for shot in shots:
        y, x = (round(c) for c in shot.centre)
        # The light is there, and its companion lies where it lay.
        assert shot.psf.rate[y - 2 : y + 3, x - 2 : x + 3].max() == shot.psf.rate.max()
    exact = shots[1]
    assert exact.psf.rate.shape == (40, 40)
    whole = exposed(light, 1e5, 1.0, np.random.default_rng(3), background=20.0) - 64.0
    y, x = (round(c) for c in exact.centre)
    here = exact.psf.rate[y - 8 : y + 9, x - 8 : x + 9]
    there = whole[33 - 8 : 33 + 9, 26 - 8 : 26 + 9]
    # The noise was drawn for the turned picture, so only the light agrees.
    assert np.corrcoef(here.ravel(), there.ravel())[0, 1] > 0.9


def test_a_window_of_other_pixels_covers_the_same_field(tmp_path: Path):
    design = plate_drawn(32, 4, window=24)
    path = photographed(tmp_path, spot(), "")
    text = path.read_text()
    # 60 pixels are all there are.
    for pixel, window in (("1.85 um", 24), ("0.925 um", 48), ("0.4 um", 60)):
        assert read_measurement(written(tmp_path, text.replace("1.85 um", pixel)), design.camera).window == window


@pytest.mark.parametrize(("pixel", "covered"), [("3 um", 15), ("80 um", 1), ("200 um", 0)])
def test_pixels_so_wide_that_the_design_covers_hardly_any_are_refused(tmp_path: Path, pixel: str, covered: int):
    """A pitch in the wrong unit: 24 pixels of 1.85 um are a few of these."""
    path = photographed(tmp_path, spot(), "")
    written(tmp_path, path.read_text().replace("1.85 um", pixel))
    with pytest.raises(InputError, match=rf"\.toml: pixel: .* at least 16 pixels per side, but got {covered} of"):
        read_measurement(path, plate_drawn(32, 4, window=24).camera)


def test_brackets_become_images(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    design = plate_drawn(96, 4, window=48)
    lights = light_of(design, usual_process(design), {}, (6e-3, np.inf))
    path = photograph(tmp_path, lights, (6e-3, np.inf), kinds=("tiff", "exr"), more="window = 40")
    with caplog.at_level("INFO", "doedesign"):
        measurement = read_measurement(path, design.camera)
    files = [text.removeprefix("reading ") for text in caplog.messages if text.startswith("reading ")]
    assert len(files) == 8
    assert set(measurement.digests) == {"measurement.toml", *files}
    assert [shot.name for shot in measurement.images] == ["near0", "far1"]
    assert measurement.full["near0"] < 10  # the shorter exposure has nearly all that the longer one lacks
    near = measurement.images[0]
    total = near.psf.rate[near.psf.valid].sum() * 2.0 / 3e7
    assert total == pytest.approx(lights[0].sum(), rel=0.01)
    assert measurement.spec.pixel_m == PIXEL_M
    assert near.defocus_sigma == 0.0


def test_a_depth_that_is_not_exact_leaves_a_curvature(tmp_path: Path):
    camera = plate_drawn(32, 4, window=24).camera
    path = photographed(tmp_path, spot(), 'defocus_sigma = "1 um"', 'depth_sigma = "0.06 mm"')
    (shot,) = read_measurement(path, camera).images
    expected = np.hypot(0.06e-3 / 6e-3**2, 1e-6 / camera.sensor_distance_m**2)
    assert shot.defocus_sigma == pytest.approx(expected)
