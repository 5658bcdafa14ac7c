"""One measured image beside its model: the window, its place, its weights, and the two numbers that are solved for.

Of every image the brightness and the level of its background are unknown. Given the model's image they follow from
linear least squares, so the search never sees them (variable projection): with r = y - gain m - background at the
best gain and background, the gradient of the weighted squares with respect to the model is -2 gain W r.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import irfft2, rfft2
from scipy.ndimage import gaussian_filter

from fab.errors import InputError
from sim.measured import MeasuredPsf, cut_window, parabola_vertex, smoothed

Image = Float[np.ndarray, "y x"]


class MeasuredImage(NamedTuple):
    """A measured image as it came: the whole merged frame of a point source at a depth.

    Attributes:
        centre: row and column about which its light lies.
        brightness: rate that all light on the clear aperture would give, and its relative standard deviation; None
            where only the shape is known.
        defocus_sigma: standard deviation of the source's curvature, 1/m; 0 if its depth is exact.
        beam_radius_m: radius of a Gaussian beam on the plate, at 1/e² of its irradiance; infinite for even light.
    """

    name: str
    depth_m: float
    psf: MeasuredPsf
    centre: tuple[float, float]
    brightness: tuple[float, float] | None = None
    defocus_sigma: float = 0.0
    beam_radius_m: float = math.inf


class Target(NamedTuple):
    """A measured image in the window, in units of `scale` in which its light adds up to about 1.

    The chief ray lies `shift_px` from the window's middle (y, x), as found before the fit.
    """

    image: MeasuredImage
    psf: MeasuredPsf
    scale: float
    shift_px: tuple[float, float]

    @property
    def name(self) -> str:
        """The image's name."""
        return self.image.name

    @property
    def pixels(self) -> int:
        """Number of pixels that count."""
        return int(self.psf.valid.sum())

    @property
    def gain_sigma(self) -> float | None:
        """Standard deviation of the gain, which should be 1 where the brightness is known."""
        return self.image.brightness and self.image.brightness[1]


class Match(NamedTuple):
    """A model's image beside a measured one: residual = image - gain * model - background, weighted.

    Weights are inverse variances, zero where a pixel says nothing; chi2 has a term for a gain that is known.
    """

    target: Target
    weights: Image
    model: Image
    gain: float
    background: float
    residual: Image
    chi2: float

    @property
    def chi2_per_pixel(self) -> float:
        """Sum of squares over the pixels that count."""
        return self.chi2 / max(self.target.pixels, 1)

    def residuals(self) -> Float[np.ndarray, " n"]:
        """Residuals in standard deviations, last that of a gain that is known; their squares add up to `chi2`."""
        pixels, sigma = (np.sqrt(self.weights) * self.residual).ravel(), self.target.gain_sigma
        return np.append(pixels, (self.gain - 1.0) / sigma) if sigma else pixels

    def residual_jacobian(self, columns: Float[np.ndarray, "p y x"]) -> Float[np.ndarray, "p n"]:
        """Derivatives of `residuals`, gain and background solved for (Kaufman, BIT 15, 49, 1975)."""
        root, sigma = np.sqrt(self.weights).ravel(), self.target.gain_sigma
        flat = self.gain * columns.reshape(len(columns), -1) * root
        basis = np.stack([self.model.ravel(), np.ones(root.size)]) * root
        normal = basis @ basis.T
        if sigma:
            normal[0, 0] += sigma**-2
        shares = np.linalg.solve(normal, basis @ flat.T)
        pixels = shares.T @ basis - flat
        return np.column_stack([pixels, -shares[0] / sigma]) if sigma else pixels


def match(target: Target, weights: Image, model: Image) -> Match:
    """Best gain and background, and what is left."""
    rate, total, sigma = target.psf.rate, weights.sum(), target.gain_sigma
    mean_model, mean_rate = (float((weights * v).sum() / total) for v in (model, rate))
    centred = weights * (model - mean_model)
    wanted, trust = (1.0, sigma**-2) if sigma else (0.0, 0.0)
    against = float((centred * (rate - mean_rate)).sum()) + trust * wanted
    gain = max(against / (float((centred * (model - mean_model)).sum()) + trust), np.finfo(float).tiny)
    background = mean_rate - gain * mean_model
    residual = np.where(weights > 0, rate - gain * model - background, 0.0)
    chi2 = float((weights * residual**2).sum()) + trust * (gain - wanted) ** 2
    return Match(target, weights, model, gain, background, residual, chi2)


