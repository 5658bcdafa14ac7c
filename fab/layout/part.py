"""Parts: what is drawn beside the DOE (marks, test structures, lettering), and the photomasks it is drawn for.

A part is small, lies about its own origin and lists the points that people measure at. It is moved and joined with
others, never turned or mirrored: a mirrored mark would say that a photomask is the right way round when it is not.

A photomask is its layer, and what its polygons are on it. On an etch layer a polygon means "etched here", on the chrome
and the zero layer "chrome here". With "clear" polygons the photomask is dark field: chrome all over, and polygons let
light through. With "dark" polygons it is clear field: glass all over, and polygons are chrome.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fab.layout.geometry import Box, Layer, Shapes, box_around, chrome_layer, merged
from fab.layout.polygons import rectangles
from fab.levels import Levels
from fab.units import NM, UM

ZERO_LAYER = 10

Tone = Literal["clear", "dark"]
Resist = Literal["positive", "negative"]
_LIMIT = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Part:
    """Shapes on any layers about their own origin, and named points x, y (metres from it) that people measure at."""

    dbu_m: float
    shapes: Mapping[Layer, Shapes]
    places: Mapping[str, tuple[float, float]]

    @property
    def box(self) -> Box:
        """The smallest x0, y0, x1, y1 around all shapes, database units; all 0 if there are none."""
        return box_around(shapes.box for shapes in self.shapes.values() if shapes.box) or (0, 0, 0, 0)


@dataclass(frozen=True)
class Photomask:
    """One mask of the set: its layer, what polygons are on the photomask, and what it makes.

    Marks are datatype 1 of the layer, test structures 2, lettering 3. An etch mask has its bit of the levels and the
    depth that it etches (metres); one that makes chrome has None and 0. Light opens a positive resist, and a negative
    one stays where light falls.
    """

    layer: int
    tone: Tone
    makes: Literal["etch", "liftoff", "wet etch", "zero layer"]
    bit: int | None = None
    depth_m: float = 0.0
    resist: Resist = "positive"

    @property
    def opens(self) -> bool:
        """Whether its polygons open the resist: where they are clear a positive one, where they are dark a negative."""
        return (self.tone == "clear") == (self.resist == "positive")

    @property
    def name(self) -> str:
        """Usual name: "mask 3", "chrome", "zero layer"; a mask's number is its bit + 1."""
        return self.makes if self.makes == "zero layer" else "chrome" if self.bit is None else f"mask {self.bit + 1}"

    @property
    def code(self) -> str:
        """Two characters for small places: "M3", "CR", "Z0"."""
        return {"zero layer": "Z0", "chrome": "CR"}.get(self.name, f"M{self.layer}")

    @property
    def depth(self) -> str:
        """Depth that it etches, as text: "300 nm"."""
        return f"{self.depth_m / NM:.6g} nm"

    def on(self, datatype: Literal[1, 2, 3]) -> Layer:
        """Return the layer of its marks (1), test structures (2) or lettering (3)."""
        return Layer(self.layer, datatype, f"{self.code}_{('MARKS', 'TEST', 'LABEL')[datatype - 1]}")


def photomasks_of(
    levels: Levels, order: Sequence[int], tone: Tone, chrome: Literal["liftoff", "etch", "none"], zero_layer: bool
) -> tuple[Photomask, ...]:
    """List the photomasks of a job in the order in which they are used: zero layer, etch masks, chrome.

    The first of them makes the marks that all others are aligned to. `tone` is that of the etch masks, whose polygons
    open the resist: a positive one if they are clear, a negative one if they are dark. The resist is the same at every
    step, so that chrome that is etched away around its polygons needs the other tone than chrome that is lifted off, or
    than an etch.
    """
    opposite: Tone = "dark" if tone == "clear" else "clear"
    resist: Resist = "positive" if tone == "clear" else "negative"
    chrome_tone = opposite if chrome == "etch" else tone
    zero = [Photomask(ZERO_LAYER, chrome_tone, "zero layer", resist=resist)] if zero_layer else []
    etches = [Photomask(bit + 1, tone, "etch", bit, levels.etch_depth_m(bit), resist) for bit in order]
    way = "liftoff" if chrome == "liftoff" else "wet etch"
    last = [] if chrome == "none" else [Photomask(chrome_layer(levels).number, chrome_tone, way, resist=resist)]
    return (*zero, *etches, *last)


