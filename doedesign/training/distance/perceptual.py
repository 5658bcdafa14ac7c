"""Distances between pictures that follow the eye more than the pixels: LPIPS, and multi-scale SSIM in its stead.

LPIPS (Zhang, Isola, Efros, Shechtman and Wang, "The unreasonable effectiveness of deep features as a perceptual
metric", CVPR 2018, version 0.1) sends both pictures through the first layers of a network that was trained to name
things. At several depths ("taps") the features of every place are brought to unit length, their squared differences are
weighted by channel, and the result is averaged over places and summed over taps. Such backbones are `squeeze`
(SqueezeNet 1.1), `alex` (AlexNet) and `vgg` (VGG16). The weights belong to others and do not come with this package:
the user names files of them. examples/convert_lpips.py makes one from an installed `lpips` and `torchvision`.

The backbones know the world the right way up, and an upside-down face means little to them. Pictures here have row 0 at
the lowest y, so they are turned over before they are looked at, and maps are turned back.

Distances take display values (sRGB) and can be differentiated by both pictures. Only what is asked for is computed:
the features of a reference that nothing depends on are made once, and nothing flows back through them. Without weights,
`MsSsim` stands in.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from doedesign.training.distance.backbones import LEAST_PX, Backbone, backbone_of, convolutions, taps_of, weight_shapes
from doedesign.training.distance.similarity import Images, MsSsim
from fab.errors import InputError
from fab.files import opened, paths_of, sha256_file
from fab.pictures import decoding

# Mean and spread of each colour that the backbones were trained with, for values from -1 to 1.
_MEAN = np.array([-0.030, -0.088, -0.188], np.float32)
_SPREAD = np.array([0.458, 0.448, 0.450], np.float32)
_TINY = 1e-10
_MOST_BYTES = 1 << 30  # of the weights in a file; VGG16 with its classifier, in half precision or single, is smaller

_CURE = "Make the file with examples/convert_lpips.py."


class Lpips(eqx.Module):
    """LPIPS with its weights; made by `read_lpips`.

    Attributes:
        kernels: `[ky, kx, in, out]` of every convolution, by torchvision's name without "features.".
        biases: of every convolution.
        heads: weight of every channel of each tap.
        backbone: which network.
        digest: SHA-256 of the files that the weights were read from, joined by "+".
    """

    kernels: dict[str, Float[Array, "_ _ _ _"]]
    biases: dict[str, Float[Array, " _"]]
    heads: tuple[Float[Array, " _"], ...]
    backbone: Backbone = eqx.field(static=True)
    digest: str = eqx.field(static=True, default="")

    @property
    def name(self) -> str:
        """Name in a run's record."""
        return f"lpips_{self.backbone}"

    @property
    def least_px(self) -> int:
        """Rows and columns that a picture must have at least."""
        return LEAST_PX[self.backbone]

    def __call__(self, a: Images, b: Images) -> Float[Array, " b"]:
        """LPIPS distance of pictures, 0 for equal ones and about 1 for unlike ones.

        Args:
            a: `[b, c, y, x]` display values, white 1, row 0 at the lowest y; three colours, or one that stands for all.
            b: the pictures to compare with.

        Raises:
            ValueError: unlike shapes, other numbers of colours, or a picture smaller than `least_px`.
        """
        return jnp.sum(jnp.stack([jnp.mean(each, (1, 2)) for each in _taps(self, a, b)]), axis=0)

    def map(self, a: Images, b: Images) -> Float[Array, "b y x"]:
        """Map of the differences: those of all taps, each enlarged to the pictures' size (linearly), and summed.

        This is what the authors' code calls `spatial`. Its mean is the distance but for what enlarging does at the
        edges. A deep feature sees far beyond its own place, so a small region's share is only roughly its own.
        Arguments and errors are those of the distance.
        """
        size = (a.shape[0], *a.shape[2:])
        large = [jax.image.resize(each, size, "linear", antialias=False) for each in _taps(self, a, b)]
        return jnp.sum(jnp.stack(large), axis=0)[:, ::-1]


def _taps(model: Lpips, a: Images, b: Images) -> list[Float[Array, "b _ _"]]:
    """Weighted squared difference at every tap, first row at the top."""
    if a.shape != b.shape or a.shape[1] not in (1, 3):
        raise ValueError(f"both pictures must have one shape and 1 or 3 colours, but got {a.shape} and {b.shape}")
    if min(a.shape[2:]) < (least := model.least_px):
        raise ValueError(f"{model.name} needs pictures of at least {least} x {least} pixels, but got {a.shape[2:]}")
    # One after the other, not as one batch: nothing flows back through the reference.
    pairs = zip(model.heads, _features(model, a), _features(model, b), strict=True)
    return [jnp.sum(head * jnp.square(_unit(of_a) - _unit(of_b)), -1) for head, of_a, of_b in pairs]


