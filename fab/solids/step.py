"""STEP, through the kernel of cadquery: the few shapes that plates are made of, their files, and their volumes.

Lengths are metres here and millimetres in the file. Solids are built from their faces, whose common edges are
shared, and never by Boolean operations: the time is linear in the number of faces, and thousands of them take
seconds. The names of authors, programs and times in the file's header are fixed, so that the same
shapes give the same bytes. What the functions return are shapes of the kernel.
"""

# The modules of the kernel are compiled, and pyright does not see into them.
# pyright: reportAttributeAccessIssue=false

import io
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from fab.errors import CheckFailed, InputError
from fab.files import os_errors_explained, write_atomic
from fab.units import MM

_HEADER_TIME = "2000-01-01T00:00:00"
_COUNTED = re.compile(rb"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\()'\d+',([^;]*);")


class Body(NamedTuple):
    """Volume of a part, cubic metres, and its centre of mass x, y, z, metres."""

    volume_m3: float
    centre_m: tuple[float, float, float]


def _point(x_m: float, y_m: float, z_m: float) -> Any:
    from OCP.gp import gp_Pnt

    return gp_Pnt(x_m / MM, y_m / MM, z_m / MM)


def _axis() -> Any:
    from OCP.gp import gp_Ax1, gp_Dir, gp_Pnt

    return gp_Ax1(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1))


def _faces(shape: Any) -> Iterator[Any]:
    from OCP.TopAbs import TopAbs_FACE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(shape, TopAbs_FACE)
    while explorer.More():
        yield TopoDS.Face_s(explorer.Current())
        explorer.Next()


def _polygon(points: list[Any], closed: bool) -> Any:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakePolygon

    maker = BRepBuilderAPI_MakePolygon()
    for point in points:
        maker.Add(point)
    if closed:
        maker.Close()
    return maker.Wire()


