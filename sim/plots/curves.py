"""Curves over colours and depths: MTF and encircled energy of a PSF bank beside the plain lens.

One small panel per depth, far depths above and near ones below, with a line per colour: solid for the DOE, dashed for
the lens alone.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from fab.figure import FAINT, INK, evenly_spaced, legend_above, length_text, panels
from fab.units import MM
from sim.camera import Camera
from sim.metrics import encircled_energy, mean_wavelength_m, spot_radius_m
from sim.plots.colours import colour_label, depth_positions, line_colours
from sim.plots.places import unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    import sim.psf_bank
    import sim.transfer

_MOST_DEPTHS = 3
_MOST_COLOURS = 6
_RADII = 96
_FEW_DECADES = 60.0  # largest over smallest number of an axis that has room for more than powers of ten
_LENS: dict[str, Any] = {"ls": "--", "lw": 0.9}


def plot_mtf(
    transfer: "sim.transfer.TransferBank",
    camera: Camera,
    near_m: Sequence[float],
    far_m: Sequence[float],
    lens: "sim.transfer.TransferBank | None" = None,
    ax: "Axes | None" = None,
    *,
    title: str = "",
) -> "FigureBase":
    """Draw the modulation transfer along x up to the sensor's Nyquist frequency; that of the plain lens is dashed.

    Far depths have an even frequency axis; near ones, whose contrast dies at low frequencies, a logarithmic one. Of
    more than three near or far depths, and of more than six colours, an even choice is shown. The `title` says whose
    they are. A ValueError for no depth, or one that is not in a bank.
    """
    per, unit = (np.radians(1.0), "degree") if camera.in_angles else (MM, "mm")
    frequencies = transfer.frequencies_per_m * per

    def finish(axes: "Axes", _: int, group: str) -> None:
        if group == "near":
            axes.set_xscale("log")
        axes.set_xlim(frequencies[1] if group == "near" else 0, frequencies[-1])
        if group == "near":
            _label_decades(axes)

    both = [(transfer.transfer, transfer.depths_m)] + ([(lens.transfer, lens.depths_m)] if lens is not None else [])
    words = (f"frequency along x (cycles/{unit})", "MTF")
    note = "{}plate and pixel before sampling; all light counts, also beyond the window"
    note = note.format("degrees about the axis; " if camera.in_angles else "lens, ")
    if near_m:
        note += "; frequencies: even for far depths, logarithmic for near ones, where contrast dies at low frequencies"
    heading = _heading("modulation transfer", title)
    return _plot_curves(camera, frequencies, both, (near_m, far_m), finish, words, (heading, note), ax)


def plot_encircled(
    bank: "sim.psf_bank.PsfBank",
    camera: Camera,
    near_m: Sequence[float],
    far_m: Sequence[float],
    lens: "sim.psf_bank.PsfBank | None" = None,
    ax: "Axes | None" = None,
    *,
    title: str = "",
    curves: Sequence[Float[np.ndarray, "w d r"]] | None = None,
) -> "FigureBase":
    """Draw the share of the incident light inside centred circles of growing radius; that of the plain lens is dashed.

    Dotted lines stand at the radius of the geometric defocus disc of near depths, and of the far spot of far ones. The
    `title` says whose it is, and `curves` are the `encircled_curves` of bank and lens where they are known. A
    ValueError for no depth, or one that is not in a bank.
    """
    hues, unit = line_colours(camera.colours), unit_of(camera)
    radii, banks = encircled_radii_m(bank), [one for one in (bank, lens) if one is not None]
    both = list(zip(curves or encircled_curves(banks), (one.depths_m for one in banks), strict=True))

    def finish(axes: "Axes", depth: int, group: str) -> None:
        lines = [(camera.defocus_radius_m(bank.depths_m[depth]), FAINT)]
        if group == "far":
            lines = [(spot_radius_m(camera, mean_wavelength_m(camera.colours[c])), hues[c]) for c in _shown(camera)]
        for radius, hue in lines:
            axes.axvline(unit.of(radius), color=hue, ls=":", lw=1.0)
        axes.set_xscale("log")
        axes.set_xlim(unit.of(radii[0]), unit.of(radii[-1]))
        _label_decades(axes)

    marks = [*(["far spot (far)"] if far_m else []), *(["geometric defocus disc (near)"] if near_m else [])]
    note = f"dotted: {', '.join(marks)}; radii are logarithmic; shares are of all light on the aperture"
    words = (f"radius ({unit.name})", "encircled energy")
    heading = _heading("encircled energy", title)
    return _plot_curves(camera, unit.of(radii), both, (near_m, far_m), finish, words, (heading, note), ax)


def encircled_radii_m(bank: "sim.psf_bank.PsfBank") -> Float[np.ndarray, " r"]:
    """Radii of circles for `bank`, metres, at even ratios from one pixel to the corners of its window."""
    return bank.pixel_m * np.geomspace(1.0, bank.energy.shape[-1] / np.sqrt(2), _RADII)


def encircled_curves(banks: Sequence["sim.psf_bank.PsfBank"]) -> list[Float[np.ndarray, "w d r"]]:
    """Light of every one of `banks`, of one window and the same colours, within `encircled_radii_m` of the first."""
    energy = np.concatenate([np.asarray(one.energy) for one in banks], axis=1)
    curves = np.asarray(encircled_energy(energy, banks[0].pixel_m, encircled_radii_m(banks[0])))
    return np.split(curves, np.cumsum([len(one.depths_m) for one in banks])[:-1], axis=1)


def _heading(what: str, whose: str) -> str:
    """Title of a picture: whose it is, if that is known, and of what."""
    return f"{whose}: {what}" if whose else what.capitalize()


def _label_decades(axes: "Axes") -> None:
    """Plain numbers on a logarithmic axis, at 1, 2 and 5 of every decade where it has few of them."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high / low > _FEW_DECADES else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def _shown(camera: Camera) -> list[int]:
    return evenly_spaced(len(camera.colours), _MOST_COLOURS)


