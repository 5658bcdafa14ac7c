"""Dirt and soil on a cover glass or a windshield: clumps cut from filtered noise.

The paper (section 3.2): Perlin noise, low-pass filtered with a Gaussian, cut at a random threshold, in a random soil
colour, at 5 to 12 cm. Here every length is one of the dirt itself, so its picture grows as it comes nearer (eq. 11).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from sim.imaging.scene import Obstruction
from sim.obstruction.noise import layered_noise
from sim.obstruction.parameters import DEPTHS_M, Range, WithLimits, draw_from
from sim.obstruction.view import CameraView

# Reflectance in linear sRGB of three Munsell soil colours, from the renotation data (Newhall, Nickerson and Judd 1943;
# xyY under illuminant C, Y over that of a perfect white), adapted to D65 by Bradford's transform.
SOILS = {
    "10YR 3/2": (0.0890, 0.0594, 0.0356),  # very dark greyish brown, as wet topsoil
    "7.5YR 4/4": (0.2019, 0.0993, 0.0426),  # brown, as clay
    "10YR 5/4": (0.2884, 0.1762, 0.0776),  # yellowish brown, as dry loam
}


@dataclass(frozen=True)
class Dirt(WithLimits):
    """Clumps of soil. Lengths are those of the dirt itself, in metres; a range is drawn from uniformly.

    Attributes:
        depth_m: distance of the glass; the paper's 5 to 12 cm.
        clump_m: width of the widest noise cells, about the distance of two clumps; the clumps themselves are about 0.6
            of it wide. The public release's cells come out at 3.55 mm whatever the distance.
        octaves: scales of noise, each half the one before; the small ones make edges ragged.
        persistence: amplitude of a scale over that of the one before.
        blur_m: sigma of the Gaussian low-pass (an estimate: the paper gives none).
        coverage: share of the frame above the threshold. The random threshold is chosen through the share, so that no
            draw is empty or covers all (an estimate).
        edge_m: length over which the layer thickens from its edge inward to 63 % of its opacity (an estimate).
        opacity: greatest share of light a clump keeps off.
        light: light on the side that the camera sees, over that on a white of the scene; below 1, for a glass seen from
            within is lit from behind (an estimate).
        colour_jitter: largest change that is added to each colour's linear reflectance, either way.
        grain: rms of the texture of the soil, relative.
    """

    depth_m: Range = (0.05, 0.12)
    clump_m: Range = (2.5e-3, 4.5e-3)
    octaves: int = 5
    persistence: float = 0.5
    blur_m: Range = (30e-6, 150e-6)
    coverage: Range = (0.1, 0.4)
    edge_m: Range = (30e-6, 150e-6)
    opacity: Range = (0.9, 1.0)
    light: Range = (0.3, 1.0)
    colour_jitter: float = 0.015
    grain: float = 0.2

    name: ClassVar[str] = "dirt"
    limits: ClassVar[Mapping[str, Range]] = {
        "depth_m": DEPTHS_M,
        "clump_m": (10e-6, 0.1),
        "blur_m": (0.0, 0.01),
        "edge_m": (0.0, 0.01),
        "coverage": (0.001, 0.999),
        "opacity": (0.0, 1.0),
        "light": (0.0, 1.0),
        "octaves": (1, 10),
        "persistence": (0.0, 1.0),
        "colour_jitter": (0.0, 1.0),
        "grain": (0.0, 1.0),
    }

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one dirty glass."""
        view.require(background)
        depth_m = draw_from(rng, self.depth_m)
        cell, blur, edge = (
            view.pixels(draw_from(rng, given), depth_m) for given in (self.clump_m, self.blur_m, self.edge_m)
        )
        field = layered_noise(rng, view.shape, cell, octaves=self.octaves, persistence=self.persistence, blur=blur)
        mask = layer(field, draw_from(rng, self.coverage), edge) * np.float32(draw_from(rng, self.opacity))
        texture = layered_noise(rng, view.shape, cell / 3, octaves=5, persistence=0.7)
        grain = 1 + self.grain * (texture / max(float(np.std(texture)), 1e-12))
        radiance = np.clip(self.soil(rng)[:, None, None] * grain, 0, 1)
        return Obstruction(mask, radiance, depth_m)

    def soil(self, rng: np.random.Generator) -> Float[np.ndarray, " c"]:
        """Linear light of a random soil in a random light, float32."""
        colour = np.array(list(SOILS.values())[rng.integers(len(SOILS))]) + self.colour_jitter * rng.uniform(-1, 1, 3)
        return (np.maximum(colour, 0.005) * draw_from(rng, self.light)).astype(np.float32)


def layer(field: Float[np.ndarray, "y x"], coverage: float, edge: float) -> Float[np.ndarray, "y x"]:
    """Opacity 1 - exp(-d / edge), float32, at about `d` pixels inside the share `coverage` where a field is highest.

    An edge of less than half a pixel counts as that, which keeps it smooth.
    """
    threshold = np.quantile(field, 1 - coverage)
    slope = np.sqrt(np.mean(np.square(np.diff(field, axis=0))) + np.mean(np.square(np.diff(field, axis=1))))
    inward = np.maximum(field - np.float32(threshold), 0) / np.float32(max(slope, 1e-12) * max(edge, 0.5))
    return -np.expm1(-inward)
