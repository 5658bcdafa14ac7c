import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.errors import CheckFailed, InputError
from fab.grid import Grid
from fab.levels import Levels, height_of
from fab.solids.columns import PixelWindow, reduced_cells, whole, window_cells
from fab.solids.mesh import Mesh, closed_volume_m3, relief_mesh
from fab.solids.meshfile import Unit, read_mesh, write_3mf, write_glb, write_stl
from fab.units import NM, UM
from tests.fab.maps import level_map_from

SIXTEEN = Levels(16, 75 * NM)
PITCH = 1.85 * UM
# float32 keeps 24 bits: positions of these sizes are off by 6e-8 of themselves at most, volumes by a few times that.
FLOAT32 = 3e-7

AWKWARD = {
    "one pixel": [[5]],
    "a row": [[0, 15, 0, 3, 3]],
    "a column": [[0], [15], [7]],
    "kissing corners": [[15, 0], [0, 15]],
    "kissing at four heights": [[3, 9], [12, 0]],
    "empty plane": [[0] * 4] * 3,
    "full plane": [[15] * 3] * 5,
    "a one-pixel hole": [[15, 15, 15], [15, 0, 15], [15, 15, 15]],
    "a one-pixel pillar": [[0, 0, 0], [0, 15, 0], [0, 0, 0]],
}


def cells_of(level_map, levels=SIXTEEN, pitch_m=PITCH):
    given = level_map_from(level_map, levels, pitch_m)
    return window_cells(given, whole(given.grid))


def random_map(shape, count=16):
    return np.random.default_rng(11).integers(0, count, shape).astype(np.uint8)


