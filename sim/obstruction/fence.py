"""Fences near the camera: chain-link, bars and welded grids of round wire.

The paper (section 3.2) scales masks of photographed fences to a wire of 4 mm at 40 to 80 cm, turned by up to 90
degrees, mirrored at random, with jittered contrast and colour. Those masks cannot be had; here the fence is built: a
plane of wires in metres, bent a little out of shape, turned, tilted, and seen in perspective (eq. 11 pixel by pixel). A
tilted fence is nearer on one side, and drawn so, but its one depth stands for the blur of all of it.

A pixel's coverage is the overlap of its width with the wire's, measured across the wire, so edges are smooth and areas
exact. A wire is a cylinder: tilting the fence brings wires together but makes none of them thinner. Its light is
Lambert's, from one direction and from all round.

Chain-link (the shape, not its numbers, of ASTM A392): every wire is a flat spiral, from the front a zigzag with rounded
bends, hooked into its neighbours' bends. Mesh widths are distances of parallel wires.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi, radians, sin, tan
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from sim.imaging.scene import Obstruction
from sim.obstruction.noise import layered_noise
from sim.obstruction.parameters import DEPTHS_M, Range, WithLimits, draw_from
from sim.obstruction.view import CameraView

Pixels = Float[np.ndarray, "y x"]
Pattern = Literal["chain_link", "bars", "grid"]

# Linear reflectances (estimates): zinc, twice as common as each of green plastic, black plastic and rust.
_FINISHES = ((0.46, 0.47, 0.48), (0.46, 0.47, 0.48), (0.03, 0.12, 0.05), (0.03, 0.03, 0.035), (0.20, 0.08, 0.035))
_NOISE_RMS = 0.2157  # of one scale of Perlin's noise, the mean over a cell


@dataclass(frozen=True)
class Fence(WithLimits):
    """Round wires in a plane. Lengths are those of the fence itself, in metres; a range is drawn from uniformly.

    Attributes:
        patterns: which patterns occur, each as often.
        depth_m: distance of the fence on the axis; the paper's 40 to 80 cm.
        wire_m: diameter of a wire; the paper's 4 mm.
        mesh_m: distance of parallel wires, centre to centre; usual chain-link has 1 to 2 1/4 inches.
        diamond_rad: angle of a chain-link's wires to its length; 45 degrees is a square mesh.
        rotation_rad: turn in the plane; the paper's 0 to 90 degrees.
        tilt_rad: angle between the fence's normal and the axis, about a random direction (an estimate).
        sag_m: rms by which wires are off their places, over lengths of four meshes (an estimate).
        bend_m: the same over lengths of one mesh (an estimate).
        light: light on the camera's side, over that on a white of the scene (an estimate).
        ambient: share of it that comes from all round.
        colour_jitter: largest relative change of a colour, either way.
    """

    patterns: tuple[Pattern, ...] = ("chain_link", "grid", "bars")
    depth_m: Range = (0.4, 0.8)
    wire_m: Range = (4e-3, 4e-3)
    mesh_m: Range = (25e-3, 57e-3)
    diamond_rad: Range = (radians(40), radians(50))
    rotation_rad: Range = (0.0, pi / 2)
    tilt_rad: Range = (0.0, radians(30))
    sag_m: Range = (0.0, 2e-3)
    bend_m: Range = (0.0, 0.6e-3)
    light: Range = (0.5, 1.0)
    ambient: Range = (0.2, 0.5)
    colour_jitter: float = 0.08

    name: ClassVar[str] = "fence"
    limits: ClassVar[Mapping[str, Range]] = {
        "depth_m": DEPTHS_M,
        "wire_m": (1e-5, 0.5),
        "mesh_m": (1e-4, 5.0),
        "sag_m": (0.0, 0.1),
        "bend_m": (0.0, 0.1),
        "diamond_rad": (0.1, 1.47),
        "rotation_rad": (-2 * pi, 2 * pi),
        "tilt_rad": (0.0, 1.2),
        "light": (0.0, 1.0),
        "ambient": (0.0, 1.0),
        "colour_jitter": (0.0, 1.0),
    }

    def __post_init__(self) -> None:
        """Check every parameter, and raise an InputError for one that cannot be meant."""
        several = isinstance(self.patterns, tuple | list) and self.patterns
        if not several or any(pattern not in get_args(Pattern) for pattern in self.patterns):
            rule = f"must be a list of patterns out of {', '.join(get_args(Pattern))}"
            raise InputError(f"{self.name}: patterns", rule, self.patterns, "Name at least one.")
        super().__post_init__()
        if self.mesh_m[0] <= self.wire_m[1]:
            rule = f"must be wider than the widest wire, {self.wire_m[1]:g} m"
            raise InputError(f"{self.name}: mesh_m", rule, self.mesh_m, "Give a wider mesh or a thinner wire.")

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one fence, or raise an InputError where the view is too wide for the tilt."""
        view.require(background)
        pattern = self.patterns[rng.integers(len(self.patterns))]
        depth_m, wire_m, mesh_m = (draw_from(rng, given) for given in (self.depth_m, self.wire_m, self.mesh_m))
        plane = tilted_plane(view, depth_m, draw_from(rng, self.tilt_rad), rng.uniform(0, 2 * pi))
        plane = self.bent(rng, view, plane, mesh_m)
        rotation, mirrored = draw_from(rng, self.rotation_rad), bool(rng.integers(2))
        c, s = np.float32(cos(rotation)), np.float32(sin(rotation))
        u, v = c * plane.u + s * plane.v, c * plane.v - s * plane.u
        plane = plane._replace(u=-u if mirrored else u, v=v)
        diamond, row, column = draw_from(rng, self.diamond_rad), *(int(rng.integers(n)) for n in view.shape)
        wire_u, wire_v = on_a_wire(pattern, mesh_m, diamond, wire_m, rng.uniform(-0.5, 0.5))
        # A wire runs through a random pixel, so that no frame falls into a gap.
        u, v = (
            plane.u + (np.float32(wire_u) - plane.u[row, column]),
            plane.v + (np.float32(wire_v) - plane.v[row, column]),
        )
        if pattern == "chain_link":
            wires = zigzags(u, v, mesh_m, diamond, wire_m)
        else:
            wires = (rods(u, mesh_m, along_u=False), rods(v, mesh_m, along_u=True))[: 1 if pattern == "bars" else 2]
        lamp = self.lamp(rng)
        mask = np.zeros(view.shape, np.float32)
        shade = np.zeros(view.shape, np.float32)
        for family in wires:
            cover, light = seen(family, plane, wire_m, lamp)
            mask, shade = cover + (1 - cover) * mask, cover * light + (1 - cover) * shade
        finish = np.array(_FINISHES[rng.integers(len(_FINISHES))])
        colour = (finish * (1 + self.colour_jitter * rng.uniform(-1, 1, 3))).astype(np.float32)
        # The light of what covers a pixel, not that times its coverage.
        bare = np.where(mask > 1e-6, shade / np.maximum(mask, 1e-6), 0)
        stain = 1 + 0.4 * layered_noise(rng, view.shape, max(view.pixels(3 * wire_m, depth_m), 2.0), octaves=3)
        return Obstruction(mask, np.clip(colour[:, None, None] * (bare * stain), 0, 1), depth_m)

    def bent(self, rng: np.random.Generator, view: CameraView, plane: "_Plane", mesh_m: float) -> "_Plane":
        """Move the wires off their places, slowly varying over the frame."""
        moved = [plane.u, plane.v]
        for given, meshes in ((self.sag_m, 4), (self.bend_m, 1)):
            rms_m = draw_from(rng, given)
            cell = max(meshes * mesh_m / plane.pixel_m, 2.0)
            for axis in range(2):
                noise = layered_noise(rng, view.shape, cell)
                if rms_m:
                    moved[axis] = moved[axis] + np.float32(rms_m / _NOISE_RMS) * noise
        return plane._replace(u=moved[0], v=moved[1])

    def lamp(self, rng: np.random.Generator) -> "_Lamp":
        """Draw a light from above, before or behind the fence."""
        azimuth, toward = rng.uniform(0, pi), rng.uniform(-0.2, 0.9)
        across = (1 - toward**2) ** 0.5
        strength, ambient = draw_from(rng, self.light), draw_from(rng, self.ambient)
        return _Lamp(across * sin(azimuth), across * cos(azimuth), toward, strength, ambient)


