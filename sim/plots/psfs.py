"""The picture of a PSF bank: where the light of a point goes, for every colour and depth."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from fab.figure import DPI, INK, LIGHT, SMALL, bare, evenly_spaced, extent_of, length_text, panels, shrunk
from fab.units import DEGREES, MICROMETRES
from sim.camera import Camera
from sim.metrics import energy_within, mean_wavelength_m, spot_radius_m
from sim.plots.colours import colour_label, depth_positions, wavelength_order
from sim.plots.places import label_places, size_text, unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import LogNorm
    from matplotlib.figure import FigureBase

    import sim.psf_bank

    Bank = sim.psf_bank.PsfBank

_MOST_COLUMNS = 6
_MOST_ROWS = 6
# Below the level that the dimmest fiftieth of the light does not exceed, everything is black.
_BLACK = 0.02
# Parts (left, bottom, width, height) of a far panel for its centre, enlarged, and for its words; outside it where they
# would cover light that is as bright as this share of the brightest.
_INSET, _WORDS, _BRIGHT = (0.62, 0.62, 0.36, 0.36), (0.0, 0.0, 0.4, 0.16), 0.1
_ASIDE = (1.05, 0.55, 0.45, 0.45)


class _Group(NamedTuple):
    """Depths that share a colour scale: "near" or "far", positions in the bank, energies in picture pixels."""

    name: str
    depths: list[int]
    images: Float[np.ndarray, "w d v u"]
    norm: "LogNorm"


def plot_psfs(
    bank: "Bank",
    camera: Camera,
    near_m: Sequence[float],
    far_m: Sequence[float],
    ax: "Axes | None" = None,
    *,
    title: str = "",
    remark: str = "",
) -> "FigureBase":
    """Draw the PSFs of a bank: a row per colour, near depths on the left and far ones on the right.

    Energies are shown on a logarithmic scale, one for the near and one for the far columns. Three colours make a last
    row in which they stand together. The centre of a far PSF is enlarged in its corner, or beside it where it would
    cover light that is as bright, as of several spots. Of more than six depths, or six colours, an even choice is
    shown; the title says whose they are, and a remark stands below. A ValueError for no depth, or one that is not in
    the bank.
    """
    most = _MOST_COLUMNS if len(near_m) + len(far_m) <= _MOST_COLUMNS else _MOST_COLUMNS // 2
    shown = {
        name: depth_positions(bank.depths_m, depths, most)
        for name, depths in (("near", near_m), ("far", far_m))
        if len(depths)
    }
    columns = sum(map(len, shown.values()))
    if columns == 0:
        raise ValueError("`near_m` and `far_m` must hold at least one depth, but both are empty")
    rows = [[i] for i in evenly_spaced(len(camera.colours), _MOST_ROWS)]
    if len(camera.colours) == 3:
        rows.append(wavelength_order(camera.colours))
    side = min(max(10.0 / columns, 1.6), 3.2)
    groups = []
    for name, depths in shown.items():
        energy = np.asarray(bank.energy)[:, depths]
        images = np.stack([[shrunk(image, round(DPI * side)) for image in row] for row in energy])
        groups.append(_Group(name, depths, images, light_scale(images, float(energy.max()))))
    # An empty column keeps the groups apart.
    widths = [1.0] * len(groups[0].depths) + ([0.15] + [1.0] * len(groups[1].depths) if groups[1:] else [])
    aside = any(_covers_light(group.images) for group in groups if group.name == "far")
    beside = (sum(_ASIDE[::2]) - 1.0) * side * len(shown.get("far", ())) if aside else 0.0
    size = (max(0.9 + sum(widths) * (side + 0.1), 4.5) + beside, 1.65 + len(rows) * (side + 0.1))
    heading = f"{title}: point spread functions" if title else "Point spread functions"
    scales = "colours: logarithmic" + (", one scale for near and one for far depths" if len(groups) > 1 else "")
    note = "; ".join(filter(None, (_notes(camera, bank, shown, aside=aside), scales, remark)))
    with panels(ax, size, heading, note, layout="compressed") as figure:
        grid = figure.subplots(len(rows), len(widths), sharex=True, sharey=True, squeeze=False, width_ratios=widths)
        first = 0
        for group in groups:
            panes = grid[:, first : first + len(group.depths)]
            _draw_group(figure, panes, camera, bank, group, rows, aside=aside)
            first += len(group.depths) + 1
        for spare in grid[:, len(groups[0].depths) : first - 1 - len(groups[-1].depths)].flat:
            spare.set_axis_off()
        for axes, picked in zip(grid[:, 0], rows, strict=True):
            name = colour_label(camera.colours[picked[0]]) if len(picked) == 1 else "together"
            label_places(axes, unit_of(camera), "y")
            axes.set_ylabel(f"{name}\n{axes.get_ylabel()}")
        grid[0, 0].locator_params(nbins=3, steps=[1, 2, 5, 10])
    return figure


def plot_measured(bank: "Bank", ax: "Axes | None" = None) -> "FigureBase":
    """Draw PSFs whose camera is not known, such as measured ones: a row per colour, a column per depth, one scale.

    Of more than six of either an even choice is shown.
    """
    depths = evenly_spaced(len(bank.depths_m), _MOST_COLUMNS)
    rows = evenly_spaced(len(bank.colours), _MOST_ROWS)
    unit = DEGREES if bank.in_angles else MICROMETRES
    side = min(max(10.0 / len(depths), 1.6), 3.2)
    chosen = np.asarray(bank.energy)[rows][:, depths]
    images = np.stack([[shrunk(image, round(DPI * side)) for image in row] for row in chosen])
    norm = light_scale(images, float(chosen.max()))
    size = (max(0.9 + len(depths) * (side + 0.1), 4.5), 1.65 + len(rows) * (side + 0.1))
    note = "the camera is not known: no far spot and no defocus disc; colours: logarithmic, one scale"
    with panels(ax, size, "Point spread functions", note, layout="compressed") as figure:
        grid = figure.subplots(len(rows), len(depths), sharex=True, sharey=True, squeeze=False)
        for row, colour in enumerate(rows):
            for column, depth in enumerate(depths):
                axes = grid[row, column]
                box = extent_of(chosen.shape[-2:], bank.pixel_m / unit.scale, 1.0)
                axes.imshow(
                    images[row, column], origin="lower", extent=box, norm=norm, cmap=LIGHT, interpolation="auto"
                )
                if row == 0:
                    axes.set_title(length_text(bank.depths_m[depth]))
            label_places(grid[row, 0], unit, "y")
            grid[row, 0].set_ylabel(f"{bank.colours[colour]}\n{grid[row, 0].get_ylabel()}")
        for axes in grid[-1]:
            label_places(axes, unit, "x")
        grid[0, 0].locator_params(nbins=3, steps=[1, 2, 5, 10])
        bar = figure.colorbar(
            grid[0, 0].images[0], ax=grid.ravel().tolist(), location="bottom", aspect=20 * len(depths)
        )
        bar.set_label("light per pixel")
        bar.ax.minorticks_off()
    return figure


def light_scale(images: Float[np.ndarray, "*bank v u"], brightest: float) -> "LogNorm":
    """A logarithmic scale up to the brightest pixel and down to the light that matters."""
    from matplotlib.colors import LogNorm

    top = brightest if brightest > 0 else 1.0
    # Dark pixels may lie a rounding error below zero.
    ordered = np.sort(np.maximum(images, 0.0), axis=None)
    light = np.cumsum(ordered, dtype=np.float64)
    dim = float(ordered[np.searchsorted(light, _BLACK * light[-1])])
    return LogNorm(min(max(dim, 1e-7 * top), 1e-2 * top), top, clip=True)


def shaded(images: Float[np.ndarray, "w v u"], norm: "LogNorm") -> np.ndarray:
    """Colours `[v, u, rgba]` of one energy map, or of three as red, green and blue.

    Three keep the proportions of their energies as their hue, and the strongest sets the brightness, as R. Lupton et
    al. (PASP 2004) do for stars; a power below one makes up for the darkness of pure colours.
    """
    from matplotlib import colormaps

    if len(images) == 1:
        return colormaps[LIGHT](norm(images[0]))
    strongest = images.max(axis=0)
    brightness = np.clip(norm(strongest), 0.0, 1.0) ** 0.7
    # Dark pixels may lie a rounding error below zero.
    hue = np.clip(images / np.maximum(strongest, np.finfo(np.float32).tiny), 0.0, 1.0)
    return np.moveaxis(hue * brightness, 0, -1)


def _covers_light(images: Float[np.ndarray, "w d v u"]) -> bool:
    """Whether an inset or words within the panels would cover light that is about as bright as the brightest."""
    brightest = np.maximum(images.max(axis=(2, 3)), np.finfo(np.float32).tiny)
    for left, bottom, width, height in (_INSET, _WORDS):
        ends = [
            slice(math.floor(first * count), math.ceil((first + share) * count))
            for first, share, count in ((bottom, height, images.shape[2]), (left, width, images.shape[3]))
        ]
        if np.any(images[:, :, ends[0], ends[1]].max(axis=(2, 3)) > _BRIGHT * brightest):
            return True
    return False


def _draw_group(
    figure: "FigureBase",
    panes: np.ndarray,
    camera: Camera,
    bank: "Bank",
    group: _Group,
    rows: list[list[int]],
    *,
    aside: bool,
) -> None:
    """Draw the columns of a group and its colour scale."""
    from matplotlib.cm import ScalarMappable

    for column, depth in enumerate(group.depths):
        for row, picked in enumerate(rows):
            _draw_panel(panes[row, column], camera, bank, group, column, picked, aside=aside)
        panes[0, column].set_title(f"{group.name}, {length_text(bank.depths_m[depth])}")
        label_places(panes[-1, column], unit_of(camera), "x")
    scale = ScalarMappable(group.norm, LIGHT)
    bar = figure.colorbar(scale, ax=panes.ravel().tolist(), location="bottom", aspect=20 * len(group.depths))
    bar.set_label(f"{group.name}: share of light per pixel")
    bar.ax.minorticks_off()


def _draw_panel(
    axes: "Axes", camera: Camera, bank: "Bank", group: _Group, column: int, picked: list[int], *, aside: bool
) -> None:
    """Draw one depth in one colour, or in three."""
    from matplotlib.patheffects import withStroke

    scale = unit_of(camera).scale
    _show(axes, shaded(group.images[picked, column], group.norm), bank.energy.shape[-2:], bank.pixel_m / scale)
    depth = group.depths[column]
    disc_m = _disc_m(camera, bank.depths_m[depth])
    if disc_m > _least_disc_m(bank):
        _circle(axes, disc_m / scale, "--")
    shares = {"window": float(np.asarray(bank.energy)[picked[0], depth].sum(dtype=np.float64))}
    aside = aside and group.name == "far"
    if group.name == "far":
        inset = axes.inset_axes(_ASIDE if aside else _INSET)
        # As centred as the whole: an odd window keeps its middle pixel.
        size, pixels = bank.energy.shape[-1], _inset_pixels(camera, bank)
        cut = slice(size // 2 - pixels, size - size // 2 + pixels)
        middle = np.asarray(bank.energy)[picked, depth, cut, cut]
        _show(inset, shaded(middle, group.norm), middle.shape[-2:], bank.pixel_m / scale)
        radius_m = _spot_radius_m(camera, picked[0])
        _circle(inset, radius_m / scale, ":")
        bare(inset)
        inset.spines[:].set_color(INK if aside else "white")
        shares["spot"] = float(energy_within(middle[0], bank.pixel_m, radius_m))
    if len(picked) == 1:
        words = "\n".join(f"{name} {100 * share:.1f} %" for name, share in shares.items())
        if aside:
            below = {"transform": axes.transAxes, "color": INK, "fontsize": SMALL, "va": "top"}
            axes.text(_ASIDE[0], _ASIDE[1] - 0.03, words, **below)
            return
        rim = [withStroke(linewidth=2, foreground="black")]
        style = {"color": "white", "fontsize": SMALL, "path_effects": rim, "va": "bottom"}
        axes.text(0.03, 0.03, words, transform=axes.transAxes, **style)


def _show(axes: "Axes", shades: np.ndarray, shape: tuple[int, ...], pixel: float) -> None:
    axes.imshow(shades, origin="lower", extent=extent_of(shape, pixel, 1.0), interpolation="auto")


def _circle(axes: "Axes", radius: float, line: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0, 0), radius, ls=line, ec="white", lw=0.9, fill=False))


def _spot_radius_m(camera: Camera, colour: int) -> float:
    return spot_radius_m(camera, mean_wavelength_m(camera.colours[colour]))


def _inset_pixels(camera: Camera, bank: "Bank") -> int:
    """Pixels on each side of the centre that the inset shows: three radii of the largest far spot."""
    radius = max(_spot_radius_m(camera, i) for i in range(len(camera.colours)))
    return min(math.ceil(3 * radius / bank.pixel_m), bank.energy.shape[-1] // 2)


def _disc_m(camera: Camera, depth_m: float) -> float:
    """Radius of the defocus disc; without a lens nothing is out of focus."""
    return 0.0 if camera.distance_m is not None else camera.defocus_radius_m(depth_m)


def _least_disc_m(bank: "Bank") -> float:
    """Radius below which a circle would hide what it surrounds, or not be seen at all."""
    return bank.energy.shape[-1] * bank.pixel_m / 80


def _notes(camera: Camera, bank: "Bank", shown: dict[str, list[int]], *, aside: bool) -> str:
    """Meaning of the marks in the panels."""
    words = []
    depths = [bank.depths_m[i] for positions in shown.values() for i in positions]
    if any(_disc_m(camera, depth) > _least_disc_m(bank) for depth in depths):
        words.append("dashed: geometric defocus disc")
    if "far" in shown:
        width = 2 * _inset_pixels(camera, bank) + bank.energy.shape[-1] % 2
        words.append(f"{'beside' if aside else 'inset'}: central {size_text(camera.in_angles, width * bank.pixel_m)}")
        words.append("dotted: far spot (first dark ring + 1 pixel)")
    if len(camera.colours) == 3:
        words.append("together: all three as red, green, blue")
    if camera.light == "edges":
        words.append("with the light of walls")
    return "; ".join(words)
