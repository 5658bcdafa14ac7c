"""Pictures of a calibration and of explanations; each takes the place of axes `ax` of a subplot, or is a new figure."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from doedesign.calibration.uncertainty import DETERMINED
from doedesign.report.labels import error_label, value_text
from fab.figure import (
    DPI,
    FAINT,
    INK,
    LIGHT,
    LINE,
    MARK,
    SERIES,
    SMALL,
    bare,
    extent_of,
    length_text,
    panels,
    scale_bar,
    shrunk,
)
from fab.units import UM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.calibration.estimate import Calibration
    from doedesign.calibration.explanations import Explanation, ExplanationSet

_SIDE = 2.6  # inches of an image
_ROW = 0.27  # inches of one error's row
_MOST_SIGMA = 5.0
_MOST_EXPLANATIONS = 14
_BESIDE: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "va": "center", "fontsize": SMALL}
_READINGS = {"ring_to_disc": "ring:disc", "far_spot": "far spot", "throughput": "throughput"}


def plot_fitted_psfs(result: "Calibration", ax: "Axes | None" = None) -> "FigureBase":
    """Draw every measured image beside the model's, and their difference in standard deviations; grey: not used."""
    count = len(result.fit.at.matches)
    words = (
        "measured and model: logarithmic, background taken off, in units of the model's light in the window; "
        "difference: measured - model in standard deviations of the noise; grey: no usable pixel"
    )
    size = (3 * _SIDE + 1.9, count * (_SIDE + 0.55) + 0.85)
    with panels(ax, size, "Measured PSFs beside those of the plate that was found", words) as figure:
        for index, row in enumerate(figure.subplots(count, 3, squeeze=False)):
            _draw_image(figure, row, result, index)
    return figure


def _draw_image(figure: "FigureBase", row: Sequence["Axes"], result: "Calibration", index: int) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm, Normalize

    objective, at = result.objective, result.fit.at
    found = at.matches[index]
    target, total = found.target, found.model.sum()
    model = found.model / total
    measured = (target.psf.rate - found.background) / (found.gain * total)
    valid, everywhere = found.weights > 0, np.ones(model.shape, dtype=bool)
    top = float(model.max())
    norm = LogNorm(max(float(np.quantile(model, 0.02)), 1e-6 * top), top, clip=True)
    pulls, ends = found.residual * np.sqrt(found.weights), Normalize(-_MOST_SIGMA, _MOST_SIGMA)
    light, differences = (colormaps[name].with_extremes(bad=FAINT) for name in (LIGHT, "RdBu_r"))
    pixel_m = objective.model.camera.pixel_m
    images = (
        (f"{target.name}, {length_text(target.image.depth_m)}: measured", measured, valid, light, norm),
        ("model", model, everywhere, light, norm),
        (f"difference, {found.chi2_per_pixel:.3g} chi2 per pixel", pulls, valid, differences, ends),
    )
    for axes, (title, values, there, colours, scale) in zip(row, images, strict=True):
        box, dots = extent_of(model.shape, pixel_m), round(DPI * _SIDE)
        # Shrunk to the picture's dots, over the pixels that are there.
        share = shrunk(there.astype(np.float64), dots)
        mean = shrunk(np.where(there, values, 0.0), dots) / np.maximum(share, 1e-9)
        image = np.ma.array(mean, mask=share < 0.25)
        shown = axes.imshow(image, origin="lower", extent=box, cmap=colours, norm=scale)
        axes.set_title(title)
        bare(axes)
        if axes is not row[0]:
            figure.colorbar(shown, cax=axes.inset_axes((1.03, 0, 0.04, 1))).ax.minorticks_off()
    scale_bar(row[0], model.shape[1] * pixel_m)
    # The fitted place of the image.
    shift = objective.motion(at.scores, index) * pixel_m / UM
    row[1].set_xlabel(f"centre {shift[1]:+.2f}, {shift[0]:+.2f} µm (x, y)", fontsize=SMALL, loc="left")


