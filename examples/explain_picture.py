"""The picture of explain_1to1.py: what errors do to the ratio, ratio and throughput together, and three near PSFs."""

from collections.abc import Sequence
from math import log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from explain_plates import (
    BEYOND,
    DEEPEST,
    FULL_WAVE,
    MEASURED_RATIO,
    MEASURED_THROUGHPUT,
    MISSED,
    PROBE,
    WIDTH_ERROR,
    Answer,
    Bench,
    Seen,
)

from fab.figure import FAINT, INK, LIGHT, LINE, MARK, SERIES, SMALL, panels, save
from fab.units import UM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from doedesign.prediction import Prediction

_TICKS = (0.5, 1, 2, 3, 5, 10, 20)
_ORANGE, _GREEN = SERIES[4], SERIES[2]


def draw(path: Path, answer: Answer) -> None:
    """Draw an answer.

    Args:
        path: the PNG file.
        answer: what was found.
    """
    words = (
        f"Lower right: near PSFs at the {PROBE} probe, logarithmic, one scale for all three; circle: edge of the disc. "
        "Lift: the design raised by that many of its 16 steps, modulo one wave. The light without errors is the same "
        f"at {FULL_WAVE}, the masks are not."
    )
    near = [f"near {k}" for k in range(len(answer.shown))]
    title = "From 3:1 to 1:1: which errors of a 16-level plate would do it?"
    with panels(None, (11.0, 8.7), title, words) as figure:
        mosaic: Any = [["errors"] * 3 + ["lifts"] * 3, ["both"] * 3 + near]
        at = figure.subplot_mosaic(mosaic, height_ratios=(3.1, 3.55))
        _draw_errors(at["errors"], answer)
        _draw_lifts(at["lifts"], answer)
        _draw_both(at["both"], answer)
        for k, (seen, prediction) in enumerate(answer.shown):
            _draw_near(at[near[k]], answer.bench, seen, prediction, k)
    save(figure, path)


def _ratio_axis(axis: Any, values: Sequence[float]) -> None:
    """Make an axis one of ratios: logarithmic, with plain numbers."""
    name, axes = axis.axis_name, axis.axes
    low, high = 0.9 * min(0.75, *values), 1.12 * max(5.0, *values)
    axes.set(**{f"{name}scale": "log", f"{name}lim": (low, high)})
    ticks = [tick for tick in _TICKS if low < tick < high]
    axis.set_ticks(ticks, [f"{tick:g}:1" for tick in ticks])
    axis.set_ticks([], minor=True)


