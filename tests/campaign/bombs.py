"""Small files that stand for immense things: drawings, pictures and archives that a reader must refuse unopened.

Each function returns the bytes of the files by name; the ending says what kind of file it is.
"""

import io
import json
import lzma
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import gdstk
import numpy as np
from PIL import Image

TOP = "DOE_EXAMPLE_DOE"
UM, NM = 1e-6, 1e-9


def _library() -> tuple[gdstk.Library, gdstk.Cell]:
    library = gdstk.Library(unit=UM, precision=NM)
    cell = gdstk.Cell("LEAF")
    cell.add(gdstk.rectangle((0, 0), (1, 1), layer=1))
    library.add(cell)
    return library, cell


def nested_arrays(depth: int = 5, count: int = 32767) -> gdstk.Library:
    """Arrays of arrays: one square, drawn (count^2)^depth times."""
    library, cell = _library()
    for level in range(depth):
        above = gdstk.Cell(f"ARRAY_{level}")
        above.add(gdstk.Reference(cell, columns=count, rows=count, spacing=(1, 1)))
        library.add(above)
        cell = above
    return library


def doublings(depth: int = 30) -> gdstk.Library:
    """Cells that place the one below twice: one square, drawn 2^depth times without a single array."""
    library, cell = _library()
    for level in range(depth):
        above = gdstk.Cell(f"TWICE_{level}")
        above.add(gdstk.Reference(cell), gdstk.Reference(cell, (1, 0)))
        library.add(above)
        cell = above
    return library


def chain(length: int = 20_000) -> gdstk.Library:
    """Cells that each place the one before."""
    library, cell = _library()
    for level in range(length):
        above = gdstk.Cell(f"LINK_{level}")
        above.add(gdstk.Reference(cell))
        library.add(above)
        cell = above
    return library


def many_cells(count: int = 30_000) -> gdstk.Library:
    """A heap of cells that nothing places."""
    library = _library()[0]
    for number in range(count):
        cell = gdstk.Cell(f"CELL_{number}")
        cell.add(gdstk.rectangle((0, 0), (1, 1), layer=1))
        library.add(cell)
    return library


def many_polygons(count: int = 200_000) -> gdstk.Library:
    """One cell of pentagons."""
    library = gdstk.Library(unit=UM, precision=NM)
    cell = gdstk.Cell(TOP)
    for k in range(count):
        cell.add(gdstk.Polygon([(k, 0), (k + 1, 0), (k + 1, 1), (k + 0.5, 2), (k, 1)], layer=1))
    library.add(cell)
    return library


def repeated_shapes(count: int = 32767) -> gdstk.Library:
    """One square, repeated in place: OASIS keeps that as one record."""
    library, cell = _library()
    square = gdstk.rectangle((0, 0), (1, 1), layer=1)
    square.repetition = gdstk.Repetition(columns=count, rows=count, spacing=(2, 2))
    cell.add(square)
    return library


DRAWINGS: dict[str, Callable[[], gdstk.Library]] = {
    function.__name__: function for function in (nested_arrays, doublings, chain, many_cells, many_polygons)
}


def gds_bombs() -> dict[str, bytes]:
    """Drawings as GDSII."""
    return {f"{name}.gds": drawn(make(), ".gds") for name, make in DRAWINGS.items()}


def oasis_bombs() -> dict[str, bytes]:
    """Drawings as OASIS."""
    return {
        f"{name}.oas": drawn(make(), ".oas") for name, make in {**DRAWINGS, "repeated_shapes": repeated_shapes}.items()
    }


