"""Measured PSFs: from the frames of a camera to one image with known noise.

Several exposures of a point source through the plate, each with a dark frame (`sim.frames`), are freed of their dark
level, merged to one image of high dynamic range, freed of the background, and cut to a window round the light. Nothing
is interpolated: the window moves by whole pixels and the model moves by the rest. Pixels without information (saturated
in every exposure, another colour of a mosaic, beyond the frame's edge) are marked as not valid.

Noise. A pixel of one exposure has the variance read² + dark's + step² / 12 + signal / gain, in counts². Exposures are
weighted by its inverse, taken from a first estimate of the signal, so the merged variance is `floor + slope * signal`
with known coefficients, for any signal; a fit can use its model's.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, label

from fab.errors import InputError
from sim.frames import CameraFrame

Image = Float[np.ndarray, "y x"]
_BORDER = 0.05  # of the shorter side: where a frame should hold background alone
_HOT = 3.0  # standard deviations of a dark frame above its median
_SEARCH = 1024  # samples per side on which the light is looked for


class Noise(NamedTuple):
    """Noise of a pixel itself: electrons per count, and the standard deviation of a reading in electrons."""

    gain_e: float
    read_e: float


class MeasuredPsf(NamedTuple):
    """A merged image."""

    rate: Image  # `[y, x]` counts per unit of exposure
    floor: Image  # variance of `rate` without light
    slope: Image  # variance of `rate` per unit of light
    valid: Bool[np.ndarray, "y x"]  # pixels that carry information

    def variance(self, signal: Image) -> Image:
        """Variance of `rate` where the light is `signal`; what is below zero is no light."""
        return self.floor + self.slope * np.maximum(signal, 0.0)


def merge_exposures(
    frames: Sequence[CameraFrame],
    exposures: Sequence[float],
    darks: Sequence[CameraFrame | float],
    noise: Noise,
    *,
    clipped_at: float | None = None,
    dark_count: int = 1,
    names: Sequence[str] = (),
) -> MeasuredPsf:
    """Merge exposures of the same scene, of any unit of time, into one image per unit of exposure.

    Args:
        frames: exposures of equal shape.
        exposures: their lengths.
        darks: for each a frame without light of the same length, or the level of black in counts.
        noise: gain and read noise.
        clipped_at: value from which a pixel is full; by default what each file says.
        dark_count: frames that every dark frame is the mean of.
        names: names of the frames in messages.

    Raises:
        InputError: frames or exposures that do not fit, or an image that is dark or saturated everywhere.
    """
    names = tuple(names) or tuple(f"image {i}" for i in range(len(frames)))
    shape = frames[0].counts.shape
    lights, floors, heats, usable = [], [], [], []
    for frame, exposure, dark, name in zip(frames, exposures, darks, names, strict=True):
        if frame.counts.shape != shape:
            got = f"{frame.counts.shape} against {shape}"
            rule = "all exposures of an image must have the same size"
            raise InputError(name, rule, got, "Give frames of one camera.")
        if not 0 < exposure < np.inf:
            raise InputError(name, "an exposure must be positive", exposure, "Give its length.")
        light, floor, heat = _without_dark(frame, dark, noise, dark_count, name)
        lights.append(light)
        floors.append(floor)
        heats.append(heat)
        top = frame.clipped_at if clipped_at is None else clipped_at
        usable.append(frame.valid if top is None else np.logical_and(frame.valid, frame.counts < top - frame.step / 2))
    times = np.asarray(exposures, np.float64)[:, None, None]
    used = np.stack(usable)
    valid = used.any(axis=0)
    if valid.sum() < 0.01 * sum(frame.valid.sum() for frame in frames) / len(frames):
        raise InputError(names[int(np.argmin(exposures))], "some pixels must not be saturated", "hardly any", _SHORTER)
    # One dark frame for all is the same noise in all.
    shared = len(frames) > 1 and all(dark is darks[0] for dark in darks)
    light, floor, heat = (np.stack(each) for each in (lights, floors, heats))
    return _merged(light, floor, heat, used, times, noise.gain_e, shared)._replace(valid=valid)


_SHORTER = "Add a shorter exposure, or check `saturation`."


def _without_dark(
    frame: CameraFrame, dark: CameraFrame | float, noise: Noise, dark_count: int, name: str
) -> tuple[Image, Image, Image]:
    """Counts above black, their variance without light, and that which the dark frame has besides."""
    read = (noise.read_e / noise.gain_e) ** 2 + frame.step**2 / 12
    if not isinstance(dark, CameraFrame):
        light = frame.counts.astype(np.float64) - dark
        floor, own = np.full(light.shape, read), np.zeros(light.shape)
    else:
        if dark.counts.shape != frame.counts.shape:
            got = f"{dark.counts.shape} against {frame.counts.shape}"
            raise InputError(name, "a dark frame must have its image's size", got, "Take it with the same settings.")
        light = frame.counts.astype(np.float64) - dark.counts
        # Electrons that heat sets free are as noisy as those of light; where a dark frame is bright, both frames are.
        # What may be noise alone is no heat: half of all pixels would have some, and weigh less where they look dark.
        above = dark.counts - np.median(dark.counts[frame.valid])
        heat = np.where(above > _HOT * np.sqrt(read / dark_count), above, 0.0) / noise.gain_e
        floor, own = read + heat, (read + heat) / dark_count
    if not light[frame.valid].mean() > 0:
        got = f"a mean of {light[frame.valid].mean():.4g} counts above dark"
        raise InputError(name, "an image must be brighter than its dark frame", got, "Check which is which.")
    return light, floor, own


def _merged(
    light: Float[np.ndarray, "n y x"],
    floor: Float[np.ndarray, "n y x"],
    of_darks: Float[np.ndarray, "n y x"],
    used: Bool[np.ndarray, "n y x"],
    times: Float[np.ndarray, "n 1 1"],
    gain_e: float,
    shared: bool,
) -> MeasuredPsf:
    """Mean of the rates, weighted by their inverse variance; zero where nothing is usable."""
    total = np.maximum((used * times).sum(axis=0), np.finfo(float).tiny)
    first = np.maximum((used * light).sum(axis=0) / total, 0.0)
    variance = floor + of_darks + first * times / gain_e
    # Where nothing is noisy all count alike.
    weight = used * times**2 / np.maximum(variance, 1e-9 * variance.max() or 1.0)
    share = weight / np.maximum(weight.sum(axis=0), np.finfo(float).tiny)
    dark = (share / times).sum(axis=0) ** 2 * of_darks[0] if shared else (share**2 * of_darks / times**2).sum(axis=0)
    return MeasuredPsf(
        rate=(share * light / times).sum(axis=0),
        floor=(share**2 * floor / times**2).sum(axis=0) + dark,
        slope=(share**2 / (times * gain_e)).sum(axis=0),
        valid=np.asarray(used.any(axis=0)),
    )


def without_background(psf: MeasuredPsf) -> tuple[MeasuredPsf, float]:
    """Take off the level of the frame's border, the mean of its outer twentieth without outliers, and return it.

    Where the PSF reaches the border this takes light away, too: a fit should leave an offset free.
    """
    rows, columns = psf.rate.shape
    wide = max(2, round(_BORDER * min(rows, columns)))
    border = psf.valid.copy()
    border[wide : rows - wide, wide : columns - wide] = False
    values = psf.rate[border if border.any() else psf.valid]
    middle = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - middle))
    level = float(values[np.abs(values - middle) <= max(3 * spread, np.finfo(float).tiny)].mean())
    # Its light is gone, its noise is not.
    return psf._replace(rate=psf.rate - level, floor=psf.floor + psf.slope * max(level, 0.0)), level


def centre_of_light(psf: MeasuredPsf) -> tuple[float, float]:
    """Row and column of the point about which the light is most symmetric, good to a few pixels.

    The peak of the image's convolution with itself. An InputError where no light exceeds the noise.
    """
    factor = max(1, -(-max(psf.rate.shape) // _SEARCH))
    there = (np.where(psf.valid, values, 0.0) for values in (psf.rate, psf.floor, psf.valid))
    sums, floor, share = (_sums(values, factor) for values in there)
    light = _without_holes(sums, share, factor)
    # That filter leaves a fifth of white noise.
    quiet = np.sqrt(np.median(floor[share > 0] / share[share > 0] ** 2)) / 5
    clear = np.where(light > 6 * quiet, np.maximum(light, 0.0), 0.0)
    if not clear.any():
        raise InputError("image", "there must be light above the noise", "none", "Expose longer, or check the files.")
    size = tuple(cast(int, next_fast_len(2 * count, real=True)) for count in clear.shape)
    folded = np.asarray(irfft2(np.square(np.asarray(rfft2(clear, size))), size))
    top, left = (int(i) for i in np.unravel_index(np.argmax(folded), size))
    peak = (top + parabola_vertex(folded[:, left], top), left + parabola_vertex(folded[top], left))
    # A bin's middle lies (factor - 1) / 2 pixels beyond its first one.
    row, column = (factor * place / 2 + (factor - 1) / 2 for place in peak)
    return row, column


def smoothed(psf: MeasuredPsf) -> Image:
    """The image a little blurred and without holes, for comparisons that need every pixel."""
    light, share = (np.where(psf.valid, values, 0.0).astype(np.float64) for values in (psf.rate, psf.valid))
    return _without_holes(light, share, 1)


def _without_holes(light: Image, share: Image, factor: int) -> Image:
    """Sums over bins, of which `share` counts the pixels that are there, as a blurred image.

    A missing region counts as the brightest of all or, if it reaches the border, as beyond the frame.
    """
    seen = gaussian_filter(share, 1.5)
    there = seen > 0.02 * factor**2
    mean = gaussian_filter(light, 1.5) / np.maximum(seen, 1e-3)
    labelled: Any = label(~there)
    regions = labelled[0]
    edge = np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]])
    full = ~there & ~np.isin(regions, edge)
    return np.where(there, mean, np.where(full, mean[there].max() if there.any() else 0.0, 0.0))


def _sums(values: Image, factor: int) -> Float[np.ndarray, "v u"]:
    """Sums over squares of `factor` pixels; the last ones are filled up with zeros."""
    padded = np.pad(values, [(0, -size % factor) for size in values.shape])
    rows, columns = (size // factor for size in padded.shape)
    return padded.reshape(rows, factor, columns, factor).sum(axis=(1, 3))


def parabola_vertex(values: Float[np.ndarray, " n"], at: int) -> float:
    """Where between its neighbours the parabola through a peak has its vertex."""
    low, peak, high = values[at - 1], values[at], values[(at + 1) % len(values)]
    bend = low - 2 * peak + high
    return float((low - high) / (2 * bend)) if bend < 0 else 0.0


def cut_window(psf: MeasuredPsf, centre: tuple[float, float], window: int) -> tuple[MeasuredPsf, tuple[float, float]]:
    """Cut a square of whole pixels whose middle is nearest to a point (row, column); an InputError for a smaller frame.

    Returns:
        the square, pixels beyond the frame not valid, and where in it the point lies: pixels from its middle (y, x).
    """
    if min(psf.rate.shape) < window:
        rule = f"an image must have at least the window's {window} pixels per side"
        raise InputError("image", rule, psf.rate.shape, "Take a smaller `window`, or the whole frame.")
    corner = [place - (window - 1) / 2 for place in centre]
    starts = [round(place) for place in corner]
    # Places in the frame with a window of zeros all round.
    places = [window + min(max(start, -window), size) for start, size in zip(starts, psf.rate.shape, strict=True)]
    y, x = (slice(place, place + window) for place in places)
    cut = MeasuredPsf(*(np.pad(values, window)[y, x] for values in psf))
    return cut, (corner[0] - starts[0], corner[1] - starts[1])


def binned(psf: MeasuredPsf, factor: int) -> MeasuredPsf:
    """Add squares of `factor` x `factor` pixels, which must divide the sides; one that lacks a pixel is not valid."""
    if any(size % factor for size in psf.rate.shape):
        raise ValueError(f"the sides must be multiples of {factor}, but the shape is {psf.rate.shape}")
    whole = _sums((~psf.valid).astype(np.float64), factor) == 0
    rate, floor, slope = (_sums(values, factor) for values in psf[:3])
    # Variances add; a shot-noise slope applies to the sum of signals.
    return MeasuredPsf(rate, floor, slope / factor**2, whole)