class _Plane(NamedTuple):
    """Where every pixel's direction meets the fence: (u, v) in the plane in metres.

    `away` is the distance along the axis over that of the plane's middle, `pixel_m` a pixel's width there.
    """

    u: Pixels
    v: Pixels
    away: Pixels
    pixel_m: float


class _Wires(NamedTuple):
    """Wires that do not cross: every pixel's signed distance from the nearest (metres), and its gradient by u and v."""

    off: Pixels
    normal_u: float
    normal_v: float | Pixels


class _Lamp(NamedTuple):
    """Direction towards the light (y up, x, and towards the camera), its strength, and the share from all round."""

    y: float
    x: float
    toward: float
    strength: float
    ambient: float


def tilted_plane(view: CameraView, depth_m: float, tilt_rad: float, towards_rad: float) -> _Plane:
    """Meet every pixel's direction with a plane through the axis at `depth_m`; u runs along +x and v along +y.

    It is tilted nearer in the direction `towards_rad`, from +x to +y; an InputError for a view too wide for that.
    """
    y, x = view.slopes()
    along, across = x * cos(towards_rad) + y * sin(towards_rad), y * cos(towards_rad) - x * sin(towards_rad)
    # Where the ray (along, across, 1) t meets the plane z = depth - along tan(tilt).
    nearness = 1 + along * np.float32(tan(tilt_rad))
    if nearness.min() < 0.1:
        rule = "must keep the whole frame's fence before the lens, within ten times its distance"
        raise InputError(f"{Fence.name}: tilt_rad", rule, f"{tilt_rad:g} in this view", "Give a smaller one.")
    away = 1 / nearness
    u, v = along * away * np.float32(depth_m / cos(tilt_rad)), across * away * np.float32(depth_m)
    u, v = u * cos(towards_rad) - v * sin(towards_rad), u * sin(towards_rad) + v * cos(towards_rad)
    return _Plane(u, v, away, view.pixel_at_m(depth_m))


