"""Solids and height maps of something else, in an order whose manifest was mended to hide it."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from fab.aperture import RoundAperture
from fab.manifest.records import read_manifest
from fab.solids.meshfile import read_mesh, write_3mf, write_glb, write_stl
from fab.solids.substrate import ChromeFilm, Substrate, substrate_step
from fab.units import MM
from tests.fab.maps import SMALL
from tests.fab.mended import mend, restate, told


@pytest.mark.parametrize("end", [".3mf", ".glb", "_MM.stl"])
@pytest.mark.parametrize("what", ["mirrored", "a column moved", "in micrometres"])
def test_a_mesh_of_something_else_is_named(order_folder, end, what):
    file = f"{SMALL}_RELIEF{end}"
    mesh = read_mesh(order_folder / file, "mm" if end == "_MM.stl" else None)
    vertices, triangles = mesh.vertices_m.copy(), mesh.triangles
    if what == "mirrored":  # closed, of the same volume
        vertices[:, 0] *= -1
        triangles = triangles[:, ::-1].copy()
    elif what == "a column moved":
        top = np.isclose(vertices[:, 2], vertices[:, 2].max(), atol=1e-12)
        vertices[np.flatnonzero(top)[0], 0] += 1e-6
    else:
        vertices *= 1000
    write = {".3mf": write_3mf, ".glb": write_glb, "_MM.stl": write_stl}[end]
    write(order_folder / file, replace(mesh, vertices_m=vertices, triangles=triangles))
    mend(order_folder, file)
    assert "columns have no top of the height of the level map" in told(order_folder, file)


def test_a_solid_of_something_else_is_named(order_folder):
    pitch = read_manifest(order_folder).wafer.die_pitch_mm * MM
    glass, window = Substrate("die", pitch, 0.5 * MM), (-0.8 * MM, -1.5 * MM, 0.8 * MM, -1.2 * MM)
    film = ChromeFilm(RoundAperture(19.6e-6), 0.6 * MM, 200e-9, pitch, (window,))
    substrate_step(order_folder / f"{SMALL}_PLATE.step", glass, RoundAperture(29.6e-6), film)
    mend(order_folder, f"{SMALL}_PLATE.step")
    assert "CARTESIAN_POINT" in told(order_folder, f"{SMALL}_PLATE.step")
    path = order_folder / f"{SMALL}_WAFER.step"
    path.write_bytes(path.read_bytes().replace(b"SI_UNIT(.MILLI.,.METRE.)", b"SI_UNIT(.CENTI.,.METRE.)"))
    mend(order_folder, path.name)
    assert "SI_UNIT(.CENTI." in told(order_folder, path.name)


def test_a_wafer_that_is_said_to_lie_the_other_way_round_is_named(order_folder):
    path = order_folder / f"{SMALL}_WAFER.step"
    manifest = read_manifest(order_folder)
    entry = next(model for model in manifest.models if model.file == path.name)
    x, y, z = entry.centres_mm["SUBSTRATE"]
    assert y > 0  # what the flat at -y takes away
    turned = replace(entry, centres_mm={**entry.centres_mm, "SUBSTRATE": [x, -y, z]})
    restate(order_folder, lambda m: replace(m, models=[turned if e.file == path.name else e for e in m.models]))
    assert f"models[{path.name}].centres_mm.SUBSTRATE[1] is {-y!r} instead of {y!r}" in told(
        order_folder, "manifest.json"
    )


def test_height_maps_upside_down_or_in_another_unit_are_named(order_folder):
    tif, npy, sag = (order_folder / f"{SMALL}_{end}" for end in ("HEIGHT.tif", "HEIGHT.npy", "SAG.DAT"))
    tifffile.imwrite(tif, tifffile.imread(tif)[::-1])
    np.save(npy, np.load(npy) * 1e6)
    header, rest = sag.read_bytes().split(b"\r\n", 1)
    words = header.split()
    words[4] = b"3"  # metres
    sag.write_bytes(b" ".join(words) + b"\r\n" + rest)
    mend(order_folder, tif.name, npy.name, sag.name)
    for path in (tif, npy):
        assert "heights differ from the level map" in told(order_folder, path.name)
    assert "in unit 3 instead of" in told(order_folder, sag.name)
    npy.write_bytes(b"ruin")
    mend(order_folder, npy.name)
    assert "it cannot be read" in told(order_folder, npy.name)
