"""Methods of the paper's tables: from what one is shown to a picture.

`METHODS` are those that need no training. Deconvolution is scikit-image's, inpainting scikit-image's and OpenCV's, each
as published and with one setting for all pairs. Beyond its edges a capture is mirrored for deconvolution: without end
for the Wiener filter, which takes a picture for periodic; by three half windows of the PSF for Richardson-Lucy, which
takes it for dark outside, so that even light comes out even to 1 % after its 30 iterations. A PSF that loses light is
brought to unit energy, and the capture with it.

Inpainting fills the occluded region (the sharp mask, at least half of a pixel blocked) and leaves the rest alone. Where
that is the whole picture, there is nothing to fill it from, and it stays black.

References:
    W. H. Richardson, JOSA 62 (1972); L. B. Lucy, Astron. J. 79 (1974). F. Orieux, J.-F. Giovannelli and T. Rodet,
    JOSA A 27 (2010), whose filter scikit-image's `wiener` is. A. Telea, J. Graphics Tools 9 (2004). M. Bertalmio,
    A. L. Bertozzi and G. Sapiro, CVPR 2001 (Navier-Stokes). S. B. Damelin and N. S. Hoang, J. Math. 2018 (biharmonic).
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from doedesign.recon.baselines import noise_to_signal, noise_variance
from fab.errors import InputError
from sim.light import srgb_from_linear
from sim.sensor import Sensor

Picture = Float[np.ndarray, "c y x"]

_ITERATIONS = 30  # scikit-image's own number
_RADIUS_PX = 3  # of the neighbourhood that OpenCV's inpainting looks at, as in its examples


class MethodInputs(NamedTuple):
    """All that a method is shown of a pair.

    Attributes:
        light: `[c, y, x]` linear light, white 1: a developed capture, or the scene itself where a method is given that.
        far: `[c, y, x]` PSFs of the scene, energy per pixel, as the method is told them.
        near: the same of the obstruction.
        mask: `[y, x]` share of each pixel that is blocked, sharp.
        sensor: the sensor of the capture.
    """

    light: Picture
    far: Float[np.ndarray, "c ky kx"]
    near: Float[np.ndarray, "c kv ku"]
    mask: Float[np.ndarray, "y x"]
    sensor: Sensor

    @property
    def hole(self) -> Bool[np.ndarray, "y x"]:
        """The occluded region, as scores have it."""
        return self.mask >= 0.5


Method = Callable[[MethodInputs], Picture]
"""From inputs to display values `[c, y, x]`, which scores clip to 0..1."""


def as_seen(given: MethodInputs) -> Picture:
    """The light as it is, in display values."""
    return srgb_from_linear(given.light)


def richardson_lucy(given: MethodInputs, *, near: bool = False) -> Picture:
    """Richardson-Lucy deconvolution by scikit-image, with the far or the near PSF; 30 iterations."""
    from skimage.restoration import richardson_lucy as restored

    def by_colour(image: np.ndarray, psf: np.ndarray, _: float) -> np.ndarray:
        margin = 3 * (max(psf.shape) // 2)
        wide = np.pad(np.maximum(image, 0), margin, mode="symmetric")
        return restored(wide, psf, num_iter=_ITERATIONS, clip=False, filter_epsilon=1e-6)[(_inner(margin),) * 2]

    return _deconvolved(given, near, by_colour)


def wiener(given: MethodInputs, *, near: bool = False) -> Picture:
    """Wiener filter by scikit-image, with the far or the near PSF.

    It weighs the power of the picture's Laplacian by `balance`, for which the ratio of the noise's variance to that of
    the capture stands.
    """
    from skimage.restoration import wiener as restored

    def by_colour(image: np.ndarray, psf: np.ndarray, ratio: float) -> np.ndarray:
        y, x = image.shape
        # Mirrored once, or as often as a wide PSF needs.
        more = [2 * size * max(1, -(-wide // (2 * size))) - size for size, wide in zip((y, x), psf.shape, strict=True)]
        period = np.pad(image, [(0, count) for count in more], mode="symmetric")
        return np.asarray(restored(period, psf, balance=ratio, clip=False))[:y, :x]

    return _deconvolved(given, near, by_colour)


def _inner(margin: int) -> slice:
    return slice(margin, -margin or None)


def _deconvolved(
    given: MethodInputs, near: bool, by_colour: Callable[[np.ndarray, np.ndarray, float], np.ndarray]
) -> Picture:
    psfs = given.near if near else given.far
    ratios = noise_to_signal(given.light, noise_variance(given.light, given.sensor))
    found = []
    for light, psf, ratio in zip(given.light, psfs.astype(np.float64), ratios, strict=True):
        energy = psf.sum()
        found.append(by_colour(light.astype(np.float64) / energy, psf / energy, float(ratio)))
    return srgb_from_linear(np.stack(found).astype(np.float32))


def biharmonic(given: MethodInputs) -> Picture:
    """Biharmonic inpainting by scikit-image."""
    from skimage.restoration import inpaint_biharmonic

    shown = np.clip(as_seen(given), 0, 1)
    if given.hole.all():
        return np.zeros_like(shown)
    return inpaint_biharmonic(shown, given.hole, channel_axis=0).astype(np.float32)


def telea(given: MethodInputs) -> Picture:
    """Inpainting by fast marching (Telea) by OpenCV, on 8-bit display values.

    Raises:
        InputError: OpenCV is not installed.
    """
    return _by_opencv(given, "INPAINT_TELEA")


def navier_stokes(given: MethodInputs) -> Picture:
    """Inpainting by fluid dynamics (Bertalmio, Bertozzi, Sapiro) by OpenCV, on 8-bit display values.

    Raises:
        InputError: OpenCV is not installed.
    """
    return _by_opencv(given, "INPAINT_NS")


def _by_opencv(given: MethodInputs, name: str) -> Picture:
    try:
        import cv2
    except ImportError as error:
        cure = 'Install it with: pip install "doedesign[evaluation]"'
        raise InputError("method", "Telea and Navier-Stokes inpainting are OpenCV's", "no OpenCV here", cure) from error
    shown = np.round(255 * np.clip(as_seen(given), 0, 1)).astype(np.uint8)
    if given.hole.all():  # OpenCV would return what it was given, a scene that nobody sees
        return np.zeros(shown.shape, np.float32)
    hole, flag = given.hole.astype(np.uint8), getattr(cv2, name)
    found = np.stack([cv2.inpaint(np.ascontiguousarray(one), hole, _RADIUS_PX, flag) for one in shown])
    return found.astype(np.float32) / 255


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "as_seen": as_seen,
        "richardson_lucy_far": richardson_lucy,
        "richardson_lucy_near": lambda given: richardson_lucy(given, near=True),
        "wiener_far": wiener,
        "wiener_near": lambda given: wiener(given, near=True),
        "biharmonic": biharmonic,
        "telea": telea,
        "navier_stokes": navier_stokes,
    }
)
