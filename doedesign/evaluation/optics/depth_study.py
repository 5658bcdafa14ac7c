"""The light of a design against the depth of its source, as drawn and as a process makes it: the paper's fig. 8."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.design.design import Design
from fab.errors import InputError
from fab.figure import (
    FAINT,
    INK,
    LIGHT,
    LINE,
    SERIES,
    SMALL,
    bare,
    evenly_spaced,
    extent_of,
    length_text,
    panels,
    scale_bar,
    shrunk,
)
from fab.process import Process
from fab.units import UM
from sim.camera import Camera, Colour
from sim.metrics import energy_within, radius_map_m, ring_to_disc, spot_radius_m, zeroth_order
from sim.optic import CellOptic
from sim.plots.psfs import light_scale, shaded
from sim.psf_bank import Length, depths_from, psf

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

PROBE_M = 520e-9  # the paper's source for PSFs
# Of the paper's plate: ring:disc in its simulation and on its bench.
SIMULATED_RATIO, MEASURED_RATIO = 3.0, 1.0
_PICTURES = 6


class DepthRow(NamedTuple):
    """Numbers of a plate at a depth (metres): `inside` is the light inside the geometric defocus disc of the depth.

    `throughput` is that in the window, `zeroth_order` the share of the light that passes as if the plate were flat,
    from every depth the same.
    """

    plate: str
    depth_m: float
    ring_to_disc: float
    inside: float
    throughput: float
    zeroth_order: float


@dataclass(frozen=True, eq=False)
class DepthStudy:
    """PSFs against depth, as drawn and as fabricated: the paper's fig. 8.

    Attributes:
        name: of the design.
        camera: its camera, with the probe's wavelength.
        depths_m: source depths, the farthest first, metres.
        plates: names, that of the plate as drawn first.
        near: how many of the depths have a defocus disc wider than the far spot; these are the last.
        shown: positions of the depths of which there are pictures.
        pictures: ``[plate, shown, y, x]`` PSFs, of the plate as drawn and of the first as fabricated.
        radii_m: of the cuts, metres.
        cuts: ``[plate, depth, radius]`` energy per pixel, the mean over a turn, of the same plates.
        rows: numbers of every plate and depth.
    """

    name: str
    camera: Camera
    depths_m: tuple[float, ...]
    plates: tuple[str, ...]
    near: int
    shown: tuple[int, ...]
    pictures: Float[np.ndarray, "2 s y x"]
    radii_m: Float[np.ndarray, " r"]
    cuts: Float[np.ndarray, "2 d r"]
    rows: tuple[DepthRow, ...]

    def of(self, plate: str) -> tuple[DepthRow, ...]:
        """Rows of one plate, the farthest depth first."""
        return tuple(row for row in self.rows if row.plate == plate)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw PSFs at some depths, cuts through all, and what a lab reads off them; on `ax`, or on a new figure."""
        return _plot_depths(self, ax)


