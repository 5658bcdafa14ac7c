"""The study of networks for lamps: its rows, with a network that changes nothing, go on where they were left."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doedesign.capture.images import Pictures, picture_files
from doedesign.hdr.capture import LampCamera, PlateSeries
from doedesign.hdr.network import LampNetwork
from doedesign.hdr.scenes import Lamps, LampScenes
from doedesign.hdr.solver import LampSolver
from doedesign.hdr.study import CASES, LampCase, LampStudy
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.imaging.glare import Glare
from sim.sensor import Sensor

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import snapshot_hdr  # pyright: ignore[reportMissingImports]
import snapshot_hdr_network  # pyright: ignore[reportMissingImports]


def small_study() -> LampStudy:
    """Three colours of one line, a chequerboard of 48 cells, frames of 48 pixels."""
    colours = tuple(Colour(name, (nm * 1e-9,), (1.0,)) for name, nm in (("red", 620), ("green", 540), ("blue", 465)))
    bare = Camera(Grid((48, 48), 10e-6), 0.48e-3, "fused_silica", colours, 4e-3, 12e-6, 31)
    camera = LampCamera(bare, Sensor(full_well_e=20000, exposure=0.8, quantum_efficiency=(1.0,)))
    heights = snapshot_hdr.chequerboard(np.full((48, 48), 100e-9), 3)
    series = PlateSeries.of(camera, heights)
    scenes = LampScenes(Pictures(picture_files(None)[:2], most_px=200), Lamps((1, 2), (3.0, 5.0)), 48, 40)
    solver = LampSolver(rounds=2, iterations=5)
    plain = camera.psf(0 * heights)
    return LampStudy(camera, series, plain, lambda _: heights, scenes, Glare(window=31), solver, {4: plain})


def test_a_chequerboard_has_squares_of_one_height():
    found = snapshot_hdr.chequerboard(np.array([[0.0, 2.0, 0.0, 0.0]] * 4), 2)
    assert found.tolist() == [[0, 0, 2, 2]] * 2 + [[2, 2, 0, 0]] * 2


@pytest.mark.slow
def test_networks_are_judged_scene_by_scene(tmp_path: Path):
    study, network = small_study(), LampNetwork.make(0, width=8)
    networks = dict.fromkeys(snapshot_hdr_network.CAMERAS, network)
    rows = snapshot_hdr_network.measure(study, networks, tmp_path, 1)
    assert {(row.case, row.camera) for row in rows} == {
        (case, camera) for case in ("quick solver", "network") for camera in snapshot_hdr.CAMERAS
    }
    of = {(row.case, row.camera): row for row in rows}
    assert of["network", "clipped"].lamps == of["quick solver", "clipped"].lamps
    # A network that has learnt nothing adds little to the estimate's error.
    assert of["network", "plate"].lamps == pytest.approx(of["quick solver", "plate"].lamps, abs=1.0)
    more = [*rows, *(row._replace(scene=1, lamps=row.lamps + (row.case == "network")) for row in rows)]
    gain = snapshot_hdr_network.over_solver(more)["plate"]["lamps"]
    assert gain["mean"] == pytest.approx(of["network", "plate"].lamps - of["quick solver", "plate"].lamps + 0.5)
    again = snapshot_hdr_network.measure(study, networks, tmp_path, 1)
    assert [row[:4] for row in again] == [row[:4] for row in rows]


@pytest.mark.slow
def test_cases_without_lamps_and_of_a_chequerboard():
    study = small_study()
    dark, board = (case for case in CASES if not case.lit or case.cells_px)
    rows = {row.camera: row for row in study.rows(dark, 0)}
    assert all(np.isnan(row.lamps) for row in rows.values())
    assert all(np.isfinite(row.elsewhere) for row in rows.values())
    found = snapshot_hdr.summary([*rows.values(), *study.rows(dark, 1)])
    assert found[dark.name]["plate"]["lamps"] is None
    assert "gain_elsewhere" in found[dark.name]
    assert "-/" in snapshot_hdr.table(found)
    # The chequerboard given here is the plain lens: both cameras see the same.
    same = {row.camera: row for row in study.rows(board, 0)}
    assert same["plate"][4:] == same["plain lens"][4:]
    drawn = LampCase("as drawn", fabricated=False)
    between = snapshot_hdr.between_cases([*study.rows(drawn, 0), *study.rows(board, 0), *study.rows(board, 1)])
    assert between["as drawn over chequerboard"]["scenes"] == 1


def test_where_the_light_of_a_plate_goes():
    study = small_study()
    found = snapshot_hdr.light_of_plate(study, copies=2, near_px=3, half_px=1)
    assert set(found) == {"red", "green", "blue"}
    bare = snapshot_hdr.light_of_plate(replace(study, series=replace(study.series, exact=study.plain)), 2, 3, 1)
    assert bare["red"]["straight"] == pytest.approx(1)
    assert 0.5 < found["red"]["straight"] < 1
    # The four first orders of a chequerboard of 60 um lie 3.4 pixels away along both axes; 3 is the nearest pixel.
    assert [at for at, _ in found["red"]["copies"]] == [4.2, 4.2]
    assert sum(share for _, share in found["red"]["copies"]) > sum(share for _, share in bare["red"]["copies"])
