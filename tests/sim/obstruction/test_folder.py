import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from fab.errors import InputError
from sim.light import linear_from_srgb
from sim.obstruction import CameraView, MaskFolder
from sim.obstruction.folder import read_mask, resized

VIEW = CameraView((120, 160), 10e-6, 10e-3)  # 1 mm at 10 cm is 10 pixels
GREY = np.full((3, 120, 160), 0.5, np.float32)
AT: dict[str, Any] = {"depth_m": (0.1, 0.1), "light": (1.0, 1.0)}


def square(folder: Path, name: str = "square.png", sidecar: dict[str, float] | None = None) -> Path:
    """A picture of 50 x 40 pixels with a white square of 20 x 20."""
    values = np.zeros((40, 50), np.uint8)
    values[5:25, 20:40] = 255
    path = folder / name
    Image.fromarray(values).save(path)
    if sidecar:
        path.with_suffix(".json").write_text(json.dumps(sidecar))
    return path


@pytest.mark.parametrize("sidecar", [{"pitch_um": 100.0}, {"width_m": 5e-3}, {}])
def test_a_picture_has_the_size_of_the_real_thing(tmp_path: Path, sidecar: dict[str, float]):
    square(tmp_path, sidecar=sidecar)
    kind = MaskFolder(tmp_path, width_m=None if sidecar else 5e-3, **AT)
    mask = np.asarray(kind.draw(np.random.default_rng(0), VIEW, GREY).mask)
    # 20 pixels of 0.1 mm are 2 mm, or 20 pixels of the frame at 10 cm.
    assert mask.sum() == pytest.approx(400, rel=1e-4)
    far = MaskFolder(tmp_path, width_m=5e-3, depth_m=(0.25, 0.25))
    assert np.asarray(far.draw(np.random.default_rng(0), VIEW, GREY).mask).sum() == pytest.approx(64, rel=1e-4)


def test_what_stands_beside_a_picture_comes_before_the_parameter(tmp_path: Path):
    square(tmp_path, sidecar={"pitch_um": 50.0})
    mask = np.asarray(MaskFolder(tmp_path, width_m=5e-3, **AT).draw(np.random.default_rng(0), VIEW, GREY).mask)
    assert mask.sum() == pytest.approx(100, rel=1e-4)


@pytest.mark.parametrize("scale", [0.13, 0.5, 1.0, 2.6])
def test_areas_are_kept_and_edges_smooth(rng: np.random.Generator, scale: float):
    picture = np.zeros((40, 50))
    picture[8:31, 11:37] = rng.uniform(0, 1, (23, 26))
    frame = resized(picture, (130, 150), scale, (-1.3, -2.7))
    assert frame.dtype == np.float32
    # Double precision sums of float32 results.
    assert frame.sum() == pytest.approx(picture.sum() * scale**2, rel=2e-3 if scale > 1 else 1e-5)


def test_at_its_own_scale_a_picture_is_itself(rng: np.random.Generator):
    picture = rng.uniform(0, 1, (12, 15))
    np.testing.assert_allclose(resized(picture, (8, 10), 1.0, (2.0, 3.0)), picture[2:10, 3:13], atol=1e-6)
    halves = resized(picture, (6, 7), 0.5, (0.0, 0.0))
    np.testing.assert_allclose(halves, picture[:, :14].reshape(6, 2, 7, 2).mean((1, 3)), atol=1e-6)


def test_the_first_row_is_the_top_and_pictures_are_mirrored_sideways_only(tmp_path: Path):
    mask = read_mask(square(tmp_path)).mask
    assert mask[15:35, 20:40].all()
    assert mask.sum() == 400
    kind = MaskFolder(tmp_path, width_m=5e-3, **AT)
    places = set()
    for seed in range(12):
        y, x = np.nonzero(np.asarray(kind.draw(np.random.default_rng(seed), VIEW, GREY).mask) > 0.5)
        places.add((int(y.min()), int(x.min())))
        assert 0 <= y.min() <= y.max() < 120
    assert len(places) == 12


def test_opaque_pixels_cover_in_their_own_colour(tmp_path: Path):
    rgba = np.zeros((30, 30, 4), np.uint8)
    rgba[10:20, 10:20] = (200, 100, 50, 255)
    Image.fromarray(rgba).save(tmp_path / "leaf.png")
    picture = read_mask(tmp_path / "leaf.png")
    assert picture.mask.sum() == 100
    drawn = MaskFolder(tmp_path, width_m=7e-3, **AT).draw(np.random.default_rng(1), VIEW, GREY)
    mask, radiance = np.asarray(drawn.mask), np.asarray(drawn.radiance)
    expected = linear_from_srgb(np.array([200, 100, 50]) / 255)
    # Edge pixels, too: the transparent black beside them lends them nothing.
    np.testing.assert_allclose(
        radiance[:, mask > 0.01].T, np.broadcast_to(expected, (int((mask > 0.01).sum()), 3)), rtol=1e-3
    )


