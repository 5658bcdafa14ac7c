"""Dirt, raindrops or a fence, one to a scene: for a network that is to know all three."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from sim.imaging.scene import Obstruction
from sim.obstruction.dirt import Dirt
from sim.obstruction.fence import Fence
from sim.obstruction.parameters import ObstructionKind, Range, WithLimits
from sim.obstruction.raindrop import Raindrop
from sim.obstruction.view import CameraView


@dataclass(frozen=True)
class DirtRaindropFence(WithLimits):
    """Dirt, raindrops or a fence.

    Attributes:
        dirt: the dirt.
        raindrop: the drops.
        fence: the fence.
        dirt_share: how often it is dirt.
        raindrop_share: how often it is drops; otherwise it is a fence.
    """

    dirt: Dirt = field(default_factory=Dirt)
    raindrop: Raindrop = field(default_factory=Raindrop)
    fence: Fence = field(default_factory=Fence)
    dirt_share: float = 1 / 3
    raindrop_share: float = 1 / 3

    name: ClassVar[str] = "dirt_raindrop_fence"
    limits: ClassVar[Mapping[str, Range]] = {"dirt_share": (0.0, 1.0), "raindrop_share": (0.0, 1.0)}

    def __post_init__(self) -> None:
        """Check the shares, which leave the rest to fences; raise an InputError."""
        super().__post_init__()
        if self.dirt_share + self.raindrop_share > 1:
            rule, got = "shares must add up to at most 1", f"{self.dirt_share:g} and {self.raindrop_share:g}"
            raise InputError(f"{self.name}: raindrop_share", rule, got, "Lower one of them; fences get the rest.")

    @property
    def parts(self) -> tuple[tuple[float, ObstructionKind], ...]:
        """The kinds that it is by lot, each with how often."""
        rest = max(1 - self.dirt_share - self.raindrop_share, 0.0)
        return (self.dirt_share, self.dirt), (self.raindrop_share, self.raindrop), (rest, self.fence)

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Cast lots and draw (see `sim.obstruction.parameters.ObstructionKind`)."""
        lot = rng.uniform()
        rest = self.raindrop if lot < self.dirt_share + self.raindrop_share else self.fence
        kind = self.dirt if lot < self.dirt_share else rest
        return kind.draw(rng, view, background)
