"""Loss curves: the history of an optimisation and of a training."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from doedesign.spec import Spec
from fab.figure import INK, SERIES, panels, single

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

__all__ = ["plot_history", "plot_spot_history", "plot_training"]


def plot_history(
    records: Sequence[Mapping[str, Any]], ax: "Axes | None" = None, *, title: str = "", note: str = ""
) -> "Axes":
    """Draw the loss of an optimisation and its terms over the steps, on `ax` or the axes of a new figure.

    A long history is drawn faintly under its running mean, since every step sees another depth. A record per step has
    "step", "loss", "terms" (values, not weighted) and "names" (of the terms). The `title` says whose it is, the `note`
    why it is not smooth (`history_note`).

    Raises:
        ValueError: no records.
    """
    steps = _steps(records)
    values = np.array([[record["loss"], *record["terms"]] for record in records], dtype=np.float64)
    # A user's objective is named "module:function".
    labels = ["loss", *(name.rpartition(":")[2][:22] for name in records[0]["names"])]
    # A only term is the loss.
    series = {
        label: column
        for i, (label, column) in enumerate(zip(labels, values.T, strict=True))
        if i == 0 or not np.allclose(column, values[:, 0])
    }
    heading = f"{title}: loss over the steps" if title else "Loss over the steps"
    with single(ax, (6.6, 3.9 if note else 3.6), heading, note) as axes:
        window = _plot_series(axes, steps, series, faint=True)
        if values.min() > 0 and values.max() > 30 * values.min():
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=min(0.0, float(values.min())))
        label = f"step (running mean of {window})" if window > 1 else "step"
        axes.set(xlabel=label, ylabel="loss and its terms without weights")
        axes.grid(True)
        axes.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0)
    return axes


def plot_spot_history(
    records: Sequence[Mapping[str, Any]], ax: "Axes | None" = None, *, title: str = "", note: str = ""
) -> "FigureBase":
    """Draw the light of spots over the steps, and beside it how unequal they are, in per cent.

    Each has an axis of its own: one changes by a percent, the other by decades. A record per step has the "terms"
    efficiency and uniformity error, among its "names"; the others are as in `plot_history`.

    Raises:
        ValueError: no records.
    """
    steps = _steps(records)
    terms = {name: k for k, name in enumerate(records[0]["names"])}
    values = 100 * np.array([record["terms"] for record in records], np.float64)
    heading = "light on the spots and uniformity error over the steps"
    heading = f"{title}: {heading}" if title else heading.capitalize()
    with panels(ax, (8.4, 3.9 if note else 3.6), heading, note) as figure:
        left, right = figure.subplots(1, 2)
        for axes, name, label in ((left, "efficiency", "light on the spots (%)"),
                                  (right, "uniformity_error", "uniformity error (%)")):  # fmt: skip
            series = values[:, terms[name]]
            window = _plot_series(axes, steps, {name: series}, faint=True)
            axes.set(xlabel=f"step (running mean of {window})" if window > 1 else "step", ylabel=label)
            axes.grid(True)
        if series.min() > 0 and series.max() > 3 * series.min():
            right.set_yscale("log")
        else:
            right.set_ylim(bottom=0)
    return figure


def history_note(spec: Spec) -> str:
    """Why the loss of a spec is not smooth, in words for its picture; nothing where it should be.

    Args:
        spec: the spec.
    """
    if spec.aims:
        if spec.spots is not None:
            return "Weights of the spots follow the light of the rounded levels, step by step, so the light may jump."
        return "First phases are free, then they take the levels of the process, which costs something at first."
    words = []
    if spec.optimize.colours == "in_turn" and len(spec.optics.colours) > 1:
        count = len(spec.optics.colours)
        words.append(
            f"Every step looks at one of {count} colours in turn, which are not equally good: hence the zigzag."
        )
    elif len(spec.scene.near_m) > 1 or len(spec.scene.far_m) > 1:
        words.append("Every step looks at one near and one far depth, in shuffled rounds: hence the zigzag.")
    if spec.robust is not None:
        words.append(f"From step {spec.optimize.steps} on, plates with errors are judged, whose loss is higher.")
    return " ".join(words)


def plot_training(records: Sequence[Mapping[str, Any]], title: str = "", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the loss and its parts over the steps, and beside them the PSNR on scenes that were not trained on.

    Every step sees another scene, so the loss is drawn as a running mean. Records are lines of the history
    (`doedesign.training.history`) with "step", "loss", "parts" and, at some, "validation".

    Raises:
        ValueError: no records.
    """
    steps = _steps(records)
    series = {"loss": np.array([record["loss"] for record in records], np.float64)}
    for name in records[0]["parts"]:
        values = np.array([record["parts"].get(name, np.nan) for record in records], np.float64)
        if np.any(values != 0):  # a term without weight is not computed
            series[name] = values
    heading = f"{title}: training of the network" if title else "Training of the network"
    note = (
        "Every step sees other scenes, so its loss jumps. Right: pictures that are never trained on, before (capture)"
    )
    note += " and after the network (reconstruction); occluded: where they are covered."
    with panels(ax, (8.4, 4.6), heading, note) as figure:
        left, right = figure.subplots(1, 2)
        window = _plot_series(left, steps, series)
        left.set_ylim(bottom=0)
        left.set_ylabel(f"loss and its parts (mean of {window})" if window > 1 else "loss and its parts")
        _plot_scores(right, [record for record in records if record.get("validation")])
        margin = 0.03 * len(steps)
        for axes in (left, right):
            # The same steps in both, however few validations there were.
            axes.set(xlim=(steps[0] - margin, steps[-1] + 1 + margin), xlabel="step")
            axes.grid(True)
            # Above the panel, so that no line hides behind the names.
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.01), borderaxespad=0.0, ncols=2)
    return figure


def _steps(records: Sequence[Mapping[str, Any]]) -> np.ndarray:
    if not records:
        raise ValueError("`records` must hold at least one step, but is empty")
    return np.array([record["step"] for record in records])


def _plot_series(axes: "Axes", steps: np.ndarray, series: Mapping[str, np.ndarray], *, faint: bool = False) -> int:
    """Plot running means, the first bold, over the values themselves if `faint`; return the steps of a mean."""
    window = max(1, len(steps) // 60)
    middle = slice((window - 1) // 2, len(steps) - window // 2)
    for k, (label, values) in enumerate(series.items()):
        style: dict[str, Any] = {"color": INK if k == 0 else SERIES[(k - 1) % len(SERIES)], "zorder": 3 - (k > 0)}
        if faint and window > 1:
            axes.plot(steps, values, **style, alpha=0.35, lw=0.8)
        mean = np.convolve(values, np.full(window, 1 / window), mode="valid")
        axes.plot(steps[middle], mean, **style, lw=2.0 if k == 0 else 1.4, label=label)
    return window


def _plot_scores(axes: "Axes", validations: Sequence[Mapping[str, Any]]) -> None:
    """PSNR by region: the network's solid, the capture's dashed."""
    steps = [one["step"] + 1 for one in validations]
    for k, region in enumerate(("occluded", "full")):
        for which, style in (("reconstruction", "-"), ("capture", "--")):
            values = [one["validation"][which][region]["psnr"] for one in validations]
            numbers = [np.nan if value is None else value for value in values]
            axes.plot(steps, numbers, style, marker=".", ms=4, color=SERIES[k], label=f"{which}, {region}")
    axes.set_ylabel("PSNR on held-out pictures (dB)")