def loose_edges(triangles):
    """Directed edges that do not come exactly once, and once more the other way round."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    size = edges.max() + 1
    forth, back = np.sort(edges @ [size, 1]), np.sort(edges @ [1, size])
    return int(np.count_nonzero(forth != back) + np.count_nonzero(np.diff(forth) == 0))


@pytest.mark.parametrize("level_map", AWKWARD.values(), ids=AWKWARD.keys())
def test_awkward_maps_give_closed_meshes_of_the_right_volume(level_map):
    cells = cells_of(level_map)
    mesh = relief_mesh(cells, base_m=UM)
    want = np.sum((np.asarray(level_map) * 75 * NM + UM) * PITCH**2)
    # Sums of a few dozen numbers in float64.
    assert mesh.volume_m3 == pytest.approx(want, rel=1e-14)
    assert loose_edges(mesh.triangles) == 0
    assert closed_volume_m3(mesh) == pytest.approx(want, rel=FLOAT32)


@given(hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=7), elements=st.integers(0, 3)))
def test_whole_numbers_give_the_volume_exactly(level_map):
    # Heights, pitch and base are powers of two, so float64 holds everything without rounding.
    cells = cells_of(level_map, Levels(4, 2.0**-23), 2.0**-20)
    mesh = relief_mesh(cells, 2.0**-22)
    assert mesh.volume_m3 == (int(level_map.sum()) + 2 * level_map.size) * 2.0**-63
    assert loose_edges(mesh.triangles) == 0


@pytest.mark.parametrize("count", [2, 64])
def test_a_large_mesh_is_a_solid_to_manifold3d_and_to_trimesh(count):
    levels, level_map = Levels(count, 20 * NM), random_map((31, 40), count)
    mesh = relief_mesh(cells_of(level_map, levels), UM)
    want = (height_of(level_map, levels).sum() + UM * level_map.size) * PITCH**2
    assert mesh.volume_m3 == pytest.approx(want, rel=1e-13)  # a few thousand sums
    assert closed_volume_m3(mesh) == pytest.approx(want, rel=FLOAT32)
    theirs = trimesh.Trimesh(mesh.vertices_m / UM, mesh.triangles, process=False)
    assert theirs.is_watertight
    assert theirs.is_winding_consistent
    assert theirs.volume * UM**3 == pytest.approx(want, rel=1e-10)  # its sum of cones about the origin cancels


def test_the_mesh_stands_where_the_map_does():
    level_map = np.zeros((4, 6), dtype=np.uint8)
    level_map[3, 1] = 15  # high y, low x
    level_map = level_map_from(level_map, SIXTEEN, PITCH)
    mesh = relief_mesh(window_cells(level_map, whole(level_map.grid)), UM)
    top = mesh.vertices_m[mesh.vertices_m[:, 2] == 0]
    assert np.allclose(np.unique(top[:, 0]), [-2 * PITCH, -PITCH], rtol=1e-15)
    assert np.allclose(np.unique(top[:, 1]), [PITCH, 2 * PITCH], rtol=1e-15)
    assert mesh.vertices_m[:, 2].min() == pytest.approx(-1125 * NM - UM, rel=1e-15)
    part = relief_mesh(window_cells(level_map, PixelWindow(2, 0, 2, 3)), UM)
    assert np.allclose(part.vertices_m.min(axis=0)[:2], [-3 * PITCH, 0], rtol=1e-15)
    assert part.vertices_m[:, 2].max() == 0


def test_a_base_of_no_thickness_is_refused():
    for base in (0.0, -UM, float("nan")):
        with pytest.raises(InputError, match="positive and finite"):
            relief_mesh(cells_of(random_map((5, 6))), base)


@pytest.mark.parametrize(
    ("shape", "most", "block"), [((9, 10), 10, 1), ((9, 10), 4, 3), ((7, 5), 3, 3), ((6, 4), 1, 6)]
)
def test_reduction_keeps_the_volume_and_the_outline(shape, most, block):
    level_map, grid = random_map(shape), Grid(shape, PITCH)
    cells = reduced_cells(level_map_from(level_map, SIXTEEN, PITCH), most)
    assert cells.block == block
    assert max(cells.height_m.shape) <= most
    want = height_of(level_map, SIXTEEN).sum() * PITCH**2
    assert cells.volume_m3 == pytest.approx(want, rel=1e-14)
    assert cells.area_m2 == pytest.approx(np.prod(grid.extent_m), rel=1e-14)
    last = level_map[(shape[0] - 1) // block * block :, :block]
    assert cells.height_m[-1, 0] == pytest.approx(last.mean() * 75 * NM, rel=1e-14)
    mesh = relief_mesh(cells, UM)
    assert closed_volume_m3(mesh) == pytest.approx(want + UM * cells.area_m2, rel=FLOAT32)


def test_blocks_of_one_mean_make_one_plane_whatever_the_order_of_the_sum():
    # Three steps of 0.1 um add up differently from behind, by the last digit.
    cells = reduced_cells(level_map_from([[1, 2, 3, 3, 2, 1]] * 3, Levels(4, 0.1 * UM)), most=2)
    assert cells.height_m[0, 0] == cells.height_m[0, 1]


def test_meshes_too_large_for_any_viewer_are_refused():
    level_map = level_map_from(np.zeros((2001, 2001)))
    with pytest.raises(InputError, match="at most 4000000 columns"):
        window_cells(level_map, whole(level_map.grid))
    with pytest.raises(InputError, match="1 to 2000"):
        reduced_cells(level_map, 2001)
    with pytest.raises(InputError, match="lie on"):
        window_cells(level_map, PixelWindow(2000, 0, 2, 1))


@pytest.mark.parametrize("defect", ["missing", "turned", "inside out", "moved"])
def test_a_damaged_mesh_is_found(defect):
    mesh = relief_mesh(cells_of(random_map((4, 4))), UM)
    triangles, vertices = mesh.triangles.copy(), mesh.vertices_m.copy()
    if defect == "missing":
        triangles = triangles[:-1]
    elif defect == "turned":
        triangles[5] = triangles[5, ::-1]
    elif defect == "inside out":
        triangles = triangles[:, ::-1].copy()
    else:
        vertices[0, 2] -= 10 * NM
    damaged = Mesh(vertices, triangles)
    if defect == "moved":
        assert abs(damaged.volume_m3 / mesh.volume_m3 - 1) > 1e-5
    else:
        with pytest.raises(CheckFailed, match="not the skin of a solid"):
            closed_volume_m3(damaged)


def written(folder, mesh) -> dict[Path, Unit | None]:
    """The mesh in every kind of file, and the unit that its reader must be told."""
    folder.mkdir()
    units: dict[str, Unit | None] = {"mm.3mf": None, "um.3mf": None, "m.glb": None, "mm.stl": "mm", "um.stl": "um"}
    write_3mf(folder / "mm.3mf", mesh)
    write_3mf(folder / "um.3mf", mesh, "um")
    write_glb(folder / "m.glb", mesh)
    write_stl(folder / "mm.stl", mesh)
    write_stl(folder / "um.stl", mesh, "um")
    return {folder / name: unit for name, unit in units.items()}


def test_every_file_reads_back_closed_in_place_and_of_the_right_volume(tmp_path):
    mesh = relief_mesh(cells_of(random_map((8, 13))), UM)
    for path, unit in written(tmp_path / "a", mesh).items():
        back = read_mesh(path, unit)
        # 3MF holds decimal picometres, which these heights and half pitches are; the others float32.
        close = 1e-13 if path.suffix == ".3mf" else FLOAT32
        assert back.volume_m3 == pytest.approx(mesh.volume_m3, rel=close), path.name
        assert closed_volume_m3(back) == pytest.approx(mesh.volume_m3, rel=FLOAT32), path.name
        assert np.allclose(back.vertices_m.min(axis=0), mesh.vertices_m.min(axis=0), rtol=1e-6), path.name
        assert np.allclose(back.vertices_m.max(axis=0), mesh.vertices_m.max(axis=0), rtol=1e-6, atol=1e-15), path.name


def test_other_readers_see_the_units(tmp_path):
    mesh = relief_mesh(cells_of(random_map((3, 4))), UM)
    written(tmp_path / "a", mesh)
    for name, said, unit_m in (("mm.3mf", "millimeter", 1e-3), ("um.3mf", "micron", UM)):
        scene = trimesh.load_scene(tmp_path / "a" / name, process=False)
        assert scene.units == said
        assert np.allclose(scene.extents * unit_m, np.ptp(mesh.vertices_m, axis=0), rtol=1e-12)
        with zipfile.ZipFile(tmp_path / "a" / name) as archive:
            assert archive.testzip() is None
            assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
            root = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
        assert root.get("unit") == said
        assert "heights x 1" in (root.findtext("{*}metadata") or "")
        assert len(root.findall(".//{*}triangle")) == len(mesh.triangles)
    scene = trimesh.load_scene(tmp_path / "a" / "m.glb", process=False)
    across, deep, high = np.ptp(mesh.vertices_m, axis=0)
    # A viewer's up is y.
    assert np.allclose(scene.extents, [across, high, deep], rtol=1e-6)
    for name in ("mm", "um"):
        head = (tmp_path / "a" / f"{name}.stl").read_bytes()[:80]
        assert head.startswith(f"binary STL, unit {name};".encode())


def test_stl_normals_point_outward(tmp_path):
    write_stl(tmp_path / "a.stl", relief_mesh(cells_of([[15]]), UM), "um")
    facets = np.frombuffer(
        (tmp_path / "a.stl").read_bytes()[84:], [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]
    )
    # A box around (0, 0, -2.1 um): the way from its centre to a facet goes along the normal.
    away = facets["v"].mean(axis=1) - facets["v"].mean(axis=(0, 1))
    assert np.all(np.sum(away * facets["n"], axis=1) > 0)
    assert np.allclose(np.linalg.norm(facets["n"], axis=1), 1, atol=1e-6)


def test_the_same_mesh_gives_the_same_bytes(tmp_path):
    def content(folder):
        return {p.name: p.read_bytes() for p in written(folder, relief_mesh(cells_of(random_map((5, 4))), UM))}

    assert content(tmp_path / "a") == content(tmp_path / "b")


@pytest.mark.parametrize("name", ["mm.3mf", "m.glb", "mm.stl"])
def test_damaged_and_missing_files_are_refused(tmp_path, name):
    files = written(tmp_path / "a", relief_mesh(cells_of(random_map((3, 3))), UM))
    path = tmp_path / "a" / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="hold one mesh"):
        read_mesh(path, files[path])
    path.unlink()
    with pytest.raises(InputError, match="must exist"):
        read_mesh(path, files[path])


@pytest.mark.parametrize(("name", "unit"), [("a.stl", None), ("a.glb", "mm"), ("a.obj", None)])
def test_an_stl_file_needs_its_unit_and_the_others_have_one(tmp_path, name, unit):
    with pytest.raises(InputError, match="with its unit given"):
        read_mesh(tmp_path / name, unit)
