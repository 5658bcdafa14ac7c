import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab.aperture import MaskAperture, RectangularAperture, RoundAperture
from fab.errors import InputError
from sim.psf_bank import PsfBank
from sim.store import read_bank, read_height, read_picture, write_bank, write_height, write_picture
from tests.campaign import bombs

ROOT = Path(__file__).parents[2]
MEASURED = ROOT.parent / "shared" / "data" / "optics_reference" / "measured_psf" / "diffusercam_psf_sample.tif"


def heights(ny: int = 20, nx: int = 30) -> np.ndarray:
    return np.random.default_rng(5).uniform(0, 1.2e-6, (ny, nx)).astype(np.float32)


def write_foreign(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    """An EXR as another program writes it; OpenEXR changes the dictionaries it is given."""
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict(channels)).write(str(path))


@settings(max_examples=20)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(1e-9, 1e-3),
    st.floats(1e-6, 1.0),
    st.sampled_from(["C", "F", "transposed", "reversed", "float64"]),
)
def test_heights_come_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, ny: int, nx: int, pitch_m: float, aperture_m: float, layout: str
):
    """Whatever the memory layout: OpenEXR itself writes transposed arrays wrong without a word."""
    height = heights(ny, nx)
    given_array = {
        "C": height,
        "F": np.asfortranarray(height),
        "transposed": np.ascontiguousarray(height.T).T,
        "reversed": np.ascontiguousarray(height[::-1, ::-1])[::-1, ::-1],
        "float64": height.astype(np.float64),
    }[layout]
    path = tmp_path_factory.mktemp("store") / "height.exr"
    before = given_array.copy()
    write_height(path, given_array, pitch_m, aperture_m, {"note": "π is fine"})
    stored = read_height(path)
    np.testing.assert_array_equal(stored.height_m, height)
    assert stored.height_m.dtype == np.float32
    assert (stored.pitch_m, stored.aperture) == (pitch_m, RoundAperture(aperture_m))  # all digits of a float64
    assert stored.metadata == {"note": "π is fine"}
    np.testing.assert_array_equal(given_array, before)


def test_the_first_scan_line_is_the_highest_y(tmp_path: Path):
    height = heights()
    write_height(tmp_path / "h.exr", height, 1e-6, 3e-5)
    file = OpenEXR.File(str(tmp_path / "h.exr"), separate_channels=True)
    np.testing.assert_array_equal(file.channels()["height"].pixels, height[::-1])
    assert file.header()["pitch_m"] == "1e-06"


def test_same_values_same_bytes(tmp_path: Path):
    for name in ("a", "b"):
        write_height(tmp_path / name, heights(300, 200), 1.85e-6, 4.44e-3, {"b": "2", "a": "1"})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_taken_names_are_refused(tmp_path: Path):
    for name in ("pitch_m", "sha256", "psf_bank", "channels", "compression", "version"):  # the last was lost
        with pytest.raises(ValueError, match="names of their own"):
            write_height(tmp_path / "h.exr", heights(), 1e-6, 1e-5, {name: "x"})


def make_bank(colours: tuple[str, ...], depths_m: tuple[float, ...]) -> PsfBank:
    energy = np.random.default_rng(1).random((len(colours), len(depths_m), 9, 9)).astype(np.float32)
    return PsfBank(energy, colours, depths_m, 3.7e-6, (0.1, -1 / 3))


@pytest.mark.parametrize(
    ("colours", "depths_m"),
    [
        (("red", "green", "blue"), (0.05, np.inf)),
        (("mono",), (1 / 3, 0.0831, 0.08310000001, 12.5, np.inf)),
        (("R.1", "ü", "a b"), (5e-4,)),
    ],
)
def test_banks_come_back_exactly(tmp_path: Path, colours: tuple[str, ...], depths_m: tuple[float, ...]):
    bank = make_bank(colours, depths_m)
    write_bank(tmp_path / "psf.exr", bank, {"spec": "abc"})
    again = read_bank(tmp_path / "psf.exr")
    np.testing.assert_array_equal(again.energy, bank.energy)
    assert again.energy.dtype == np.float32
    assert (again.colours, again.depths_m, again.pixel_m) == (colours, depths_m, 3.7e-6)
    assert again.field_rad == bank.field_rad
    names = OpenEXR.File(str(tmp_path / "psf.exr"), separate_channels=True).channels().keys()
    assert len(names) == len(colours) * len(depths_m)