def _unit(features: Float[Array, "b y x c"]) -> Float[Array, "b y x c"]:
    """Bring the features of every place to unit length; where all are zero, they and their slope stay zero."""
    square = jnp.sum(jnp.square(features), -1, keepdims=True)
    dead = square == 0
    return jnp.where(dead, 0, features / (jnp.sqrt(jnp.where(dead, 1, square)) + _TINY))


def _features(model: Lpips, image: Images) -> list[Float[Array, "b _ _ _"]]:
    upright = jnp.asarray(image)[:, :, ::-1].transpose(0, 2, 3, 1)
    # A single colour becomes three by broadcasting.
    return taps_of(model.backbone, model.kernels, model.biases, (2 * upright - 1 - _MEAN) / _SPREAD)


def weights_of(backbone_state: Mapping[str, ArrayLike], head_state: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """Collect the float32 arrays by name that `read_lpips` needs, from state dicts.

    They are of torchvision's `squeezenet1_1`, `alexnet` or `vgg16`, whose classifier is left out, and of `lpips.LPIPS`
    or one of its v0.1 files, where a backbone is left out.

    Raises:
        InputError: a weight is missing, has another shape or is not finite.
    """
    found = {key: np.asarray(value) for key, value in backbone_state.items() if key.startswith("features.")}
    for key, value in head_state.items():
        if head := re.fullmatch(r"(lin\d+)\.model\.\d+\.weight", key):
            found[head[1]] = np.ravel(np.asarray(value))
    return _checked(found, "the state dicts")[1]


def read_lpips(paths: str | Path | Sequence[str | Path]) -> Lpips:
    """Read LPIPS from `.npz` files that together hold a backbone (torchvision's names) and its heads (lin0, lin1, ...).

    Other arrays in them are left alone. Half precision is widened.

    Raises:
        InputError: a file cannot be read, or a weight is missing, there twice, of another shape, or not finite.
    """
    weights: dict[str, np.ndarray] = {}
    paths = paths_of(paths, "lpips_weights")
    for path in paths:
        more = _read_npz(path)
        if twice := sorted(weights.keys() & more.keys()):
            cure = "Name one file of each kind."
            raise InputError(str(path), "a weight must stand in one file only", f"{twice[0]} once more", cure)
        weights |= more
    backbone, checked = _checked(weights, ", ".join(map(str, paths)) or "no file")
    # torchvision has [out, in, ky, kx].
    convs = list(convolutions(backbone))
    kernels = {c.key: jnp.asarray(checked[f"features.{c.key}.weight"].transpose(2, 3, 1, 0)) for c in convs}
    biases = {c.key: jnp.asarray(checked[f"features.{c.key}.bias"]) for c in convs}
    heads = tuple(jnp.asarray(checked[f"lin{k}"]) for k in range(sum(key.startswith("lin") for key in checked)))
    return Lpips(kernels, biases, heads, backbone, "+".join(sorted(sha256_file(path) for path in paths)))


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    """Weights of one file; numpy leaves a damaged archive open, so it is opened here."""
    rule = "must be a whole .npz file of numbers"
    with decoding(path, rule, _CURE), opened(path) as stream, np.load(stream, allow_pickle=False) as archive:
        # A few kilobytes can stand for gigabytes of zeros.
        size = sum(member.file_size for member in archive.zip.infolist())
        if size > _MOST_BYTES:
            raise ValueError(f"{size} bytes of weights, where {_MOST_BYTES} are the most")
        return {key: archive[key] for key in archive.files if re.fullmatch(r"features\..*|lin\d+", key)}


def _checked(weights: Mapping[str, np.ndarray], where: str) -> tuple[Backbone, dict[str, np.ndarray]]:
    """Recognise the backbone, and take its weights as float32."""
    backbone = backbone_of(weights)
    if backbone is None:
        rule = "must hold a backbone's weights by torchvision's names (features.0.weight ...)"
        raise InputError(where, rule, ", ".join(sorted(weights)[:3]) or "none of them", _CURE)
    shapes = weight_shapes(backbone)
    if lacking := [key for key in shapes if key not in weights]:
        others = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        rule = f"must hold all weights of the {backbone} backbone and its heads (lin0 ...)"
        cure = f"Name the file that holds them, too. {_CURE}"
        raise InputError(where, rule, f"no {lacking[0]}{others}", cure)
    checked: dict[str, np.ndarray] = {}
    for key, shape in shapes.items():
        if weights[key].shape != shape or weights[key].dtype.kind != "f":
            got = f"{weights[key].dtype} {weights[key].shape}"
            raise InputError(where, f"{key} of the {backbone} backbone must be floats {shape}", got, _CURE)
        with np.errstate(over="ignore"):  # refused below
            checked[key] = weights[key].astype(np.float32)
        if not np.isfinite(checked[key]).all():
            raise InputError(where, f"{key} must be finite in float32", "NaN or infinity", _CURE)
    return backbone, checked


Perceptual = Lpips | MsSsim
"""Either distance: called with two pictures; `name` and `digest` go into a run's record."""
