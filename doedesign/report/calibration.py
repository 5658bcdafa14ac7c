"""What a calibration found: measured images beside the model's, errors with their uncertainty, and what to believe."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import (
    DPI,
    FAINT,
    INK,
    LIGHT,
    LINE,
    MARK,
    SERIES,
    SMALL,
    length_text,
    note,
    picture,
    place,
    scale_bar,
    shrunk,
    wrapped,
)
from doedesign.report.tolerance import error_label
from fab.process import DEVIATIONS
from fab.units import UM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from doedesign.calibration import Calibration

_SIDE = 2.6  # inches of an image
_ABOVE, _BELOW, _LEFT, _GAP, _BAR = 0.3, 0.4, 0.15, 0.12, 0.6
_ROW = 0.27  # inches of one error's row
_MOST_SIGMA = 5.0


class _Scale(NamedTuple):
    """How values of an error are written: factor and unit."""

    factor: float
    unit: str


def _scale_of(name: str) -> _Scale:
    key = name.partition("[")[0]
    unit = DEVIATIONS[key].unit
    if key == "magnification":
        return _Scale(1e6, "ppm")
    return {"m": _Scale(1e9, "nm"), "rad": _Scale(math.degrees(1.0), "°"), "1": _Scale(100.0, "%")}[unit]


def value_text(name: str, value: float, sigma: float | None = None) -> str:
    """An error with its unit, and its standard deviation: "-120 ± 4 nm"; as many digits as mean something."""
    scale = _scale_of(name)
    shown = scale.factor * value
    if sigma is None or not sigma > 0:
        return f"{shown:.3g} {scale.unit}"
    spread = scale.factor * sigma
    digits = max(0, 1 - math.floor(math.log10(spread)))
    return f"{shown:.{digits}f} ± {spread:.{digits}f} {scale.unit}"


def draw_fitted_psfs(path: str | Path, result: "Calibration") -> None:
    """Draw every measured image beside the model's, and what is left between them in standard deviations.

    Measured and model share a logarithmic scale. Pixels that say nothing are grey.

    Args:
        path: the PNG file.
        result: the calibration.

    Raises:
        InputError: the system refuses the path.
    """
    targets = result.objective.targets
    across = _LEFT + 3 * (_SIDE + _GAP) + 2 * _BAR + 0.1
    words = (
        "measured and model: logarithmic, background taken off, in units of the model's light in the window; "
        "difference: measured - model in standard deviations of the noise; grey: no usable pixel"
    )
    text = wrapped(words, across - 0.3)
    foot = 0.2 + 0.15 * (text.count("\n") + 1)
    high = _ABOVE + _SIDE + _BELOW
    with picture(path, (across, foot + high * len(targets))) as figure:
        for i in range(len(targets)):
            _draw_image(figure, foot + (len(targets) - 1 - i) * high + _BELOW, result, i)
        note(figure, 0.15, 0.1, text)


def _draw_image(figure: "Figure", bottom: float, result: "Calibration", index: int) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm, Normalize

    objective, at = result.objective, result.fit.at
    target, found, weights = objective.targets[index], at.matches[index], result.fit.weights[index]
    total = at.images[index].sum()
    model = at.images[index] / total
    measured = (target.psf.rate - found.background) / (found.gain * total)
    pulls = found.residual * np.sqrt(weights)
    valid = weights > 0
    dots = round(DPI * _SIDE)
    top = float(model.max())
    norm = LogNorm(max(float(np.quantile(model, 0.02)), 1e-6 * top), top, clip=True)
    pull_norm = Normalize(-_MOST_SIGMA, _MOST_SIGMA)
    palette = colormaps[LIGHT].with_extremes(bad=FAINT)
    differences = colormaps["RdBu_r"].with_extremes(bad=FAINT)
    half = model.shape[0] * objective.model.camera.pixel_m / UM / 2
    panels = [
        (f"{target.name}, {length_text(target.depth_m)}: measured", measured, palette, norm),
        ("model", model, palette, norm),
        (f"difference, {found.chi2 / max(valid.sum(), 1):.3g} chi2 per pixel", pulls, differences, pull_norm),
    ]
    left = _LEFT
    for column, (title, values, colours, scale) in enumerate(panels):
        axes = place(figure, left, bottom, _SIDE, _SIDE)
        shown = _masked(values, valid if column != 1 else np.ones_like(valid), dots)
        axes.imshow(shown, origin="lower", extent=(-half, half, -half, half), cmap=colours, norm=scale)
        axes.set_title(title)
        axes.set_xticks([])
        axes.set_yticks([])
        left += _SIDE + _GAP
        if column == 0:
            scale_bar(axes, 2 * half * UM)
        if column > 0:
            bar = place(figure, left, bottom, 0.1, _SIDE)
            figure.colorbar(ScalarMappable(scale, colours), cax=bar)
            bar.minorticks_off()
            left += _BAR
    # Words under the middle panel: what was solved for.
    shift = objective.motion(at.scores, index)
    pixel = objective.model.camera.pixel_m
    text = f"centre {shift[1] * pixel / UM:+.2f}, {shift[0] * pixel / UM:+.2f} µm (x, y)"
    note(figure, _LEFT + _SIDE + _GAP, bottom - 0.2, text)


def _masked(values: Float[np.ndarray, "y x"], valid: np.ndarray, dots: int) -> np.ma.MaskedArray:
    """Shrunk to the picture's dots, over the pixels that are there."""
    share = shrunk(valid.astype(np.float64), dots)
    mean = shrunk(np.where(valid, values, 0.0), dots) / np.maximum(share, 1e-9)
    return np.ma.array(mean, mask=share < 0.25)


