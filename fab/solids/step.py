"""STEP, through the kernel of cadquery: the few shapes that plates are made of, their files, and their volumes.

Lengths are metres here and millimetres in the file. Solids are built from their faces, whose common edges are shared,
and never by Boolean operations: the time is linear in the number of faces, and thousands of them take seconds. Authors,
programs and times in the header are fixed, so that the same shapes give the same bytes. The functions return shapes of
the kernel.
"""

import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from fab.aperture.loops import Division
from fab.errors import CheckFailed, InputError
from fab.files import os_errors_explained, read_bytes, write_atomic
from fab.units import MM

_HEADER_TIME = "2000-01-01T00:00:00"
_NUMBER = re.compile(rb"(?<![#A-Z0-9'])-?\d+\.\d*(?:E[+-]?\d+)?")
_COUNTED = re.compile(rb"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\()'\d+',([^;]*);")


class _Kernel:
    """Classes of the kernel by name, each loaded on its first use from the module that its name begins with."""

    def __getattr__(self, name: str) -> Any:
        found = getattr(import_module(f"OCP.{name.partition('_')[0]}"), name)
        setattr(self, name, found)
        return found


occ = _Kernel()


class Body(NamedTuple):
    """Volume of a part, cubic metres, and its centre of mass x, y, z, metres."""

    volume_m3: float
    centre_m: tuple[float, float, float]


def _point(x_m: float, y_m: float, z_m: float) -> Any:
    return occ.gp_Pnt(x_m / MM, y_m / MM, z_m / MM)


def _inside(shape: Any, kind: Any) -> Iterator[Any]:
    """Yield the shapes of a kind, such as edges, within another."""
    explorer = occ.TopExp_Explorer(shape, kind)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _faces(shape: Any) -> Iterator[Any]:
    return map(occ.TopoDS.Face_s, _inside(shape, occ.TopAbs_FACE))


def _polygon(points: list[Any], closed: bool) -> Any:
    maker = occ.BRepBuilderAPI_MakePolygon()
    for point in points:
        maker.Add(point)
    if closed:
        maker.Close()
    return maker.Wire()


def revolved(corners_m: list[tuple[float, float]], closed: bool) -> Any:
    """Turn corners r, z (metres) around the z axis: to a solid if they are closed, otherwise to a shell."""
    wire = _polygon([_point(r, 0, z) for r, z in corners_m], closed)
    profile = occ.BRepBuilderAPI_MakeFace(wire).Face() if closed else wire
    return occ.BRepPrimAPI_MakeRevol(profile, occ.gp_Ax1(occ.gp_Pnt(0, 0, 0), occ.gp_Dir(0, 0, 1))).Shape()


def disc(radius_m: float) -> Any:
    """Return a disc without thickness in the plane z = 0."""
    return next(_faces(revolved([(0.0, 0.0), (radius_m, 0.0)], closed=False)))


