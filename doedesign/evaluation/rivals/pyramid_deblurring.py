"""A network that deblurs by a pyramid of features, judged at two scales in training.

After O. Kupyn, T. Martyniuk, J. Wu, Z. Wang, "DeblurGAN-v2: deblurring (orders-of-magnitude) faster and better", ICCV
2019: five scales of features are brought to one width and added from the coarsest down, all of them together make the
difference from the picture, and a relativistic adversary of two scales judges it
(`doedesign.evaluation.rivals.adversary.DoubleScaleJudge`). Besides its size it differs in that its features are not
those of a network that was trained to recognise objects, and that its loss is that of all other networks here.
"""

import itertools
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import QUIET, Answer, Residual, Rise, RivalNetwork, widened
from doedesign.recon.network import Block

_FACTORS = (1, 2, 4, 6, 8)  # features of every scale over those of the finest


class PyramidDeblurring(RivalNetwork):
    """A feature pyramid. `PyramidDeblurring.make` draws one.

    Attributes:
        stem: into the finest scale.
        down: a halving and a residual block for each further scale.
        beside: layers that bring every scale but the finest to one width, the second finest first.
        maps: a layer on each of these.
        join: what sees all of them together, at a quarter of the resolution.
        up: ways up to half and to full resolution.
        head: the last layer.
    """

    stem: Block
    down: tuple[tuple[Block, Residual], ...]
    beside: tuple[Block, ...]
    maps: tuple[Block, ...]
    join: Block
    up: tuple[Rise, Rise]
    head: Block

    multiple: ClassVar[int] = 2 ** (len(_FACTORS) - 1)

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 16) -> "PyramidDeblurring":
        """Draw one whose corrections begin near nothing.

        Args:
            colours: channels of a picture.
            seed: seed of its weights.
            width: features of the finest scale; the pyramid has twice as many, and the deepest scale eight times.
        """
        rng = np.random.default_rng(seed)
        widths, level = [width * factor for factor in _FACTORS], 2 * width
        down = tuple(
            (Block.make(rng, before, wide, 3, 2), Residual.make(rng, wide))
            for before, wide in itertools.pairwise(widths)
        )
        deep = len(_FACTORS) - 2  # scales that are joined
        return cls(
            colours,
            width,
            Block.make(rng, colours, width, 5, normal=False),
            down,
            tuple(Block.make(rng, wide, level, 1, normal=False, act=False) for wide in widths[1:]),
            tuple(Block.make(rng, level, width) for _ in range(deep)),
            Block.make(rng, deep * width, level),
            (Rise.make(rng, level, level, level), Rise.make(rng, level, width, width, normal=False)),
            Block.make(rng, width, colours, normal=False, act=False, gain=QUIET),
        )

    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Answer pictures; the mask is not looked at."""
        del mask
        self.require_fits(picture)
        finest = image = self.stem(picture - 0.5)
        lateral = []
        for (halving, residual), block in zip(self.down, self.beside, strict=True):
            image = residual(halving(image))
            lateral.append(block(image))
        pyramid = [lateral.pop()]
        while len(lateral) > 1:
            pyramid.append(lateral.pop() + widened(pyramid[-1], 2))
        # All at a quarter of the resolution, the coarsest first.
        factors = [2**k for k in reversed(range(len(pyramid)))]
        seen = [widened(block(each), f) for block, each, f in zip(self.maps, pyramid, factors, strict=True)]
        image = self.join(jnp.concatenate(seen, axis=-1))
        image = self.up[1](self.up[0](image, lateral.pop()), finest)
        return Answer(picture + QUIET * self.head(image), {})
