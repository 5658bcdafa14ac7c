"""The picture of a PSF bank: where the light of a point goes, for every colour and depth."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import (
    DPI,
    LIGHT,
    SMALL,
    colour_label,
    depth_positions,
    length_text,
    note,
    picture,
    place,
    shrunk,
    spread,
    wavelength_order,
    wrapped,
)
from fab.units import UM
from sim.camera import Camera, Colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    from sim.psf_bank import PsfBank

_MOST_COLUMNS = 6
_MOST_ROWS = 6
# Inches: room at the left for the labels of the first column, above for titles, between panels and between groups.
_LEFT, _ABOVE, _GAP, _BETWEEN = 0.85, 0.3, 0.1, 0.4
# Below the level that the dimmest fiftieth of the light does not exceed, everything is black.
_BLACK = 0.02


class _Group(NamedTuple):
    """Depths that share a colour scale.

    Attributes:
        name: "near" or "far".
        depths: positions in the bank.
        images: `[w, d, y, x]` energies, averaged to picture pixels.
        norm: the scale.
    """

    name: str
    depths: list[int]
    images: Float[np.ndarray, "w d v u"]
    norm: "LogNorm"


def draw_psfs(
    path: str | Path, camera: Camera, bank: "PsfBank", near_m: Sequence[float], far_m: Sequence[float]
) -> None:
    """Draw the PSFs of a bank: a row per colour, near depths on the left and far ones on the right.

    Energies are shown on a logarithmic scale, one for the near and one for the far columns. Three colours make a
    last row in which they stand together. Of more than six depths, or six colours, an even choice is shown.

    Args:
        path: the PNG file.
        camera: the camera of the bank.
        bank: the PSFs.
        near_m: depths of the bank to show as near, metres; may be empty.
        far_m: depths of the bank to show as far, metres; may be empty.

    Raises:
        ValueError: no depth is given, or one is not in the bank.
        InputError: the system refuses the path.
    """
    shown = {name: _positions(bank, name, near_m, far_m) for name in ("near", "far")}
    columns = sum(len(depths) for depths in shown.values())
    if columns == 0:
        raise ValueError("`near_m` and `far_m` must hold at least one depth, but both are empty")
    rows = [[i] for i in spread(len(camera.colours), _MOST_ROWS)]
    if len(camera.colours) == 3:
        rows.append(wavelength_order(camera.colours))
    # Sides of whole dots, so that one sample is one dot where the window is finer than the picture.
    side = round(DPI * min(max(10.0 / columns, 1.6), 3.2)) / DPI
    groups = [_group(bank, name, depths, round(DPI * side)) for name, depths in shown.items() if depths]
    width = max(_LEFT + columns * (side + _GAP) + _BETWEEN * (len(groups) - 1) + 0.1, 4.5)
    words = wrapped(_notes(camera, bank, shown), width - 0.3)
    below = 1.25 + 0.15 * (words.count("\n") + 1)
    with picture(path, (width, below + len(rows) * (side + _GAP) + _ABOVE)) as figure:
        left = _LEFT
        for group in groups:
            _draw_group(figure, (left, below, side), camera, bank, group, rows)
            across = len(group.depths) * (side + _GAP)
            _colour_bar(figure, group, (left, below - 0.62, min(across - _GAP, 5.0)))
            left += across + _BETWEEN
        note(figure, 0.15, 0.1, words)


def _positions(bank: "PsfBank", name: str, near_m: Sequence[float], far_m: Sequence[float]) -> list[int]:
    """Positions in the bank of the depths to show as near or as far."""
    most = _MOST_COLUMNS if len(near_m) + len(far_m) <= _MOST_COLUMNS else _MOST_COLUMNS // 2
    return depth_positions(bank, near_m if name == "near" else far_m, most)


def _group(bank: "PsfBank", name: str, depths: list[int], dots: int) -> _Group:
    energy = bank.energy[:, depths]
    images = np.stack([[shrunk(image, dots) for image in row] for row in energy])
    return _Group(name, depths, images, _scale(images, float(energy.max())))


def _scale(images: Float[np.ndarray, "w d v u"], brightest: float) -> "LogNorm":
    """A logarithmic scale up to the brightest pixel and down to the light that matters."""
    from matplotlib.colors import LogNorm

    top = brightest if brightest > 0 else 1.0
    # Dark pixels may lie a rounding error below zero.
    ordered = np.sort(np.maximum(images, 0.0), axis=None)
    light = np.cumsum(ordered, dtype=np.float64)
    dim = float(ordered[np.searchsorted(light, _BLACK * light[-1])])
    return LogNorm(min(max(dim, 1e-7 * top), 1e-2 * top), top, clip=True)


def _shade(images: Float[np.ndarray, "w v u"], group: _Group) -> np.ndarray:
    """Colours `[v, u, rgba]` of one energy map, or of three as red, green and blue.

    Three keep the proportions of their energies as their hue, and the strongest sets the brightness, as R. Lupton et
    al. (PASP 2004) do for stars; a power below one makes up for the darkness of pure colours.
    """
    from matplotlib import colormaps

    if len(images) == 1:
        return colormaps[LIGHT](group.norm(images[0]))
    strongest = images.max(axis=0)
    brightness = np.clip(group.norm(strongest), 0.0, 1.0) ** 0.7
    # Dark pixels may lie a rounding error below zero.
    hue = np.clip(images / np.maximum(strongest, np.finfo(np.float32).tiny), 0.0, 1.0)
    return np.moveaxis(hue * brightness, 0, -1)


def _draw_group(
    figure: "Figure",
    box_in: tuple[float, float, float],
    camera: Camera,
    bank: "PsfBank",
    group: _Group,
    rows: list[list[int]],
) -> None:
    """Draw the columns of a group; the box is left and bottom of the lowest left panel, and a panel's side."""
    left, bottom, side = box_in
    for column, depth in enumerate(group.depths):
        for row, picked in enumerate(rows):
            box = (left + column * (side + _GAP), bottom + (len(rows) - 1 - row) * (side + _GAP), side)
            axes = _draw_panel(figure, box, camera, bank, group, column, picked)
            first = column == 0 and left == _LEFT
            _tick(axes, first=first, last=row == len(rows) - 1)
            if first:
                name = colour_label(camera.colours[picked[0]]) if len(picked) == 1 else "together"
                axes.set_ylabel(f"{name}\ny (µm)", labelpad=1)
            if row == 0:
                axes.set_title(f"{group.name}, {length_text(bank.depths_m[depth])}")