def outline(width_m: float, flat_m: float | None) -> Any:
    """Return a face at z = 0, centred: a square, or a disc with a flat of some length (0 for none) at -y."""
    half = width_m / 2
    if flat_m is None:
        corners = [_point(x, y, 0) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
        return occ.BRepBuilderAPI_MakeFace(_polygon(corners, closed=True)).Face()
    circle = occ.gp_Circ(occ.gp_Ax2(occ.gp_Pnt(0, 0, 0), occ.gp_Dir(0, 0, 1)), half / MM)
    if not flat_m:
        return occ.BRepBuilderAPI_MakeFace(
            occ.BRepBuilderAPI_MakeWire(occ.BRepBuilderAPI_MakeEdge(circle).Edge()).Wire()
        ).Face()
    y_m = -math.sqrt(half**2 - (flat_m / 2) ** 2)
    right, left = _point(flat_m / 2, y_m, 0), _point(-flat_m / 2, y_m, 0)
    arc = occ.BRepBuilderAPI_MakeEdge(circle, right, left).Edge()
    flat = occ.BRepBuilderAPI_MakeEdge(left, right).Edge()
    return occ.BRepBuilderAPI_MakeFace(occ.BRepBuilderAPI_MakeWire(arc, flat).Wire()).Face()


def filled(corners_m: Sequence[tuple[float, float]]) -> Any:
    """Return a polygon without thickness in the plane z = 0, by its corners x, y, metres."""
    return occ.BRepBuilderAPI_MakeFace(_polygon([_point(x, y, 0) for x, y in corners_m], closed=True)).Face()


def holed(surface: Any, holes: Iterable[Any]) -> Any:
    """Return a plane face less others inside it."""
    for hole in holes:
        wire = occ.TopoDS.Wire_s(next(_inside(hole, occ.TopAbs_WIRE)).Reversed())
        surface = occ.BRepBuilderAPI_MakeFace(surface, wire).Face()
    return surface


def _parted(division: Division, surface: Any) -> tuple[list[Any], list[Any]]:
    """Return the open and the closed parts of a face at z = 0; neighbours have their edges in common."""
    loops = [filled(loop.tolist()) for loop in division.loops]

    def faces(parts: list[tuple[int | None, list[int]]]) -> list[Any]:
        grounds = [surface if outer is None else loops[outer] for outer, _ in parts]
        return [holed(face, (loops[n] for n in inner)) for face, (_, inner) in zip(grounds, parts, strict=True)]

    return faces(division.open), faces(division.closed)


def raised(surface: Any, thickness_m: float) -> Any:
    """Return the solid of some thickness (metres) above a face at z = 0."""
    return slab(surface, -thickness_m)


def framed(surface: Any, division: Division, thickness_m: float) -> Any:
    """Return a film of some thickness (metres) on a face at z = 0, without the open parts of a division, metres."""
    _, closed = _parted(division, surface)
    solids = [raised(part, thickness_m) for part in closed]
    return solids[0] if len(solids) == 1 else _compound(solids)


def opened(division: Division) -> Any:
    """Return the open parts of a division, metres, without thickness in the plane z = 0."""
    parts, _ = _parted(division._replace(closed=[]), None)
    return parts[0] if len(parts) == 1 else _compound(parts)


def _compound(shapes: Iterable[Any]) -> Any:
    builder, compound = occ.BRep_Builder(), occ.TopoDS_Compound()
    builder.MakeCompound(compound)
    for shape in shapes:
        builder.Add(compound, shape)
    return compound


def boxes(corners_m: Iterable[tuple[float, float, float, float, float, float]]) -> Any:
    """Return a compound of boxes, each from its corner x, y, z to the opposite one."""
    ends = ((_point(*corners[:3]), _point(*corners[3:])) for corners in corners_m)
    return _compound(occ.BRepPrimAPI_MakeBox(low, high).Shape() for low, high in ends)


class Copies(NamedTuple):
    """A part that is one shape at many places x, y, metres; the file holds the shape once."""

    shape: Any
    places_m: Sequence[tuple[float, float]]


def _place(x_m: float, y_m: float) -> Any:
    move = occ.gp_Trsf()
    move.SetTranslation(occ.gp_Vec(x_m / MM, y_m / MM, 0))
    return occ.TopLoc_Location(move)


def slab(surface: Any, thickness_m: float) -> Any:
    """Return the solid of some thickness (metres) below a face at z = 0."""
    return occ.BRepPrimAPI_MakePrism(surface, occ.gp_Vec(0, 0, -thickness_m / MM)).Shape()


def _rim(shell: Any, radius_m: float) -> Any:
    """Return the circular edge in which a revolved relief ends at z = 0."""
    # The faces come in the order of the profile, so the last one holds it.
    for edge in map(occ.TopoDS.Edge_s, _inside(list(_faces(shell))[-1], occ.TopAbs_EDGE)):
        curve = occ.BRepAdaptor_Curve(edge)
        if curve.GetType() == occ.GeomAbs_Circle:
            circle = curve.Circle()
            if circle.Location().Z() == 0 and abs(circle.Radius() * MM / radius_m - 1) < 1e-12:
                return edge
    raise AssertionError("a relief must end in a circle at z = 0")


def plate(surface: Any, thickness_m: float, profile_m: list[tuple[float, float]]) -> Any:
    """Return a plate below a face at z = 0 with a revolved relief set into it, as one solid.

    The relief is given by its corners r, z from the axis to its rim at z = 0, metres.
    """
    relief = revolved(profile_m, closed=False)
    hole = occ.BRepBuilderAPI_MakeWire(_rim(relief, profile_m[-1][0])).Wire()
    top = occ.BRepBuilderAPI_MakeFace(surface, hole).Face()
    return _closed([*_walls(surface, thickness_m), top, *_faces(relief)])


def _walls(surface: Any, thickness_m: float) -> list[Any]:
    """Return the faces of a slab below a face, but for that face."""
    return [face for face in _faces(slab(surface, thickness_m)) if not face.IsSame(surface)]


def _closed(faces: Iterable[Any]) -> Any:
    """Return the solid that faces with common edges enclose."""
    builder, shell = occ.BRep_Builder(), occ.TopoDS_Shell()
    builder.MakeShell(shell)
    for face in faces:
        builder.Add(shell, face)
    shell.Closed(True)
    fix = occ.ShapeFix_Shell()
    fix.FixFaceOrientation(shell)
    solid = occ.BRepBuilderAPI_MakeSolid(fix.Shell()).Solid()
    occ.BRepLib.OrientClosedSolid_s(solid)
    return solid


def marked_plate(surface: Any, thickness_m: float, division: Division) -> Any:
    """Return a plate below a face at z = 0 with the parts of a division (metres) as faces of their own."""
    opened_parts, closed_parts = _parted(division, surface)
    return _closed([*_walls(surface, thickness_m), *closed_parts, *opened_parts])


@contextmanager
def _silence() -> Iterator[None]:
    """Keep the kernel from printing its progress."""
    messenger = occ.Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)


