"""Parts that rivals share: what they are asked and answer, blocks, ways up and down, holes.

Channels stand last, pictures are display values (sRGB), 0 to 1, and a mask is the share of each pixel that is blocked.
A pixel is known where its mask is below one half, which is where scores count it as not occluded
(`doedesign.training.scores`).
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.recon.conv import doubled
from doedesign.recon.network import Block, normalised, shrunk

LEAK = 0.01
# Of what leaves a network, and of the branch of a residual block: both begin as small corrections.
QUIET = 0.1


class Answer(NamedTuple):
    """A rival's answer: the picture `[b, y, x, c]`, display values, and what its own loss looks at, by name."""

    picture: Float[Array, "b y x c"]
    extras: Mapping[str, Any]


class RivalNetwork(eqx.Module):
    """A network to compare with; subclasses have a class method `make(colours, seed, width)` that draws one.

    Attributes:
        colours: channels of a picture.
        width: features of its finest scale.
        multiple: divisor of the sides of a picture; the least side is twice that.
    """

    colours: int = eqx.field(static=True)
    width: int = eqx.field(static=True)

    multiple: ClassVar[int]

    @property
    def layout(self) -> dict[str, Any]:
        """Arguments of `make`, but for the seed, that give a network of this shape; JSON can say them."""
        return {"colours": self.colours, "width": self.width}

    @abstractmethod
    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Answer pictures with their masks; ValueError for another number of colours or sides that do not fit."""

    def loss(self, answer: Answer, reference: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Float[Array, ""]:
        """Terms of its own beside the loss of training, weighted, a mean over the batch; none by default.

        Args:
            answer: what it answered.
            reference: what should have been seen, display values.
            mask: the true mask, also where the network was not given it.
        """
        del answer, reference, mask
        return jnp.float32(0)

    def require_fits(self, picture: Float[Array, "b y x c"]) -> None:
        """Raise ValueError for pictures of another number of colours, or with sides that `multiple` does not divide."""
        if picture.shape[3] != self.colours:
            raise ValueError(f"`picture` must have {self.colours} colours, but got {picture.shape[3]}")
        if any(side % self.multiple or side < 2 * self.multiple for side in picture.shape[1:3]):
            rule = f"sides of `picture` must be multiples of {self.multiple}, at least {2 * self.multiple}"
            raise ValueError(f"{rule}, but got {picture.shape[1:3]}")


def count_of(tree: Any) -> int:
    """Count the numbers that are learnt."""
    return sum(int(leaf.size) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)))


def known_of(mask: Float[Array, "b y x"]) -> Float[Array, "b y x 1"]:
    """Tell known pixels, 1, from those of the hole, 0."""
    return (mask < 0.5).astype(jnp.float32)[..., None]


def pasted(
    found: Float[Array, "b y x c"], picture: Float[Array, "b y x c"], known: Float[Array, "b y x 1"]
) -> Float[Array, "b y x c"]:
    """The picture itself where it is known, and what was found elsewhere."""
    return jnp.where(known > 0.5, picture, found)


def leaky(image: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Leaky ReLU, as of `doedesign.recon.network.Block`."""
    return jax.nn.leaky_relu(image, LEAK)


def pooled(image: Float[Array, "b y x c"]) -> Float[Array, "b v u c"]:
    """Largest of every two by two pixels."""
    b, y, x, c = image.shape
    return image.reshape(b, y // 2, 2, x // 2, 2, c).max(axis=(2, 4))


def widened(image: Float[Array, "b y x c"], factor: int) -> Float[Array, "b v u c"]:
    """Every pixel as `factor` by `factor` equal ones."""
    return jnp.repeat(jnp.repeat(image, factor, axis=1), factor, axis=2)


def smoothly_doubled(image: Float[Array, "b y x c"]) -> Float[Array, "b v u c"]:
    """Twice the sides, between pixels on straight lines."""
    b, y, x, c = image.shape
    return jax.image.resize(image, (b, 2 * y, 2 * x, c), "linear")


def cross_entropy(logit: Float[Array, "*s"], share: Float[Array, "*s"]) -> Float[Array, ""]:
    """Mean cross-entropy of a logistic guess with a share of 0 to 1."""
    return jnp.mean(jax.nn.softplus(logit) - share * logit)


class Residual(eqx.Module):
    """A residual block: its input, and a small correction of it from two convolutions.

    The first is normalised, the second is not, so that the sum keeps how bright a place is.
    """

    first: Block
    second: Block

    @classmethod
    def make(cls, rng: np.random.Generator, width: int) -> "Residual":
        """Draw one."""
        first = Block.make(rng, width, width)
        return cls(first, Block.make(rng, width, width, normal=False, act=False, gain=QUIET))

    def __call__(self, image: Float[Array, "b y x c"]) -> Float[Array, "b y x c"]:
        """Apply the block."""
        return image + self.second(self.first(image))


class Rise(eqx.Module):
    """From one scale to the next finer one: a transposed convolution, joined with what stands beside, if anything."""

    weights: Float[Array, "i 2 2 o"]
    joins: tuple[Block, ...]
    normal: bool = eqx.field(static=True)

    @classmethod
    def make(
        cls, rng: np.random.Generator, coarse: int, beside: int, fine: int, *, normal: bool = True, blocks: int = 1
    ) -> "Rise":
        """Draw one from `coarse` features to `fine` ones with `beside` beside them, and so many blocks."""
        weights = (rng.standard_normal((coarse, 2, 2, fine)) / np.sqrt(coarse)).astype(np.float32)
        inputs = [fine + beside] + [fine] * (blocks - 1)
        return cls(jnp.asarray(weights), tuple(Block.make(rng, i, fine, normal=normal) for i in inputs), normal)

    def __call__(self, image: Float[Array, "b y x i"], *beside: Float[Array, "b v u k"]) -> Float[Array, "b v u o"]:
        """Go up by one scale."""
        risen = doubled(image, self.weights)
        found = jnp.concatenate([leaky(normalised(risen) if self.normal else risen), *beside], axis=-1)
        for block in self.joins:
            found = block(found)
        return found


class UnetTrunk(eqx.Module):
    """A U-Net without its last layer: two convolutions at every scale, the largest of four pixels on the way down.

    The finest scale goes without normalisation, as in `doedesign.recon.network`: it alone knows how bright a place is.
    """

    down: tuple[tuple[Block, Block], ...]
    up: tuple[Rise, ...]

    @classmethod
    def make(cls, rng: np.random.Generator, inputs: int, widths: Sequence[int]) -> "UnetTrunk":
        """Draw one with so many features at every scale, the finest first."""
        down = []
        for level, (before, wide) in enumerate(zip((inputs, *widths), widths, strict=False)):
            normal = level > 0
            down.append((Block.make(rng, before, wide, normal=normal), Block.make(rng, wide, wide, normal=normal)))
        up = [
            Rise.make(rng, widths[level + 1], widths[level], widths[level], normal=level > 0, blocks=2)
            for level in reversed(range(len(widths) - 1))
        ]
        return cls(tuple(down), tuple(up))

    def __call__(self, image: Float[Array, "b y x i"]) -> Float[Array, "b y x o"]:
        """Features of the finest scale."""
        skips = []
        for level, blocks in enumerate(self.down):
            image = pooled(image) if level else image
            for block in blocks:
                image = block(image)
            skips.append(image)
        image = skips.pop()
        for rise in self.up:
            image = rise(image, skips.pop())
        return image


def halved(image: Float[Array, "b y x c"]) -> Float[Array, "b v u c"]:
    """Means of every two by two pixels."""
    return shrunk(image, 2)
