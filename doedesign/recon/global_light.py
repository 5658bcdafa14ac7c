"""Veil and gain from the whole picture: a branch of low resolution before the local ones.

An obstruction out of focus takes the share alpha of the light behind it and adds its own,

    capture = (1 - alpha) (scene * far PSF) + alpha L,      alpha = mask * near PSF,

L being the light of dirt, wire or water and of what is seen between them (paper, eq. 10). Gain 1 / (1 - alpha) and veil
alpha L are as smooth as the near PSF is wide, tens of pixels, so cells of 2^depth pixels hold them. How bright a place
was behind a veil cannot be told from a few pixels around it, and normalised features do not know how bright they were.
So this branch keeps brightness (nothing is normalised) and sees with dilated convolutions, and with means over the
picture, everything there is.

It says two things of every cell, both as logarithms, which are brought to full size smoothly: how many times brighter
the scene is than the capture's mean M there, and by how much its contrast about that mean has to grow,

    light = M brightness + (capture - M) gain,      veil = M (1 - brightness / gain).

That is a veil and a gain, told so that an error of one does not pass for the other: a gain alone would brighten a place
as much as it sharpens it, and the first thing that a network learnt would be to leave it alone.

A cell is described by the mean, the least and the spread of its pixels' light. A veil adds to the first two, and the
least light of a textured place bounds it (K. He, J. Sun and X. Tang, "Single image haze removal using dark channel
prior", CVPR 2009); the spread shrinks by 1 - alpha. Nothing else of the network is needed for it, so the branch can be
taught by itself, on many more scenes than the whole (`doedesign.training.lesson`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.recon.blocks import LEAK, QUIET, shrunk

_WIDTH = 32
_DILATIONS = (1, 2, 4, 8, 1)
_MOST = 2.5  # of both logarithms: a factor of twelve
_GAMMA = 1 / 2.2  # of display values, near enough for a description
# Spreads of light below the noise are noise; those of pictures lie about e^-3.5, an e-fold and a bit either way.
_LEAST_SPREAD, _USUAL_LOG_SPREAD, _LOG_SPREADS = 1e-3, -3.5, 1.2


class SmoothLight(NamedTuple):
    """Smooth fields of an obstruction's light: the light it adds, and the logarithm of what makes up for its shadow."""

    veil: Float[Array, "b y x c"]
    log_gain: Float[Array, "b y x 1"]


class WideLayer(eqx.Module):
    """A residual layer of a dilated 3 x 3 convolution and of the mean over the picture."""

    weights: Float[Array, "3 3 i i"]
    of_mean: Float[Array, "i i"]
    bias: Float[Array, " i"]
    dilation: int = eqx.field(static=True)

    @classmethod
    def make(cls, rng: np.random.Generator, width: int, dilation: int) -> "WideLayer":
        """Draw weights small enough that what is added is about half of what is there."""
        spread = 0.5 / np.sqrt(width)
        weights = (spread / 3 * rng.standard_normal((3, 3, width, width))).astype(np.float32)
        of_mean = (spread * rng.standard_normal((width, width))).astype(np.float32)
        return cls(jnp.asarray(weights), jnp.asarray(of_mean), jnp.zeros(width), dilation)

    def __call__(self, image: Float[Array, "b y x i"]) -> Float[Array, "b y x i"]:
        """Apply the layer; beyond its edges, which may be nearer than it reaches, a picture goes on as they are."""
        margin = self.dilation
        padded = jnp.pad(image, ((0, 0), (margin, margin), (margin, margin), (0, 0)), mode="edge")
        found = jax.lax.conv_general_dilated(
            padded,
            self.weights,
            (1, 1),
            "VALID",
            rhs_dilation=(margin, margin),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )
        mean = jnp.mean(image, axis=(1, 2), keepdims=True) @ self.of_mean
        return image + jax.nn.leaky_relu(found + mean + self.bias, LEAK)


class GlobalLight(eqx.Module):
    """The branch. `GlobalLight.make` draws one.

    Attributes:
        first: weights that take in a cell's description.
        bias: of these.
        layers: layers of rising reach.
        last: weights that end in the logarithms of gain and brightness.
    """

    first: Float[Array, "i k"]
    bias: Float[Array, " k"]
    layers: tuple[WideLayer, ...]
    last: Float[Array, "k o"]

    @classmethod
    def make(cls, rng: np.random.Generator, colours: int) -> "GlobalLight":
        """Draw a branch for so many colours; it begins near nothing."""
        seen = 3 * colours
        first = (rng.standard_normal((seen, _WIDTH)) / np.sqrt(seen)).astype(np.float32)
        layers = tuple(WideLayer.make(rng, _WIDTH, dilation) for dilation in _DILATIONS)
        last = (QUIET / np.sqrt(_WIDTH) * rng.standard_normal((_WIDTH, 1 + colours))).astype(np.float32)
        return cls(jnp.asarray(first), jnp.zeros(_WIDTH), layers, jnp.asarray(last))

    def __call__(self, light: Float[Array, "b y x c"], scale: int) -> SmoothLight:
        """Veil and gain of a capture, linear light, in cells of `scale` pixels, of which its sides are multiples."""
        shape = (light.shape[1], light.shape[2])
        logs = self.of_cells(described(light, scale))
        return smooth_light(*(enlarged(part, shape) for part in (shrunk(light, scale), *logs)))

    def of_cells(self, cells: Float[Array, "b v u k"]) -> tuple[Float[Array, "b v u 1"], Float[Array, "b v u c"]]:
        """Logarithms of gain and brightness of cells that are `described`."""
        image = jax.nn.leaky_relu(cells @ self.first + self.bias, LEAK)
        for layer in self.layers:
            image = layer(image)
        logs = _MOST * jnp.tanh(QUIET * (image @ self.last))
        return logs[..., :1], logs[..., 1:]


def smooth_light(
    mean: Float[Array, "b y x c"], log_gain: Float[Array, "b y x 1"], log_brightness: Float[Array, "b y x c"]
) -> SmoothLight:
    """Veil and gain that lift the mean of the light by the brightness and its contrast by the gain."""
    return SmoothLight(mean * (1 - jnp.exp(log_brightness - log_gain)), log_gain)


def unveiled(light: Float[Array, "b y x c"], found: SmoothLight) -> Float[Array, "b y x c"]:
    """Take a veil off, and make up for the shadow."""
    return (light - found.veil) * jnp.exp(found.log_gain)


def described(light: Float[Array, "b y x c"], scale: int) -> Float[Array, "b v u k"]:
    """Mean, least and spread of the light of every colour in cells of `scale` pixels, each brought to about 1.

    Mean and least are display values, spreads logarithms.
    """
    b, y, x, c = light.shape
    cells = light.reshape(b, y // scale, scale, x // scale, scale, c)
    mean, least = jnp.mean(cells, axis=(2, 4)), jnp.min(cells, axis=(2, 4))
    variance = jnp.mean((cells - mean[:, :, None, :, None]) ** 2, axis=(2, 4))
    spread = 0.5 * jnp.log(variance + _LEAST_SPREAD**2)
    shown = [jnp.maximum(value, _LEAST_SPREAD) ** _GAMMA for value in (mean, least)]
    return jnp.concatenate([*shown, (spread - _USUAL_LOG_SPREAD) / _LOG_SPREADS], axis=-1)


def enlarged(image: Float[Array, "b v u k"], shape: tuple[int, int]) -> Float[Array, "b y x k"]:
    """Bring cells to full size, linearly between their middles and as the outermost beyond these."""
    return jax.image.resize(image, (image.shape[0], *shape, image.shape[-1]), "linear")
