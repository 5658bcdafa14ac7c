"""The certificate of a design: in memory, on disk, and its words."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doedesign.design.design import Design
from doedesign.runs.certificate import Certificate, certify, in_words
from fab.aperture import RectangularAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.units import NM, UM
from sim.camera import Camera, Colour
from sim.metrics import zeroth_order
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.rigorous.edge_optic import with_edges
from tests.doedesign.small_runs import SPEC, call, finished_run

pytestmark = pytest.mark.slow  # its fixtures take many seconds

LEVELS = Levels(16, 75 * NM)
COLOURS = (Colour("green", (550e-9,), (1.0,)), Colour("both", (550e-9, 650e-9), (0.5, 0.5)))
CAMERA = Camera(Grid((64, 64), 1.85 * UM), 64 * 1.85 * UM, "fused_silica", COLOURS, 1e-3, 3.7 * UM, 48)
DEPTHS_M = (4e-3, np.inf)


@pytest.fixture(scope="module")
def design() -> Design:
    level = np.random.default_rng(0).integers(0, 16, (64, 64)).astype(np.uint8)
    level_map = LevelMap(level, LEVELS, CAMERA.grid, CAMERA.aperture_m, "random")
    return Design(level_map, CAMERA, DEPTHS_M[:1], DEPTHS_M[1:])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("certified") / "certificate"


@pytest.fixture(scope="module")
def found(design: Design, folder: Path) -> Certificate:
    return certify(design, cells=4, pieces=0, out=folder)


def test_the_whole_is_told_both_ways(design: Design, found: Certificate):
    height = design.level_map.height_m
    thin, walls = HeightOptic.of(CAMERA, height), with_edges(height, CAMERA, depths_m=DEPTHS_M)
    np.testing.assert_array_equal(found.scalar.energy, psf(thin, depths=DEPTHS_M).energy)
    np.testing.assert_array_equal(found.edges.energy, psf(walls, depths=DEPTHS_M).energy)
    orders = np.array([zeroth_order(thin), zeroth_order(walls)])
    assert found.orders[("green", 550e-9)] == pytest.approx(tuple(orders[:, 0]))
    assert found.orders[("both", 550e-9)] == pytest.approx(tuple(orders[:, 0]))
    assert found.orders[("both", 650e-9)] == pytest.approx(tuple(orders[:, 1]))
    changes = found.changes()
    assert [(row["colour"], row["depth_m"]) for row in changes] == [
        ("green", 4e-3),
        ("green", None),
        ("both", 4e-3),
        ("both", None),
    ]
    one, other = (np.asarray(bank.energy[1, 0], float) for bank in (found.scalar, found.edges))
    assert changes[2]["difference"] == pytest.approx(np.linalg.norm(one - other) / np.linalg.norm(other), rel=1e-5)
    # Walls of random levels are a tenth of the light.
    assert 0.03 < changes[2]["difference"] < 0.5
    assert changes[2]["ring_to_disc_edges"] == pytest.approx(float(found.edges.ring_to_disc()[1, 0]))


def test_rows_of_every_wavelength_are_solved_once(found: Certificate):
    assert [one.wavelength_m for one in found.rows] == [550e-9] * 13 + [650e-9] * 13
    assert found.worst("edges") < 0.03 < found.worst("scalar")
    assert found.worst("scalar") == max(one.orders.error(one.orders.scalar).max() for one in found.rows)


def test_the_record_holds_every_order(found: Certificate, folder: Path):
    record = json.loads((folder / "certificate.json").read_text())
    assert len(record["rows"]) == 2 * len(found.rows)
    te, tm = record["rows"][:2]
    first = found.rows[0]
    assert (te["polarisation"], tm["polarisation"], te["wavelength_m"]) == ("TE", "TM", 550e-9)
    assert te["order"] == [-2, -1, 0, 1, 2]
    np.testing.assert_allclose(te["rigorous"], first.orders.rigorous[0])
    np.testing.assert_allclose(tm["edges"], first.orders.edges[1])
    assert te["error_edges"] == pytest.approx(first.orders.error(first.orders.edges)[0])
    assert tm["energy"] == pytest.approx(1)
    assert record["psfs"] == json.loads(json.dumps(found.changes()))
    assert record["verdict"] == in_words(found)
    assert (folder / "certificate.png").stat().st_size > 10_000
    listed = json.loads((folder / "manifest.json").read_text())
    assert set(listed["results_sha256"]) == {"certificate.json", "certificate.png"}


def test_words_say_what_to_believe(found: Certificate):
    first, green, *_, last = in_words(found)
    assert f"thin off by up to {100 * found.worst('scalar'):.1f} %" in first
    assert f"with edges {100 * found.worst('edges'):.2f} %" in first
    thin, edges = found.orders[("green", 550e-9)]
    assert (
        f"0th order, green 550 nm: scalar {100 * thin:.2f} %, with edges {100 * edges:.2f} %; on the cut-outs" in green
    )
    own = [one.orders for one in found.rows if one.wavelength_m == 550e-9]
    assert green.endswith(f"rigorous {100 * np.mean([o.zeroth(o.rigorous) for o in own]):.2f} %")
    assert last.startswith("PSFs with edges differ from scalar ones by")


@pytest.fixture(scope="module")
def fine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Certificate, dict]:
    """Of a design with cells of a wavelength, whose squares have few terms."""
    grid, folder = Grid((24, 24), 0.5 * UM), tmp_path_factory.mktemp("fine") / "certificate"
    camera = Camera(grid, 24 * 0.5 * UM, "fused_silica", COLOURS[:1], 1e-3, 3.7 * UM, 48)
    level = np.random.default_rng(0).integers(0, 4, (24, 24)).astype(np.uint8)
    level_map = LevelMap(level, Levels(4, 150 * NM), grid, camera.aperture_m, "fine")
    found = certify(Design(level_map, camera, (), (np.inf,)), cells=4, pieces=2, out=folder)
    return found, json.loads((folder / "certificate.json").read_text())


def test_rows_along_a_wide_plate_are_as_long_as_asked_for():
    grid, opening = Grid((6, 24), 0.5 * UM), RectangularAperture((3 * UM, 12 * UM))
    camera = Camera(grid, opening, "fused_silica", COLOURS[:1], 1e-3, 3.7 * UM, 48)
    level = np.random.default_rng(0).integers(0, 4, grid.shape).astype(np.uint8)
    level_map = LevelMap(level, Levels(4, 150 * NM), grid, opening, "wide")
    found = certify(Design(level_map, camera, (), (np.inf,)), cells=8, pieces=0)
    assert {(one.row.axis, len(one.row.height_m)) for one in found.rows} == {("x", 8), ("y", 6)}


def test_squares_are_recorded_beside_rows(fine: tuple[Certificate, dict]):
    found, record = fine
    assert len(found.pieces) == 2
    assert len(record["pieces"]) == 4
    along_x, along_y = record["pieces"][:2]
    one = found.pieces[0]
    assert (along_x["polarisation"], along_y["polarisation"]) == ("x", "y")
    np.testing.assert_allclose(along_y["rigorous"], one.orders.rigorous[1])
    np.testing.assert_allclose(along_x["edges"], one.orders.edges[0])
    np.testing.assert_allclose(along_x["scalar"], one.orders.scalar)
    np.testing.assert_allclose(along_x["height_m"], one.piece.height_m)
    assert along_y["error_scalar"] == pytest.approx(one.orders.error(one.orders.scalar)[1])
    assert along_y["unsettled"] == pytest.approx(one.unsettled[1])
    assert along_x["energy"] == pytest.approx(one.orders.energy[0])
    (whole,) = record["whole"]
    assert whole["rows"] == found.cut_orders(550e-9)
    means = {kind: np.mean([o.orders.zeroth(getattr(o.orders, kind)).mean() for o in found.pieces])
             for kind in ("scalar", "edges", "rigorous")}  # fmt: skip
    assert whole["pieces"] == pytest.approx(means)
    assert found.cut_orders(650e-9, "pieces") is None


def test_words_speak_of_squares_where_there_are_some(fine: tuple[Certificate, dict], found: Certificate):
    words = in_words(fine[0])
    thin, edges = (100 * fine[0].worst(kind, "pieces") for kind in ("scalar", "edges"))
    assert words[1].startswith(f"squares of 2 x 2 cells against Maxwell's equations: thin off by up to {thin:.1f} %")
    assert f"with edges {edges:.2f} % (rigorous orders settled to" in words[1]
    means = fine[0].cut_orders(550e-9, "pieces")
    assert means is not None
    assert words[2].endswith(
        f"; on the squares scalar {100 * means['scalar']:.2f} %, with edges {100 * means['edges']:.2f} %, "
        f"rigorous {100 * means['rigorous']:.2f} %"
    )
    assert not any("squares" in line for line in in_words(found))


def test_bad_input(design: Design):
    for cells in (3, 65):
        with pytest.raises(InputError, match=r"cells: must lie from 4 to 64"):
            certify(design, cells=cells)
    for pieces in (-1, 14):
        with pytest.raises(InputError, match=r"pieces: must lie from 0 to 13"):
            certify(design, pieces=pieces)
    for side in (1, 5):
        with pytest.raises(InputError, match=r"side: must lie from 2 to 4"):
            certify(design, pieces=1, side=side)
    small = LevelMap(np.eye(3, dtype=np.uint8), LEVELS, Grid((3, 3), UM), 3 * UM, "small")
    with pytest.raises(InputError, match=r"side: squares must fit into the design of 3 cells, but got 4"):
        certify(Design(small, replace(CAMERA, grid=small.grid, aperture=3 * UM)), pieces=1, side=4)
    flat = design.level_map.with_level(np.zeros_like(design.level_map.level))
    with pytest.raises(InputError, match="must not be flat where rows are cut out"):
        certify(Design(flat, CAMERA, DEPTHS_M[:1], DEPTHS_M[1:]))


def test_the_command_writes_into_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    run = finished_run(tmp_path, SPEC)
    code, printed, said = call("certify", run, "--cells", 4, "--pieces", 0)
    assert code == 0, said
    assert f"{run}/certificate/certificate.png" in printed
    assert "rows against Maxwell's equations" in said
    code, _, said = call("certify", run, "--cells", 2)
    assert (code, "cells: must lie from 4 to 64" in said) == (2, True)