def rods(across: Pixels, mesh_m: float, *, along_u: bool) -> _Wires:
    """Straight wires at equal distances; `across` is the coordinate across them, metres."""
    off = across - np.float32(mesh_m) * np.round(across / np.float32(mesh_m))
    return _Wires(off, 0.0 if along_u else 1.0, 1.0 if along_u else 0.0)


def on_a_wire(pattern: Pattern, mesh_m: float, diamond_rad: float, wire_m: float, place: float) -> tuple[float, float]:
    """A point (u, v) of a wire's centre line, at `place` from -1/2 to 1/2 of its way from bend to bend."""
    if pattern != "chain_link":
        return 0.0, place * mesh_m
    half, reach = _piece(mesh_m, diamond_rad, wire_m)
    return place * reach, (0.5 + place) * half


def _piece(mesh_m: float, diamond_rad: float, wire_m: float) -> tuple[float, float]:
    """Extent along v and u of a zigzag's straight piece: half a period, and to a wire beyond the neighbour's bend."""
    return mesh_m / (2 * sin(diamond_rad)), mesh_m / (2 * cos(diamond_rad)) + wire_m


def zigzags(u: Pixels, v: Pixels, mesh_m: float, diamond_rad: float, wire_m: float) -> tuple[_Wires, _Wires]:
    """Wires of a chain-link fence, running along v: every other one, and those between.

    A zigzag is its own mirror image about every bend, so v is folded there and one straight piece is left. Folding
    softly rounds the bends to the radius of a wire. Bends reach past their neighbours' by a wire, as hooks do.
    """
    half, reach = _piece(mesh_m, diamond_rad, wire_m)
    width, period = mesh_m / cos(diamond_rad), 2 * half
    length = (half**2 + reach**2) ** 0.5
    normal = (half / length, -reach / length)
    found = []
    for shift in (0.0, 0.5):
        # Neighbours bend towards each other.
        at = v / np.float32(period) + np.float32(shift)
        lap = at - np.round(at)
        hard = np.abs(lap) * np.float32(period)
        low = np.hypot(hard, np.float32(wire_m / 2))
        high = np.hypot(half - low, np.float32(wire_m / 2))
        folded, steepness = half - high, (hard / low) * (half - low) / high
        side = u - np.float32(width * shift)
        side = side - np.float32(width) * np.round(side / np.float32(width))
        off = np.float32(normal[0]) * side + np.float32(normal[1]) * (folded - np.float32(half / 2))
        found.append(_Wires(off, normal[0], np.float32(normal[1]) * steepness * np.sign(lap)))
    return found[0], found[1]


def seen(wires: _Wires, plane: _Plane, wire_m: float, lamp: _Lamp) -> tuple[Pixels, Pixels]:
    """Coverage and light of a family of wires.

    Distances are turned into pixels by the gradient of the distance over the frame, which is that of the plane's
    coordinates across the wire; the diameter by eq. 11 at the wire's own distance.
    """
    (u_y, u_x), (v_y, v_x) = np.gradient(plane.u), np.gradient(plane.v)
    slope_y = wires.normal_u * u_y + wires.normal_v * v_y
    slope_x = wires.normal_u * u_x + wires.normal_v * v_x
    slope = np.maximum(np.hypot(slope_y, slope_x), np.float32(1e-9))
    off = wires.off / slope
    half = np.float32(wire_m / (2 * plane.pixel_m)) / plane.away
    cover = np.clip(np.minimum(off + 0.5, half) - np.maximum(off - 0.5, -half), 0, 1)
    across = np.clip(off / half, -1, 1)
    # The camera sees the half of the cylinder that faces it.
    facing = across * (slope_y * lamp.y + slope_x * lamp.x) / slope + np.sqrt(1 - across**2) * lamp.toward
    light = lamp.strength * (lamp.ambient + (1 - lamp.ambient) * np.maximum(facing, 0))
    return cover.astype(np.float32), light.astype(np.float32)