def write_step(path: str | Path, name: str, parts: Mapping[str, Any]) -> None:
    """Write named parts, shapes or `Copies`, as one STEP assembly whose bytes depend on them alone."""

    def text(value: str) -> Any:
        return occ.TCollection_HAsciiString(value)

    def named(label: Any, value: str) -> Any:
        occ.TDataStd_Name.Set_s(label, occ.TCollection_ExtendedString(value))
        return label

    document = occ.TDocStd_Document(occ.TCollection_ExtendedString("doedesign"))
    occ.XCAFApp_Application.GetApplication_s().InitDocument(document)
    shapes = occ.XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    root = named(shapes.NewShape(), name)
    for part, shape in parts.items():
        if isinstance(shape, Copies):
            one, label = shapes.AddShape(shape.shape, False), shapes.NewShape()
            for number, place in enumerate(shape.places_m, 1):
                named(shapes.AddComponent(label, one, _place(*place)), f"{part}_{number}")
            named(one, f"{part}_ONE")
        else:
            label = shapes.AddShape(shape, False)
        named(label, part)
        named(shapes.AddComponent(root, label, occ.TopLoc_Location()), part)
    shapes.UpdateAssemblies()
    writer = occ.STEPCAFControl_Writer()
    # Planes and cylinders need no second description of their edges.
    occ.Interface_Static.SetIVal_s("write.surfacecurve.mode", 0)
    occ.Interface_Static.SetCVal_s("write.step.unit", "MM")
    stream = io.BytesIO()
    with _silence():
        writer.Transfer(document, occ.STEPControl_AsIs)
        header = occ.APIHeaderSection_MakeHeader(writer.ChangeWriter().Model())
        header.SetName(text(name))
        header.SetTimeStamp(text(_HEADER_TIME))
        for setter in (header.SetAuthorValue, header.SetOrganizationValue):
            setter(1, text(""))
        for setter in (header.SetPreprocessorVersion, header.SetOriginatingSystem, header.SetAuthorisation):
            setter(text("doedesign"))
        writer.WriteStream(stream)
    # The kernel counts the placements of parts on from file to file.
    numbers = itertools.count(1)

    def numbered(found: re.Match[bytes]) -> bytes:
        return b"%s'%d',%s;" % (found[1], next(numbers), found[2].replace(b"\n", b"").replace(b"  ", b""))

    write_atomic(path, _COUNTED.sub(numbered, stream.getvalue()))


