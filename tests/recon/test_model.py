"""A model in memory: whatever a capture comes as, it is reconstructed alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.capture.simulate import SimulatedCapture
from doedesign.recon.model import Model
from doedesign.recon.network import NetworkShape
from doedesign.recon.photos import read_capture, write_reconstruction
from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.light import srgb_from_linear
from sim.psf_bank import PsfBank
from sim.store import write_bank, write_picture
from tests.recon.drawn_networks import drawn
from tests.recon.test_reconstruct import COLOURS, PIXEL, WAVES, bank

LAYOUT = NetworkShape(width=3, depth=1, features=False, refine=False)


@pytest.fixture(scope="module")
def model() -> Model:
    """A network that uses the PSFs it is given."""
    return Model(drawn(LAYOUT, 0.1), bank(), COLOURS, WAVES, PIXEL, (0.05, 0.12))


def camera(pixel_m: float = PIXEL, waves: tuple[float, ...] = tuple(reversed(WAVES))) -> Camera:
    """The model's camera, with its colours from red to blue."""
    colours = tuple(Colour(f"{w:g}", (w,), (1.0,)) for w in waves)
    return Camera(Grid((16, 16), 2e-6), 30e-6, "fused_silica", colours, 1e-3, pixel_m, 7)


def shot(seen_by: Camera, light: np.ndarray) -> SimulatedCapture:
    """A capture whose PSFs are the model's at 0.05 m and at infinity, colours in the other order."""
    energy = bank().energy[::-1][: len(light)]
    blank = np.zeros(light.shape[1:], np.float32)
    return SimulatedCapture(
        light, light, light, blank, blank[None], blank, energy[:, 3], energy[:, 0], 0.05, np.inf, seen_by, "paper"
    )


@pytest.fixture
def light() -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 1, (3, 24, 30)).astype(np.float32)


def test_files_and_arrays_are_the_same(model: Model, tmp_path: Path, light: np.ndarray):
    display = srgb_from_linear(light)
    for name, bits in (("a.png", 8), ("b.tif", 16), ("c.tif", None)):
        write_reconstruction(tmp_path / name, display, bits)
        found = model.reconstruct(tmp_path / name)
        photo = read_capture(tmp_path / name)
        np.testing.assert_array_equal(model.reconstruct(photo.light.transpose(1, 2, 0)).picture, found.picture)
        np.testing.assert_array_equal(found.light, photo.light)
    counts = np.rint(255 * display).astype(np.uint8).transpose(1, 2, 0)
    np.testing.assert_array_equal(model.reconstruct(counts).picture, model.reconstruct(tmp_path / "a.png").picture)
    with pytest.raises(InputError, match="every pixel must be finite"):
        model.reconstruct(np.full((8, 8, 3), np.nan))
    with pytest.raises(InputError, match="must be one picture"):
        model.reconstruct(np.zeros((8, 8, 4)))


def test_a_simulated_capture_brings_its_psfs(model: Model, light: np.ndarray, caplog: pytest.LogCaptureFixture):
    own = model.psfs(near_m=0.05, far_m=np.inf)
    wanted = model.reconstruct(light.transpose(1, 2, 0), psfs=own).picture
    found = model.reconstruct(shot(camera(), light))
    np.testing.assert_array_equal(found.picture, wanted)
    assert (found.near_m, found.far_m) == (0.05, np.inf)
    assert not caplog.records
    # Other PSFs reach the network, too.
    other = model.reconstruct(replace(shot(camera(), light), psf_far=bank(seed=1).energy[:, 3]))
    assert np.abs(other.picture - wanted).max() > 1e-3


def test_another_camera_is_told(model: Model, light: np.ndarray, caplog: pytest.LogCaptureFixture):
    for seen_by in (camera(1.85e-6), camera(waves=(620e-9, 550e-9, 450e-9))):
        caplog.clear()
        model.reconstruct(shot(seen_by, light))
        assert ["another camera" in record.getMessage() for record in caplog.records] == [True]
    grey = shot(camera(waves=(550e-9,)), light)
    names = ("clean", "conventional", "doe", "psf_far", "psf_near")
    grey = replace(grey, **{name: getattr(grey, name)[:1] for name in names})
    with pytest.raises(InputError, match="must have the 3 colours"):
        model.reconstruct(grey)


