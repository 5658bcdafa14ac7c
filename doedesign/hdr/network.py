"""A network that goes on from the solver's estimate: what copies say of lamps, weighed by where they fell.

The solver (`doedesign.hdr.solver`) finds the lamps' light x at full pixels, and the scene u behind their veil. The
network is shown the capture, both of these, and how well light of every pixel is known from its copies: the share of
its light that falls beside it on pixels that are not full, and on those that are calm. It is shown, too, what is left
of copies in u: what stands out of its surroundings, taken back to where it would come from (a matched filter),

    K' w (u - bell of u) / K^2' w    over x,    w: pixels that are not full, calm ones most.

A first U-Net moves the lamps on the logarithmic scale of the mu-law. The veil of what was moved is taken off the scene
by the PSF,

    u <- u - K (x' - x) / k0    where the capture is not full,

and a second U-Net corrects what is left, in display values. Nothing in it knows of a plate: a plain lens is given the
same network, trained in the same way. PSFs are inputs, those that are known: of the design, with the lens's glare.

Blocks are those of `doedesign.recon.network`, without normalisation, as brightness is what is asked for.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.ndimage
from jaxtyping import Array, Complex, Float

from doedesign.hdr.capture import LampCapture
from doedesign.hdr.scores import MU
from doedesign.recon.network import Block
from sim.light import linear_from_srgb, srgb_from_linear

Picture = Float[np.ndarray, "c y x"]
Kernel = Float[np.ndarray, "c v u"]
Frame = Float[np.ndarray, "y x c"]
PEAK = 200.0  # light that is 1 on the logarithmic scale, white 1
_BESIDE_PX = 16  # from a PSF's middle, beyond which light counts as that of copies, halo or glare beside a lamp
_MIDDLE = 1  # pixels around a PSF's middle that count as its middle, as in the solver
_CALM = 0.02  # difference between neighbours, relative to white, at which a pixel counts half
_EVIDENCE = 20.0  # copies take a twentieth of the light; as a feature, about 1
_QUIET = 1e-3  # of the last weights, so that answers begin near nothing
_FOLD = 2  # pixels along a side of the squares that a U-Net is given as one, which is four times as fast
_BELL_PX = 8.0  # standard deviation of the bell that is what copies stand out of
_LEAST_SHARE = 0.05  # of what a sum of pixels that are seen can be
_WIDTHS = ((1.0, 1.5, 2.0), (0.75, 1.0))  # of the scales of both U-Nets, over the network's


class LampView(NamedTuple):
    """Pictures of one capture or of a batch that a network is given, channels last.

    Attributes:
        light: `[..., y, x, c]` the capture, linear, white 1, cut off at the full well.
        full: `[..., y, x, c]` 1 where a pixel is full, else 0.
        found: `[..., y, x, c]` light that the solver found.
        evidence: `[..., y, x, 2 c]` how well a pixel's light is known from what falls beside it, about 0 to 1.
        left: `[..., y, x, c]` light that seems to be missing at full pixels by what is left of their copies, over what
            was found there, its large values compressed.
    """

    light: Any
    full: Any
    found: Any
    evidence: Any
    left: Any


class Veil(NamedTuple):
    """Convolution with a known PSF, of light that ends with the frame.

    Attributes:
        transfer: `[c, v, u]` transform of the PSF with its middle at the first sample, over its middle's energy.
        size: samples of the transform, y and x.
    """

    transfer: Complex[Array, "c v u"] | Complex[np.ndarray, "c v u"]
    size: tuple[int, int]

    @classmethod
    def of(cls, psf: Kernel, shape: tuple[int, int]) -> "Veil":
        """Veil of a frame.

        Args:
            psf: `[c, v, u]` PSFs in an odd window, energy per pixel.
            shape: pixels of the frame, y and x.
        """
        half = psf.shape[-1] // 2
        size = tuple(int(scipy.fft.next_fast_len(n + half, real=True)) for n in shape)  # pyright: ignore
        core = psf[:, half - _MIDDLE : half + _MIDDLE + 1, half - _MIDDLE : half + _MIDDLE + 1]
        kernel = np.zeros((len(psf), *size), np.float32)
        y, x = (np.arange(-r, r + 1) for r in (min(half, n // 2 - 1) for n in size))
        kernel[:, y[:, None], x] = psf[:, y[:, None] + half, x + half] / core.sum(axis=(1, 2))[:, None, None]
        return cls(np.asarray(scipy.fft.rfft2(kernel), np.complex64), (size[0], size[1]))

    def spread(self, light: Float[Array, "*b y x c"], turned: bool = False) -> Float[Array, "*b y x c"]:
        """Light spread by the PSF, over the energy of its middle.

        Args:
            light: linear light, channels last.
            turned: whether to take the adjoint.
        """
        transfer = jnp.conj(self.transfer) if turned else self.transfer
        first = jnp.moveaxis(light, -1, -3)
        found = jnp.fft.irfft2(jnp.fft.rfft2(first, self.size) * transfer, self.size)
        return jnp.moveaxis(found[..., : light.shape[-3], : light.shape[-2]], -3, -1)


def viewed(capture: LampCapture, found: Picture, psf: Kernel) -> LampView:
    """Pictures of a capture for a network.

    Args:
        capture: what the camera saw.
        found: `[c, y, x]` light that the solver found.
        psf: `[c, v, u]` the PSFs of white light that the solver was given.

    Raises:
        ValueError: unlike shapes.
    """
    if found.shape != capture.light.shape or len(psf) != len(found):
        raise ValueError(f"shapes must match, but got {found.shape}, {capture.light.shape} and PSFs {psf.shape}")
    axis = np.arange(psf.shape[-1]) - psf.shape[-1] // 2
    beside = np.where(np.hypot(axis[:, None], axis) > _BESIDE_PX, psf, np.float32(0))
    # A veil is relative to its PSF's middle; evidence, to the light that passes.
    beside[:, axis.size // 2, axis.size // 2] = 1
    veil = Veil.of(beside, (capture.light.shape[1], capture.light.shape[2]))
    behind = np.where(capture.full, 0, found)
    steps = [np.abs(np.diff(behind, axis=n, append=np.take(behind, [-1], axis=n))) for n in (1, 2)]
    calm = _CALM / (_CALM + steps[0] + steps[1])
    seen = (~capture.full).astype(np.float32)
    pictures = (capture.light, capture.full, found, seen, seen * calm)
    light, full, estimate, seen, calm = (np.moveaxis(np.asarray(one, np.float32), 0, -1) for one in pictures)
    shares = [np.asarray(veil.spread(jnp.asarray(one), turned=True)) - one for one in (seen, calm)]
    left = np.arcsinh(full * _missing(estimate, seen, calm, beside) / np.maximum(estimate, 1.0))
    return LampView(light, full, estimate, _EVIDENCE * np.concatenate(shares, axis=-1), left)


def _missing(found: Frame, seen: Frame, calm: Frame, beside: Kernel) -> Frame:
    """Light that lamps lack by what stands out of the scene where their copies fall."""
    bell = (_BELL_PX, _BELL_PX, 0)
    around, share = (scipy.ndimage.gaussian_filter(one, bell) for one in (seen * found, seen))
    stands_out = calm * (found - around / np.maximum(share, _LEAST_SHARE))
    middle = beside.shape[-1] // 2
    copies = beside.copy()
    copies[:, middle, middle] = 0
    most = (copies**2).sum(axis=(1, 2))
    sums = []
    for kernel, picture in ((copies, stands_out), (copies**2, calm)):
        # A middle of 1 makes `Veil` take the kernel as it is; its own share is taken off again.
        kernel[:, middle, middle] = 1
        veil = Veil.of(kernel, (found.shape[0], found.shape[1]))
        sums.append(np.asarray(veil.spread(jnp.asarray(picture), turned=True)) - picture)
    return sums[0] / np.maximum(sums[1], _LEAST_SHARE * most)


class LampUnet(eqx.Module):
    """A U-Net of blocks without normalisation, on squares of 2 x 2 pixels.

    Attributes:
        down: two blocks of every scale, the finest first.
        up: joins of the ways up, the coarsest first.
        last: what it ends in.
    """

    down: tuple[tuple[Block, Block], ...]
    up: tuple[Block, ...]
    last: Block

    @classmethod
    def make(cls, rng: np.random.Generator, inputs: int, outputs: int, widths: Sequence[int]) -> "LampUnet":
        """Draw one whose answer begins near nothing.

        Args:
            rng: where weights are drawn from.
            inputs: channels that it is given.
            outputs: channels of its answer.
            widths: features of every scale, the finest first.
        """
        make = partial(Block.make, rng, normal=False)
        before = (_FOLD**2 * inputs, *widths)
        down = tuple(
            (make(before[level], wide, stride=2 if level else 1), make(wide, wide)) for level, wide in enumerate(widths)
        )
        up = tuple(make(widths[n] + widths[n - 1], widths[n - 1]) for n in range(len(widths) - 1, 0, -1))
        return cls(down, up, make(widths[0], _FOLD**2 * outputs, act=False, gain=_QUIET))

    def __call__(self, image: Float[Array, "b y x i"]) -> Float[Array, "b y x o"]:
        """Apply it; sides are multiples of its coarsest scale's squares."""
        image, beside = _folded(image), []
        for first, second in self.down:
            image = second(first(image))
            beside.append(image)
        image = beside.pop()
        for join in self.up:
            risen = jnp.repeat(jnp.repeat(image, 2, axis=1), 2, axis=2)
            image = join(jnp.concatenate([risen, beside.pop()], axis=-1))
        return _unfolded(self.last(image))


