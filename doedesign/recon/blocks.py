"""Blocks of the network: a convolution with its normalisation and activation, and means of an image.

A block is a convolution, an instance normalisation without parameters or a bias, and a leaky ReLU.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.recon.conv import convolution

LEAK = 0.01
# Of what leaves a stage: its last weights begin small, and as Adam moves every weight by as much whatever its slope,
# what hundreds of them add up to has to be made small once more, or the first steps overshoot.
QUIET = 0.1


class Block(eqx.Module):
    """Convolution, instance normalisation or a bias (which a normalisation would take away), leaky ReLU if `act`."""

    weights: Float[Array, "ky kx i o"]
    bias: Float[Array, " o"] | None
    stride: int = eqx.field(static=True, default=1)
    act: bool = eqx.field(static=True, default=True)

    @classmethod
    def make(
        cls,
        rng: np.random.Generator,
        inputs: int,
        outputs: int,
        size: int = 3,
        stride: int = 1,
        *,
        normal: bool = True,
        act: bool = True,
        gain: float = 1.0,
    ) -> "Block":
        """Draw weights of the variance that keeps signals as large as they are (He et al. 2015), times `gain`²."""
        scale = gain * np.sqrt(2 / (1 + LEAK**2) / (inputs * size * size))
        weights = jnp.asarray((scale * rng.standard_normal((size, size, inputs, outputs))).astype(np.float32))
        return cls(weights, None if normal else jnp.zeros(outputs), stride, act)

    def __call__(self, image: Float[Array, "b y x i"], half: bool = False) -> Float[Array, "b v u o"]:
        """Apply the block."""
        found = convolution(image, self.weights, self.stride, half=half)
        found = normalised(found) if self.bias is None else found + self.bias
        return jax.nn.leaky_relu(found, LEAK) if self.act else found


def normalised(image: Float[Array, "b y x c"]) -> Float[Array, "b y x c"]:
    """Every channel of every image with mean 0 and variance 1."""
    mean = jnp.mean(image, axis=(1, 2), keepdims=True)
    variance = jnp.mean((image - mean) ** 2, axis=(1, 2), keepdims=True)
    return (image - mean) * jax.lax.rsqrt(variance + 1e-5)


def shrunk(image: Float[Array, "b y x c"], factor: int) -> Float[Array, "b v u c"]:
    """Means over squares of `factor` pixels."""
    b, y, x, c = image.shape
    return image.reshape(b, y // factor, factor, x // factor, factor, c).mean(axis=(2, 4))
