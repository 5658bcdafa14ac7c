"""A network that looks for drops in rounds, and repairs what its attention found.

After R. Qian, R. T. Tan, W. Yang, J. Su, J. Liu, "Attentive generative adversarial network for raindrop removal from a
single image" (AttentiveGAN), CVPR 2018: a recurrent network with a memory makes one map of attention after the other,
all of them supervised by the mask; an autoencoder sees the last of them beside the picture and answers at three
scales, and an adversary looks where the attention does (`doedesign.evaluation.rivals.adversary.AttentiveJudge`).

Besides its size it differs in that attention has half the resolution, that the middle of the autoencoder is a scale
further down instead of dilated, that the answer is the difference from the picture, and that the rounds begin at the
given mask, as the paper's comparison hands it out, and not at a half everywhere. (Hand it one half to have it without.)
"""

import itertools
from typing import ClassVar

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
    cross_entropy,
    halved,
    smoothly_doubled,
)
from doedesign.recon.network import Block

_ROUNDS = 4
_FADING = 0.8  # of the weight of a round's attention from one round to the one before, as in the paper
_ATTENTION_WEIGHT, _SCALE_WEIGHT = 0.1, 0.5


class Memory(eqx.Module):
    """A convolutional LSTM: four gates of a convolution that sees the features and the last output."""

    gates: Block

    def __call__(
        self, image: Float[Array, "b y x w"], shown: Float[Array, "b y x w"], kept: Float[Array, "b y x w"]
    ) -> tuple[Array, Array]:
        """The next output, and what is kept."""
        found = self.gates(jnp.concatenate([image, shown], axis=-1))
        take, forget, new, show = jnp.split(found, 4, axis=-1)
        # Remembering is the rule: a memory that begins by forgetting has no slopes from earlier rounds.
        kept = jax.nn.sigmoid(forget + 1) * kept + jax.nn.sigmoid(take) * jnp.tanh(new)
        return jax.nn.sigmoid(show) * jnp.tanh(kept), kept


class Attention(eqx.Module):
    """Rounds of looking, at half the resolution; every round sees the picture and the attention of the one before."""

    first: Block
    residual: tuple[Residual, ...]
    memory: Memory
    last: Block

    @classmethod
    def make(cls, rng: np.random.Generator, colours: int, width: int) -> "Attention":
        """Draw one."""
        return cls(
            Block.make(rng, colours + 1, width, normal=False),
            tuple(Residual.make(rng, width) for _ in range(2)),
            Memory(Block.make(rng, 2 * width, 4 * width, normal=False, act=False)),
            Block.make(rng, width, 1, normal=False, act=False),
        )

    def __call__(self, picture: Float[Array, "b y x c"], start: Float[Array, "b y x 1"]) -> Float[Array, "r b y x 1"]:
        """Logits of the attention after every round, from what it begins at, 0 to 1."""
        shown = kept = jnp.zeros((*picture.shape[:3], self.last.weights.shape[2]))
        seen, logits = start, []
        for _ in range(_ROUNDS):
            image = self.first(jnp.concatenate([picture, seen], axis=-1))
            for block in self.residual:
                image = block(image)
            shown, kept = self.memory(image, shown, kept)
            logits.append(self.last(shown))
            seen = jax.nn.sigmoid(logits[-1])
        return jnp.stack(logits)


class AttentiveDropRemoval(RivalNetwork):
    """Recurrent attention and a contextual autoencoder. `AttentiveDropRemoval.make` draws one.

    Its answer has as extras the logits of all rounds at half the resolution, "attention" `[r, b, y, x, 1]`, and its
    pictures at a quarter and at half of it, "scales".
    """

    attention: Attention
    down: tuple[tuple[Block, ...], ...]
    up: tuple[Rise, ...]
    scale_heads: tuple[Block, Block]
    head: Block

    multiple: ClassVar[int] = 8

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 16) -> "AttentiveDropRemoval":
        """Draw one whose corrections begin near nothing.

        Args:
            colours: channels of a picture.
            seed: seed of its weights.
            width: features of the finest scale and of the attention; further scales have two, four and six times as
                many.
        """
        rng, widths = np.random.default_rng(seed), [width, 2 * width, 4 * width, 6 * width]
        down: list[tuple[Block, ...]] = [(Block.make(rng, colours + 1, width, 5, normal=False),)]
        for before, wide in itertools.pairwise(widths):
            down.append((Block.make(rng, before, wide, 3, 2), Block.make(rng, wide, wide)))
        up = tuple(
            Rise.make(rng, widths[level + 1], widths[level], widths[level], normal=level > 0)
            for level in reversed(range(3))
        )
        heads = [Block.make(rng, wide, colours, 3, normal=False, act=False, gain=QUIET) for wide in widths[2::-1]]
        return cls(colours, width, Attention.make(rng, colours, width), tuple(down), up, (heads[0], heads[1]), heads[2])

    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Remove drops; the rounds of attention begin at the mask."""
        self.require_fits(picture)
        small = halved(picture)
        attention = self.attention(small - 0.5, halved(mask[..., None]))
        seen = smoothly_doubled(jax.nn.sigmoid(attention[-1]))
        image, skips = jnp.concatenate([picture - 0.5, seen], axis=-1), []
        for blocks in self.down:
            for block in blocks:
                image = block(image)
            skips.append(image)
        image, found = skips.pop(), []
        # The coarsest way up ends at a quarter of the resolution, where the first of the pictures is made.
        for rise, head, plain in zip(
            self.up, (*self.scale_heads, self.head), (halved(small), small, picture), strict=True
        ):
            image = rise(image, skips.pop())
            found.append(plain + QUIET * head(image))
        return Answer(found[-1], {"attention": attention, "scales": tuple(found[:-1])})

    def loss(self, answer: Answer, reference: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Float[Array, ""]:
        """Cross-entropy of every round's attention with the mask, later ones weighted more, and errors at two scales.

        Args:
            answer: what it answered.
            reference: what should have been seen, display values.
            mask: the true mask.
        """
        share = halved(mask[..., None])
        rounds = [cross_entropy(logit, share) for logit in answer.extras["attention"]]
        weights = _FADING ** jnp.arange(_ROUNDS - 1, -1, -1)
        attention = jnp.dot(weights, jnp.stack(rounds)) / jnp.sum(weights)
        quarter, half = answer.extras["scales"]
        small = halved(reference)
        scales = jnp.mean(jnp.abs(half - small)) + jnp.mean(jnp.abs(quarter - halved(small)))
        return _ATTENTION_WEIGHT * attention + _SCALE_WEIGHT * scales
