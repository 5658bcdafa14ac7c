"""Obstructions with the numbers of the paper's public code, which differ from the paper's text.

Written from those numbers alone, to compare with results that were trained on them. All three have masks of zeros and
ones, and their colours were meant as display values: they are turned into linear light here. Sizes in pixels were
meant for a frame of 512 x 512 behind 8 mm (or 50 mm) of focal length.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from fab.errors import InputError
from fab.units import format_length
from sim.imaging.scene import Obstruction
from sim.light import linear_from_srgb, srgb_from_linear
from sim.obstruction.fence import Fence
from sim.obstruction.noise import gradients, perlin
from sim.obstruction.parameters import DEPTHS_M, Range, WithLimits, draw_from
from sim.obstruction.view import CameraView

_LEAST_PX = 4  # pixels of a cell; of finer ones the tile is larger than memory
_MESHES = (8, 14)  # of the release's fences, in wires
_CELLS = 8  # noise cells along each side of the release's tile
_CELL_M = 64 * 3.7e-6 * 0.12 / 8e-3  # their width on the glass: 64 pixels of 3.7 um at 12 cm behind 8 mm


@dataclass(frozen=True)
class ReleaseDirt(WithLimits):
    """Dirt as in the release: no low-pass, a fixed threshold, and most of it in the middle.

    One scale of noise with cells of 3.55 mm on a tile of 8 x 8 of them, stretched to 0 to 1, emptied below 0.55, faded
    from the middle to the corners of the frame, divided by its largest value, and covering where that exceeds 0.3. The
    colour is (30, 20, 10) of 255 times 1 to 2.5, plus up to 5 either way for each colour, times that value. The paper's
    text has a Gaussian blur and a random threshold instead, and no fading.
    """

    depth_m: Range = (0.05, 0.12)  # distance of the glass; 5 to 12 cm

    name: ClassVar[str] = "release_dirt"
    limits: ClassVar[Mapping[str, Range]] = {"depth_m": DEPTHS_M}

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one dirty glass."""
        view.require(background)
        depth_m = draw_from(rng, self.depth_m)
        if view.pixels(_CELL_M, depth_m) < _LEAST_PX:
            rule = f"must be so near that cells of {format_length(_CELL_M)} have {_LEAST_PX} pixels"
            raise InputError(f"{self.name}: depth_m", rule, format_length(depth_m), "Give a smaller depth.")
        spans = [n / view.pixels(_CELL_M, depth_m) for n in view.shape]
        cells = [max(_CELLS, int(np.ceil(span))) for span in spans]
        lattice = gradients(rng, (cells[0] + 1, cells[1] + 1))
        starts = [rng.uniform(0, n - span) for n, span in zip(cells, spans, strict=True)]
        tile = perlin(lattice, *(np.linspace(0, n, 32 * n, endpoint=False) for n in cells))
        y, x = (a + np.arange(n) * (s / n) for a, s, n in zip(starts, spans, view.shape, strict=True))
        value = (perlin(lattice, y, x) - tile.min()) / np.ptp(tile)
        y, x = ((np.arange(n) - (n - 1) / 2) for n in view.shape)
        radius = np.hypot(y[:, None], x[None, :])
        value = np.where(value > 0.55, value, 0) * (1 - radius / radius.max())
        value = (value / max(float(value.max()), 1e-12)).astype(np.float32)
        mask = (value > 0.3).astype(np.float32)
        colour = np.array([30.0, 20.0, 10.0]) * rng.uniform(1, 2.5) + rng.uniform(-5, 5, 3)
        display = np.clip(colour / 255, 0, 1).astype(np.float32)[:, None, None] * value
        return Obstruction(mask, linear_from_srgb(display), depth_m)


