"""Curves: MTF and encircled energy of a PSF bank beside the plain lens, and the history of an optimisation.

One small panel per depth, far depths above and near ones below, with a line per colour: solid for the plate, dashed
for the lens alone.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import (
    FAINT,
    INK,
    SERIES,
    colour_label,
    depth_positions,
    length_text,
    line_colours,
    note,
    picture,
    place,
    spread,
    wrapped,
)
from fab.units import MM, UM
from sim.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sim.psf_bank import PsfBank
    from sim.transfer import TransferBank

_MOST_DEPTHS = 3
_MOST_COLOURS = 6
_RADII = 96
_LENS = {"ls": "--", "lw": 0.9}
# Inches: a panel's height and least width, room at the left, between columns and rows, and for the legend.
_HIGH, _WIDE, _LEFT, _ASIDE, _APART, _LEGEND = 1.75, 2.6, 0.65, 0.2, 0.7, 0.35

# (panel, position of a depth in the bank, name of its group)
_DrawPanel = Callable[["Axes", int, str], None]


def draw_mtf(
    path: str | Path,
    camera: Camera,
    transfer: "TransferBank",
    near_m: Sequence[float],
    far_m: Sequence[float],
    lens_transfer: "TransferBank | None" = None,
) -> None:
    """Draw the modulation transfer along x up to the sensor's Nyquist frequency.

    Far depths have an even frequency axis; near ones, whose contrast dies at low frequencies, a logarithmic one. Of
    more than three near or far depths, and of more than six colours, an even choice is shown.

    Args:
        path: the PNG file.
        camera: colours.
        transfer: MTF of lens, plate and pixel.
        near_m: near depths to show, metres; may be empty.
        far_m: far depths to show, metres; may be empty.
        lens_transfer: MTF of the plain lens and pixel at the same depths, dashed.

    Raises:
        ValueError: no depth is given, or one is not in a bank.
        InputError: the system refuses the path.
    """
    frequencies = transfer.frequencies_per_m * MM

    def draw(axes: "Axes", depth: int, group: str) -> None:
        lens = None if lens_transfer is None else lens_transfer.transfer
        _plot_both(axes, frequencies, (transfer.transfer, transfer), (lens, lens_transfer), depth, camera)
        if group == "near":
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlim(frequencies[1] if group == "near" else 0, frequencies[-1])

    words = ("frequency along x (cycles/mm)", "MTF")
    marks = "lens, plate and pixel before sampling; all light counts, also beyond the window"
    _draw_panels(path, camera, transfer, (near_m, far_m), draw, words, lens_transfer is not None, marks)


def draw_encircled(
    path: str | Path,
    camera: Camera,
    bank: "PsfBank",
    near_m: Sequence[float],
    far_m: Sequence[float],
    lens_bank: "PsfBank | None" = None,
) -> None:
    """Draw the share of the incident light inside centred circles of growing radius.

    Dotted lines stand at the radius of the geometric defocus disc of near depths, and of the far spot of far ones.

    Args:
        path: the PNG file.
        camera: optics of the bank.
        bank: PSFs of the plate.
        near_m: near depths of the bank, metres; may be empty.
        far_m: far depths of the bank, metres; may be empty.
        lens_bank: PSFs of the plain lens at the same depths, dashed.

    Raises:
        ValueError: no depth is given, or one is not in a bank.
        InputError: the system refuses the path.
    """
    from sim.metrics import encircled_energy, mean_wavelength_m, spot_radius_m

    hues = line_colours(camera.colours)
    size = bank.energy.shape[-1]
    radii = bank.pixel_m * np.geomspace(1.0, size / np.sqrt(2), _RADII)
    shares = encircled_energy(bank.energy, bank.pixel_m, radii)
    lens_shares = None if lens_bank is None else encircled_energy(lens_bank.energy, bank.pixel_m, radii)

    def draw(axes: "Axes", depth: int, group: str) -> None:
        _plot_both(axes, radii / UM, (shares, bank), (lens_shares, lens_bank), depth, camera)
        lines = [(camera.defocus_radius_m(bank.depths_m[depth]), FAINT)]
        if group == "far":
            lines = [(spot_radius_m(camera, mean_wavelength_m(camera.colours[c])), hues[c]) for c in _shown(camera)]
        for radius, hue in lines:
            axes.axvline(radius / UM, color=hue, ls=":", lw=1.0)
        axes.set_xscale("log")
        axes.set_xlim(radii[0] / UM, radii[-1] / UM)
        axes.xaxis.set_major_formatter("{x:g}")

    words = ("radius (µm)", "encircled energy")
    spots = ["far spot (far)"] if far_m else []
    discs = ["geometric defocus disc (near)"] if near_m else []
    marks = "dotted: " + ", ".join(spots + discs)
    _draw_panels(path, camera, bank, (near_m, far_m), draw, words, lens_bank is not None, marks)


def _shown(camera: Camera) -> list[int]:
    return spread(len(camera.colours), _MOST_COLOURS)


def _plot_both(
    axes: "Axes",
    x: Float[np.ndarray, " x"],
    plate: tuple[Float[np.ndarray, "w d x"], "PsfBank | TransferBank"],
    lens: tuple[Float[np.ndarray, "w d x"] | None, "PsfBank | TransferBank | None"],
    depth: int,
    camera: Camera,
) -> None:
    """Plot the curves of one depth, a line per colour: the plain lens dashed, the plate over it."""
    hues = line_colours(camera.colours)
    curves, bank = plate
    lens_curves, lens_bank = lens
    lines: list[tuple[np.ndarray, dict[str, Any]]] = [(curves[:, depth], {"lw": 1.2})]
    if lens_curves is not None and lens_bank is not None:
        lines.insert(0, (lens_curves[:, depth_positions(lens_bank, [bank.depths_m[depth]], 1)[0]], _LENS))
    for values, style in lines:
        for colour in _shown(camera):
            axes.plot(x, values[colour], color=hues[colour], **style)


def _draw_panels(
    path: str | Path,
    camera: Camera,
    bank: "PsfBank | TransferBank",
    depths_m: tuple[Sequence[float], Sequence[float]],
    draw: _DrawPanel,
    words: tuple[str, str],
    with_lens: bool,
    marks: str,
) -> None:
    """Draw a row of panels per group of depths, (near, far), under a legend; `words` name the two axes."""
    named = {"far": depths_m[1], "near": depths_m[0]}
    groups = {name: depth_positions(bank, depths, _MOST_DEPTHS) for name, depths in named.items() if depths}
    if not groups:
        raise ValueError("`near_m` and `far_m` must hold at least one depth, but both are empty")
    columns = max(len(depths) for depths in groups.values())
    width = max(_WIDE, 4.8 / columns - _ASIDE)
    across = _LEFT + columns * (width + _ASIDE)
    words_above = wrapped(marks, across - _LEFT)
    legend = _LEGEND + 0.15 * (words_above.count("\n") + 1)
    size = (across, len(groups) * (_HIGH + _APART) + legend)
    with picture(path, size) as figure:
        for row, (name, depths) in enumerate(reversed(groups.items())):
            for column, depth in enumerate(depths):
                at = (_LEFT + column * (width + _ASIDE), 0.5 + row * (_HIGH + _APART))
                axes = place(figure, *at, width, _HIGH)
                draw(axes, depth, name)
                axes.set_ylim(0, 1.02)
                axes.grid(color=FAINT, lw=0.4, alpha=0.5)
                axes.set_title(f"{name}, {length_text(bank.depths_m[depth])}")
                axes.set_xlabel(words[0], labelpad=2)
                axes.tick_params(labelleft=column == 0, length=2.5)
                if column == 0:
                    axes.set_ylabel(words[1])
        _legend(figure, camera, with_lens)
        note(figure, _LEFT, size[1] - legend + 0.05, words_above)


def _legend(figure: "Figure", camera: Camera, with_lens: bool) -> None:
    from matplotlib.lines import Line2D

    hues = line_colours(camera.colours)
    lines = [Line2D([], [], color=hues[i], label=colour_label(camera.colours[i])) for i in _shown(camera)]
    if with_lens:
        lines.append(Line2D([], [], color=INK, **_LENS, label="lens alone"))
    across, up = figure.get_size_inches()
    corner = (_LEFT / across, 1 - 0.08 / up)
    look = {"loc": "upper left", "borderaxespad": 0.0, "borderpad": 0.0, "columnspacing": 1.2, "handlelength": 2.2}
    figure.legend(handles=lines, ncols=len(lines), bbox_to_anchor=corner, **look)


def draw_history(path: str | Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Draw the loss and its terms over the steps.

    A long history is drawn faintly under its running mean, since every step looks at another depth.

    Args:
        path: the PNG file.
        records: one per step with "step", "loss", "terms" (values, not weighted) and "names" (of the terms).

    Raises:
        ValueError: no records.
        InputError: the system refuses the path.
    """
    if not records:
        raise ValueError("`records` must hold at least one step, but is empty")
    steps = np.array([record["step"] for record in records])
    values = np.array([[record["loss"], *record["terms"]] for record in records], dtype=np.float64)
    # A user's objective is named "module:function".
    labels = ["loss", *(name.rpartition(":")[2][:22] for name in records[0]["names"])]
    window = max(1, len(steps) // 60)
    with picture(path, (6.6, 3.4)) as figure:
        axes = place(figure, 0.65, 0.5, 4.4, 2.75)
        for i, (label, series) in enumerate(zip(labels, values.T, strict=True)):
            if i > 0 and np.allclose(series, values[:, 0]):
                continue  # the only term is the loss
            look: dict[str, Any] = {
                "color": INK if i == 0 else SERIES[(i - 1) % len(SERIES)],
                "zorder": 3 if i == 0 else 2,
            }
            if window > 1:
                axes.plot(steps, series, **look, alpha=0.35, lw=0.8)
            middle = slice((window - 1) // 2, len(steps) - window // 2)
            mean = np.convolve(series, np.full(window, 1 / window), mode="valid")
            axes.plot(steps[middle], mean, **look, lw=2.0 if i == 0 else 1.4, label=label)
        if values.min() > 0 and values.max() > 30 * values.min():
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=min(0.0, float(values.min())))
        axes.set_xlabel(f"step (running mean of {window})" if window > 1 else "step", labelpad=2)
        axes.set_ylabel("loss and its terms without weights")
        axes.grid(color=FAINT, lw=0.4, alpha=0.5)
        axes.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0)