def _draw_panel(
    figure: "Figure",
    box_in: tuple[float, float, float],
    camera: Camera,
    bank: "PsfBank",
    group: _Group,
    column: int,
    picked: list[int],
) -> "Axes":
    """Draw one depth in one colour, or in three, into a square given by left, bottom and side in inches."""
    left, bottom, side = box_in
    axes = place(figure, left, bottom, side, side)
    half_um = bank.energy.shape[-1] * bank.pixel_m / UM / 2
    _show(axes, _shade(group.images[picked, column], group), half_um)
    depth = group.depths[column]
    disc_m = camera.defocus_radius_m(bank.depths_m[depth])
    if disc_m > _least_disc_m(bank):
        _circle(axes, disc_m, "--")
    shares = {"window": float(bank.energy[picked[0], depth].sum(dtype=np.float64))}
    if group.name == "far":
        part = min(0.42 * side, 0.85)
        inset = place(figure, left + side - part - 0.04, bottom + side - part - 0.04, part, part)
        middle = _middle(bank.energy[picked, depth], _inset_pixels(camera, bank))
        _show(inset, _shade(middle, group), middle.shape[-1] * bank.pixel_m / UM / 2)
        radius_m = _spot_radius_m(camera, camera.colours[picked[0]])
        _circle(inset, radius_m, ":")
        inset.set_xticks([])
        inset.set_yticks([])
        for spine in inset.spines.values():
            spine.set_color("white")
        shares["spot"] = _energy_within(middle[0], bank.pixel_m, radius_m)
    if len(picked) == 1:
        _write(axes, "\n".join(f"{name} {100 * share:.1f} %" for name, share in shares.items()))
    return axes