@dataclass(frozen=True)
class ReleaseRaindrop(WithLimits):
    """Raindrops as in the release: a window that magnifies the scene and stays upright.

    Between 5 and 7 drops at 12 cm, fewer in proportion as the glass comes nearer; radius of 1 to 3 mm, but never above
    a twentieth of the frame, which cuts most of them short (all, at 5 cm). Lower half a disc, upper half an ellipse 0.8
    to 1.5 times as high. A drop of r pixels shows a patch 4 r wide and 5 r high, shifted upwards by a tenth of its
    distance from the frame's top, as an equidistant fish-eye lens of focal lengths 30 r and 20 r has it after
    straightening to 1.2 r^(1/3) times these; display values become 0.6 + 1.5 (x - 0.5). A real drop's image is inverted
    and much smaller (`sim.obstruction.raindrop`).
    """

    depth_m: Range = (0.05, 0.12)  # distance of the glass; 5 to 12 cm
    radius_m: Range = (1e-3, 3e-3)  # radius before it is cut short; 1 to 3 mm

    name: ClassVar[str] = "release_raindrop"
    limits: ClassVar[Mapping[str, Range]] = {"depth_m": DEPTHS_M, "radius_m": (1e-5, 0.02)}

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw a glass with drops."""
        view.require(background)
        depth_m = draw_from(rng, self.depth_m)
        display = srgb_from_linear(background.astype(np.float32))
        mask = np.zeros(view.shape, np.float32)
        shown = np.zeros(background.shape, np.float32)
        for _ in range(max(1, int(rng.integers(5, 8) * depth_m / 0.12))):
            radius = int(min(view.pixels(draw_from(rng, self.radius_m), depth_m), max(min(view.shape) // 20, 1)))
            radius, height = max(radius, 1), rng.uniform(0.8, 1.5)
            row, column = (int(rng.integers(n)) for n in view.shape)
            y, x = np.arange(view.shape[0])[:, None] - row, np.arange(view.shape[1])[None, :] - column
            inside = np.hypot(y / np.where(y > 0, height, 1), x) < radius
            rows, columns = np.nonzero(inside)
            at_y, at_x = _fish_eye(rows - row, columns - column, radius)
            # A tenth of the patch's first row, counted from the top of the frame.
            lift = int(0.1 * max(view.shape[0] - 1 - row - 3 * radius, 0))
            at = [row + lift + at_y, column + at_x]
            for colour, seen in zip(display, shown, strict=True):
                patch = map_coordinates(colour, at, order=1, mode="nearest", prefilter=False)
                seen[inside] = np.clip(0.6 + 1.5 * (patch - 0.5), 0, 1)
            mask[inside] = 1
        return Obstruction(mask, linear_from_srgb(shown), depth_m)


def _fish_eye(
    y: Float[np.ndarray, " n"] | np.ndarray, x: np.ndarray, radius: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Where the straightened fish-eye picture of a patch takes its pixels from, pixels from the patch's middle."""
    focal_y, focal_x, wider = 20 * radius, 30 * radius, 1.2 * radius ** (1 / 3)
    slope_y, slope_x = y / (focal_y * wider), x / (focal_x * wider)
    slope = np.maximum(np.hypot(slope_y, slope_x), 1e-12)
    angle = np.arctan(slope) / slope
    return focal_y * slope_y * angle, focal_x * slope_x * angle


@dataclass(frozen=True)
class ReleaseFence(WithLimits):
    """Fences as in the release: wires of 5 to 15 mm where the paper has 4 mm, turned by up to 90 degrees either way.

    The release scales photographed masks that were not published; here `Fence` takes their place, neither tilted nor
    bent, with meshes 8 to 14 wires wide (an estimate). Contrast of the display values changes by up to a fifth.
    """

    depth_m: Range = (0.4, 0.8)  # distance of the fence; 40 to 80 cm
    wire_m: Range = (5e-3, 15e-3)  # diameter of a wire; 5 to 15 mm

    name: ClassVar[str] = "release_fence"
    limits: ClassVar[Mapping[str, Range]] = {
        "depth_m": DEPTHS_M,
        "wire_m": (Fence.limits["mesh_m"][0] / _MESHES[0], 0.1),
    }

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one fence."""
        wire_m, mesh = draw_from(rng, self.wire_m), rng.uniform(*_MESHES)
        fence = Fence(
            depth_m=self.depth_m,
            wire_m=(wire_m, wire_m),
            mesh_m=(mesh * wire_m, mesh * wire_m),
            rotation_rad=(-pi / 2, pi / 2),
            tilt_rad=(0.0, 0.0),
            sag_m=(0.0, 0.0),
            bend_m=(0.0, 0.0),
        )
        drawn = fence.draw(rng, view, background)
        mask = (np.asarray(drawn.mask) > 0.5).astype(np.float32)
        display = srgb_from_linear(np.asarray(drawn.radiance))
        grey = float(display.mean(where=mask > 0)) if mask.any() else 0.0
        display = np.clip(grey + np.float32(rng.uniform(0.8, 1.2)) * (display - np.float32(grey)), 0, 1)
        return Obstruction(mask, linear_from_srgb(display), drawn.depth_m)