def test_channels_are_named_by_depth_and_colour(tmp_path: Path):
    write_bank(tmp_path / "psf.exr", make_bank(("red",), (0.05, 5e-4, np.inf)))
    names = OpenEXR.File(str(tmp_path / "psf.exr"), separate_channels=True).channels().keys()
    assert sorted(names) == ["z0p5mm.red", "z50mm.red", "zinf.red"]


def test_depths_must_differ(tmp_path: Path):
    with pytest.raises(ValueError, match="must differ"):
        write_bank(tmp_path / "psf.exr", make_bank(("red",), (0.05, 0.05)))


def test_a_banks_own_pitch_stands(tmp_path: Path):
    write_bank(tmp_path / "psf.exr", make_bank(("red",), (0.05,)))
    assert read_bank(tmp_path / "psf.exr", pixel_m=3.7e-6).pixel_m == 3.7e-6
    with pytest.raises(InputError, match="pixel pitch given must be that of the file"):
        read_bank(tmp_path / "psf.exr", pixel_m=1.85e-6)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_a_measured_psf_of_another_program(tmp_path: Path, dtype: type, rng: np.random.Generator):
    images = {name: rng.integers(0, 2000, (12, 14)).astype(dtype) for name in "RGB"}
    write_foreign(tmp_path / "rgb.exr", images)
    bank = read_bank(tmp_path / "rgb.exr", pixel_m=2e-6)
    assert (bank.colours, bank.depths_m, bank.pixel_m) == (("R", "G", "B"), (np.inf,), 2e-6)
    for c, name in enumerate("RGB"):
        np.testing.assert_array_equal(bank.energy[c, 0], images[name][::-1].astype(np.float32))
    write_foreign(tmp_path / "y.exr", {"Y": images["G"], "A": images["R"]})
    grey = read_bank(tmp_path / "y.exr", pixel_m=2e-6, depth_m=0.1)
    assert (grey.colours, grey.depths_m) == (("Y",), (0.1,))


def test_a_measured_psf_from_the_laboratory(tmp_path: Path):
    if not MEASURED.is_file():
        pytest.skip("the measured PSF is not beside this checkout")
    from skimage.io import imread

    image = imread(MEASURED).astype(np.float32)
    write_foreign(tmp_path / "m.exr", {"Y": image})
    bank = read_bank(tmp_path / "m.exr", pixel_m=6.5e-6, depth_m=0.02)
    assert bank.energy.shape == (1, 1, *image.shape)
    np.testing.assert_array_equal(bank.energy[0, 0], image[::-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.__setitem__((2, 3), np.nan), "finite and at least 0, but got nan m at row 17, column 3"),
        (lambda a: a.__setitem__((0, 0), np.inf), "finite and at least 0"),
        (lambda a: a.__setitem__((5, 5), -1e-9), r"finite and at least 0, but got -1e-09 m.*\(1 such pixels\)"),
    ],
)
def test_impossible_heights_are_refused(tmp_path: Path, change: Callable[[np.ndarray], None], message: str):
    height = heights()
    change(height)
    write_foreign(tmp_path / "h.exr", {"height": height})
    with pytest.raises(InputError, match=message):
        read_height(tmp_path / "h.exr")


