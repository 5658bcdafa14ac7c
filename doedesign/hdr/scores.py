"""Scores of pictures with lamps: mu-law PSNR in the saturated part, PSNR of display values elsewhere.

The saturated part is where the scene itself is brighter than the sensor can hold, colour by colour, so that it is the
same for every camera. Elsewhere counts what light a plate and its undoing cost. The mu-law (N. K. Kalantari and R.
Ramamoorthi, ACM Trans. Graph. 36, 144, 2017, with mu = 5000) compresses light as an eye does:

    T(z) = log(1 + mu z) / log(1 + mu),    z = light / the brightest light of the scene.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sim.light import srgb_from_linear

MU = 5000.0
Picture = Float[np.ndarray, "c y x"]


class HdrScore(NamedTuple):
    """Scores of one reconstruction, dB.

    Attributes:
        lamps: mu-law PSNR in the saturated part.
        elsewhere: PSNR of display values (sRGB) in the rest of the picture.
    """

    lamps: float
    elsewhere: float


def compressed(light: Picture, peak: float, mu: float = MU) -> Picture:
    """Light on the logarithmic scale of the mu-law: 0 for none, 1 for `peak`.

    Args:
        light: light in any unit; what is below 0 counts as 0.
        peak: the brightest light, in the same unit.
        mu: how strongly it is compressed.
    """
    return np.log1p(mu * np.maximum(np.asarray(light, np.float64), 0.0) / peak) / np.log1p(mu)


def judged_light(found: Picture, truth: Picture, saturated: Bool[np.ndarray, "c y x"], mu: float = MU) -> HdrScore:
    """Judge a reconstruction.

    Args:
        found: `[c, y, x]` linear light, white 1.
        truth: light of the scene.
        saturated: where the scene is brighter than the sensor holds.
        mu: compression of the mu-law.

    Returns:
        the scores; NaN where a part is empty, infinite where it is right.

    Raises:
        ValueError: unlike shapes.
    """
    if not found.shape == truth.shape == saturated.shape:
        raise ValueError(f"shapes must be alike, but got {found.shape}, {truth.shape} and {saturated.shape}")
    peak = float(truth.max())
    bright = compressed(found, peak, mu) - compressed(truth, peak, mu)
    shown = srgb_from_linear(np.clip(found, 0, 1)) - srgb_from_linear(np.clip(truth, 0, 1))
    return HdrScore(_psnr(bright[saturated]), _psnr(shown[~saturated]))


def _psnr(error: Float[np.ndarray, " n"]) -> float:
    if not error.size:
        return float("nan")
    squared = float(np.mean(np.square(error, dtype=np.float64)))
    return float("inf") if squared == 0 else -10 * float(np.log10(squared))
