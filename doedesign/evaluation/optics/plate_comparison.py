"""The light of a design beside that of classic plates in its own camera, near and far: the paper's fig. 4."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.design.design import Design
from doedesign.design.problem import judge_height, problem_of
from doedesign.design.starts import StartSetup, flat, fresnel, random, ring
from doedesign.spec import input_files
from fab.errors import InputError
from fab.figure import (
    bare,
    extent_of,
    length_text,
    panels,
    scale_bar,
    shrunk,
)
from fab.levels import height_of, quantise_wrapped
from fab.units import MM, UM
from sim.camera import Camera
from sim.metrics import far_spot, participation, ring_to_disc, spot_radius_m
from sim.optic import CellOptic, HeightOptic
from sim.plots.colours import colour_label, line_colours, wavelength_order
from sim.plots.psfs import light_scale, shaded
from sim.psf_bank import Length, PsfBank, depths_from, psf
from sim.rigorous.edge_optic import optic_as_drawn
from sim.transfer import directional_mtf

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

THIN_LENS, FRESNEL, RANDOM, RING, PROPOSED = "thin lens", "Fresnel", "random", "ring", "proposed"
_FREQUENCIES = 121  # up to the sensor's Nyquist frequency, the closer the lower
_NEAR, _FAR = 0, 1


class PlateRow(NamedTuple):
    """Numbers of a plate in a colour; MTF are radial means at shares of the sensor's Nyquist frequency.

    `concentration` is the near PSF's participation over that of the thin lens; `throughput` is the light in the window.
    """

    plate: str
    colour: str
    throughput_near: float
    throughput_far: float
    far_spot: float
    concentration: float
    ring_to_disc: float
    mtf_near_quarter: float
    mtf_near_half: float
    mtf_near_nyquist: float
    mtf_far_quarter: float
    mtf_far_half: float
    mtf_far_nyquist: float


@dataclass(frozen=True, eq=False)
class PlateLight:
    """Light of one plate, near and far.

    Attributes:
        name: its name.
        bank: PSFs at the near and the far depth.
        transfer: ``[colour, depth, way, frequency]`` MTF, 1 at frequency 0; the ways are the radial mean, x and y.
    """

    name: str
    bank: PsfBank
    transfer: Float[np.ndarray, "c 2 3 f"]


@dataclass(frozen=True, eq=False)
class OpticsComparison:
    """Plates in one camera: the paper's fig. 4.

    Attributes:
        name: of the design.
        camera: the camera.
        near_m: the near depth, metres.
        far_m: the far one.
        frequencies_per_m: of all MTFs, cycles per metre on the sensor.
        plates: the thin lens first.
    """

    name: str
    camera: Camera
    near_m: float
    far_m: float
    frequencies_per_m: Float[np.ndarray, " f"]
    plates: tuple[PlateLight, ...]

    @property
    def rows(self) -> tuple[PlateRow, ...]:
        """Numbers, plate by plate and colour by colour."""
        nyquist, at = self.frequencies_per_m[-1], self.frequencies_per_m
        lens, found = np.asarray(self.plates[0].bank.energy)[:, _NEAR], []
        for plate in self.plates:
            energy = np.asarray(plate.bank.energy)
            for number, colour in enumerate(self.camera.colours):
                near, far = energy[number]
                spread = float(participation(near)) / float(participation(lens[number]))
                ratio = float(ring_to_disc(near, self.camera, self.near_m).ratio)
                spot = float(far_spot(far, self.camera, colour))
                passed = [float(image.sum(dtype=np.float64)) for image in (near, far)]
                asked = nyquist * np.array([0.25, 0.5, 1.0])
                transfer = [float(v) for curve in plate.transfer[number, :, 0] for v in np.interp(asked, at, curve)]
                found.append(PlateRow._make((plate.name, colour.name, *passed, spot, spread, ratio, *transfer)))
        return tuple(found)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw a row per plate: PSFs near and far, and the MTF of either; on `ax`, or on a new figure."""
        return _plot_comparison(self, ax)


