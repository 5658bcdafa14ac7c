"""A network that fills holes by fast Fourier convolutions, whose every layer sees the whole picture.

After R. Suvorov et al., "Resolution-robust large mask inpainting with Fourier convolutions" (LaMa), WACV 2022, and L.
Chi, B. Jiang, Y. Mu, "Fast Fourier convolution", NeurIPS 2020. Besides its size it differs in that it is trained by the
loss of all other networks here, without an adversary and without a perceptual loss of a wide view, and that features
are normalised within residual branches alone.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import (
    QUIET,
    Answer,
    Rise,
    RivalNetwork,
    known_of,
    leaky,
    pasted,
)
from doedesign.recon.conv import convolution
from doedesign.recon.network import Block, normalised

_BLOCKS = 6
_GLOBAL_SHARE = 0.75  # of the features, as in the paper


class Spectral(eqx.Module):
    """The global branch: a layer on the spectrum of half the features, between two on pixels.

    Frequencies are those of the picture's own frame, so that one layer serves pictures of any size.
    """

    narrow: Block
    spectrum: Block
    widen: Block

    @classmethod
    def make(cls, rng: np.random.Generator, width: int) -> "Spectral":
        """Draw one for an even number of features."""
        half = width // 2
        return cls(
            Block.make(rng, width, half, 1, normal=False),
            Block.make(rng, 2 * half, 2 * half, 1, normal=False),
            Block.make(rng, half, width, 1, normal=False, act=False),
        )

    def __call__(self, image: Float[Array, "b y x c"]) -> Float[Array, "b y x c"]:
        """Apply the branch."""
        narrow = self.narrow(image)
        waves = jnp.fft.rfft2(narrow, axes=(1, 2), norm="ortho")
        waves = self.spectrum(jnp.concatenate([waves.real, waves.imag], axis=-1))
        real, imaginary = jnp.split(waves, 2, axis=-1)
        shape = (narrow.shape[1], narrow.shape[2])
        back = jnp.fft.irfft2(real + 1j * imaginary, shape, axes=(1, 2), norm="ortho")
        return self.widen(narrow + back)


class FourierConvolution(eqx.Module):
    """A fast Fourier convolution: local and global features, each made of both; only the last path is spectral.

    Weights of the local paths are `[y, x, input, output]`.
    """

    local_from_local: Float[Array, "3 3 l l"]
    local_from_global: Float[Array, "3 3 g l"]
    global_from_local: Float[Array, "3 3 l g"]
    spectral: Spectral

    @classmethod
    def make(cls, rng: np.random.Generator, narrow: int, wide: int, gain: float = 1.0) -> "FourierConvolution":
        """Draw one for so many local and global features."""

        def drawn(inputs: int, outputs: int) -> Array:
            return Block.make(rng, inputs, outputs, gain=gain).weights

        spectral = Spectral.make(rng, wide)
        spectral = eqx.tree_at(lambda s: s.widen.weights, spectral, replace_fn=lambda w: gain * w)
        return cls(drawn(narrow, narrow), drawn(wide, narrow), drawn(narrow, wide), spectral)

    def __call__(self, narrow: Float[Array, "b y x l"], wide: Float[Array, "b y x g"]) -> tuple[Array, Array]:
        """Local and global features; neither is normalised."""
        local = convolution(narrow, self.local_from_local) + convolution(wide, self.local_from_global)
        return local, convolution(narrow, self.global_from_local) + self.spectral(wide)


class FourierResidual(eqx.Module):
    """A residual block of two Fourier convolutions."""

    first: FourierConvolution
    second: FourierConvolution

    @classmethod
    def make(cls, rng: np.random.Generator, narrow: int, wide: int) -> "FourierResidual":
        """Draw one for so many local and global features."""
        first = FourierConvolution.make(rng, narrow, wide)
        return cls(first, FourierConvolution.make(rng, narrow, wide, QUIET))

    def __call__(self, narrow: Float[Array, "b y x l"], wide: Float[Array, "b y x g"]) -> tuple[Array, Array]:
        """Apply the block."""
        inner = (leaky(normalised(part)) for part in self.first(narrow, wide))
        local, spectral = self.second(*inner)
        return narrow + local, wide + spectral


class FourierInpainting(RivalNetwork):
    """A network of Fourier convolutions at a quarter of the resolution. `FourierInpainting.make` draws one."""

    stem: tuple[Block, ...]
    residual: tuple[FourierResidual, ...]
    up: tuple[Rise, ...]
    head: Block

    multiple: ClassVar[int] = 4

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 24) -> "FourierInpainting":
        """Draw one.

        Args:
            colours: channels of a picture.
            seed: seed of its weights.
            width: features at full resolution, an even number; at a quarter of it there are four times as many.
        """
        rng, deep = np.random.default_rng(seed), 4 * width
        wide = 2 * round(_GLOBAL_SHARE * deep / 2)
        stem = (
            Block.make(rng, colours + 1, width, 5, normal=False),
            Block.make(rng, width, 2 * width, 3, 2, normal=False),
            Block.make(rng, 2 * width, deep, 3, 2, normal=False),
        )
        residual = tuple(FourierResidual.make(rng, deep - wide, wide) for _ in range(_BLOCKS))
        up = (
            Rise.make(rng, deep, 0, 2 * width, normal=False),
            Rise.make(rng, 2 * width, 0, width, normal=False),
        )
        head = Block.make(rng, width, colours, 5, normal=False, act=False)
        return cls(colours, width, stem, residual, up, head)

    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Fill the hole of a picture; what the picture holds there is not looked at."""
        self.require_fits(picture)
        known = known_of(mask)
        # About zero, so that the hole is a grey and not the darkest of all pictures.
        image = jnp.concatenate([(picture - 0.5) * known, 1 - known], axis=-1)
        for block in self.stem:
            image = block(image)
        count = self.residual[0].first.local_from_local.shape[3]
        narrow, wide = image[..., :count], image[..., count:]
        for block in self.residual:
            narrow, wide = block(narrow, wide)
        image = jnp.concatenate([narrow, wide], axis=-1)
        for rise in self.up:
            image = rise(image)
        return Answer(pasted(0.5 + QUIET * self.head(image), picture, known), {})