def _draw_errors(axes: "Axes", answer: Answer) -> None:
    """Every error alone: at lift 0 by dots, over all lifts by bars."""
    by_error: dict[str, list[Seen]] = {"none: the probe alone": answer.of("drawn")}
    for seen in answer.of("single", "lifted"):
        by_error.setdefault(seen.plate.error, []).append(seen)
    order = sorted(by_error, key=lambda error: min(seen.ratio for seen in by_error[error]))
    for row, error in enumerate(order):
        ratios = [seen.ratio for seen in by_error[error]]
        if any(seen.plate.lift for seen in by_error[error]):
            axes.plot([min(ratios), max(ratios)], [row, row], color=LINE, alpha=0.25, lw=7, solid_capstyle="butt")
        home = [seen.ratio for seen in by_error[error] if seen.plate.lift == 0]
        axes.plot(home, [row] * len(home), "o", color=LINE, ms=3.8, mec="white", mew=0.4)
    drawn = answer.seen[0].light[FULL_WAVE]["ring_to_disc"]
    axes.axvline(MEASURED_RATIO, color=MARK, lw=1.2)
    axes.axvline(drawn, color=INK, lw=1.0, ls=":", zorder=0)
    axes.set_yticks(range(len(order)), order)
    axes.set_ylim(len(order) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    _ratio_axis(axes.xaxis, [seen.ratio for seen in answer.of("single", "lifted")])
    axes.set_xlabel(f"ring:disc at the {PROBE} probe")
    axes.set_title("Each error alone, within its range. Dots: lift 0; bars: all lifts")
    for ratio, words, hue in ((MEASURED_RATIO, "measured ", MARK), (drawn, f"design, {FULL_WAVE} ", INK)):
        axes.text(ratio, len(order) - 0.5, words, color=hue, fontsize=SMALL, rotation=90, ha="right", va="bottom")


def _draw_lifts(axes: "Axes", answer: Answer) -> None:
    """What line width does to the design at every lift."""
    plates = [*answer.of("drawn"), *answer.alone(WIDTH_ERROR)]
    reaching = {seen.plate.lift for seen in plates if seen.reaches}
    for lift in sorted({seen.plate.lift for seen in plates}, key=lambda k: (k == 0, k in reaching)):
        at_lift = [(s.plate.variation.common_cd_bias_m / UM, s.ratio) for s in plates if s.plate.lift == lift]
        hue, width = (LINE, 1.3) if lift in reaching else (FAINT, 0.9)
        hue, width = (INK, 2.4) if lift == 0 else (hue, width)
        axes.plot(*zip(*sorted(at_lift), strict=True), "o-", color=hue, lw=width, ms=2.5)
    axes.axhline(MEASURED_RATIO, color=MARK, lw=1.2)
    # Room for words above.
    _ratio_axis(axes.yaxis, [2 * max(seen.ratio for seen in plates), *(seen.ratio for seen in plates)])
    axes.set_xlabel("etched areas grow by this at every edge (µm)")
    axes.set_ylabel(f"ring:disc at the {PROBE} probe")
    axes.set_title(f"Line width off, the same design at {len(answer.of('drawn'))} lifts")
    words = f"lifts that reach 1:1: {', '.join(map(str, sorted(reaching)))}" if reaching else "no lift reaches 1:1"
    place_: Any = {"fontsize": SMALL, "ha": "center", "va": "top", "transform": axes.transAxes}
    axes.text(0.5, 0.98, "lift 0", color=INK, weight="bold", **place_)
    axes.text(0.5, 0.93, words, color=LINE, **place_)
    axes.text(0.5, 0.88, "others", color=FAINT, **place_)


def _draw_both(axes: "Axes", answer: Answer) -> None:
    """Ratio and throughput of everything."""
    passed = answer.bench.passed
    random = answer.of("draw", "frail draw")
    missed = [seen for seen in answer.alone(MISSED) if seen.plate.size == DEEPEST]
    for words, plates, mark, hue, size in (
        ("overlay, width and depth, at random", random, "o", FAINT, 4),
        ("line width alone, all lifts", answer.alone(WIDTH_ERROR), "o", LINE, 4),
        ("errors at their limits together", answer.of("together"), "s", _ORANGE, 4.5),
        ("deepest etch missed, all lifts", missed, "^", _GREEN, 5),
    ):
        x, y = [seen.ratio for seen in plates], [seen.throughput for seen in plates]
        axes.plot(x, y, mark, color=hue, ms=size, mec="white", mew=0.4, label=words)
    curve = answer.needed[0].curves["common_depth_scale"]
    shallow = [(r, t) for s, r, t in zip(curve.scores, curve.ring_to_disc, curve.throughput, strict=True) if s <= 0]
    x, y = zip(*shallow, strict=True)
    deepest = min(curve.scores) * BEYOND["common_depth_scale"]
    axes.plot(x, y, "--", color=INK, lw=1.0, label=f"all etches too shallow, to {deepest:.0%}")
    axes.plot(answer.seen[0].ratio, answer.seen[0].throughput, "D", color=INK, ms=6, label="no errors")
    axes.plot(MEASURED_RATIO, MEASURED_THROUGHPUT, "*", color=MARK, ms=14, mec="white", label="the paper's plate")
    _ratio_axis(axes.xaxis, [seen.ratio for seen in answer.seen])
    at_right: Any = {"fontsize": SMALL, "ha": "right", "va": "bottom", "transform": axes.get_yaxis_transform()}
    for words, level in (
        ("all that leaves a plate", passed),
        ("86 % of what leaves a plate", MEASURED_THROUGHPUT * passed),
    ):
        axes.axhline(level, color=FAINT, lw=0.9, ls=":", zorder=0)
        axes.text(0.99, level + 0.003, words, **at_right)
    axes.set_ylim(min(seen.throughput for seen in answer.seen) - 0.17, passed + 0.035)
    axes.set_xlabel(f"ring:disc at the {PROBE} probe")
    axes.set_ylabel("energy in the sensor window, per incident")
    axes.set_title("Both measured numbers at once")
    axes.legend(loc="lower left", ncols=2, handletextpad=0.4, labelspacing=0.3, columnspacing=1.0, handlelength=1.4)


def _draw_near(axes: "Axes", bench: Bench, seen: Seen, prediction: "Prediction", index: int) -> None:
    """One near PSF at the probe."""
    from matplotlib.patches import Circle

    energy = np.maximum(prediction.bank.energy[1, 0], 1e-30)
    # One scale for all three, upward from a tenth of an even window.
    low = log10(0.1 / energy.size)
    half = bench.camera.window * bench.camera.pixel_m / 2 / UM
    sides = (-half, half, -half, half)
    axes.imshow(np.log10(energy), cmap=LIGHT, origin="lower", extent=sides, vmin=low, vmax=low + 2.5)
    radius = (bench.camera.defocus_radius_m(bench.near_m) + bench.camera.pixel_m) / UM
    axes.add_patch(Circle((0, 0), radius, fill=False, color="white", lw=0.7, ls="--"))
    axes.set(xticks=[], yticks=[])
    plate = seen.plate
    sizes = plate.size.replace(", ", ",\n")
    titles = ("no errors\nlift 0", f"{plate.error}\n{sizes}, lift {plate.lift}", f"the same\nat lift {plate.lift}")
    axes.set_title(titles[index].replace("um", "µm"), fontsize=SMALL)
    axes.set_xlabel(f"{seen.ratio:.2f}:1\nin the window {seen.throughput:.2f}", fontsize=SMALL)
