"""The reconstruction network: a U-Net whose features are deconvolved with the camera's own PSFs (paper §3.3).

First stage: the capture and its Wiener estimate with the near PSF go down through `depth` halvings. At every scale the
features are filtered with the inverse of the far PSF (`doedesign.recon.wiener`); the way up joins what it brings, the
features and the filtered features. The capture itself is taken back along the form of eq. 10: a veil lies on it, it
lacks the light that was kept off, and behind both it is blurred with the far PSF,

    light = F⁻¹[(capture - veil) exp(gain)].

Veil and gain, which are smooth, are what the first stage ends in, with a correction of the picture for the rest. On
request (`global_light`) a branch of low resolution, which sees the whole picture, undoes a veil and a gain before
(`doedesign.recon.global_light`).
Second stage: residual blocks that see the first stage's picture and the capture.

PSFs are inputs: simulated, as fabricated or measured ones are handed in at run time, and the same weights serve all of
them.

Light is linear where blur is undone, and turns into display values (sRGB) where the picture is put together: a
convolution by a PSF holds for light, an error of a picture is seen on a display.

A block is a convolution, an instance normalisation without parameters, and a leaky ReLU. Normalised features no longer
know how bright a place was, so the first scale goes without normalisation and so does the head. The public release's
variant (`variant = "release"`) normalises there, too, adds nothing but a correction to the capture as it is, and its
second stage does not see the capture.
"""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.recon.blocks import LEAK, QUIET, Block, normalised, shrunk
from doedesign.recon.conv import doubled
from doedesign.recon.global_light import GlobalLight, unveiled
from doedesign.recon.wiener import Blur, blur_at, deblurred, sharpened
from sim.light import srgb_from_linear

Variant = Literal["paper", "release"]

_WIDTHS = (1, 2, 4, 8, 12)  # features of every scale over those of the first
_REFINEMENTS = 3
_LOG_REGULARISER = float(np.log(1e-2))
_LOG_BASE_REGULARISER = float(np.log(1e-3))  # of a whole picture: about the noise of a sensor in daylight
_MOST_GAIN = 3.5  # of the logarithm: no sensor shows more than a factor of thirty
# Of the release, and not learnt there.
_RELEASE_LOG_REGULARISER = float(np.log(1e-6))


@dataclass(frozen=True)
class NetworkShape:
    """Shape of a network: the colours of a capture, and the parts that `doedesign.spec.training.NetworkSpec` names."""

    colours: int = 3
    width: int = 12
    depth: int = 4
    wiener: bool = True
    features: bool = True
    near_estimate: bool = True
    refine: bool = True
    variant: Variant = "paper"
    global_light: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError for a width that colours do not divide, or a depth beyond 1 to 4."""
        if self.colours < 1 or self.width < self.colours or self.width % self.colours:
            raise ValueError(f"`width` must be a multiple of the {self.colours} colours, but got {self.width}")
        if not 1 <= self.depth < len(_WIDTHS):
            raise ValueError(f"`depth` must be from 1 to {len(_WIDTHS) - 1}, but got {self.depth}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Features of every scale, the finest first."""
        return tuple(self.width * factor for factor in _WIDTHS[: self.depth + 1])

    @property
    def multiple(self) -> int:
        """Divisor of the sides of a capture."""
        return int(2**self.depth)


class Scale(eqx.Module):
    """Blocks of one scale on the way down, and the regulariser of its Wiener filter, or None without one."""

    blocks: tuple[Block, ...]
    log_regulariser: Float[Array, " k"] | None


class UpBlock(eqx.Module):
    """From one scale to the next finer one: a transposed convolution, joined with the features of that scale."""

    weights: Float[Array, "i 2 2 o"]
    join: Block

    def __call__(
        self, image: Float[Array, "b y x i"], beside: list[Float[Array, "b v u k"]], half: bool
    ) -> Float[Array, "b v u o"]:
        """Go up by one scale."""
        risen = jax.nn.leaky_relu(normalised(doubled(image, self.weights)), LEAK)
        return self.join(jnp.concatenate([risen, *beside], axis=-1), half)