def target_of(image: MeasuredImage, window: int, model: Image) -> Target:
    """Cut an image to a window, pixels per side, and find its centre by comparison with a centred model of it.

    Raises:
        InputError: the image is smaller than the window, or its middle is no light at all.
    """
    psf, rest = _window(image, image.centre, window)
    centre, shift = image.centre, _shift_px(smoothed(psf), model)
    for _ in range(2):
        if max(map(abs, shift)) <= 1:
            break
        # From here on the place in the window is the model's word.
        low_y, low_x = (c - r for c, r in zip(centre, rest, strict=True))
        centre = (low_y + shift[0], low_x + shift[1])
        psf, rest = _window(image, centre, window)
        shift = _shift_px(smoothed(psf), model)
    scale = image.brightness[0] if image.brightness else float(psf.rate[psf.valid].sum())
    if not scale > 0:
        raise InputError(image.name, "the light above the background must add up", f"{scale:.4g}", "Expose longer.")
    unit = MeasuredPsf(psf.rate / scale, psf.floor / scale**2, psf.slope / scale, psf.valid)
    return Target(image, unit, scale, shift)


def _window(image: MeasuredImage, centre: tuple[float, float], window: int) -> tuple[MeasuredPsf, tuple[float, float]]:
    try:
        psf, rest = cut_window(image.psf, centre, window)
    except InputError as error:
        raise InputError(image.name, error.rule, error.got, error.cure) from error
    if not psf.valid.any():
        got = f"a centre at row {centre[0]:.0f}, column {centre[1]:.0f}"
        raise InputError(image.name, "its light must lie within the frame", got, "Check `centre`.")
    return psf, rest


def _correlation(image: Image, model: Image) -> Float[np.ndarray, "v u"]:
    """Correlation of the roots of two intensities for every shift of the first, normalised, in FFT order.

    The model is blurred like the image (`sim.measured.smoothed`).
    """
    one, other = (np.sqrt(np.maximum(values, 0.0)) for values in (image, gaussian_filter(model, 1.5)))
    one, other = one - one.mean(), other - other.mean()
    size = (2 * image.shape[0], 2 * image.shape[1])
    ahead, behind = (np.asarray(rfft2(v, size)) for v in (one, other))
    norm = np.sqrt((one**2).sum() * (other**2).sum())
    return np.asarray(irfft2(ahead * behind.conj(), size)) / max(norm, np.finfo(float).tiny)


def _shift_px(image: Image, model: Image) -> tuple[float, float]:
    """By how many pixels (y, x) an image lies off a model: the peak of their correlation."""
    likeness = _correlation(image, model)
    row, column = (int(i) for i in np.unravel_index(np.argmax(likeness), likeness.shape))

    def place(line: Float[np.ndarray, " n"], at: int) -> float:
        return (at if at < len(line) // 2 else at - len(line)) + parabola_vertex(line, at)

    return place(likeness[:, column], row), place(likeness[row], column)


def likeness(target: Target, model: Image, quarter_turns: int, mirrored: bool) -> float:
    """How much an image, turned to the left after it was mirrored left to right, looks like a model: 1 if equal."""
    picture = smoothed(target.psf)
    # Rows count upwards, so numpy's turn to the left is one to the right.
    turned = np.rot90(picture[:, ::-1] if mirrored else picture, -quarter_turns)
    return float(_correlation(turned, model).max())


def measured_weights(target: Target, model_error: float) -> Image:
    """Inverse variances with the signal taken from the measurement itself, smoothed a little against its noise."""
    valid = target.psf.valid.astype(np.float64)
    light = gaussian_filter(np.maximum(target.psf.rate, 0.0) * valid, 0.7)
    # Over the pixels that are there: a mosaic has others between them.
    return weights_at(target, light / np.maximum(gaussian_filter(valid, 0.7), 1e-3), model_error)


def weights_at(target: Target, signal: Image, model_error: float, background: float = 0.0) -> Image:
    """Inverse variances where light `signal` lies on a background that the model does not make; zero where not valid.

    `model_error` is the relative error that the model expects of itself.
    """
    # What the transform gets wrong at a bright pixel it gets wrong beside it, too.
    nearby = gaussian_filter(signal**2, 1.0)
    variance = target.psf.variance(signal + background) + model_error**2 * nearby
    return np.where(target.psf.valid, 1 / np.maximum(variance, np.finfo(float).tiny), 0.0)
