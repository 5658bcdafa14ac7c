"""A network that finds a fence, fills it smoothly, and corrects the filling.

After T. Matsui, M. Ikehara, "Single-image fence removal using deep convolutional neural network" (DefenceNet), IEEE
Access 8, 38846 (2020), as the paper describes it: a U-Net that detects the fence, Gaussian inpainting of what it found,
and a residual network on the result. Besides its size it differs in that the detector sees the picture itself and not
its high frequencies.

In the paper's comparison the true mask fills, `fills = "given"`; the detector is trained all the same. With
`fills = "detected"` the mask is not looked at but in the loss.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import (
    QUIET,
    Answer,
    Residual,
    Rise,
    RivalNetwork,
    UnetTrunk,
    cross_entropy,
    halved,
    smoothly_doubled,
)
from doedesign.recon.network import Block

FILLS = ("given", "detected")

_DETECTOR_SCALES, _BLOCKS = 4, 8
_DETECTION_WEIGHT = 0.1
_LEAST_SHARE = 0.2  # of known pixels that settle a place; fewer are helped by what a coarser scale says


def smoothly_filled(picture: Float[Array, "b y x c"], known: Float[Array, "b y x 1"]) -> Float[Array, "b y x c"]:
    """Fill a hole by weighted means over ever larger surroundings, a bell that is as wide as the hole is.

    Known pixels stay; pixels of a share of 0 to 1 are mixed. Sides are halved as long as they are even.
    """
    return known * picture + (1 - known) * _filling(picture * known, known)


def _filling(weighted: Array, weight: Array) -> Array:
    """Means of surroundings: those of this scale where it knows enough, of coarser ones elsewhere."""
    here = weighted / jnp.maximum(weight, 1e-6)
    _, y, x, _ = weighted.shape
    if y % 2 or x % 2 or min(y, x) < 2:
        mean = jnp.sum(weighted, axis=(1, 2), keepdims=True) / jnp.maximum(
            jnp.sum(weight, axis=(1, 2), keepdims=True), 1e-6
        )
        coarse = jnp.broadcast_to(mean, weighted.shape)
    else:
        coarse = smoothly_doubled(_filling(halved(weighted), halved(weight)))
    trust = jnp.minimum(weight / _LEAST_SHARE, 1.0)
    return trust * here + (1 - trust) * coarse


class FenceRemoval(RivalNetwork):
    """Detection, smooth filling, correction. `FenceRemoval.make` draws one.

    Its answer has as extras the logits of detection, "detection" `[b, y, x]`, and the filled picture, "filled".
    """

    fills: str = eqx.field(static=True)
    detector: UnetTrunk
    detection: Block
    stem: tuple[Block, Block]
    residual: tuple[Residual, ...]
    rise: Rise
    head: Block

    multiple: ClassVar[int] = 2 ** (_DETECTOR_SCALES - 1)

    @property
    def layout(self) -> dict[str, Any]:
        """Arguments of `make`, but for the seed."""
        return {**super().layout, "fills": self.fills}

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 16, fills: str = "given") -> "FenceRemoval":
        """Draw one whose corrections begin near nothing.

        Args:
            colours: channels of a picture.
            seed: seed of its weights.
            width: features at full resolution.
            fills: which mask fills, the given or the detected one.

        Raises:
            ValueError: another word for `fills`.
        """
        if fills not in FILLS:
            raise ValueError(f"`fills` must be one of {', '.join(FILLS)}, but got {fills!r}")
        rng = np.random.default_rng(seed)
        widths = [width * factor for factor in (1, 2, 4, 4)[:_DETECTOR_SCALES]]
        return cls(
            colours,
            width,
            fills,
            UnetTrunk.make(rng, colours, widths),
            Block.make(rng, width, 1, 1, normal=False, act=False),
            (
                Block.make(rng, 2 * colours + 1, width, normal=False),
                Block.make(rng, width, 2 * width, 3, 2, normal=False),
            ),
            tuple(Residual.make(rng, 2 * width) for _ in range(_BLOCKS)),
            Rise.make(rng, 2 * width, width, width, normal=False),
            Block.make(rng, width, colours, normal=False, act=False, gain=QUIET),
        )

    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Remove what the mask that fills covers, and correct the rest: light of a near fence spreads beyond it."""
        self.require_fits(picture)
        logit = self.detection(self.detector(picture))
        hole = mask[..., None] if self.fills == "given" else jax.nn.sigmoid(logit)
        filled = smoothly_filled(picture, 1 - hole)
        first = self.stem[0](jnp.concatenate([filled - 0.5, picture - 0.5, hole], axis=-1))
        image = self.stem[1](first)
        for block in self.residual:
            image = block(image)
        found = filled + QUIET * self.head(self.rise(image, first))
        return Answer(found, {"detection": logit[..., 0], "filled": filled})

    def loss(self, answer: Answer, reference: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Float[Array, ""]:
        """Cross-entropy of the detection with the true mask, weighted.

        Args:
            answer: what it answered.
            reference: what should have been seen, which is not needed.
            mask: the true mask.
        """
        del reference
        return _DETECTION_WEIGHT * cross_entropy(answer.extras["detection"], mask)
