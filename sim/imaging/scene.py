"""Scenes: what a camera looks at, in layers of linear light.

A scene is a background and any number of obstructions before it, all drawn in central perspective through the middle
of the aperture: a pixel of the scene is a pixel of the sensor, the direction (y, x) · pixel / focal length from the
middle, upright as it lands there. Light is linear, 1 for a white of the scene; arrays are `[colour, y, x]` with row 0
at the lowest y. What the aperture's width does to these layers is left to `sim.imaging.formation`.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

# A depth may be traced, so that scenes of many depths share one compiled capture and can be stacked for `vmap`.
Depth = float | Float[Array, ""] | Float[np.ndarray, ""]


class Obstruction(eqx.Module):
    """Something near that covers part of the view.

    Attributes:
        mask: `[y, x]` share of a pixel's direction that is blocked, 0 to 1, sharp.
        radiance: `[c, y, x]` linear light it sends where it covers; elsewhere without meaning.
        depth_m: distance from the aperture, metres.
    """

    mask: Float[Array, "y x"] | Float[np.ndarray, "y x"]
    radiance: Float[Array, "c y x"] | Float[np.ndarray, "c y x"]
    depth_m: Depth


class Scene(eqx.Module):
    """A background and the obstructions before it.

    Attributes:
        background: `[c, y, x]` linear light without any obstruction.
        background_depth_m: distance of the background from the aperture, metres; `inf` allowed.
        obstructions: from the farthest to the nearest.
    """

    background: Float[Array, "c y x"] | Float[np.ndarray, "c y x"]
    background_depth_m: Depth
    obstructions: tuple[Obstruction, ...] = ()
