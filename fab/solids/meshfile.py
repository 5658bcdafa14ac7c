"""Mesh files: 3MF and STL for slicers and printers, glTF (.glb) for viewers, and their reader.

3MF says its unit, glTF is in metres by its standard, STL knows none and says it in its header and, better, in
its name. The same mesh gives the same bytes.
"""

import io
import json
import struct
import zipfile
from array import array
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Literal
from xml.parsers.expat import ParserCreate

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import opened, read_bytes, write_atomic
from fab.solids.mesh import Mesh
from fab.units import MM, UM

Unit = Literal["mm", "um"]
_UNIT_M = {"mm": MM, "um": UM}
_3MF_UNITS = {"mm": "millimeter", "um": "micron"}
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
)
_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>\n'
)
# The oldest time a zip can hold, so that the same mesh gives the same bytes.
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


def _decimals(picometres: NDArray[np.int64], decimals: int) -> NDArray[Any]:
    """Write whole picometres as decimal numbers of units that have so many decimals, without zeros at the end."""
    different, where = np.unique(picometres, return_inverse=True)
    texts = [f"{value / 10**decimals:.{decimals}f}".rstrip("0").rstrip(".") for value in different.tolist()]
    return np.array(texts, dtype=object)[where]


def _rows(row: str, values: NDArray[Any]) -> Iterator[str]:
    """Fill in a row of text for every row of an array, thousands at a time."""
    parts = (values[start : start + 2**14] for start in range(0, len(values), 2**14))
    return (row * len(part) % tuple(part.ravel().tolist()) for part in parts)


def write_3mf(path: str | Path, mesh: Mesh, unit: Unit = "mm") -> None:
    """Write a mesh as 3MF, which states its unit (``"mm"`` or ``"um"``); numbers are rounded to a picometre."""
    decimals = {"mm": 9, "um": 6}[unit]
    picometres = np.rint(mesh.vertices_m * 1e12).astype(np.int64)
    corners = np.stack([_decimals(axis, decimals) for axis in picometres.T], axis=1)
    vertices = _rows('<vertex x="%s" y="%s" z="%s"/>\n', corners)
    triangles = _rows('<triangle v1="%d" v2="%d" v3="%d"/>\n', mesh.triangles)
    head = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<model unit="{_3MF_UNITS[unit]}" xml:lang="en-US" xmlns="{_CORE}">\n'
        f'<metadata name="Description">{mesh.about}</metadata>\n'
        '<resources><object id="1" type="model" name="DOE"><mesh>\n<vertices>\n'
    )
    tail = '</triangles>\n</mesh></object></resources>\n<build><item objectid="1"/></build>\n</model>\n'
    model = chain([head], vertices, ["</vertices>\n<triangles>\n"], triangles, [tail])
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        members = {"[Content_Types].xml": [_TYPES], "_rels/.rels": [_RELATIONS], "3D/3dmodel.model": model}
        for name, parts in members.items():
            info = zipfile.ZipInfo(name, _ZIP_TIME)
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as member:
                for part in parts:
                    member.write(part.encode())
    write_atomic(path, stream.getvalue())


def write_glb(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as binary glTF, metres and float32; the node turns z up to glTF's +y."""
    positions = mesh.vertices_m.astype(np.float32)
    indices = mesh.triangles.astype(np.uint32)
    body = indices.tobytes() + positions.tobytes()
    value: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "doedesign"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "DOE", "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}], "extras": {"description": mesh.about}}
        ],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": indices.nbytes, "target": 34963},
            {"buffer": 0, "byteOffset": indices.nbytes, "byteLength": positions.nbytes, "target": 34962},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5125, "count": indices.size, "type": "SCALAR"},
            {
                "bufferView": 1,
                "componentType": 5126,
                "count": len(positions),
                "type": "VEC3",
                "min": positions.min(axis=0).tolist(),
                "max": positions.max(axis=0).tolist(),
            },
        ],
    }
    text = json.dumps(value).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(body)
    if total >= 2**32:
        raise InputError(str(path), "a GLB file must stay below 4 GB", f"{total} bytes", "Mesh fewer columns.")
    parts = [struct.pack("<III", 0x46546C67, 2, total), struct.pack("<II", len(text), 0x4E4F534A), text]
    write_atomic(path, b"".join([*parts, struct.pack("<II", len(body), 0x004E4942), body]))


def write_stl(path: str | Path, mesh: Mesh, unit: Unit = "mm") -> None:
    """Write a mesh as binary STL, float32; the format knows no unit, so the header says it."""
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.zeros(len(mesh.triangles), dtype=kind)
    corners = mesh.vertices_m[mesh.triangles] / _UNIT_M[unit]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    facets["corners"] = corners
    header = f"binary STL, unit {unit}; {mesh.about}".encode()[:80].ljust(80)
    write_atomic(path, b"".join([header, struct.pack("<I", len(facets)), facets.tobytes()]))


_CHUNK = 1 << 20  # bytes; by itself the parser asks for two thousand at a time
_TEXT_PER_TRIANGLE = 300  # bytes, with its share of the vertices; written are about 100
_MOST_TRIANGLES = 1 << 24
_MOST_ACCESSORS = 8  # two are written; normals, colours and the like have one each


