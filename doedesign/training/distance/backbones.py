"""The first layers of three networks that were trained to name things, as LPIPS looks at them.

`squeeze` is SqueezeNet 1.1 (Iandola et al. 2016), `alex` AlexNet in its one-column form (Krizhevsky 2014) and `vgg`
VGG16 (Simonyan and Zisserman 2015), each as far as its last tap. Layers are numbered as in torchvision, where
activations and pools count too, so that weights keep their names.
"""

from collections.abc import Container, Iterator, Mapping
from functools import reduce
from itertools import chain
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Backbone = Literal["squeeze", "alex", "vgg"]


class Conv(NamedTuple):
    """A convolution with zeros beyond the edges, and the ReLU after it; its weights are called "features." and key."""

    key: str
    size: int
    inputs: int
    outputs: int
    stride: int = 1
    margin: int = 0


class Fire(NamedTuple):
    """SqueezeNet's block: few channels, then many, half of them seen through a 3 x 3 kernel."""

    squeeze: Conv
    narrow: Conv
    wide: Conv

    @property
    def outputs(self) -> int:
        """Channels that go out."""
        return self.narrow.outputs + self.wide.outputs


class Pool(NamedTuple):
    """The largest value of every `size` x `size` window, two pixels apart; `partial` windows at the end may count."""

    size: int
    partial: bool = False


def _same(index: int, inputs: int, outputs: int) -> Conv:
    return Conv(str(index), 3, inputs, outputs, margin=1)


def _fire(index: int, inputs: int, squeeze: int, expand: int) -> Fire:
    return Fire(
        Conv(f"{index}.squeeze", 1, inputs, squeeze),
        Conv(f"{index}.expand1x1", 1, squeeze, expand),
        Conv(f"{index}.expand3x3", 3, squeeze, expand, margin=1),
    )


# Layers up to each tap.
_BACKBONES: Mapping[Backbone, tuple[tuple[Conv | Fire | Pool, ...], ...]] = {
    "squeeze": (
        (Conv("0", 3, 3, 64, stride=2),),
        (Pool(3, partial=True), _fire(3, 64, 16, 64), _fire(4, 128, 16, 64)),
        (Pool(3, partial=True), _fire(6, 128, 32, 128), _fire(7, 256, 32, 128)),
        (Pool(3, partial=True), _fire(9, 256, 48, 192)),
        (_fire(10, 384, 48, 192),),
        (_fire(11, 384, 64, 256),),
        (_fire(12, 512, 64, 256),),
    ),
    "alex": (
        (Conv("0", 11, 3, 64, stride=4, margin=2),),
        (Pool(3), Conv("3", 5, 64, 192, margin=2)),
        (Pool(3), _same(6, 192, 384)),
        (_same(8, 384, 256),),
        (_same(10, 256, 256),),
    ),
    "vgg": (
        (_same(0, 3, 64), _same(2, 64, 64)),
        (Pool(2), _same(5, 64, 128), _same(7, 128, 128)),
        (Pool(2), _same(10, 128, 256), _same(12, 256, 256), _same(14, 256, 256)),
        (Pool(2), _same(17, 256, 512), _same(19, 512, 512), _same(21, 512, 512)),
        (Pool(2), _same(24, 512, 512), _same(26, 512, 512), _same(28, 512, 512)),
    ),
}
# Rows and columns that a picture must have, so that something is left of it at every layer.
LEAST_PX: Mapping[Backbone, int] = {"squeeze": 17, "alex": 31, "vgg": 16}
# A weight that only this backbone has.
_MARKS: Mapping[str, Backbone] = {
    "features.3.squeeze.weight": "squeeze",
    "features.3.weight": "alex",
    "features.2.weight": "vgg",
}


def backbone_of(keys: Container[str]) -> Backbone | None:
    """Recognise a backbone by the names of its weights."""
    return next((name for mark, name in _MARKS.items() if mark in keys), None)


def taps_of(
    backbone: Backbone,
    kernels: Mapping[str, Float[Array, "_ _ _ _"]],
    biases: Mapping[str, Float[Array, " _"]],
    x: Float[Array, "b y x 3"],
) -> list[Float[Array, "b _ _ _"]]:
    """Features at every tap of pictures with the first row at the top and the mean and spread of the training.

    Kernels `[ky, kx, in, out]` and biases are given by the keys of the convolutions.
    """

    def applied(x: Array, layer: Conv | Fire | Pool) -> Array:
        match layer:
            case Pool(size, partial):
                return _pooled(x, size, partial)
            case Fire(squeeze, narrow, wide):
                few = applied(x, squeeze)
                return jnp.concatenate([applied(few, narrow), applied(few, wide)], -1)
            case Conv(key, _, _, _, stride, margin):
                margins = ((margin, margin), (margin, margin))
                dimensions = ("NHWC", "HWIO", "NHWC")
                sums = jax.lax.conv_general_dilated(
                    x, kernels[key], (stride, stride), margins, dimension_numbers=dimensions
                )
                return jax.nn.relu(sums + biases[key])

    taps = []
    for layers in _BACKBONES[backbone]:
        x = reduce(applied, layers, x)
        taps.append(x)
    return taps


def _pooled(x: Float[Array, "b y x c"], size: int, partial: bool) -> Float[Array, "b v u c"]:
    # Strided slices along one axis after the other: XLA's own windowed maximum has a gradient ten times as slow.
    for axis in (1, 2):
        places = (x.shape[axis] - size + partial) // 2 + 1
        lacking = max(0, 2 * (places - 1) + size - x.shape[axis])
        padded = jnp.pad(x, [(0, lacking * (k == axis)) for k in range(4)], constant_values=-jnp.inf)
        x = reduce(jnp.maximum, (jax.lax.slice_in_dim(padded, k, k + 2 * places - 1, 2, axis) for k in range(size)))
    return x


def convolutions(backbone: Backbone) -> Iterator[Conv]:
    """Every convolution of a backbone, in the order of its layers."""
    for layer in chain.from_iterable(_BACKBONES[backbone]):
        if isinstance(layer, Conv):
            yield layer
        elif isinstance(layer, Fire):
            yield from layer


def weight_shapes(backbone: Backbone) -> dict[str, tuple[int, ...]]:
    """Name and shape of every weight in a file: torchvision's for the backbone, lin0, lin1, ... for the taps."""
    shapes: dict[str, tuple[int, ...]] = {}
    for conv in convolutions(backbone):
        shapes[f"features.{conv.key}.weight"] = (conv.outputs, conv.inputs, conv.size, conv.size)
        shapes[f"features.{conv.key}.bias"] = (conv.outputs,)
    # A tap is after a layer with weights.
    heads = (layers[-1].outputs for layers in _BACKBONES[backbone] if not isinstance(layers[-1], Pool))
    return shapes | {f"lin{k}": (channels,) for k, channels in enumerate(heads)}