def step_bodies(path: str | Path) -> dict[str, Body]:
    """Read a STEP file back and return its bodies by part name; parts without a volume are left out.

    Raises:
        InputError: the file is missing or holds no STEP parts.
        CheckFailed: a solid is not valid.
    """
    path = Path(path)
    bodies: dict[str, Body] = {}
    measured: dict[Any, Body] = {}
    for name, shape in _read_parts(path).items():
        solids = list(_inside(shape, occ.TopAbs_SOLID))
        for solid in solids:
            if solid.TShape() not in measured:  # the copies of a solid share their geometry
                measured[solid.TShape()] = _body(solid, f"{path}: {name}")
        if solids:
            bodies[name] = _together([_placed(measured[solid.TShape()], solid.Location()) for solid in solids])
    return bodies


def _read_parts(path: Path) -> dict[str, Any]:
    """Return the shapes of an assembly by the names of its parts."""
    with os_errors_explained(path):
        path.open("rb").close()
    reader, found = occ.STEPCAFControl_Reader(), occ.TDF_LabelSequence()
    reader.SetNameMode(True)
    document = occ.TDocStd_Document(occ.TCollection_ExtendedString("doedesign"))
    with _silence():
        read = reader.ReadFile(str(path)) == occ.IFSelect_RetDone and reader.Transfer(document)
    shapes = occ.XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    shapes.GetFreeShapes(found)
    if not read or found.Length() != 1 or not occ.XCAFDoc_ShapeTool.IsAssembly_s(found.First()):
        cure = "Write the file again from its source."
        raise InputError(str(path), "the file must be STEP with parts in it", "another file, or a damaged one", cure)
    parts = occ.TDF_LabelSequence()
    occ.XCAFDoc_ShapeTool.GetComponents_s(found.First(), parts)
    return {_name(label): occ.XCAFDoc_ShapeTool.GetShape_s(label) for label in parts}


def _name(label: Any) -> str:
    name = occ.TDataStd_Name()
    return name.Get().ToExtString() if label.FindAttribute(occ.TDataStd_Name.GetID_s(), name) else ""


def step_differences(path: str | Path, wanted: str | Path) -> list[str]:
    """Compare two STEP files entity by entity, whatever their headers say; return a sentence on the first difference.

    Numbers may differ by a femtometre, since another version of the kernel may round them otherwise.
    """
    here, there = (_entities(Path(each)) for each in (path, wanted))
    if len(here) != len(there):
        return [f"{len(here)} entities instead of {len(there)}"]
    for one, other in zip(here, there, strict=True):
        if one != other and not _alike(one, other):
            return [f"it says {one[:90].decode('ascii', 'replace')!r} instead of {other[:90].decode('ascii')!r}"]
    return []


def _entities(path: Path) -> list[bytes]:
    """Return the entities of a STEP file, in its order, without line breaks."""
    data = read_bytes(path).partition(b"DATA;")[2]
    return re.sub(rb"\s+", b"", data).split(b";")


def _alike(one: bytes, other: bytes) -> bool:
    """Whether two entities are the same but for the last digits of their numbers, millimetres."""
    if _NUMBER.split(one) != _NUMBER.split(other):
        return False
    pairs = zip(_NUMBER.findall(one), _NUMBER.findall(other), strict=True)
    return all(a == b or abs(float(a) - float(b)) <= 1e-12 * max(1.0, abs(float(b))) for a, b in pairs)


def _body(solid: Any, where: str) -> Body:
    """Measure a solid where its geometry was drawn."""
    solid = solid.Located(occ.TopLoc_Location())
    if not occ.BRepCheck_Analyzer(solid).IsValid():
        raise CheckFailed([f"{where} is not a valid solid"])
    properties = occ.GProp_GProps()
    occ.BRepGProp.VolumeProperties_s(solid, properties)
    return Body(properties.Mass() * MM**3, _metres(properties.CentreOfMass()))


def _placed(body: Body, place: Any) -> Body:
    return body._replace(centre_m=_metres(_point(*body.centre_m).Transformed(place.Transformation())))


def _metres(point: Any) -> tuple[float, float, float]:
    return point.X() * MM, point.Y() * MM, point.Z() * MM


def _together(bodies: Sequence[Body]) -> Body:
    volume = math.fsum(body.volume_m3 for body in bodies)
    x, y, z = (math.fsum(body.volume_m3 * body.centre_m[axis] for body in bodies) / volume for axis in range(3))
    return Body(volume, (x, y, z))