def plot_estimates(result: "Calibration", ax: "Axes | None" = None) -> "FigureBase":
    """Draw every error and unknown of the camera with its uncertainty against its prior, and their correlation."""
    unknowns, posterior, known = result.objective.unknowns, result.posterior, result.objective.model.geometry
    kinds = list(known.unknown)
    count = len(unknowns.names) + len(kinds)
    both = (
        (unknowns.mean, known.mean),
        (unknowns.sigma, known.sigma),
        (posterior.values, posterior.geometry),
        (posterior.sigma, posterior.geometry_sigma),
    )
    mean, prior, values, sigma = (np.append(errors, np.array(camera)[kinds]) for errors, camera in both)
    height = max(_ROW * count, 1.4)
    words = (
        "grey: prior, one standard deviation; bar: posterior, one standard deviation; hollow: not determined by the "
        "images"
    )
    with panels(ax, (7.8 + height, height + 1.55), "Errors that explain the measured PSFs", words) as figure:
        errors, correlation = figure.subplots(1, 2, width_ratios=(3.6, height))
        rows = _name_rows(errors, result.rows)
        centre, spread = (values - mean) / prior, sigma / prior
        errors.barh(rows, 2, 0.75, left=-1, color=FAINT, alpha=0.35, lw=0)
        errors.axvline(0, color=FAINT, lw=0.8)
        for i, (row, text) in enumerate(zip(rows, result.rows.values(), strict=True)):
            style: dict[str, Any] = {"color": LINE, "mec": LINE, "capsize": 3, "lw": 1.6, "ms": 5}
            fill = LINE if spread[i] < DETERMINED else "white"
            errors.errorbar(centre[i], row, xerr=spread[i], fmt="o", mfc=fill, **style)
            errors.annotate(text, (1.03, row), **_BESIDE)
        reach = max(1.3, float(np.max(np.abs(centre) + spread)) * 1.1)
        whose = "plate and camera" if kinds else "the plate"
        title = f"errors of {whose}, {posterior.chi2_per_pixel:.3g} chi2 per pixel"
        xlabel = "distance from the prior's mean, in its standard deviations"
        errors.set(xlim=(-reach, reach), xlabel=xlabel, title=title)
        shown = correlation.imshow(posterior.correlation, cmap="RdBu_r", vmin=-1, vmax=1, origin="upper", aspect="auto")
        ticks = {"xticks": [], "yticks": range(count), "yticklabels": [""] * count}
        # The rows of the errors.
        correlation.set(ylim=(count - 0.4, -0.6), **ticks, title="correlation, same order")
        figure.colorbar(shown, ax=correlation)
    return figure