def draw_estimates(path: str | Path, result: "Calibration") -> None:
    """Draw every error with its uncertainty against what was believed before, and how errors hang together.

    Args:
        path: the PNG file.
        result: the calibration.

    Raises:
        InputError: the system refuses the path.
    """
    unknowns, posterior = result.objective.unknowns, result.posterior
    count = len(unknowns.names)
    high = max(_ROW * count, 1.4)
    words = (
        "grey: what was believed beforehand, one standard deviation; bar: one standard deviation of what is known now; "
        "hollow: not determined by the images"
    )
    text = wrapped(words, 9.0)
    foot = 0.65 + 0.15 * (text.count("\n") + 1)
    size = (5.9 + 1.3 + high + 0.75, foot + high + 0.35)
    with picture(path, size) as figure:
        axes = place(figure, 1.9, foot, 3.6, high)
        rows = np.arange(count)[::-1]
        centre = (posterior.values - unknowns.mean) / unknowns.sigma
        spread = posterior.sigma / unknowns.sigma
        axes.barh(rows, 2, 0.75, left=-1, color=FAINT, alpha=0.35, lw=0)
        axes.axvline(0, color=FAINT, lw=0.8)
        for row, value, bar, name in zip(rows, centre, spread, unknowns.names, strict=True):
            determined = result.determined[name]
            look: dict[str, Any] = {"color": LINE, "capsize": 3, "lw": 1.6, "ms": 5}
            fill = LINE if determined else "white"
            axes.errorbar(value, row, xerr=bar, fmt="o", mfc=fill, mec=LINE, **look)
            i = unknowns.names.index(name)
            axes.annotate(
                value_text(name, posterior.values[i], posterior.sigma[i]),
                (1.02, row),
                xycoords=("axes fraction", "data"),
                va="center",
                fontsize=SMALL,
            )
        axes.set_yticks(rows, [error_label(name) for name in unknowns.names])
        axes.set_ylim(-0.6, count - 0.4)
        reach = max(1.3, float(np.max(np.abs(centre) + spread)) * 1.1)
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("distance from what was believed, in its standard deviations", labelpad=2)
        axes.tick_params(length=2.5)
        axes.set_title(f"errors of the plate, {posterior.chi2_per_pixel:.3g} chi2 per pixel")
        _draw_correlation(figure, (5.9 + 1.3, foot, high), result)
        note(figure, 0.15, 0.1, text)


