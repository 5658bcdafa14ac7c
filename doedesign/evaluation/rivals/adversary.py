"""Adversaries: networks that learn to tell a rival's pictures from true ones, and whom it is to deceive.

They are made for training and are not kept. None is normalised, so that small pictures do as well; the least side is
32 pixels.
"""

import itertools
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import Answer, halved
from doedesign.recon.network import Block

_ATTENTION_WEIGHT = 0.05  # as in the paper of the attentive network


class Adversary(eqx.Module):
    """A judge of a rival in training; subclasses have a class method `make(colours, seed, width)`."""

    @abstractmethod
    def deception(self, answer: Answer, reference: Float[Array, "b y x c"]) -> Float[Array, ""]:
        """Compute what the rival is to lower: how well its answer is told from true pictures."""

    @abstractmethod
    def error(self, answer: Answer, reference: Float[Array, "b y x c"]) -> Float[Array, ""]:
        """Compute what the adversary is to lower: how badly it tells the answer from true pictures."""


class PatchJudge(eqx.Module):
    """Scores of patches: halvings, then a score of every place that is left, of which differences alone count."""

    blocks: tuple[Block, ...]
    last: Float[Array, " w"]

    @classmethod
    def make(cls, rng: np.random.Generator, colours: int, width: int, halvings: int) -> "PatchJudge":
        """Draw one; features double until there are four times `width`."""
        widths = [colours, *(width * min(2**k, 4) for k in range(halvings))]
        pairs = itertools.pairwise(widths)
        blocks = tuple(Block.make(rng, i, o, 3, 2, normal=False) for i, o in pairs)
        # No bias: none would be learnt.
        return cls(blocks, Block.make(rng, widths[-1], 1, 1).weights[0, 0, :, 0])

    def __call__(self, picture: Float[Array, "b y x c"]) -> Float[Array, "b v u"]:
        """Scores; a patch of three halvings is 15 pixels wide, of five 63."""
        image = picture - 0.5
        for block in self.blocks:
            image = block(image)
        return image @ self.last


class DoubleScaleJudge(Adversary):
    """Two judges, of small patches and of large ones; each compares true pictures with the mean of answers.

    Relativistic average least squares: a true picture is to score one more than answers do on average, and an answer
    one less than true pictures.
    """

    small: PatchJudge
    large: PatchJudge

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 16) -> "DoubleScaleJudge":
        """Draw one.

        Args:
            colours: channels of a picture.
            seed: seed of its weights; others than those of a rival with the same.
            width: features after the first halving.
        """
        rng = np.random.default_rng((seed, 1))
        return cls(PatchJudge.make(rng, colours, width, 3), PatchJudge.make(rng, colours, width, 5))

    def deception(self, answer: Answer, reference: Float[Array, "b y x c"]) -> Float[Array, ""]:
        """Least squares for answers that score one more than true pictures (see `Adversary`)."""
        return self._least_squares(reference, answer.picture)

    def error(self, answer: Answer, reference: Float[Array, "b y x c"]) -> Float[Array, ""]:
        """Least squares for true pictures that score one more than answers (see `Adversary`)."""
        return self._least_squares(answer.picture, reference)

    def _least_squares(self, worse: Array, better: Array) -> Array:
        total = jnp.float32(0)
        for judge in (self.small, self.large):
            low, high = judge(worse), judge(better)
            total += jnp.mean((high - jnp.mean(low) - 1) ** 2) + jnp.mean((low - jnp.mean(high) + 1) ** 2)
        return total / 4


class AttentiveJudge(Adversary):
    """A judge with a map of its own of where it looks: where the rival's attention does; nowhere in true pictures.

    Attributes:
        before: layers down to a quarter of the resolution.
        map: where it looks, logits.
        after: layers on what is seen there.
        last: the scores.
    """

    before: tuple[Block, ...]
    map: Block
    after: tuple[Block, ...]
    last: Block

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 16) -> "AttentiveJudge":
        """Draw one.

        Args:
            colours: channels of a picture.
            seed: seed of its weights; others than those of a rival with the same.
            width: features after the first halving.
        """
        rng = np.random.default_rng((seed, 1))
        return cls(
            (
                Block.make(rng, colours, width, 3, 2, normal=False),
                Block.make(rng, width, 2 * width, 3, 2, normal=False),
                Block.make(rng, 2 * width, 2 * width, normal=False),
            ),
            Block.make(rng, 2 * width, 1, normal=False, act=False),
            (
                Block.make(rng, 2 * width, 4 * width, 3, 2, normal=False),
                Block.make(rng, 4 * width, 4 * width, 3, 2, normal=False),
            ),
            Block.make(rng, 4 * width, 1, 1, normal=False, act=False),
        )

    def deception(self, answer: Answer, reference: Float[Array, "b y x c"]) -> Float[Array, ""]:
        """Cross-entropy of answers that pass for true (see `Adversary`)."""
        del reference
        return jnp.mean(jax.nn.softplus(-self._judged(answer.picture)[0]))

    def error(self, answer: Answer, reference: Float[Array, "b y x c"]) -> Float[Array, ""]:
        """Cross-entropy of telling both, and the error of the map in both (see `Adversary`)."""
        false, seen = self._judged(answer.picture)
        true, nowhere = self._judged(reference)
        attention = halved(jax.nn.sigmoid(answer.extras["attention"][-1]))
        maps = jnp.mean((seen - attention) ** 2) + jnp.mean(nowhere**2)
        return jnp.mean(jax.nn.softplus(false)) + jnp.mean(jax.nn.softplus(-true)) + _ATTENTION_WEIGHT * maps

    def _judged(self, picture: Array) -> tuple[Array, Array]:
        """Scores, and where it looked, 0 to 1."""
        image = picture - 0.5
        for block in self.before:
            image = block(image)
        looked = jax.nn.sigmoid(self.map(image))
        image = image * looked
        for block in self.after:
            image = block(image)
        return self.last(image), looked