def test_wrong_content_is_named(tmp_path: Path):
    write_foreign(tmp_path / "y.exr", {"Y": heights(), "Z": heights()})
    with pytest.raises(InputError, match=r"channel named height, in metres, but got the channels Y, Z"):
        read_height(tmp_path / "y.exr")
    with pytest.raises(InputError, match="channels R, G, B or a single one"):
        read_bank(tmp_path / "y.exr", pixel_m=1e-6)
    write_foreign(tmp_path / "p.exr", {"height": heights()}, pitch_m="wide")
    with pytest.raises(InputError, match="pitch_m: must be a positive length in metres, but got 'wide'"):
        read_height(tmp_path / "p.exr")
    write_foreign(tmp_path / "b.exr", {"Y": heights()}, psf_bank="{}")
    with pytest.raises(InputError, match="must list colours, depths_m"):
        read_bank(tmp_path / "b.exr")
    write_foreign(tmp_path / "n.exr", {"Y": np.full((4, 4), np.nan, np.float32)})
    with pytest.raises(InputError, match="channel Y: a PSF must be finite"):
        read_bank(tmp_path / "n.exr", pixel_m=1e-6)
    write_foreign(tmp_path / "m.exr", {"Y": heights()})
    with pytest.raises(InputError, match="pixel pitch of a PSF from another program must be given"):
        read_bank(tmp_path / "m.exr")


@pytest.mark.parametrize(
    "described",
    [
        "[" * 100_000,
        {"depths_m": [10**400]},
        {"pixel_m": 10**400},
        {"pixel_sine": 10**400},
        {"field_rad": ["nan", "0"]},
        {"field_rad": ["0", "inf"]},
        {"field_rad": [10**400, 0]},
    ],
)
def test_a_bank_that_describes_itself_by_no_numbers_is_refused(tmp_path: Path, described: Any):
    usual = {"colours": ["red"], "depths_m": ["1"], "pixel_m": "1e-6", "field_rad": ["0", "0"]}
    text = described if isinstance(described, str) else json.dumps(usual | described)
    write_foreign(tmp_path / "b.exr", {"z1000mm.red": heights()}, psf_bank=text)
    with pytest.raises(InputError, match=r"b\.exr: psf_bank.*must (list colours|be a positive|have a field_rad)"):
        read_bank(tmp_path / "b.exr")


def test_heights_of_another_program_may_lack_their_lengths(tmp_path: Path):
    write_foreign(tmp_path / "bare.exr", {"height": heights()})
    stored = read_height(tmp_path / "bare.exr")
    assert (stored.pitch_m, stored.aperture) == (None, None)
    np.testing.assert_array_equal(stored.height_m, heights()[::-1])


def test_a_cropped_picture_has_lost_its_centre(tmp_path: Path):
    window = (np.array([0, 0], np.int32), np.array([99, 99], np.int32))
    write_foreign(tmp_path / "c.exr", {"height": heights()}, displayWindow=window)
    with pytest.raises(InputError, match="must fill its display window"):
        read_height(tmp_path / "c.exr")


def test_every_truncation_and_every_flipped_byte_is_noticed(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """Either the file still holds exactly what was written (a byte of its decoration changed), or it is refused."""
    height = heights(7, 6)
    write_height(tmp_path / "good.exr", height, 1.85e-6, 1.11e-5)
    data = (tmp_path / "good.exr").read_bytes()
    bad = tmp_path / "bad.exr"
    damaged = [data[:length] for length in range(0, len(data), 7)]
    damaged += [data[:i] + bytes([data[i] ^ 0x55]) + data[i + 1 :] for i in range(len(data))]
    refused = 0
    for content in damaged:
        bad.write_bytes(content)
        try:
            stored = read_height(bad)
        except InputError:
            refused += 1
            continue
        np.testing.assert_array_equal(stored.height_m, height)
        assert (stored.pitch_m, stored.aperture) == (1.85e-6, RoundAperture(1.11e-5))
    assert refused > 0.6 * len(damaged)
    printed = capfd.readouterr()
    assert printed.out == ""
    assert printed.err == ""


@pytest.mark.parametrize("read", [read_height, read_bank])
def test_a_missing_file_and_a_folder_are_named(tmp_path: Path, read: Callable[[Path], object]):
    with pytest.raises(InputError, match=r"nowhere\.exr: the file must exist"):
        read(tmp_path / "nowhere.exr")
    with pytest.raises(InputError, match="the path must be a file"):
        read(tmp_path)


def test_an_unusable_place_is_named_and_nothing_is_left(tmp_path: Path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"above the last must be a folder|parent must not be a file"):
        write_height(tmp_path / "file" / "h.exr", heights(), 1e-6, 1e-5)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_reading_heights_needs_no_jax():
    code = "import sys, sim.store; assert 'jax' not in sys.modules and 'OpenEXR' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_pictures_keep_their_maps_and_words(tmp_path: Path, rng: np.random.Generator):
    maps = {"R": rng.normal(size=(4, 6)).astype(np.float32), "Z": np.full((4, 6), np.inf, np.float32)}
    write_picture(tmp_path / "a.exr", maps, {"what": "light"})
    channels, texts = read_picture(tmp_path / "a.exr")
    assert {name: values.tobytes() for name, values in channels.items()} == {k: v.tobytes() for k, v in maps.items()}
    assert texts == {"what": "light"}
    with pytest.raises(ValueError, match="one shape"):
        write_picture(tmp_path / "b.exr", {**maps, "G": np.zeros((4, 5))})


def test_threads_that_read_at_once_leave_the_terminal_as_it_was(tmp_path: Path):
    """Broken files are talked about on stdout and stderr; what hides that must not hide anything afterwards."""
    paths = [tmp_path / f"{k}.exr" for k in range(4)]
    for path in paths:
        write_picture(path, {"Y": np.zeros((64, 64), np.float32)})
    before, place = sys.stdout, os.fstat(2)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(read_picture, paths * 50))
    assert sys.stdout is before
    assert os.path.samestat(os.fstat(2), place)