def plot_check(result: "Calibration", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the posterior check: residuals against the noise, images predicted from the others, numbers read off."""
    words = (
        "left: residuals of all pixels in standard deviations, against the normal distribution (dashed); middle: "
        "chi2 per pixel of every image in the fit and as predicted from the other images; right: numbers read off "
        "the images against the model's (zero), bar: noise, shade: uncertainty of the model"
    )
    with panels(ax, (9.9, 3.85), "Does the plate that was found explain the images?", words) as figure:
        residuals, images, readings = figure.subplots(1, 3, width_ratios=(2.4, 1.7, 2.0))
        _draw_residuals(residuals, result)
        _draw_left_out(images, result)
        _draw_readings(readings, [reading for reading in result.readings if reading.measured])
    return figure


def _draw_residuals(axes: "Axes", result: "Calibration") -> None:
    bins = np.linspace(-6, 6, 61)
    for i, found in enumerate(result.fit.at.matches):
        pulls = (found.residual * np.sqrt(found.weights))[found.weights > 0]
        style: dict[str, Any] = {"histtype": "step", "color": SERIES[i % len(SERIES)], "label": found.target.name}
        axes.hist(np.clip(pulls, -5.999, 5.999), bins.tolist(), density=True, **style)
    middle = (bins[1:] + bins[:-1]) / 2
    axes.plot(middle, np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi), color=INK, ls="--", lw=1)
    axes.set(yscale="log", ylim=(1e-4, 2), xlabel="residual / standard deviation", ylabel="density")
    axes.legend(loc="upper left")


def _draw_left_out(axes: "Axes", result: "Calibration") -> None:
    fitted = [found.chi2_per_pixel for found in result.fit.at.matches]
    rows = _name_rows(axes, [target.name for target in result.objective.targets])
    axes.barh(rows + 0.17, fitted, 0.3, color=LINE, label="fit of all")
    if result.left_out:
        axes.barh(rows - 0.17, result.left_out, 0.3, color=MARK, label="from the others")
    axes.axvline(1, color=INK, ls="--", lw=1)
    axes.set_xlabel("chi2 per pixel")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2, ncols=2, handlelength=1, columnspacing=1)


def _draw_readings(axes: "Axes", readings: Sequence[Any]) -> None:
    axes.use_sticky_edges = False  # a margin beyond the shades
    rows = _name_rows(axes, [f"{_READINGS[r.quantity]}, {r.image}" for r in readings])
    for row, reading in zip(rows, readings, strict=True):
        (value, sigma), (model, spread) = reading.measured, reading.predicted
        ratio = 100 * (value / model - 1)
        axes.errorbar(ratio, row, xerr=100 * sigma / model, fmt="o", color=LINE, capsize=3, ms=4)
        axes.barh(row, 200 * spread / model, 0.5, left=-100 * spread / model, color=MARK, alpha=0.3, lw=0)
    axes.axvline(0, color=INK, ls="--", lw=1)
    axes.set_xlabel("measured - predicted (%)")


def _name_rows(axes: "Axes", labels: Iterable[str], **style: Any) -> np.ndarray:
    """Put labels at rows, the first on top; returns the rows."""
    names = list(labels)
    rows = np.arange(len(names))[::-1]
    axes.set_yticks(rows, names, **style)
    axes.set_ylim(-0.6, max(len(names), 1) - 0.4)
    return rows


def plot_explanations(found: "ExplanationSet", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the ring:disc ratio along every error, and the explanations of the measured ratio in order."""
    shown = [*found.singles[:_MOST_EXPLANATIONS], *found.pairs[: _MOST_EXPLANATIONS // 2]]
    targets = found.targets
    title = f"what gives a ring:disc ratio of {targets.ring_to_disc:.3g} at {length_text(targets.depth_m)}"
    words = (
        "left: the model's ratio along the errors that change it most, dashed: measured; right: distance of each "
        "explanation from the process's means, in its standard deviations, with the throughput that comes with it"
    )
    if targets.throughput is not None:
        percent = f"{100 * targets.throughput:.3g} %"
        words += f"; full bars: throughput within two standard deviations of the {percent} measured"
    if alone := list(map(error_label, found.unreached)):
        words += f"; none within {found.reach:g} standard deviations: {'; '.join(alone)}"
    with panels(ax, (11.1, max(_ROW * len(shown), 3.4) + 1.6), title, words) as figure:
        curves, bars = figure.subplots(1, 2, width_ratios=(3.1, 2.2))
        _draw_curves(curves, found)
        _draw_explanations(bars, shown)
    return figure


def _draw_curves(axes: "Axes", found: "ExplanationSet") -> None:
    reached = list(dict.fromkeys(name for each in found.singles for name in each.scores))[: 2 * len(SERIES)]
    # Besides those that explain it, those that change it most.
    others = sorted(found.curves, key=lambda name: -np.ptp(np.log(found.curves[name].ring_to_disc)))
    shown = list(dict.fromkeys([*reached, *others]))[: max(len(reached), len(SERIES))]
    for i, name in enumerate(shown):
        curve = found.curves[name]
        style = "-" if i < len(SERIES) else ":"
        hue, label = SERIES[i % len(SERIES)], error_label(name)
        axes.plot(curve.scores, curve.ring_to_disc, style, color=hue, marker=".", label=label)
    axes.axhline(found.targets.ring_to_disc, color=INK, ls="--", lw=1)
    axes.set(xlabel="error, standard deviations of the process", ylabel="ring:disc ratio")
    axes.grid(True)
    axes.legend(loc="best", fontsize=SMALL - 1)


def _draw_explanations(axes: "Axes", shown: "Sequence[Explanation]") -> None:
    labels = [" + ".join(f"{error_label(n)} {value_text(n, v)}" for n, v in each.values.items()) for each in shown]
    if not shown:
        axes.text(0.5, 0.5, "none", ha="center", va="center", transform=axes.transAxes)
    for row, each in zip(_name_rows(axes, labels, fontsize=SMALL - 1), shown, strict=True):
        axes.barh(row, each.distance, 0.6, color="white" if each.fits is False else LINE, ec=LINE, lw=1.0)
        axes.annotate(f"{100 * each.throughput:.1f} %", (1.03, row), **_BESIDE)
    axes.set_xlabel("standard deviations")
    axes.annotate("throughput", (1.03, 1.02), xycoords="axes fraction", fontsize=SMALL)