def _require_bounded(path: Path, kind: str, most: int) -> None:
    """Refuse by sizes and counts what is larger than `most` triangles, or would fetch other files."""
    data = read_bytes(path)
    if kind == ".stl":
        count = int.from_bytes(data[80:84], "little")
        if len(data) != 84 + 50 * count or count > most:
            raise ValueError(f"{len(data)} bytes for {count} triangles, of which it may have {most}")
        return
    length = int.from_bytes(data[12:16], "little")
    if length > _CHUNK or data[:4] != b"glTF":
        raise ValueError(f"a header of {length} bytes")
    value = json.loads(data[20 : 20 + length])
    counts = [each["count"] for each in value["accessors"] if each["bufferView"] >= 0 and "sparse" not in each]
    if len(counts) < len(value["accessors"]) or not all(0 <= count <= 3 * most for count in counts):
        raise ValueError(f"accessors of {counts} values, where {3 * most} are the most")
    nodes, meshes = value["nodes"], value["meshes"]
    # Each place of a mesh is a copy of it; a node that is placed once at most has no more copies than are counted here.
    copies = sum("mesh" in node for node in nodes), len(meshes), sum(len(mesh["primitives"]) for mesh in meshes)
    groups = [*value.get("scenes", ()), *nodes]
    placed = [one for group in groups for key in ("nodes", "children") for one in group.get(key, ())]
    if copies != (1, 1, 1) or len(set(placed)) < len(placed) or len(counts) > _MOST_ACCESSORS:
        raise ValueError("other than one mesh of one part, which is placed once")
    if any("uri" in each for key in ("buffers", "images") for each in value.get(key, ())):
        raise ValueError("data in other files")


def _read_3mf(path: Path, most: int) -> tuple[NDArray[np.float64], NDArray[np.int32], float]:
    """Read the one object of a 3MF file as a stream; a tree of millions of elements would take gigabytes."""
    numbers, corners, seen = array("d"), array("i"), {"object": 0, "unit": ""}

    def start(tag: str, values: dict[str, str]) -> None:
        if max(len(numbers), len(corners)) > 9 * most:
            raise ValueError(f"more than {most} triangles")
        if tag == "triangle":
            corners.extend((int(values["v1"]), int(values["v2"]), int(values["v3"])))
        elif tag == "vertex":
            numbers.extend((float(values["x"]), float(values["y"]), float(values["z"])))
        elif tag == "model":
            seen["unit"] = values.get("unit", "millimeter")
        elif tag == "object":
            seen["object"] += 1
        elif tag in ("component", "item") and "transform" in values:
            raise ValueError("the mesh is moved or scaled")

    parser = ParserCreate()
    parser.StartElementHandler = start
    with opened(path) as file, zipfile.ZipFile(file) as archive, archive.open("3D/3dmodel.model") as model:
        size, largest = archive.getinfo(model.name).file_size, _CHUNK + _TEXT_PER_TRIANGLE * most
        if size > largest:
            raise ValueError(f"a model of {size} bytes, where {largest} are the most for {most} triangles")
        for text in iter(lambda: model.read(_CHUNK), b""):
            parser.Parse(text)
    parser.Parse(b"", True)
    if seen["object"] != 1:
        raise ValueError(f"{seen['object']} objects instead of one")
    scale = {said: _UNIT_M[unit] for unit, said in _3MF_UNITS.items()}[str(seen["unit"])]
    vertices = np.frombuffer(numbers, dtype=np.float64).reshape(-1, 3)
    return vertices, np.frombuffer(corners, dtype=np.int32).reshape(-1, 3), scale


def read_mesh(path: str | Path, unit: Unit | None = None, most: int = _MOST_TRIANGLES) -> Mesh:
    """Read a one-mesh file with a parser that did not write it: trimesh, and for 3MF Python's own for XML.

    `unit` says what the numbers of an STL file mean. The triangles come back in metres, z up, also from glTF.

    Raises:
        InputError: the file is missing, damaged, holds another number of meshes or more than `most` triangles.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".3mf", ".glb", ".stl") or (kind == ".stl") != (unit is not None):
        rule = "the file must be .3mf or .glb, or .stl with its unit given"
        raise InputError(str(path), rule, f"{kind} and unit {unit}", "Give the unit of an STL file only.")
    try:
        if kind == ".3mf":
            vertices, triangles, scale = _read_3mf(path, most)
        else:
            _require_bounded(path, kind, most)
            import trimesh

            parts: Any = trimesh.load_scene(path, process=False).dump()
            (part,) = parts
            vertices, triangles, scale = part.vertices, part.faces, _UNIT_M[unit] if unit else 1.0
    except InputError:
        raise
    # Each parser raises what it likes on a damaged file.
    except Exception as error:
        cure = "Write the file again from its source."
        got = str(error) or type(error).__name__
        raise InputError(str(path), "the file must be whole and hold one mesh", got, cure) from error
    corners_m = np.asarray(vertices, dtype=np.float64) * scale
    if kind == ".glb":
        corners_m = corners_m @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return Mesh(corners_m, np.asarray(triangles, dtype=np.int32))
