"""A network that fills holes in two streams, texture and structure, each of which is guided by the other.

After X. Guo, H. Yang, D. Huang, "Image inpainting via conditional texture and structure dual generation" (CTSDG), ICCV
2021. Two encoders of partial convolutions (G. Liu et al., "Image inpainting for irregular holes using partial
convolutions", ECCV 2018) see the picture and its edges; each decoder begins at what the other's encoder found, the
features of both are exchanged through gates, and the edges of the structure stream have a loss of their own.

Besides its size it differs in that the aggregation of similar regions, the adversary, and the losses of style and
perception are left out, and that edges are slopes of brightness between 0 and 1 and not lines of Canny's.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import (
    QUIET,
    Answer,
    RivalNetwork,
    cross_entropy,
    known_of,
    leaky,
    pasted,
    smoothly_doubled,
    widened,
)
from doedesign.recon.conv import convolution
from doedesign.recon.network import Block

_FACTORS = (1, 2, 4, 4)  # features of every halving over those of the first
_EDGE_GAIN = 4.0  # a step of a quarter of white from pixel to pixel is a full edge
_EDGE_WEIGHT, _TEXTURE_WEIGHT = 0.1, 0.5


def edges_of(picture: Float[Array, "b y x c"]) -> Float[Array, "b y x 1"]:
    """Edges of a picture: the slope of its mean over colours, 0 to 1."""
    grey = jnp.mean(picture, axis=-1, keepdims=True)
    across = jnp.array([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8
    slopes = convolution(grey, jnp.stack([across, across.T], axis=-1)[:, :, None, :])
    return jnp.minimum(_EDGE_GAIN * jnp.sqrt(jnp.sum(slopes**2, axis=-1, keepdims=True) + 1e-12), 1.0)


def around(known: Float[Array, "b y x 1"], size: int, stride: int) -> Float[Array, "b v u 1"]:
    """Share of a window of `size` pixels that is known, for every output of a convolution with this stride."""
    return convolution(known, jnp.full((size, size, 1, 1), 1.0 / size**2), stride)


class PartialBlock(eqx.Module):
    """A partial convolution: the mean over the known pixels of its window, then a bias and a leaky ReLU."""

    weights: Float[Array, "ky kx i o"]
    bias: Float[Array, " o"]
    stride: int = eqx.field(static=True)

    @classmethod
    def make(
        cls, rng: np.random.Generator, inputs: int, outputs: int, size: int = 3, stride: int = 1
    ) -> "PartialBlock":
        """Draw one."""
        return cls(Block.make(rng, inputs, outputs, size).weights, jnp.zeros(outputs), stride)

    def __call__(self, image: Float[Array, "b y x i"], known: Float[Array, "b y x 1"]) -> tuple[Array, Array]:
        """Features, and where they are known: where any pixel of the window was."""
        share = around(known, self.weights.shape[0], self.stride)
        seen = (share > 1e-6).astype(jnp.float32)
        found = convolution(image * known, self.weights, self.stride) / jnp.maximum(share, 1e-6)
        return leaky(found * seen + self.bias), seen


class PartialJoin(eqx.Module):
    """A way up: twice the sides, what stands beside, and a partial convolution that trusts each as far as known."""

    block: PartialBlock

    def __call__(
        self,
        image: Float[Array, "b y x i"],
        known: Float[Array, "b y x 1"],
        beside: Float[Array, "b v u k"],
        known_beside: Float[Array, "b v u 1"],
    ) -> tuple[Array, Array]:
        """Go up by one scale."""
        risen, trusted = smoothly_doubled(image), widened(known, 2)
        # Each part is masked by its own; the block weighs by either.
        found = jnp.concatenate([risen * trusted, beside * known_beside], axis=-1)
        return self.block(found, jnp.maximum(trusted, known_beside))


class Stream(eqx.Module):
    """One encoder and one decoder."""

    down: tuple[PartialBlock, ...]
    up: tuple[PartialJoin, ...]

    @classmethod
    def make(cls, rng: np.random.Generator, inputs: int, width: int) -> "Stream":
        """Draw one whose finest features are `width`."""
        widths = [width * factor for factor in _FACTORS]
        down = tuple(
            PartialBlock.make(rng, before, wide, 5 if level == 0 else 3, 2)
            for level, (before, wide) in enumerate(zip([inputs, *widths], widths, strict=False))
        )
        beside = [inputs, *widths[:-1]]
        after = [width, *widths[:-1]]
        up = tuple(
            PartialJoin(PartialBlock.make(rng, widths[level] + beside[level], after[level]))
            for level in reversed(range(len(widths)))
        )
        return cls(down, up)

    def encoded(
        self, image: Float[Array, "b y x i"], known: Float[Array, "b y x 1"]
    ) -> list[tuple[Float[Array, "b v u k"], Float[Array, "b v u 1"]]]:
        """The image and its features at every scale, the finest first, with where they are known."""
        found = [(image, known)]
        for block in self.down:
            found.append(block(*found[-1]))
        return found

    def decoded(self, start: tuple[Array, Array], skips: list[tuple[Array, Array]]) -> Float[Array, "b y x w"]:
        """Features of the finest scale, from the deepest ones of the other stream and all others of this."""
        image, known = start
        for join, (beside, known_beside) in zip(self.up, reversed(skips[:-1]), strict=True):
            image, known = join(image, known, beside, known_beside)
        return image


class GatedFusion(eqx.Module):
    """Exchange of features: each stream takes of the other what a gate, which sees both, lets through."""

    to_texture: Block
    to_structure: Block
    shares: Float[Array, "2"]

    @classmethod
    def make(cls, rng: np.random.Generator, width: int) -> "GatedFusion":
        """Draw one."""
        gates = [Block.make(rng, 2 * width, width, normal=False, act=False) for _ in range(2)]
        return cls(gates[0], gates[1], jnp.full(2, 0.5))

    def __call__(self, texture: Float[Array, "b y x w"], structure: Float[Array, "b y x w"]) -> Float[Array, "b y x v"]:
        """Both, one after the other."""
        both = jnp.concatenate([texture, structure], axis=-1)
        more = self.shares[0] * jax.nn.sigmoid(self.to_texture(both)) * structure
        other = self.shares[1] * jax.nn.sigmoid(self.to_structure(both)) * texture
        return jnp.concatenate([texture + more, structure + other], axis=-1)


class TwoStreamInpainting(RivalNetwork):
    """A network of a texture and a structure stream. `TwoStreamInpainting.make` draws one.

    Its answer has as extras the picture of the texture stream alone, "texture", and logits of edges, "edges".
    """

    texture: Stream
    structure: Stream
    texture_head: Block
    edge_head: Block
    fusion: GatedFusion
    last: tuple[Block, ...]

    multiple: ClassVar[int] = 2 ** len(_FACTORS)

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 24) -> "TwoStreamInpainting":
        """Draw one.

        Args:
            colours: channels of a picture.
            seed: seed of its weights.
            width: features at full and at half resolution; coarser scales have two and four times as many.
        """
        rng = np.random.default_rng(seed)
        return cls(
            colours,
            width,
            Stream.make(rng, colours + 1, width),
            Stream.make(rng, 3, width),
            Block.make(rng, width, colours, 1, normal=False, act=False, gain=QUIET),
            Block.make(rng, width, 1, 1, normal=False, act=False),
            GatedFusion.make(rng, width),
            (
                Block.make(rng, 2 * width, width, normal=False),
                Block.make(rng, width, colours, normal=False, act=False),
            ),
        )

    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Fill the hole of a picture; what the picture holds there is not looked at."""
        self.require_fits(picture)
        known = known_of(mask)
        held = (picture - 0.5) * known
        # An edge is known where all pixels are that it is taken from.
        edges = edges_of(held) * (around(known, 3, 1) > 1 - 1e-6)
        # A constant beside the picture: as partial convolutions see no hole, it tells them how much they saw.
        one = jnp.ones_like(known)
        textures = self.texture.encoded(jnp.concatenate([held, one], axis=-1), known)
        grey = jnp.mean(held, axis=-1, keepdims=True)
        structures = self.structure.encoded(jnp.concatenate([edges, grey, one], axis=-1), known)
        texture = self.texture.decoded(structures[-1], textures)
        structure = self.structure.decoded(textures[-1], structures)
        image = self.fusion(texture, structure)
        for block in self.last:
            image = block(image)
        alone = 0.5 + self.texture_head(texture)
        found = pasted(0.5 + QUIET * image, picture, known)
        return Answer(found, {"texture": alone, "edges": self.edge_head(structure)})

    def loss(self, answer: Answer, reference: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Float[Array, ""]:
        """Cross-entropy of the edges, and the mean absolute error of the texture stream alone, each weighted.

        Args:
            answer: what it answered.
            reference: what should have been seen, display values.
            mask: the true mask, which is not needed.
        """
        del mask
        edges = cross_entropy(answer.extras["edges"], edges_of(reference))
        return _EDGE_WEIGHT * edges + _TEXTURE_WEIGHT * jnp.mean(jnp.abs(answer.extras["texture"] - reference))