def comparison_plates(
    design: Design, *, evaluations: int = 30, seed: int = 1, fresnel_m: float | None = None
) -> dict[str, Float[np.ndarray, "y x"]]:
    """Heights of the plates that fig. 4 compares a design with, metres, in the levels of the design.

    thin lens   no relief
    Fresnel     The paper learns the focal length of a Fresnel lens together with its network. Here it is the Fresnel
                lens, with up to 40 waves at the rim, that NLopt finds of the least loss by the design's own objectives:
                the same freedom, without a network.
    random      independent heights over one wave
    ring        the circular grating from which designs start, as bright in all colours as its options say

    Args:
        design: the design.
        evaluations: of the loss in the search for the Fresnel lens.
        seed: of the random plate.
        fresnel_m: focal length of the Fresnel lens, metres, in place of the search.

    Raises:
        InputError: a design without objectives, and no `fresnel_m`.
    """
    spec, camera, levels = design.spec, design.camera, design.levels
    waves_of = spec.optics.design_wavelength_m if spec else camera.lines[0].wavelength_m
    setup = StartSetup(camera, False, waves_of, seed, level_step_m=levels.step_m)
    if fresnel_m is None:
        if spec is None or not spec.objectives:
            rule, cure = "the search for a Fresnel lens needs the design's objectives", "Give its focal length."
            raise InputError("fresnel_m", rule, "none", cure)
        # Of a map of cells, whatever the design's own parameters are.
        optimize = spec.optimize.model_copy(update={"parametrization": "freeform"})
        problem, scene = problem_of(spec.model_copy(update={"optimize": optimize}), input_files(spec))

        def loss(map_m: Float[np.ndarray, "y x"]) -> float:
            return judge_height(problem, scene, map_m)

        lens = fresnel(setup._replace(loss=loss), {"evaluations": evaluations})
    else:
        lens = fresnel(setup, {"focal_length": f"{fresnel_m / UM!r} um"})
    given = spec.optimize.start_options if spec and spec.optimize.start == "ring" else {}
    drawn = {FRESNEL: lens, RANDOM: random(setup, {}), RING: ring(setup, {**given, "roughness": 0.0})}
    stepped = {name: height_of(quantise_wrapped(map_m, levels), levels) for name, map_m in drawn.items()}
    return {THIN_LENS: flat(setup, {}), **stepped}


def compare_optics(
    design: Design,
    plates: Mapping[str, Float[np.ndarray, "y x"]] | None = None,
    near: Length | None = None,
    far: Length | None = None,
) -> OpticsComparison:
    """Compare a design with other plates in its own camera.

    Args:
        design: the design, last of the plates, as "proposed".
        plates: heights of the others, metres, by name, that without relief first; `comparison_plates` by default.
        near: the near depth, metres or with a unit; the nearest of the design by default.
        far: the far one; the farthest of the design.

    Raises:
        InputError: a design without near or far depths where none are given, or without a lens.
    """
    camera = design.camera
    if camera.distance_m is not None:
        raise InputError("design", "the comparison is one behind a lens", camera.lens_text, "Choose another design.")
    ends = []
    for words, given, own, end in (("near", near, design.near_m, min), ("far", far, design.far_m, max)):
        if given is None and not own:
            raise InputError(words, "a depth is needed", "none", f"Give `{words}`.")
        ends.append(depths_from(given)[0] if given is not None else end(own))
    depths_m = near_m, far_m = ends[0], ends[1]
    others = comparison_plates(design) if plates is None else plates
    optics: dict[str, CellOptic] = {
        name: HeightOptic.of(camera, map_m)
        if camera.light == "scalar"
        else optic_as_drawn(camera, map_m, depths_m=depths_m)
        for name, map_m in others.items()
    }
    optics[PROPOSED] = replace(design, near_m=depths_m[:1], far_m=depths_m[1:]).as_optic()
    frequencies = 0.5 / camera.pixel_m * np.linspace(0.0, 1.0, _FREQUENCIES) ** 2
    found = []
    for name, optic in optics.items():
        transfer = np.stack([directional_mtf(optic, depth, frequencies) for depth in depths_m], axis=1)
        found.append(PlateLight(name, psf(optic, depths=depths_m), transfer))
    return OpticsComparison(design.name, camera, near_m, far_m, frequencies, tuple(found))