def drawn(library: gdstk.Library, ending: str) -> bytes:
    """Bytes of a drawing as ".gds" or ".oas"."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drawing{ending}"
        (library.write_gds if ending == ".gds" else library.write_oas)(str(path))
        return path.read_bytes()


# --- pictures ---------------------------------------------------------------------------------------------------------


def _zeros(count: int) -> bytes:
    """A zlib stream of so many zero bytes, without ever having them."""
    packer = zlib.compressobj(9)
    block = bytes(1 << 20)
    parts = [packer.compress(block) for _ in range(count >> 20)]
    return b"".join([*parts, packer.compress(bytes(count & (1 << 20) - 1)), packer.flush()])


def png_bomb(width: int = 30_000, height: int = 30_000, bits: int = 8, colour: int = 0) -> bytes:
    """A black PNG."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    planes = {0: 1, 2: 3, 6: 4}[colour]
    rows = _zeros(height * (1 + width * planes * bits // 8))
    head = struct.pack(">2I5B", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def tiff_bomb(width: int = 40_000, height: int = 40_000, packed: int | None = None, compression: int = 8) -> bytes:
    """A black grey TIFF of one strip, which unfolds to `packed` bytes where it stands for `width` x `height`."""
    strip = _zeros(width * height if packed is None else packed)
    if compression == 34925:
        strip = lzma.compress(bytes(packed or width * height))
    entries = [
        (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, compression), (262, 3, 1, 1),
        (273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, len(strip)),
    ]  # fmt: skip
    tags = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<I", 8 + len(strip)) + strip + struct.pack("<H", len(entries)) + tags + bytes(4)


def jpeg_bomb(width: int = 65_000, height: int = 65_000) -> bytes:
    """A JPEG whose header promises more than it holds."""
    stream = io.BytesIO()
    Image.new("RGB", (16, 16)).save(stream, "JPEG")
    data = bytearray(stream.getvalue())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def exr_bomb(width: int = 20_000, height: int = 20_000, channels: int = 8) -> bytes:
    """A scan-line EXR of constant channels."""
    names = b"".join(f"C{n:03d}".encode() + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for n in range(channels)) + b"\0"
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        (b"channels", b"chlist", names), (b"compression", b"compression", b"\3"), (b"dataWindow", b"box2i", box),
        (b"displayWindow", b"box2i", box), (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)), (b"screenWindowCenter", b"v2f", bytes(8)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    ]  # fmt: skip
    head = struct.pack("<ii", 20000630, 2)
    head += b"".join(n + b"\0" + kind + b"\0" + struct.pack("<i", len(d)) + d for n, kind, d in attributes) + b"\0"
    blocks = [min(16, height - y) for y in range(0, height, 16)]
    # Interleaved zeros whose differences were taken: the first byte stays, all others are 128 more than before.
    packed = {
        lines: zlib.compress(b"\0" + b"\x80" * (lines * width * 4 * channels - 1), 9)
        for lines in {*blocks[:1], *blocks[-1:]}
    }
    offset, table, body = len(head) + 8 * len(blocks), [], []
    for number, lines in enumerate(blocks):
        table.append(struct.pack("<Q", offset))
        body.append(struct.pack("<ii", 16 * number, len(packed[lines])) + packed[lines])
        offset += len(body[-1])
    return head + b"".join(table) + b"".join(body)


def exr_promise(width: int = 2**31 - 10, height: int = 2**31 - 10, channels: int = 3) -> bytes:
    """The header of an immense EXR, without pixels."""
    small = exr_bomb(16, 16, channels)
    return small.replace(struct.pack("<4i", 0, 0, 15, 15), struct.pack("<4i", 0, 0, width - 1, height - 1))


def picture_bombs() -> dict[str, bytes]:
    """Pictures that decode to gigabytes."""
    return {
        "grey.png": png_bomb(), "deep.png": png_bomb(16_000, 16_000, 16, 2), "grey.tif": tiff_bomb(),
        "strip.tif": tiff_bomb(100, 100, 8 << 30), "lzma.tif": tiff_bomb(100, 100, 1 << 30, 34925),
        "large.jpg": jpeg_bomb(), "channels.exr": exr_bomb(), "wide.exr": exr_promise(),
        "thin.exr": exr_promise(16, 2**31 - 10), "many.exr": exr_bomb(100, 100, 20_000),
    }  # fmt: skip


# --- meshes and archives ----------------------------------------------------------------------------------------------


def mesh_3mf_bomb(triangles: int = 100_000_000, blanks: int = 0) -> bytes:
    """A 3MF of one triangle again and again, or of `blanks` spaces."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    row = b'<triangle v1="0" v2="1" v3="2"/>' * 1000
    head = (
        b'<model unit="millimeter"><resources><object id="1"><mesh><vertices><vertex x="0" y="0" z="0"/></vertices>'
        b"<triangles>"
    )
    parts, check, size = [], 0, 0
    for part in (head, *[row] * (triangles // 1000), *[b" " * (1 << 20)] * (blanks >> 20), b"</triangles>"):
        parts.append(packer.compress(part))
        check, size = zlib.crc32(part, check), size + len(part)
    packed = b"".join(parts) + packer.flush()
    name = b"3D/3dmodel.model"
    info = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 33, check, len(packed), size, len(name), 0)
    middle = b"PK\1\2" + struct.pack("<H", 20) + info + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    local = b"PK\3\4" + info + name + packed
    return local + middle + b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(middle), len(local), 0)


def glb_bomb(count: int = 1 << 40) -> bytes:
    """A GLB whose accessors promise numbers that no buffer holds."""
    accessor = {"componentType": 5126, "count": count, "type": "VEC3"}
    value = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "accessors": [accessor],
    }  # fmt: skip
    text = json.dumps(value).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text


def npy_bomb(count: int = 1 << 40) -> bytes:
    """An array file whose header promises more than it holds."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (count,)})
    return stream.getvalue() + bytes(64)


def npz_bomb(members: int = 2, count: int = 1 << 30) -> bytes:
    """An archive of compressed zeros."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(members):
            with archive.open(f"features.{number}.weight.npy", "w") as member:
                head = {"descr": "|u1", "fortran_order": False, "shape": (count,)}
                np.lib.format.write_array_header_1_0(member, head)
                for _ in range(count >> 20):
                    member.write(bytes(1 << 20))
    return stream.getvalue()


def model_bombs() -> dict[str, bytes]:
    """Meshes and arrays that promise or unfold to gigabytes."""
    return {
        "triangles.3mf": mesh_3mf_bomb(), "blanks.3mf": mesh_3mf_bomb(0, 4 << 30), "promise.glb": glb_bomb(),
        "promise.npy": npy_bomb(), "zeros.npz": npz_bomb(),
    }  # fmt: skip
