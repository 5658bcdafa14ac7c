"""The solids of an order: rings where the map is radial, the wafer, and a patch on request."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.drawing import draw
from fab.order.request import order_from
from fab.order.verify import verify
from fab.order.write import write_order
from fab.solids.columns import PixelWindow
from fab.solids.model import DoeModel
from fab.solids.patch import Patch
from fab.solids.step import step_bodies
from fab.solids.write import model_problems, write_models
from fab.units import MM, NM, UM
from tests.fab.maps import FEW, level_map_from
from tests.fab.parts import die_chrome
from tests.orders import named

LEVELS, GRID = Levels(16, 75 * NM), Grid((30, 30), 2 * UM)


def radial_map():
    radius = np.hypot(GRID.axis_m("y")[:, None], GRID.axis_m("x")[None, :])
    profile = np.random.default_rng(4).integers(0, 16, 30).astype(np.uint8)
    return profile[(radius / GRID.pitch_m).astype(int)], profile


def entries(folder):
    """Entries of the models by their names without the name of the job."""
    manifest = read_manifest(folder)
    job = manifest.level_map_file.removesuffix("LEVELS.npy")
    return {entry.file.removeprefix(job): entry for entry in manifest.models}


@pytest.mark.slow
def test_a_radial_order_has_its_rings_as_exact_circles(tmp_path):
    level_map, profile = radial_map()
    write_order(tmp_path / "o", LevelMap(level_map, LEVELS, GRID, 59 * UM, "rings"), wafer=FEW)
    entry = entries(tmp_path / "o")["PLATE.step"]
    assert "relief of 15 rings as exact circles; the masks draw them in pixels" in entry.content
    manifest = read_manifest(tmp_path / "o")
    glass = (manifest.wafer.die_mm * MM) ** 2 * 0.5 * MM
    outer = np.append(np.arange(1, 15) * 2 * UM, 29.5 * UM)
    areas = np.pi * np.diff(np.append(0, outer**2))
    gone = np.sum(areas * (15 - profile[:15].astype(int)) * 75 * NM)
    found = step_bodies(tmp_path / "o" / entry.file)["SUBSTRATE"].volume_m3
    # The relief is 1e-7 of the glass, of which the kernel keeps 1e-14.
    assert glass - found == pytest.approx(gone, rel=1e-5)


def test_any_other_order_has_a_flat_plate(written_order):
    entry = entries(written_order)["PLATE.step"]
    assert "where the relief is drawn flat" in entry.content


def test_the_wafer_of_an_order(written_order):
    manifest, entry = read_manifest(written_order), entries(written_order)["WAFER.step"]
    assert "primary flat of 32.5 mm at -y" in entry.content
    dies = len(manifest.wafer.dies_mm)
    assert f"chrome of {dies} dies" in entry.content
    body = step_bodies(written_order / entry.file)
    # A disc of 100 mm without its segment of 32.5 mm.
    half = np.arcsin(0.325)
    area = 2500 * (np.pi - half + np.sin(half) * np.cos(half))
    assert body["SUBSTRATE"].volume_m3 / MM**3 == pytest.approx(area * 0.5, rel=1e-12)
    assert "chrome to the edges of a die" in entry.content
    drawn_mm2 = die_chrome(written_order).area() * 1e-12  # on whole nanometres
    # As the masks draw it; they have chords of 10 nm at most for the arcs of the opening, and whole nanometres.
    assert body["CHROME"].volume_m3 / MM**3 == pytest.approx(dies * 1e-4 * drawn_mm2, rel=1e-6)


def test_chrome_is_a_ring_in_step_where_it_does_not_reach_the_edge(tmp_path):
    level_map = level_map_from(np.zeros((8, 8)), LEVELS, UM, 8 * UM)
    shown = DoeModel(level_map, Chrome(UM), Wafer(chrome_to_edge=False), 5 * MM, ((0.0, 0.0),))
    found = {entry.file: entry for entry in write_models(tmp_path, "A", shown)}
    ring_mm2 = np.pi * (shown.chrome.rim_m(level_map) ** 2 - (3 * UM) ** 2) / MM**2
    for name in ("A_PLATE.step", "A_WAFER.step"):
        assert "chrome as a ring" in found[name].content
        assert found[name].volumes_mm3["CHROME"] == pytest.approx(ring_mm2 * 1e-4, rel=1e-12)


@pytest.mark.parametrize(
    ("diameter_m", "dies", "words"),
    [
        (90 * MM, ((0.0, 0.0),), "no flat"),
        (150 * MM, ((0.0, 0.0),), "primary flat of 57.5 mm"),
        (100 * MM, ((0.0, -46.7 * MM),), "no flat"),
    ],
    ids=["unusual", "6 inch", "a die in its place"],
)
def test_wafers_have_the_usual_flat_or_none(tmp_path, diameter_m, dies, words):
    wafer = Wafer(diameter_m, blank_m=diameter_m + 25 * MM)
    level_map = level_map_from(np.zeros((8, 8)), LEVELS, UM, 8 * UM)
    shown = DoeModel(level_map, Chrome(UM), wafer, 5 * MM, dies)
    found = {entry.file: entry for entry in write_models(tmp_path, "A", shown)}
    assert words in found["A_WAFER.step"].content


@pytest.fixture(scope="module")
def patched(tmp_path_factory):
    level_map = np.random.default_rng(3).integers(0, 16, (24, 31)).astype(np.uint8)
    folder = tmp_path_factory.mktemp("patched") / "o"
    level_map = level_map_from(level_map, LEVELS, 1.85 * UM, 44 * UM, "patch")
    write_order(folder, level_map, patch=Patch(-9 * UM, 7.4 * UM, 14.8 * UM), wafer=FEW)
    return folder


def test_a_patch_is_written_in_every_format_and_read_back(patched):
    found = {name: entry for name, entry in entries(patched).items() if name.startswith("PATCH")}
    assert sorted(found) == ["PATCH.3mf", "PATCH.glb", "PATCH.step", "PATCH_MM.stl"]
    for entry in found.values():
        assert entry.window_px == [12, 7, 8, 8]
        assert "8 x 8 pixels of 1.85 um about -8.325 um, 7.4 um of the DOE" in entry.content
    level_map = np.load(named(patched, "LEVELS.npy"))
    heights = PixelWindow(12, 7, 8, 8).cut(level_map) * 75e-9 + 10e-6
    volume = heights.sum() * 1.85e-6**2 / MM**3
    assert found["PATCH.step"].volumes_mm3["PATCH"] == pytest.approx(volume, rel=1e-12)
    assert found["PATCH.glb"].volumes_mm3["RELIEF"] == pytest.approx(volume, rel=1e-12)
    asked = [check.file for check in verify(patched).checks if "read back" in check.question]
    assert set(asked) >= {entry.file for entry in found.values()}


def test_a_patch_of_another_place_is_told(patched):
    """The same files, but said to be a pixel farther: neither the centre of the boxes nor a column fits."""
    manifest = read_manifest(patched)
    order = order_from(manifest.request, np.load(patched / manifest.level_map_file), "here")
    model = draw(order).model
    for name, entry in entries(patched).items():
        if not name.startswith("PATCH"):
            continue
        assert model_problems(patched, entry, model) == []
        if name == "PATCH.step":
            centre = [value + 1e-6 for value in entry.centres_mm["PATCH"]]
            other, words = replace(entry, centres_mm={"PATCH": centre}), "its centre of mass lies 1 nm aside"
        else:
            other, words = replace(entry, window_px=[12, 8, 8, 8]), "columns have no top of the height"
        assert any(words in problem for problem in model_problems(patched, other, model))


def test_a_disk_too_full_to_compare_is_no_fault_of_the_file(written_order, tmp_path, monkeypatch):
    """The file is drawn again elsewhere to compare it: what goes wrong there is told as it is."""
    manifest = read_manifest(written_order)
    model = draw(order_from(manifest.request, np.load(written_order / manifest.level_map_file), "here")).model
    plate = next(entry for name, entry in entries(written_order).items() if name == "PLATE.step")
    assert model_problems(written_order, plate, model) == []
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="nowhere"):
        model_problems(written_order, plate, model)


@pytest.mark.slow
def test_a_mesh_alone_may_be_larger_and_a_step_patch_is_refused_before_anything_is_drawn(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    level_map = level_map_from(np.indices((60, 60)).sum(axis=0) % 2, LEVELS, UM, 60 * UM, "p")
    for width in (50 * UM, 61 * UM):
        patch = Patch(0.0, 0.0, width)
        with pytest.raises(InputError, match=r"boxes|must lie on the map"):
            write_order(tmp_path / "o", level_map, patch=patch)
    # Warnings may come first, work may not.
    assert [record.message for record in caplog.records if record.levelno < logging.WARNING] == []
    assert not (tmp_path / "o").exists()
    write_order(tmp_path / "o", level_map, patch=Patch(0.0, 0.0, 50 * UM, step=False), wafer=FEW)
    names = {name for name in entries(tmp_path / "o") if name.startswith("PATCH")}
    assert names == {"PATCH.3mf", "PATCH.glb", "PATCH_MM.stl"}