def test_a_reconstruction_draws_and_saves_itself(model: Model, light: np.ndarray, tmp_path: Path):
    found = model.reconstruct(light.transpose(1, 2, 0))
    drawn: Any = found.plot()
    assert len(drawn.axes) == 2
    assert "data:image/png;base64," in found._repr_html_()
    found.save(tmp_path / "a.png")
    again = srgb_from_linear(read_capture(tmp_path / "a.png").light)
    np.testing.assert_allclose(again, np.clip(found.picture, 0, 1), atol=1e-4)


@pytest.mark.parametrize("names", [("R", "G", "B"), ("Y",)])
def test_a_measured_psf_is_known_by_its_file_and_not_by_its_names(tmp_path: Path, names: tuple[str, ...]):
    """Colours of a camera may be called as those of other programs' files are; counts are scaled all the same."""
    count = len(names)
    own, waves = bank(COLOURS[:count]), tuple(reversed(WAVES))[:count]
    layout = replace(LAYOUT, colours=count, width=3)
    model = Model(drawn(layout, 0.1), replace(own, colours=names), names, waves, PIXEL, (0.05, 0.12))
    counts = np.random.default_rng(2).uniform(0, 4000, (count, 9, 9))
    write_picture(tmp_path / "counts.exr", dict(zip(names, counts, strict=True)))
    found = model.psfs([tmp_path / "counts.exr"] * 2, pixel_m=PIXEL)
    # Sums of 81 numbers in single precision.
    np.testing.assert_allclose(found.far.sum(axis=(1, 2)), model.psfs().far.sum(axis=(1, 2)), rtol=1e-5)
    np.testing.assert_allclose(found.far / found.far[:, :1, :1], counts / counts[:, :1, :1], rtol=1e-5)
    # A bank of our own has its energy, also of one depth.
    alone = PsfBank(own.energy[:, :1], names, (0.05,), PIXEL)
    write_bank(tmp_path / "near.exr", alone)
    found = model.psfs([tmp_path / "counts.exr", tmp_path / "near.exr"], pixel_m=PIXEL, near_m=0.05)
    np.testing.assert_array_equal(found.near[:, 1:-1, 1:-1], alone.energy[:, 0])


def test_other_psfs_are_taken_at_the_distance_that_the_network_was_trained_for(model: Model, tmp_path: Path):
    """As the model's own are, unless they have none of it."""
    trained = replace(model, far_m=6.0)
    other = bank(seed=1)
    write_bank(tmp_path / "made.exr", other)
    found = trained.psfs(str(tmp_path / "made.exr"), near_m="5 cm")
    np.testing.assert_array_equal(found.near, other.at(0.05))
    with pytest.raises(InputError, match=r"near_m: must be a positive distance, but got -50 mm\."):
        trained.psfs(near_m=-0.05)
    with pytest.raises(InputError, match="far_m: must be metres or text with a unit"):
        trained.psfs(far_m="far")
    assert (found.far_m, trained.psfs().far_m) == (6.0, 6.0)
    np.testing.assert_array_equal(found.far, other.at(6.0))
    assert model.psfs([tmp_path / "made.exr"]).far_m == np.inf  # it says none
    write_bank(tmp_path / "near.exr", bank(depths=(0.05, 0.12, 5.0)))
    assert trained.psfs([tmp_path / "near.exr"]).far_m == 5.0
    # A measured one has the energy of the model's own there.
    write_picture(tmp_path / "far.exr", dict(zip("RGB", np.ones((3, 7, 7)), strict=True)))
    found = trained.psfs([tmp_path / "far.exr"] * 2, pixel_m=PIXEL)
    assert found.far_m == 6.0
    np.testing.assert_allclose(found.far.sum(axis=(1, 2)), trained.psfs().far.sum(axis=(1, 2)), rtol=1e-5)