def without(areas: ArrayLike, holes: ArrayLike = ()) -> NDArray[np.float64]:
    """Cover boxes ``(n, 4)`` x0, y0, x1, y1, which may overlap, less some holes, with disjoint boxes."""
    areas, holes = (np.asarray(boxes, dtype=np.float64).reshape(-1, 4) for boxes in (areas, holes))
    both = np.concatenate([areas, holes])
    x, y = (np.unique(both[:, axis::2]) for axis in (0, 1))
    plane = np.zeros((max(0, y.size - 1), max(0, x.size - 1)), dtype=np.uint8)
    for boxes, value in ((areas, 1), (holes, 0)):
        columns, rows = np.searchsorted(x, boxes[:, ::2]), np.searchsorted(y, boxes[:, 1::2])
        for (x0, x1), (y0, y1) in zip(columns, rows, strict=True):
            plane[y0:y1, x0:x1] = value
    x0, y0, x1, y1 = rectangles(plane).T
    return np.stack([x[x0], y[y0], x[x1], y[y1]], axis=1)


def turned(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Exchange x and y of boxes ``(n, 4)``, which turns a figure for x into the same figure for y."""
    return boxes[:, [1, 0, 3, 2]]


def block(layer: Layer, boxes_um: ArrayLike, dbu_m: float) -> Part:
    """Draw disjoint boxes ``(n, 4)`` on one layer; corners (micrometres) off the database unit are a ValueError."""
    exact = np.asarray(boxes_um, dtype=np.float64).reshape(-1, 4) * (UM / dbu_m)
    whole = np.rint(exact)
    # 1e-3 of a unit is far above the rounding of these products and far below anything that is meant.
    if np.abs(exact - whole).max(initial=0.0) > 1e-3:
        raise ValueError(f"the boxes must be whole units of {dbu_m} m")
    return Part(dbu_m, {layer: Shapes(whole.astype(np.int32))}, {})


def _shifted(part: Part, dx: int, dy: int) -> Part:
    """Move by whole database units."""
    if max(map(abs, part.box)) + max(abs(dx), abs(dy)) > _LIMIT:
        raise ValueError(f"a part moved by ({dx}, {dy}) units must fit 32-bit coordinates")
    shift = np.array([dx, dy], dtype=np.int32)
    shapes = {
        layer: Shapes(drawn.rectangles + np.tile(shift, 2), tuple(polygon + shift for polygon in drawn.polygons))
        for layer, drawn in part.shapes.items()
    }
    places = {name: (x + dx * part.dbu_m, y + dy * part.dbu_m) for name, (x, y) in part.places.items()}
    return Part(part.dbu_m, shapes, places)


def moved(part: Part, x_m: float, y_m: float) -> Part:
    """Move a part and its places by metres, rounded to whole database units."""
    return _shifted(part, round(x_m / part.dbu_m), round(y_m / part.dbu_m))


def prefixed(part: Part, prefix: str) -> Part:
    """Return the part with `prefix` before the name of every place, such as "site left: "."""
    return Part(part.dbu_m, part.shapes, {prefix + name: place for name, place in part.places.items()})


def joined(parts: Iterable[Part]) -> Part:
    """Put parts together as they lie, layers in order; ValueError for none, mixed units or a place named twice."""
    parts = list(parts)
    if len({part.dbu_m for part in parts}) != 1:
        raise ValueError("parts that are joined must have one database unit")
    names = [name for part in parts for name in part.places]
    if len(set(names)) < len(names):
        raise ValueError(f"every place needs its own name, but {max(names, key=names.count)!r} comes twice")
    layers = sorted({layer for part in parts for layer in part.shapes}, key=lambda a: (a.number, a.datatype))
    shapes = {}
    for layer in layers:
        shapes[layer] = merged([part.shapes[layer] for part in parts if layer in part.shapes])
    return Part(parts[0].dbu_m, shapes, {name: place for part in parts for name, place in part.places.items()})


def row(parts: Sequence[Part], gap_m: float) -> Part:
    """Put parts side by side from x = 0 on, their lower edges on y = 0, `gap_m` between their boxes."""
    placed, x = [], 0
    for part in parts:
        x0, y0, x1, _ = part.box
        placed.append(_shifted(part, x - x0, -y0))
        x += x1 - x0 + round(gap_m / part.dbu_m)
    return joined(placed)


def column(parts: Sequence[Part], gap_m: float) -> Part:
    """Put parts one below the other, the last one on y = 0, left edges on x = 0, `gap_m` between boxes."""
    placed, y = [], 0
    for part in reversed(parts):
        x0, y0, _, y1 = part.box
        placed.append(_shifted(part, -x0, y - y0))
        y += y1 - y0 + round(gap_m / part.dbu_m)
    return joined(reversed(placed))


def centred(part: Part) -> Part:
    """Move a part so that the middle of its box lies on the origin, half a database unit at most off."""
    x0, y0, x1, y1 = part.box
    return _shifted(part, -math.floor((x0 + x1) / 2), -math.floor((y0 + y1) / 2))
