"""Pictures of a training: how the loss fell, and what the network makes of captures it was never trained on."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import FAINT, INK, SERIES, picture, place
from doedesign.report.sheet import SheetRow, draw_sheet, reduced

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIDE = 1.6  # inches
_MOST_ROWS = 4


class ValidationRow(NamedTuple):
    """One scene that was not trained on, display values.

    Attributes:
        label: what stands above it.
        capture: `[c, y, x]` red, green and blue as the camera records it.
        reconstruction: what the network makes of it.
        scene: what was to be seen.
    """

    label: str
    capture: Float[np.ndarray, "3 y x"]
    reconstruction: Float[np.ndarray, "3 y x"]
    scene: Float[np.ndarray, "3 y x"]


def draw_validation(path: str | Path, rows: Sequence[ValidationRow], title: str, words: str) -> None:
    """Draw scenes one below the other: capture, reconstruction, scene.

    Args:
        path: the PNG file.
        rows: the scenes; beyond four, the first.
        title: what stands above.
        words: what it was made with, for the foot.

    Raises:
        InputError: the system refuses the path.
    """
    shown = [
        SheetRow(row.label, tuple(_displayed(image) for image in (row.capture, row.reconstruction, row.scene)))
        for row in rows[:_MOST_ROWS]
    ]
    draw_sheet(path, ("capture", "reconstruction", "scene"), shown, _SIDE, title, words)


def _displayed(image: Float[np.ndarray, "3 y x"]) -> np.ndarray:
    """`[y, x, c]` cut to what a display shows."""
    return reduced(np.clip(image, 0, 1), _SIDE).transpose(1, 2, 0)


def draw_training(path: str | Path, records: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draw the loss and its parts over the steps, and beside them the PSNR on scenes that were not trained on.

    Every step sees another scene, so the loss is drawn as a running mean.

    Args:
        path: the PNG file.
        records: lines of the history (`doedesign.training.history`) with "step", "loss", "parts" and, at some,
            "validation".
        title: what stands above.

    Raises:
        ValueError: no records.
        InputError: the system refuses the path.
    """
    if not records:
        raise ValueError("`records` must hold at least one step, but is empty")
    steps = np.array([record["step"] for record in records])
    series = {"loss": np.array([record["loss"] for record in records], np.float64)}
    for name in records[0]["parts"]:
        values = np.array([record["parts"].get(name, np.nan) for record in records], np.float64)
        if np.any(values != 0):  # a term without weight is not computed
            series[name] = values
    looks = [record for record in records if record.get("validation")]
    with picture(path, (8.4, 4.0), title) as figure:
        left = place(figure, 0.65, 0.5, 3.3, 2.65)
        _plot_losses(left, steps, series)
        right = place(figure, 4.75, 0.5, 3.3, 2.65)
        _plot_scores(right, looks)
        margin = 0.03 * len(steps)
        for axes in (left, right):
            # The same steps in both, however few looks there were.
            axes.set_xlim(steps[0] - margin, steps[-1] + 1 + margin)
            axes.grid(color=FAINT, lw=0.4, alpha=0.5)
            axes.set_xlabel("step", labelpad=2)


def _plot_losses(axes: "Axes", steps: np.ndarray, series: Mapping[str, np.ndarray]) -> None:
    window = max(1, len(steps) // 60)
    middle = slice((window - 1) // 2, len(steps) - window // 2)
    for k, (label, values) in enumerate(series.items()):
        look: dict[str, Any] = {"color": INK if k == 0 else SERIES[(k - 1) % len(SERIES)], "zorder": 3 - (k > 0)}
        mean = np.convolve(values, np.full(window, 1 / window), mode="valid")
        axes.plot(steps[middle], mean, **look, lw=2.0 if k == 0 else 1.4, label=label)
    axes.set_ylim(bottom=0)
    axes.set_ylabel(f"loss and its parts (mean of {window})" if window > 1 else "loss and its parts")
    _legend(axes)


def _plot_scores(axes: "Axes", looks: Sequence[Mapping[str, Any]]) -> None:
    """PSNR by region: the network's solid, the capture's dashed."""
    steps = [look["step"] + 1 for look in looks]
    for k, region in enumerate(("occluded", "full")):
        for which, style in (("reconstruction", "-"), ("capture", "--")):
            values = [look["validation"][which][region]["psnr"] for look in looks]
            numbers = [np.nan if value is None else value for value in values]
            axes.plot(steps, numbers, style, marker=".", ms=4, color=SERIES[k], label=f"{which}, {region}")
    axes.set_ylabel("PSNR on held-out pictures (dB)")
    _legend(axes)


def _legend(axes: "Axes") -> None:
    """Names above the panel, so that no line hides behind them."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.01), borderaxespad=0.0, ncols=2)