@pytest.mark.parametrize("size", [(12_000, 12_000, 1), (8, 8, 4097)])
def test_a_picture_that_decodes_to_gigabytes_is_refused_by_its_header(tmp_path: Path, size: tuple[int, int, int]):
    (tmp_path / "a.exr").write_bytes(bombs.exr_bomb(*size))
    with pytest.raises(InputError, match="at most 4096 channels and 134217728 values in all"):
        read_picture(tmp_path / "a.exr")


def test_more_values_are_read_from_a_file_that_is_large_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # Eight values per byte of the file: a few thousand for one of a few hundred bytes.
    monkeypatch.setattr("sim.store._MOST_VALUES", 100)
    write_picture(tmp_path / "a.exr", {"Y": np.zeros((50, 50), np.float32)})
    write_picture(tmp_path / "b.exr", {"Y": np.zeros((150, 150), np.float32)})
    small, large = (8 * (tmp_path / name).stat().st_size for name in ("a.exr", "b.exr"))
    assert small / 8 < 50**2 < small
    assert large < 150**2
    channels, _ = read_picture(tmp_path / "a.exr")
    np.testing.assert_array_equal(channels["Y"], np.zeros((50, 50)))
    with pytest.raises(InputError, match=f"{large} values in all, but got 1 channels of 150 x 150"):
        read_picture(tmp_path / "b.exr")


def test_a_header_of_an_immense_picture_is_refused(tmp_path: Path):
    (tmp_path / "a.exr").write_bytes(bombs.exr_promise())
    with pytest.raises(InputError, match="whole OpenEXR picture"):
        read_picture(tmp_path / "a.exr")


def test_a_rectangular_aperture_comes_back_with_all_its_digits(tmp_path: Path):
    slit = RectangularAperture((1 / 3 * 1e-3, 2 / 7 * 1e-2))
    write_height(tmp_path / "slit.exr", np.zeros((2, 3), np.float32), 1.85e-6, slit)
    stored = read_height(tmp_path / "slit.exr")
    assert stored.aperture == slit


def test_a_mask_comes_back_and_a_damaged_one_is_refused_by_its_file(tmp_path: Path):
    mask = MaskAperture.of(np.eye(3)[:2], 1.85e-6).shrunk(0.1e-6)
    write_height(tmp_path / "mask.exr", np.zeros((2, 3), np.float32), 1.85e-6, mask)
    assert read_height(tmp_path / "mask.exr").aperture == mask
    for text in ("{", '{"shape": [2, 3]}', '{"shape": [1e9, 3], "pitch": 1, "inset": 0, "rows": []}'):
        write_foreign(tmp_path / "bad.exr", {"height": heights()}, aperture_m=text)
        with pytest.raises(InputError, match=r"bad\.exr: aperture_m: must"):
            read_height(tmp_path / "bad.exr")