def test_a_mask_without_colour_takes_the_one_given(tmp_path: Path):
    square(tmp_path)
    kind = MaskFolder(tmp_path, width_m=5e-3, colour=(0.5, 0.25, 0.0), depth_m=(0.1, 0.1), light=(0.5, 0.5))
    radiance = np.asarray(kind.draw(np.random.default_rng(1), VIEW, GREY).radiance)
    expected = 0.5 * linear_from_srgb(np.array([0.5, 0.25, 0.0]))
    np.testing.assert_allclose(radiance[:, 3, 4], expected, rtol=1e-5)


@pytest.mark.parametrize(
    "kind", ["16-bit png", "16-bit tiff", "float tiff", "1-bit tiff", "1 bit", "rgb", "opaque rgba", "palette"]
)
def test_kinds_of_files(tmp_path: Path, kind: str):
    values = np.zeros((20, 30))
    values[4:8, 10:20] = 1
    path = tmp_path / ("a.tiff" if "tiff" in kind else "a.png")
    if kind == "16-bit tiff":
        tifffile.imwrite(path, (values * 65535).astype(np.uint16))
    elif kind == "float tiff":
        tifffile.imwrite(path, values.astype(np.float32))
    elif kind == "1-bit tiff":
        Image.fromarray(values > 0).save(path)
    elif kind == "16-bit png":
        Image.fromarray((values * 65535).astype(np.uint16)).save(path)
    else:
        grey = Image.fromarray((values * 255).astype(np.uint8))
        grey.convert({"1 bit": "1", "rgb": "RGB", "opaque rgba": "RGBA", "palette": "P"}[kind]).save(path)
    picture = read_mask(path)
    np.testing.assert_allclose(picture.mask, values[::-1])
    assert picture.colour is None


def test_bad_files_are_refused_by_name_or_skipped_and_counted(tmp_path: Path):
    square(tmp_path, "good.png", {"pitch_um": 100.0})
    (tmp_path / "notes.txt").write_text("not looked at")
    whole = square(tmp_path, "cut.png", {"pitch_um": 100.0}).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.tif").write_text("no picture")
    Image.fromarray(np.zeros((5, 5), np.uint8)).save(tmp_path / "black.png")
    square(tmp_path, "unsized.png")
    flipped = bytearray(square(tmp_path, "damaged.png").read_bytes())
    flipped[-30] ^= 0xFF
    (tmp_path / "damaged.png").write_bytes(bytes(flipped))
    with pytest.raises(InputError, match=r"black\.png: a mask must cover something"):
        MaskFolder(tmp_path)
    skipped: list[tuple[Path, InputError]] = []
    kind = MaskFolder(tmp_path, on_skip=lambda path, error: skipped.append((path, error)))
    assert [p.name for p in kind.files] == ["good.png"]
    assert [p.name for p, _ in skipped] == ["black.png", "cut.png", "damaged.png", "text.tif", "unsized.png"]
    assert all(path.name in str(error) for path, error in skipped)
    assert "pitch_um" in str(skipped[-1][1])
    (tmp_path / "good.png").unlink()
    with pytest.raises(InputError, match=r"good\.png: the file must exist"):
        kind.draw(np.random.default_rng(0), VIEW, GREY)


@pytest.mark.parametrize(
    "sidecar", ["", "[]", "{}", '{"pitch_um": 0}', '{"pitch_um": true}', '{"width_m": 1, "pitch_um": 1}', '{"x": 1}']
)
def test_a_size_that_is_none_is_refused(tmp_path: Path, sidecar: str):
    square(tmp_path).with_suffix(".json").write_text(sidecar)
    with pytest.raises(InputError, match=r"square\.json"):
        MaskFolder(tmp_path, width_m=5e-3)


@pytest.mark.usefixtures("annotations_unchecked")
def test_folders_without_masks_and_wrong_parameters_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="the folder must hold a mask"):
        MaskFolder(tmp_path)
    with pytest.raises(InputError, match="nowhere"):
        MaskFolder(tmp_path / "nowhere")
    square(tmp_path)
    with pytest.raises(InputError, match="folder: width_m: must"):
        MaskFolder(tmp_path, width_m=-1.0)
    with pytest.raises(InputError, match="folder: colour: must"):
        MaskFolder(tmp_path, width_m=5e-3, colour=(2.0, 0.0, 0.0))
    for colour in ((0.5,), "red", (0.1, "a", 0.2)):
        with pytest.raises(InputError, match="colour: must be three numbers"):
            MaskFolder(tmp_path, width_m=5e-3, colour=colour)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("seed", range(8))
def test_a_small_picture_lies_in_the_frame_and_a_large_one_fills_it(tmp_path: Path, seed: int):
    Image.fromarray(np.full((40, 50), 255, np.uint8)).save(tmp_path / "full.png")
    small = MaskFolder(tmp_path, width_m=5e-3, **AT).draw(np.random.default_rng(seed), VIEW, GREY)
    assert np.asarray(small.mask).sum() == pytest.approx(50 * 40, rel=1e-3)  # none of it is cut off
    large = MaskFolder(tmp_path, width_m=30e-3, **AT).draw(np.random.default_rng(seed), VIEW, GREY)
    assert np.asarray(large.mask)[2:-2, 2:-2].min() > 0.999
