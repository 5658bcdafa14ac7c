"""The frame of a camera: sizes of near things in pixels (eq. 11), directions of pixels."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class CameraView:
    """A frame of pixels behind a lens, in perspective through the middle of the aperture.

    Attributes:
        shape: pixels (y, x).
        pixel_m: distance of the pixels, metres.
        focal_m: distance of the sensor behind the lens, metres.
    """

    shape: tuple[int, int]
    pixel_m: float
    focal_m: float

    def __post_init__(self) -> None:
        """Raise a ValueError for a frame without area, or a length that is not positive."""
        if len(self.shape) != 2 or not all(isinstance(n, int) and n > 1 for n in self.shape):
            raise ValueError(f"`shape` must be two numbers of pixels, each at least 2, but got {self.shape}")
        for name, value in (("pixel_m", self.pixel_m), ("focal_m", self.focal_m)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"`{name}` must be a positive length, but got {value}")

    def pixels(self, length_m: float, depth_m: float) -> float:
        """Size in pixels of something `length_m` wide at `depth_m`: s f / (z pixel), eq. 11."""
        if not depth_m > 0:
            raise ValueError(f"`depth_m` must be positive, but got {depth_m}")
        return length_m * self.focal_m / (depth_m * self.pixel_m)

    def pixel_at_m(self, depth_m: float) -> float:
        """Width of a pixel's direction at `depth_m`, metres."""
        return 1 / self.pixels(1.0, depth_m)

    def slopes(self) -> tuple[Float[np.ndarray, "y 1"], Float[np.ndarray, "1 x"]]:
        """Tangents (y, x) of every row's and column's direction, float32, zero on the axis."""
        y, x = ((np.arange(n) - (n - 1) / 2) * (self.pixel_m / self.focal_m) for n in self.shape)
        return y[:, None].astype(np.float32), x[None, :].astype(np.float32)

    def require(self, background: Float[np.ndarray, "c y x"]) -> None:
        """Raise a ValueError unless a background fills this frame in red, green and blue."""
        if background.shape != (3, *self.shape):
            raise ValueError(f"`background` must have the shape {(3, *self.shape)}, but got {background.shape}")