def _plot_comparison(found: OpticsComparison, ax: "Axes | None") -> "FigureBase":
    from matplotlib.lines import Line2D

    camera, count = found.camera, len(found.plates)
    hues = line_colours(camera.colours)
    picked = wavelength_order(camera.colours) if len(camera.colours) == 3 else [0]
    words = "colours as red, green, blue; " if len(picked) == 3 else ""
    note = (
        f"{words}brightness logarithmic, one scale for each column of PSFs; inset: the middle, six spot radii wide. "
        "MTF of lens, plate and pixel before sampling, of all light behind the plate; dashed along x, dotted along y."
    )
    titles = (f"near, {length_text(found.near_m)}", f"far, {length_text(found.far_m)}")
    frequencies = found.frequencies_per_m * MM
    with panels(ax, (11.4, 0.9 + 2.15 * count), f"{found.name} beside classic plates", note) as figure:
        grid = figure.subplots(count, 4, squeeze=False, width_ratios=(1, 1, 1.45, 1.45))
        for depth in (_NEAR, _FAR):
            images = [np.asarray(plate.bank.energy)[picked, depth] for plate in found.plates]
            small = np.stack([[shrunk(one, 320) for one in image] for image in images])
            norm = light_scale(small, max(float(image.max()) for image in images))
            for row, (plate, image) in enumerate(zip(found.plates, images, strict=True)):
                pane, curves = grid[row, depth], grid[row, 2 + depth]
                size = image.shape[-2:]
                pane.imshow(shaded(small[row], norm), extent=extent_of(size, camera.pixel_m, 1.0))
                if depth == _FAR:
                    _inset(pane, image, camera, norm)
                for colour in range(len(camera.colours)):
                    for way, style in ((2, ":"), (1, "--"), (0, "-")):
                        weight = 1.4 if way == 0 else 0.7
                        curve = plate.transfer[colour, depth, way]
                        curves.plot(frequencies, curve, color=hues[colour], ls=style, lw=weight)
                curves.set(ylim=(0, 1.02), xlim=(0, frequencies[-1]))
                if depth == _NEAR:
                    curves.set_xscale("log")
                    curves.set_xlim(frequencies[-1] / 200, frequencies[-1])
                    curves.xaxis.set_major_formatter("{x:g}")
                curves.grid(True)
                bare(pane)
                if row == 0:
                    pane.set_title(f"PSF {titles[depth]}")
                    curves.set_title(f"MTF {titles[depth]}")
                if row == count - 1:
                    scale_bar(pane, size[1] * camera.pixel_m)
                    curves.set_xlabel("cycles/mm on the sensor")
                else:
                    curves.tick_params(labelbottom=False)
        for axes, plate in zip(grid[:, 0], found.plates, strict=True):
            axes.set_ylabel(plate.name, fontsize=10)
        keys = [Line2D([], [], color=hues[i], label=colour_label(camera.colours[i])) for i in range(len(hues))]
        grid[0, 3].legend(handles=keys, loc="upper right")
    return figure


def _inset(axes: "Axes", image: Float[np.ndarray, "c y x"], camera: Camera, norm: Any) -> None:
    """The middle of a far PSF, with its spot, in a corner of its picture."""
    from matplotlib.patches import Circle

    spot_m = max(spot_radius_m(camera, max(colour.wavelengths_m)) for colour in camera.colours)
    size = image.shape[-1]
    pixels = min(math.ceil(3 * spot_m / camera.pixel_m), size // 2)
    cut = slice(size // 2 - pixels, size - size // 2 + pixels)
    middle = image[:, cut, cut]
    inset = axes.inset_axes((0.60, 0.60, 0.38, 0.38))
    inset.imshow(shaded(middle, norm), extent=extent_of(middle.shape[-2:], camera.pixel_m, 1.0))
    inset.add_patch(Circle((0, 0), spot_m, ls=":", ec="white", lw=0.9, fill=False))
    bare(inset)
    inset.spines[:].set_color("white")
