"""A glass that carries one of two things, by the toss of a coin."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from sim.imaging.scene import Obstruction
from sim.obstruction.dirt import Dirt
from sim.obstruction.parameters import Range, WithLimits
from sim.obstruction.raindrop import Raindrop
from sim.obstruction.view import CameraView


@dataclass(frozen=True)
class DirtRaindrop(WithLimits):
    """Dirt or raindrops, as the paper's network for windshields was trained.

    Attributes:
        dirt: the dirt.
        raindrop: the drops.
        dirt_share: how often it is dirt.
    """

    dirt: Dirt = field(default_factory=Dirt)
    raindrop: Raindrop = field(default_factory=Raindrop)
    dirt_share: float = 0.5

    name: ClassVar[str] = "dirt_raindrop"
    limits: ClassVar[Mapping[str, Range]] = {
        "dirt_share": (0.0, 1.0),
    }

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Toss the coin and draw."""
        kind = self.dirt if rng.uniform() < self.dirt_share else self.raindrop
        return kind.draw(rng, view, background)