def revolved(corners_m: list[tuple[float, float]], closed: bool) -> Any:
    """Turn corners r, z (metres) around the z axis: to a solid if they are closed, otherwise to a shell."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeRevol

    wire = _polygon([_point(r, 0, z) for r, z in corners_m], closed)
    profile = BRepBuilderAPI_MakeFace(wire).Face() if closed else wire
    return BRepPrimAPI_MakeRevol(profile, _axis()).Shape()


def disc(radius_m: float) -> Any:
    """Return a disc without thickness in the plane z = 0."""
    return next(_faces(revolved([(0.0, 0.0), (radius_m, 0.0)], closed=False)))


def outline(width_m: float, flat_m: float | None) -> Any:
    """Return a face at z = 0, centred: a square, or a disc with a flat of some length (0 for none) at -y."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeWire
    from OCP.gp import gp_Ax2, gp_Circ, gp_Dir, gp_Pnt

    half = width_m / 2
    if flat_m is None:
        corners = [_point(x, y, 0) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
        return BRepBuilderAPI_MakeFace(_polygon(corners, closed=True)).Face()
    circle = gp_Circ(gp_Ax2(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), half / MM)
    if not flat_m:
        return BRepBuilderAPI_MakeFace(BRepBuilderAPI_MakeWire(BRepBuilderAPI_MakeEdge(circle).Edge()).Wire()).Face()
    y_m = -math.sqrt(half**2 - (flat_m / 2) ** 2)
    right, left = _point(flat_m / 2, y_m, 0), _point(-flat_m / 2, y_m, 0)
    arc = BRepBuilderAPI_MakeEdge(circle, right, left).Edge()
    flat = BRepBuilderAPI_MakeEdge(left, right).Edge()
    return BRepBuilderAPI_MakeFace(BRepBuilderAPI_MakeWire(arc, flat).Wire()).Face()


def boxes(corners_m: Iterable[tuple[float, float, float, float, float, float]]) -> Any:
    """Return a compound of boxes, each from its corner x, y, z to the opposite one."""
    from OCP.BRep import BRep_Builder
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.TopoDS import TopoDS_Compound

    builder, compound = BRep_Builder(), TopoDS_Compound()
    builder.MakeCompound(compound)
    for x0, y0, z0, x1, y1, z1 in corners_m:
        builder.Add(compound, BRepPrimAPI_MakeBox(_point(x0, y0, z0), _point(x1, y1, z1)).Shape())
    return compound


def copies(shape: Any, places_m: Iterable[tuple[float, float]]) -> Any:
    """Return a compound of copies of a shape, each moved by x, y (metres)."""
    from OCP.BRep import BRep_Builder
    from OCP.gp import gp_Trsf, gp_Vec
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS_Compound

    builder, compound = BRep_Builder(), TopoDS_Compound()
    builder.MakeCompound(compound)
    for x_m, y_m in places_m:
        move = gp_Trsf()
        move.SetTranslation(gp_Vec(x_m / MM, y_m / MM, 0))
        builder.Add(compound, shape.Moved(TopLoc_Location(move)))
    return compound


def slab(surface: Any, thickness_m: float) -> Any:
    """Return the solid of some thickness (metres) below a face at z = 0."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakePrism
    from OCP.gp import gp_Vec

    return BRepPrimAPI_MakePrism(surface, gp_Vec(0, 0, -thickness_m / MM)).Shape()


def _rim(shell: Any, radius_m: float) -> Any:
    """Return the circular edge in which a revolved relief ends at z = 0."""
    from OCP.BRepAdaptor import BRepAdaptor_Curve
    from OCP.GeomAbs import GeomAbs_Circle
    from OCP.TopAbs import TopAbs_EDGE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    # The faces come in the order of the profile, so the last one holds it.
    explorer = TopExp_Explorer(list(_faces(shell))[-1], TopAbs_EDGE)
    while explorer.More():
        edge = TopoDS.Edge_s(explorer.Current())
        curve = BRepAdaptor_Curve(edge)
        if curve.GetType() == GeomAbs_Circle:
            circle = curve.Circle()
            if circle.Location().Z() == 0 and abs(circle.Radius() * MM / radius_m - 1) < 1e-12:
                return edge
        explorer.Next()
    raise AssertionError("a relief must end in a circle at z = 0")


def plate(surface: Any, thickness_m: float, profile_m: list[tuple[float, float]]) -> Any:
    """Return a plate below a face at z = 0 with a revolved relief set into it, as one solid.

    The relief is given by its corners r, z from the axis to its rim at z = 0, metres.
    """
    from OCP.BRep import BRep_Builder
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeSolid, BRepBuilderAPI_MakeWire
    from OCP.BRepLib import BRepLib
    from OCP.ShapeFix import ShapeFix_Shell
    from OCP.TopoDS import TopoDS_Shell

    relief = revolved(profile_m, closed=False)
    prism = slab(surface, thickness_m)
    hole = BRepBuilderAPI_MakeWire(_rim(relief, profile_m[-1][0])).Wire()
    top = BRepBuilderAPI_MakeFace(surface, hole).Face()
    builder, shell = BRep_Builder(), TopoDS_Shell()
    builder.MakeShell(shell)
    for face in (*(f for f in _faces(prism) if not f.IsSame(surface)), top, *_faces(relief)):
        builder.Add(shell, face)
    shell.Closed(True)
    fix = ShapeFix_Shell()
    fix.FixFaceOrientation(shell)
    solid = BRepBuilderAPI_MakeSolid(fix.Shell()).Solid()
    BRepLib.OrientClosedSolid_s(solid)
    return solid


@contextmanager
def _silence() -> Iterator[None]:
    """Keep the kernel from printing its progress."""
    from OCP.Message import Message

    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)


def _recount() -> Callable[[re.Match[bytes]], bytes]:
    """Number the placements of parts from 1; the kernel counts on from file to file."""
    numbers = itertools.count(1)
    return lambda found: b"%s'%d',%s;" % (found[1], next(numbers), found[2].replace(b"\n", b"").replace(b"  ", b""))


def write_step(path: str | Path, name: str, parts: Mapping[str, Any]) -> None:
    """Write named parts, shapes of the kernel, as one STEP assembly whose bytes depend on them alone."""
    from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
    from OCP.Interface import Interface_Static
    from OCP.STEPCAFControl import STEPCAFControl_Writer
    from OCP.STEPControl import STEPControl_AsIs
    from OCP.TCollection import TCollection_ExtendedString, TCollection_HAsciiString
    from OCP.TDataStd import TDataStd_Name
    from OCP.TDocStd import TDocStd_Document
    from OCP.TopLoc import TopLoc_Location
    from OCP.XCAFApp import XCAFApp_Application
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    def text(value: str) -> Any:
        return TCollection_HAsciiString(value)

    def named(label: Any, value: str) -> Any:
        TDataStd_Name.Set_s(label, TCollection_ExtendedString(value))
        return label

    document = TDocStd_Document(TCollection_ExtendedString("doedesign"))
    XCAFApp_Application.GetApplication_s().InitDocument(document)
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    root = named(shapes.NewShape(), name)
    for part, shape in parts.items():
        label = named(shapes.AddShape(shape, False), part)
        named(shapes.AddComponent(root, label, TopLoc_Location()), part)
    shapes.UpdateAssemblies()
    writer = STEPCAFControl_Writer()
    # Planes and cylinders need no second description of their edges.
    Interface_Static.SetIVal_s("write.surfacecurve.mode", 0)
    Interface_Static.SetCVal_s("write.step.unit", "MM")
    stream = io.BytesIO()
    with _silence():
        writer.Transfer(document, STEPControl_AsIs)
        header = APIHeaderSection_MakeHeader(writer.ChangeWriter().Model())
        header.SetName(text(name))
        header.SetTimeStamp(text(_HEADER_TIME))
        for setter in (header.SetAuthorValue, header.SetOrganizationValue):
            setter(1, text(""))
        for setter in (header.SetPreprocessorVersion, header.SetOriginatingSystem, header.SetAuthorisation):
            setter(text("doedesign"))
        writer.WriteStream(stream)
    write_atomic(path, _COUNTED.sub(_recount(), stream.getvalue()))


def step_bodies(path: str | Path) -> dict[str, Body]:
    """Read a STEP file back and return its bodies by part name; parts without a volume are left out.

    Raises:
        InputError: the file is missing or holds no STEP parts.
        CheckFailed: a solid is not valid.
    """
    import cadquery

    path = Path(path)
    with os_errors_explained(path):
        path.open("rb").close()
    try:
        with _silence():
            read = cadquery.Assembly.importStep(str(path))
    except Exception as error:
        cure = "Write the file again from its source."
        raise InputError(str(path), "the file must be STEP with parts in it", str(error), cure) from error
    bodies = {}
    for shape, name, _, _ in read:
        solids = shape.Solids()
        if not all(solid.isValid() for solid in solids):
            raise CheckFailed([f"{path}: {name} is not a valid solid"])
        if solids:
            bodies[name.split("/")[-1]] = _body(solids)
    return bodies


def _body(solids: list[Any]) -> Body:
    volumes = [solid.Volume() for solid in solids]
    centres = [solid.Center().toTuple() for solid in solids]
    volume = math.fsum(volumes)
    x, y, z = (
        math.fsum(v * c for v, c in zip(volumes, axis, strict=True)) / volume * MM
        for axis in zip(*centres, strict=True)
    )
    return Body(volume * MM**3, (x, y, z))


def step_volumes_m3(path: str | Path) -> dict[str, float]:
    """Read a STEP file back and measure its solids, as `step_bodies` does; cubic metres by part name."""
    return {name: body.volume_m3 for name, body in step_bodies(path).items()}