def _plot_curves(
    camera: Camera,
    x: Float[np.ndarray, " x"],
    both: Sequence[tuple[Any, Sequence[float]]],
    depths_m: tuple[Sequence[float], Sequence[float]],
    finish: Callable[["Axes", int, str], None],
    words: tuple[str, str],
    around: tuple[str, str],
    ax: "Axes | None",
) -> "FigureBase":
    """Draw a row of panels per group of depths (near, far).

    `both` are curves `[w, d, x]` and depths of the DOE and perhaps the lens; `finish` draws the marks of (panel,
    position of a depth in the bank, "near" or "far"); `words` name the axes, and `around` are title and note.
    """
    from matplotlib.lines import Line2D

    named = {"far": depths_m[1], "near": depths_m[0]}
    groups = {name: depth_positions(both[0][1], depths, _MOST_DEPTHS) for name, depths in named.items() if len(depths)}
    if not groups:
        raise ValueError("`near_m` and `far_m` must hold at least one depth, but both are empty")
    hues = line_colours(camera.colours)
    columns = max(map(len, groups.values()))
    title, note = around
    with panels(ax, (max(0.7 + 2.8 * columns, 5.4), 2.45 * len(groups) + 1.0), note=note) as figure:
        grid = figure.subplots(len(groups), columns, sharey=True, squeeze=False)
        for panes, (name, depths) in zip(grid, groups.items(), strict=True):
            for axes, depth in zip(panes, depths, strict=False):
                for (curves, of_m), style in reversed(list(zip(both, ({"lw": 1.2}, _LENS), strict=False))):
                    at = depth_positions(of_m, [both[0][1][depth]], 1)[0]
                    for colour in _shown(camera):
                        axes.plot(x, curves[colour, at], color=hues[colour], **style)
                finish(axes, depth, name)
                axes.grid(True)
                axes.set_title(f"{name}, {length_text(both[0][1][depth])}")
                axes.set_xlabel(words[0])
            for spare in panes[len(depths) :]:
                spare.set_axis_off()
            panes[0].set_ylabel(words[1])
        grid[0, 0].set_ylim(0, 1.02)
        keys = [Line2D([], [], color=hues[i], label=colour_label(camera.colours[i])) for i in _shown(camera)]
        if len(both) > 1:
            alone = "lens alone" if camera.distance_m is None else "aperture alone"
            keys.append(Line2D([], [], color=INK, **_LENS, label=alone))
        legend_above(figure, keys, title)
    return figure