def _draw_correlation(figure: "Figure", box_in: tuple[float, float, float], result: "Calibration") -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    left, bottom, side = box_in
    axes = place(figure, left, bottom, side, side)
    norm = Normalize(-1, 1)
    axes.imshow(result.posterior.correlation, cmap="RdBu_r", norm=norm)
    names = result.objective.unknowns.names
    axes.set_xticks([])
    axes.set_yticks(range(len(names)), [""] * len(names))
    axes.tick_params(length=2.5)
    axes.set_title("correlation, same order")
    bar = place(figure, left + side + 0.08, bottom, 0.1, side)
    figure.colorbar(ScalarMappable(norm, "RdBu_r"), cax=bar).ax.tick_params(labelsize=SMALL)


def draw_check(path: str | Path, result: "Calibration") -> None:
    """Draw the posterior check: residuals against the noise, images predicted from the others, numbers read off.

    Args:
        path: the PNG file.
        result: the calibration.

    Raises:
        InputError: the system refuses the path.
    """
    targets = result.objective.targets
    measured = [reading for reading in result.readings if reading.measured]
    words = (
        "left: residuals of all pixels in standard deviations, against the normal distribution (dashed); middle: "
        "chi2 per pixel of every image in the fit and as predicted from the other images; right: numbers read off "
        "the images against the model's (zero), bar: noise, shade: uncertainty of the model"
    )
    text = wrapped(words, 9.4)
    foot = 0.65 + 0.15 * (text.count("\n") + 1)
    with picture(path, (9.9, foot + 2.2 + 0.35)) as figure:
        axes = place(figure, 0.65, foot, 2.4, 2.2)
        bins = np.linspace(-6, 6, 61)
        for i, target in enumerate(targets):
            pulls = result.fit.at.matches[i].residual * np.sqrt(result.fit.weights[i])
            values = np.clip(pulls[result.fit.weights[i] > 0], -5.999, 5.999)
            axes.hist(
                values, bins.tolist(), density=True, histtype="step", color=SERIES[i % len(SERIES)], label=target.name
            )
        middle = (bins[1:] + bins[:-1]) / 2
        axes.plot(middle, np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi), color=INK, ls="--", lw=1)
        axes.set_yscale("log")
        axes.set_ylim(1e-4, 2)
        axes.set_xlabel("residual / standard deviation", labelpad=2)
        axes.set_ylabel("density", labelpad=2)
        axes.legend(loc="upper left", fontsize=SMALL)
        _draw_left_out(place(figure, 4.3, foot, 1.7, 2.2), result)
        _draw_readings(place(figure, 7.7, foot, 2.0, 2.2), measured)
        note(figure, 0.15, 0.1, text)


def _draw_left_out(axes: "Axes", result: "Calibration") -> None:
    fitted = [
        found.chi2 / max(int(target.psf.valid.sum()), 1)
        for target, found in zip(result.objective.targets, result.fit.at.matches, strict=True)
    ]
    rows = np.arange(len(fitted))[::-1]
    axes.barh(rows + 0.17, fitted, 0.3, color=LINE, label="fit of all")
    if result.left_out:
        axes.barh(rows - 0.17, [one.predicted for one in result.left_out], 0.3, color=MARK, label="from the others")
    axes.axvline(1, color=INK, ls="--", lw=1)
    axes.set_yticks(rows, [target.name for target in result.objective.targets])
    axes.set_ylim(-0.6, len(fitted) - 0.4)
    axes.set_xlabel("chi2 per pixel", labelpad=2)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2, ncols=2, handlelength=1, columnspacing=1)


def _draw_readings(axes: "Axes", readings: Sequence[Any]) -> None:
    rows = np.arange(len(readings))[::-1]
    for row, reading in zip(rows, readings, strict=True):
        (value, sigma), (model, spread) = reading.measured, reading.predicted
        ratio = 100 * (value / model - 1)
        axes.errorbar(ratio, row, xerr=100 * sigma / model, fmt="o", color=LINE, capsize=3, ms=4)
        axes.barh(row, 200 * spread / model, 0.5, left=-100 * spread / model, color=MARK, alpha=0.3, lw=0)
    axes.axvline(0, color=INK, ls="--", lw=1)
    names = {"ring_to_disc": "ring:disc", "far_spot": "far spot", "throughput": "throughput"}
    axes.set_yticks(rows, [f"{names[r.quantity]}, {r.image}" for r in readings])
    axes.set_ylim(-0.6, len(readings) - 0.4)
    axes.set_xlabel("measured - predicted (%)", labelpad=2)