def _folded(image: Float[Array, "b y x c"]) -> Float[Array, "b v u d"]:
    """Pixels of every square beside each other as channels."""
    b, y, x, c = image.shape
    squares = image.reshape(b, y // _FOLD, _FOLD, x // _FOLD, _FOLD, c).transpose(0, 1, 3, 2, 4, 5)
    return squares.reshape(b, y // _FOLD, x // _FOLD, _FOLD**2 * c)


def _unfolded(image: Float[Array, "b v u d"]) -> Float[Array, "b y x c"]:
    """The inverse of `_folded`."""
    b, y, x, d = image.shape
    squares = image.reshape(b, y, x, _FOLD, _FOLD, d // _FOLD**2).transpose(0, 1, 3, 2, 4, 5)
    return squares.reshape(b, _FOLD * y, _FOLD * x, d // _FOLD**2)


class LampNetwork(eqx.Module):
    """The network. `LampNetwork.make` draws one.

    Attributes:
        lamps: moves the light of full pixels.
        scene: corrects the rest.
        colours: channels of a capture.
        width: features of the first U-Net's finest scale.
    """

    lamps: LampUnet
    scene: LampUnet
    colours: int = eqx.field(static=True)
    width: int = eqx.field(static=True)

    @classmethod
    def make(cls, seed: int, colours: int = 3, width: int = 20) -> "LampNetwork":
        """Draw a network that all but hands the solver's estimate through.

        Args:
            seed: of its weights.
            colours: channels of a capture.
            width: features of the finest scale.
        """
        rng = np.random.default_rng(seed)
        first, second = ([round(width * factor) for factor in factors] for factors in _WIDTHS)
        lamps, scene = (
            LampUnet.make(rng, given * colours, colours, widths) for given, widths in ((7, first), (5, second))
        )
        return cls(lamps, scene, colours, width)

    @property
    def multiple(self) -> int:
        """Divisor of the sides of a capture."""
        return _FOLD * 2 ** max(len(self.lamps.up), len(self.scene.up))

    def __call__(self, view: LampView, veil: Veil) -> Float[Array, "b y x c"]:
        """Light of the scene, white 1.

        Args:
            view: a batch of captures; sides are multiples of `multiple`.
            veil: of the PSF that is known.

        Raises:
            ValueError: sides that cannot be halved often enough.
        """
        if any(side % self.multiple for side in view.light.shape[1:3]):
            raise ValueError(f"sides must be multiples of {self.multiple}, but got {view.light.shape[1:3]}")
        full, before = view.full, jnp.maximum(view.found, 0)
        behind = (1 - full) * before
        lifted = jnp.log1p(_EVIDENCE * veil.spread(full * before)) / np.log1p(_EVIDENCE)
        start = compressed_light(before)
        seen = [view.light, full, start, lifted, view.evidence, view.left]
        moved = start + full * self.lamps(jnp.concatenate(seen, axis=-1))
        lamps = full * light_of_compressed(moved)
        behind = jnp.maximum(behind - (1 - full) * veil.spread(lamps - full * before), 0)
        shown = srgb_from_linear(behind)
        seen = [shown, srgb_from_linear(view.light), full, moved, lifted]
        shown = shown + self.scene(jnp.concatenate(seen, axis=-1))
        return lamps + (1 - full) * linear_from_srgb(jnp.maximum(shown, 0))


def compressed_light(light: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Light on the logarithmic scale of the mu-law, 1 for 200 times white.

    Args:
        light: linear light, white 1.
    """
    return jnp.log1p(MU / PEAK * jnp.maximum(light, 0)) / np.log1p(MU)


def light_of_compressed(scaled: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Invert `compressed_light`; nothing is brighter than four thousand times white.

    Args:
        scaled: light on the logarithmic scale.
    """
    return PEAK / MU * jnp.expm1(np.log1p(MU) * jnp.clip(scaled, 0, 1.35))


@eqx.filter_jit
def _answered(network: LampNetwork, view: LampView, transfer: Array, size: tuple[int, int]) -> Array:
    return network(view, Veil(transfer, size))


def refined(network: LampNetwork, capture: LampCapture, found: Picture, psf: Kernel) -> Picture:
    """Light of a scene, `[c, y, x]`, as the network finds it.

    Args:
        network: a trained network.
        capture: what the camera saw, of any size.
        found: light that the solver found in it.
        psf: PSFs `[c, v, u]` of white light as they are known, with glare.

    Raises:
        ValueError: unlike shapes.
    """
    view, (_, ny, nx) = viewed(capture, found, psf), capture.light.shape
    more = [(0, -n % network.multiple) for n in (ny, nx)]
    whole = LampView(*(np.pad(one, [*more, (0, 0)], mode="symmetric")[None] for one in view))
    veil = Veil.of(psf, (whole.light.shape[1], whole.light.shape[2]))
    light = np.asarray(_answered(network, whole, jnp.asarray(veil.transfer), veil.size))[0, :ny, :nx]
    return np.moveaxis(light, -1, 0)