class Network(eqx.Module):
    """The network. `Network.make` draws one.

    Attributes:
        near_log_regulariser: of the Wiener estimate with the near PSF; None without one.
        far_log_regulariser: of that with the far PSF, from which the veil is taken; None for the capture as it is.
        down: scales, the finest first.
        bottom: blocks at the coarsest scale.
        up: ways up, the coarsest first.
        head: blocks that end in correction, veil and gain.
        residual: pairs of blocks of the second stage.
        last: its last block.
        light: veil and gain from the whole picture, undone before those of the head; None without them.
        layout: its shape.
    """

    near_log_regulariser: Float[Array, " c"] | None
    far_log_regulariser: Float[Array, " c"] | None
    down: tuple[Scale, ...]
    bottom: tuple[Block, ...]
    up: tuple[UpBlock, ...]
    head: tuple[Block, ...]
    residual: tuple[tuple[Block, Block], ...]
    last: Block | None
    light: GlobalLight | None
    layout: NetworkShape = eqx.field(static=True)

    @classmethod
    def make(cls, layout: NetworkShape, seed: int) -> "Network":
        """Draw a network that all but hands the capture through: its corrections begin near nothing.

        ValueError with neither learnt features nor a Wiener filter.
        """
        rng = np.random.default_rng(seed)
        release, c, widths = layout.variant == "release", layout.colours, layout.widths
        log_regulariser = _RELEASE_LOG_REGULARISER if release else _LOG_REGULARISER

        def scale(level: int) -> Scale:
            inputs = c * (1 + layout.near_estimate + layout.global_light) if level == 0 else widths[level - 1]
            wide, normal = widths[level], level > 0 or release
            first = Block.make(rng, inputs, wide, 3 if level else 7, 2 if level else 1, normal=normal)
            more = [Block.make(rng, wide, wide, normal=normal) for _ in range(2 if level else 1)]
            wiener = jnp.full(wide, log_regulariser, jnp.float32) if layout.wiener else None
            return Scale((first, *more), wiener)

        def beside(level: int) -> int:
            filtered = (widths[level] if layout.features else c) if layout.wiener else 0
            return filtered + (widths[level] if layout.features else 0)

        down = tuple(scale(level) for level in range(layout.depth + 1)) if layout.features else _bare(layout)
        deepest = beside(layout.depth)
        wide = 2 * widths[-1]
        bottom = (Block.make(rng, deepest, wide), Block.make(rng, wide, widths[-1]))
        up = tuple(
            UpBlock(
                # Of a transposed convolution.
                jnp.asarray((rng.standard_normal((coarse, 2, 2, fine)) / np.sqrt(coarse)).astype(np.float32)),
                Block.make(rng, fine + beside(level), fine),
            )
            for level, (fine, coarse) in reversed([*enumerate(pairwise(widths))])
        )
        middle = c if release else layout.width
        head = (
            Block.make(rng, layout.width, middle, normal=release),
            Block.make(rng, middle, c if release else 3 * c, 5, normal=False, act=False, gain=QUIET),
        )
        seen = c if release else 2 * c
        residual = tuple(
            (
                Block.make(rng, seen, seen, gain=1e-3 if release else 1.0),
                Block.make(rng, seen, seen, act=False, gain=1e-3 if release else 1.0),
            )
            for _ in range(_REFINEMENTS if layout.refine else 0)
        )
        last = Block.make(rng, seen, c, 5, normal=False, act=False, gain=QUIET) if layout.refine else None
        near = jnp.full(c, log_regulariser, jnp.float32) if layout.near_estimate else None
        far = jnp.full(c, _LOG_BASE_REGULARISER, jnp.float32) if layout.wiener and not release else None
        light = GlobalLight.make(rng, c) if layout.global_light else None
        return cls(near, far, down, bottom, up, head, residual, last, light, layout)

    def __call__(
        self,
        capture: Float[Array, "b c y x"],
        far: Float[Array, "b c ky kx"],
        near: Float[Array, "b c kv ku"],
        *,
        half: bool = False,
        checkpointed: bool = False,
    ) -> Float[Array, "b c y x"]:
        """Reconstruct the scene behind the obstruction.

        Args:
            capture: `[b, c, y, x]` linear light, white 1; sides are multiples of `layout.multiple`.
            far: `[b, c, y, x]` PSFs of the scene, energy per pixel, odd windows with the chief ray in the middle.
            near: the same of the obstruction.
            half: multiply in bfloat16; transforms, normalisations and sums stay in float32.
            checkpointed: for gradients, keep nothing within a scale and compute it again.

        Returns:
            `[b, c, y, x]` display values, 0 to 1 but for the network's errors.

        Raises:
            ValueError: another number of colours, or sides that cannot be halved often enough.
        """
        layout = self.layout
        if capture.shape[1] != layout.colours:
            raise ValueError(f"`capture` must have {layout.colours} colours, but got {capture.shape[1]}")
        if any(side % layout.multiple for side in capture.shape[2:]):
            raise ValueError(f"sides of `capture` must be multiples of {layout.multiple}, but got {capture.shape[2:]}")
        keep: Any = jax.checkpoint if checkpointed else lambda call: call
        light = capture.transpose(0, 2, 3, 1)
        display = srgb_from_linear(light)
        inputs = [light]
        if self.near_log_regulariser is not None:
            inputs.append(sharpened(light, near, self.near_log_regulariser))
        clearer = light if self.light is None else unveiled(light, self.light(light, layout.multiple))
        if self.light is not None:
            inputs.append(clearer)
        features, skips = jnp.concatenate(inputs, axis=-1), []
        for level, scale in enumerate(self.down):
            shape = (capture.shape[2] >> level, capture.shape[3] >> level)
            blur = blur_at(far, shape, 2**level) if scale.log_regulariser is not None else None
            plain = shrunk(light, 2**level)
            features, beside = keep(partial(_down, half=half, features=layout.features))(scale, features, plain, blur)
            skips.append(beside)
        image = jnp.concatenate(skips.pop(), axis=-1)
        for block in self.bottom:
            image = block(image, half)
        for rise in self.up:
            image = keep(lambda r, i, b: r(i, b, half))(rise, image, skips.pop())
        for block in self.head:
            image = block(image, half)
        image = QUIET * image
        if layout.variant == "release":
            picture = display + jnp.tanh(image)
        else:
            correction, veil, gain = jnp.split(image, 3, axis=-1)
            light = (clearer - veil) * jnp.exp(_MOST_GAIN * jnp.tanh(gain))
            if self.far_log_regulariser is not None:
                light = sharpened(light, far, self.far_log_regulariser)
            picture = srgb_from_linear(light) + jnp.tanh(correction)
        if self.last is not None:
            picture = self._refined(picture, display, half)
        return picture.transpose(0, 3, 1, 2)

    def _refined(self, picture: Float[Array, "b y x c"], display: Float[Array, "b y x c"], half: bool) -> Array:
        """The second stage."""
        release = self.layout.variant == "release"
        seen = picture if release else jnp.concatenate([picture, display], axis=-1)
        for first, second in self.residual:
            seen = jax.nn.leaky_relu(seen + second(first(seen, half), half), LEAK)
        assert self.last is not None  # only then is there a second stage
        found = picture + QUIET * self.last(seen, half)
        return jax.nn.relu(found) if release else found


def _bare(layout: NetworkShape) -> tuple[Scale, ...]:
    """Scales without features of their own: the capture is filtered."""
    wiener = jnp.full(layout.colours, _LOG_REGULARISER, jnp.float32) if layout.wiener else None
    if wiener is None:
        raise ValueError("`features` or `wiener` must be kept, but both are off")
    return tuple(Scale((), wiener) for _ in range(layout.depth + 1))


def _down(
    scale: Scale, image: Array, plain: Array, blur: Blur | None, *, half: bool, features: bool
) -> tuple[Array, list[Array]]:
    """One scale on the way down: what goes on, and what stays for the way up."""
    if not features:
        assert blur is not None  # `_bare` refuses a network without both
        assert scale.log_regulariser is not None
        return image, [deblurred(plain, blur, scale.log_regulariser)]
    for block in scale.blocks:
        image = block(image, half)
    if blur is None or scale.log_regulariser is None:
        return image, [image]
    return image, [image, deblurred(image, blur, scale.log_regulariser)]
