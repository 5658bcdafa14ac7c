"""The certificate of a design: in memory, on disk, and its words."""

import json
from pathlib import Path

import numpy as np
import pytest

from doedesign.design.design import Design
from doedesign.runs.certificate import Certificate, certify, in_words
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
    return certify(design, cells=4, out=folder)


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


def test_bad_input(design: Design):
    for cells in (3, 65):
        with pytest.raises(InputError, match=r"cells: must lie from 4 to 64"):
            certify(design, cells=cells)
    flat = design.level_map.with_level(np.zeros_like(design.level_map.level))
    with pytest.raises(InputError, match="must not be flat where rows are cut out"):
        certify(Design(flat, CAMERA, DEPTHS_M[:1], DEPTHS_M[1:]))


def test_the_command_writes_into_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    run = finished_run(tmp_path, SPEC)
    code, printed, said = call("certify", run, "--cells", 4)
    assert code == 0, said
    assert f"{run}/certificate/certificate.png" in printed
    assert "rows against Maxwell's equations" in said
    code, _, said = call("certify", run, "--cells", 2)
    assert (code, "cells: must lie from 4 to 64" in said) == (2, True)