def depth_study(
    design: Design,
    process: Process | str | Path | None = None,
    *,
    depths: Sequence[Length] = (),
    draws: int = 4,
    seed: int = 1,
    count: int = 25,
    probe_m: float = PROBE_M,
) -> DepthStudy:
    """Follow the PSF of a design from afar to its nearest depth, as drawn and as fabricated.

    Args:
        design: the design.
        process: the process, or the name of a stock process or a file (`Design.process`); that of the spec by default.
        depths: of the sources, metres or with a unit; by default `count` from infinity to the nearest of the design,
            evenly spaced in 1/z.
        draws: plates of the process.
        seed: of the draws.
        count: of the depths where none are given.
        probe_m: vacuum wavelength of the source; the paper's by default.

    Raises:
        InputError: a design without a lens or without a near depth, no draws, or a process that cannot be used.
    """
    if design.camera.distance_m is not None:
        rule, cure = "depths matter behind a lens", "Choose a design with a focal length."
        raise InputError("design", rule, design.camera.lens_text, cure)
    if draws < 1:
        raise InputError("draws", "must be at least 1", draws, "For example 4.")
    if depths:
        depths_m = tuple(sorted(depths_from(depths), reverse=True))
    elif design.near_m:
        inverse = np.linspace(0.0, 1 / min(design.near_m), count)
        depths_m = (math.inf, *(float(1 / one) for one in inverse[1:]))
    else:
        raise InputError("depths", "a design without near depths says none", "none", "Give some.")
    camera = replace(design.camera, colours=(Colour("probe", (probe_m,), (1.0,)),), beam=None)
    probed, made_by = replace(design, camera=camera, near_m=depths_m[-1:], far_m=depths_m[:1]), design.process(process)
    optics: dict[str, CellOptic] = {"as drawn": probed.as_optic()}
    for number in range(draws):
        draw = f"normal/{number}"
        optics[f"draw {number}"] = probed.fabricated(made_by, seed=seed, draw=draw)
    spot_m = spot_radius_m(camera, probe_m)
    near = sum(camera.defocus_radius_m(z) > spot_m for z in depths_m)
    shown = tuple(evenly_spaced(len(depths_m), _PICTURES))
    radius_px = radius_map_m((camera.window, camera.window), 1.0)
    ring_of = np.floor(radius_px).astype(int)
    counted = np.bincount(ring_of.ravel())[: camera.window // 2]
    pictures, cuts, rows = [], [], []
    for name, optic in optics.items():
        energy = np.asarray(psf(optic, depths=depths_m).energy[0], np.float64)
        order = float(zeroth_order(optic)[0])
        for depth, image in zip(depths_m, energy, strict=True):
            found = ring_to_disc(image, camera, depth)
            inside = energy_within(image, camera.pixel_m, found.disc_radius_m)
            rows.append(DepthRow(name, depth, float(found.ratio), float(inside), float(image.sum()), order))
        if len(pictures) < 2:
            pictures.append(energy[list(shown)])
            cuts.append([np.bincount(ring_of.ravel(), image.ravel())[: len(counted)] / counted for image in energy])
    radii = (np.arange(len(counted)) + 0.5) * camera.pixel_m
    return DepthStudy(
        design.name,
        camera,
        depths_m,
        tuple(optics),
        near,
        shown,
        np.stack(pictures),
        radii,
        np.array(cuts),
        tuple(rows),
    )


def _plot_depths(found: DepthStudy, ax: "Axes | None") -> "FigureBase":
    from matplotlib.colors import LogNorm

    camera, columns = found.camera, len(found.shown)
    note = (
        "Energy per pixel, logarithmic, one scale for each column; dashed: geometric defocus disc. Light inside the "
        "disc is what the plate leaves undiffracted and what it scatters there. The paper's ratios are those of its "
        "own plate."
    )
    title = f"{found.name}: light of a point against its depth, {length_text(camera.lines[0].wavelength_m)}"
    names = (found.plates[0], f"as fabricated, {found.plates[1]}")
    with panels(ax, (11.4, 9.2), title, note) as figure:
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.0, 1.15))
        top, bottom = parts
        grid = top.subplots(2, columns, squeeze=False)
        for column, depth in enumerate(found.shown):
            images = found.pictures[:, column]
            norm = light_scale(images, float(images.max()))
            for row, image in enumerate(images):
                pane = grid[row, column]
                extent = extent_of(image.shape, camera.pixel_m, 1.0)
                pane.imshow(shaded(shrunk(image, 300)[None], norm), extent=extent)
                _disc(pane, camera, found.depths_m[depth])
                bare(pane)
            grid[0, column].set_title(length_text(float(f"{found.depths_m[depth]:.3g}")))
        scale_bar(grid[1, 0], camera.window * camera.pixel_m)
        for pane, name in zip(grid[:, 0], names, strict=True):
            pane.set_ylabel(name)
        panes = bottom.subplots(2, 2)
        bend = np.array([1 / z for z in found.depths_m])
        # The spot of a source afar would take all of the scale.
        low, high = np.quantile(found.cuts[found.cuts > 0], (0.05, 0.998))
        norm = LogNorm(low, high, clip=True)
        mesh: Any = None
        for pane, cut, name in zip(panes[0], found.cuts, names, strict=True):
            pane.set_facecolor("black")
            mesh = pane.pcolormesh(
                bend, found.radii_m / UM, cut.T, norm=norm, cmap=LIGHT, shading="nearest", rasterized=True
            )
            disc = [camera.defocus_radius_m(z) / UM for z in found.depths_m]
            pane.plot(bend, disc, color="white", ls="--", lw=0.8)
            pane.set(
                title=name,
                xlabel="1/z (1/m)",
                ylabel="radius (µm)",
                ylim=(0, found.radii_m[-1] / UM),
                xlim=(0, bend[-1]),
            )
        bottom.colorbar(mesh, ax=panes[0].tolist(), label="energy per pixel", aspect=14)
        ratio, inside = panes[1]
        for number, plate in reversed(list(enumerate(found.plates))):
            style: Any = {"color": SERIES[1], "lw": 0.9, "alpha": 0.8} if number else {"color": LINE, "lw": 1.8}
            of, near = found.of(plate), len(bend) - found.near
            made = len(found.plates) - 1
            words = f"{made} plate{'s' if made > 1 else ''} as fabricated"
            label = plate if not number else words if number == 1 else None
            ratio.plot(bend[near:], [row.ring_to_disc for row in of[near:]], label=label, **style)
            inside.plot(bend[near:], [row.inside for row in of[near:]], **style)
            inside.axhline(of[0].zeroth_order * camera.lines[0].factor, **(style | {"ls": ":"}))
        for level, words in ((SIMULATED_RATIO, "paper, simulated 3:1"), (MEASURED_RATIO, "paper, measured 1:1")):
            ratio.axhline(level, color=INK, ls="--", lw=0.8)
            place = {"xy": (0.99, level), "xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
            # Above the upper line and below the lower one, where no curve is.
            up = level == SIMULATED_RATIO
            ratio.annotate(
                words, xytext=(0, 2 if up else -3), ha="right", va="bottom" if up else "top", fontsize=SMALL, **place
            )
        first = len(bend) - found.near
        most = max((row.ring_to_disc for plate in found.plates for row in found.of(plate)[first:]), default=0.0)
        ratio.set(xlabel="1/z (1/m)", ylabel="ring : disc", ylim=(0, 1.15 * max(most, SIMULATED_RATIO)))
        inside.set(xlabel="1/z (1/m)", ylabel="share of light", ylim=(0, None))
        ratio.set_title("light outside over inside the defocus disc")
        inside.set_title("light inside the disc; dotted: 0th order behind both faces")
        ratio.legend(loc="lower left")
        for pane in panes[1]:
            pane.grid(True, color=FAINT)
            pane.set_xlim(0, bend[-1])
    return figure


def _disc(axes: "Axes", camera: Camera, depth_m: float) -> None:
    from matplotlib.patches import Circle

    if (radius := camera.defocus_radius_m(depth_m)) > camera.window * camera.pixel_m / 80:
        axes.add_patch(Circle((0, 0), radius, ls="--", ec="white", lw=0.8, fill=False))