def _show(axes: "Axes", shades: np.ndarray, half_um: float) -> None:
    axes.imshow(shades, origin="lower", extent=(-half_um, half_um, -half_um, half_um), interpolation="auto")


def _circle(axes: "Axes", radius_m: float, line: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0, 0), radius_m / UM, ls=line, ec="white", lw=0.9, fill=False))


def _write(axes: "Axes", words: str) -> None:
    """Write white words with a dark rim into the lower left corner."""
    from matplotlib.patheffects import withStroke

    rim = [withStroke(linewidth=2, foreground="black")]
    axes.text(0.03, 0.03, words, transform=axes.transAxes, color="white", fontsize=SMALL, path_effects=rim, va="bottom")


def _spot_radius_m(camera: Camera, colour: Colour) -> float:
    from sim.metrics import mean_wavelength_m, spot_radius_m

    return spot_radius_m(camera, mean_wavelength_m(colour))


def _energy_within(psf: Float[np.ndarray, "y x"], pixel_m: float, radius_m: float) -> float:
    from sim.metrics import energy_within

    return energy_within(psf, pixel_m, radius_m)


def _inset_pixels(camera: Camera, bank: "PsfBank") -> int:
    """Pixels on each side of the centre that the inset shows: three radii of the largest far spot."""
    radius = max(_spot_radius_m(camera, colour) for colour in camera.colours)
    return min(math.ceil(3 * radius / bank.pixel_m), bank.energy.shape[-1] // 2)


def _middle(energy: Float[np.ndarray, "w y x"], pixels: int) -> Float[np.ndarray, "w v u"]:
    """The pixels round the centre, as centred as the whole: an odd window keeps its middle pixel."""
    size = energy.shape[-1]
    cut = slice(size // 2 - pixels, size - size // 2 + pixels)
    return energy[:, cut, cut]


def _tick(axes: "Axes", *, first: bool, last: bool) -> None:
    """Numbers only along the left and the lower border of the whole."""
    from matplotlib.ticker import MaxNLocator

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
    axes.tick_params(labelbottom=last, labelleft=first, length=2.5, pad=2)
    if last:
        axes.set_xlabel("x (µm)", labelpad=1)


def _colour_bar(figure: "Figure", group: _Group, box_in: tuple[float, float, float]) -> None:
    """Draw the scale of a group; the box is left, bottom and width."""
    from matplotlib.cm import ScalarMappable

    axes = place(figure, *box_in, 0.12)
    bar = figure.colorbar(ScalarMappable(group.norm, LIGHT), cax=axes, orientation="horizontal")
    bar.set_label(f"{group.name}: share of light per pixel", labelpad=1)
    bar.ax.minorticks_off()


def _least_disc_m(bank: "PsfBank") -> float:
    """Radius below which a circle would hide what it surrounds, or not be seen at all."""
    return bank.energy.shape[-1] * bank.pixel_m / 80


def _notes(camera: Camera, bank: "PsfBank", shown: dict[str, list[int]]) -> str:
    """What the marks in the panels mean."""
    words = []
    depths = [bank.depths_m[i] for positions in shown.values() for i in positions]
    if any(camera.defocus_radius_m(depth) > _least_disc_m(bank) for depth in depths):
        words.append("dashed: geometric defocus disc")
    if shown["far"]:
        width = 2 * _inset_pixels(camera, bank) + bank.energy.shape[-1] % 2
        words.append(f"inset: central {length_text(width * bank.pixel_m)}")
        words.append("dotted: far spot (first dark ring + 1 pixel)")
    if len(camera.colours) == 3:
        words.append("together: all three as red, green, blue")
    return "; ".join(words)
