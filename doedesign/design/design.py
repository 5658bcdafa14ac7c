"""Design: a DOE as it is drawn, with the camera it is for."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from doedesign.build import resolve_process, with_edge_moves
from doedesign.spec import Spec, load_variation
from fab.draws import EXPECTED, sources_of, variation_at
from fab.errors import InputError
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.process import Process, Variation
from fab.units import distances_from, format_length, metres, require_kind
from sim.camera import Camera, require_same_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from sim.optic import HeightOptic
    from sim.rigorous.edge_optic import EdgeOptic
    from sim.surface import FabricatedDoe

log = logging.getLogger("doedesign")


@dataclass(frozen=True, eq=False)
class Design:
    """A DOE as drawn, with all that is needed to predict it.

    Attributes:
        level_map: level of every cell; heights follow from it.
        camera: lens, sensor and substrate, on the grid of the level map.
        near_m: distances of obstructions, metres; none by default.
        far_m: distances of the scene, metres; `inf`, a star, by default.
        edge_moves_m: how far the masks draw the edges of etched areas outward to make up for the line-width bias of the
            process, first mask first, metres; empty for nowhere.
        aim: what the plate is to come out as, where the masks are drawn so that errors of the process lead there from
            another level map; None where that is the level map itself.
        continuous_m: ``[y, x]`` heights before rounding to levels, metres, if they are at hand.
        spec: the spec it was optimised for, if there was one.
        history: one record per step of its optimisation, if at hand: `step`, `loss`, `terms` and their `names`.
        folder: its run folder, if it has one.
        area_targets: the areas of its spec with their pictures read, as `doedesign.areas.target.AreaTarget`, for
            processes that may not have the files; empty where they are read from these.

    Raises:
        InputError: something other than a level map, a camera or distances, or a camera on another grid than the level
            map's.
    """

    level_map: LevelMap
    camera: Camera
    near_m: tuple[float, ...] = ()
    far_m: tuple[float, ...] = (math.inf,)
    edge_moves_m: tuple[float, ...] = ()
    aim: LevelMap | None = None
    continuous_m: Float[np.ndarray, "y x"] | None = None
    spec: Spec | None = None
    history: tuple[Mapping[str, Any], ...] = ()
    folder: Path | None = None
    area_targets: tuple[Any, ...] = ()  # a module that builds on this one has the class

    def __post_init__(self) -> None:
        """Refuse what is no design, and a camera that is for another plate."""
        cure = "Quantise heights: fab.LevelMap.from_height(fab.HeightMap(height_m, grid, aperture), levels)."
        require_kind("level_map", self.level_map, LevelMap, cure)
        require_kind("camera", self.camera, Camera, "Give lens, sensor and substrate, a sim.Camera.")
        require_same_grid(self.camera, self.level_map.grid)
        for name in ("near_m", "far_m"):
            object.__setattr__(self, name, distances_from(getattr(self, name), name))

    @property
    def name(self) -> str:
        """Name of the level map."""
        return self.level_map.name

    @property
    def levels(self) -> Levels:
        """Staircase of the level map."""
        return self.level_map.levels

    @property
    def height_m(self) -> Float[np.ndarray, "y x"]:
        """Height ``[y, x]`` of every cell above the deepest floor, metres, float32."""
        return self.level_map.height_m

    @property
    def nominal_height_m(self) -> Float[np.ndarray, "y x"]:
        """Heights ``[y, x]`` that the optimisation ended with, metres: not rounded where the spec leaves them so."""
        unrounded = self.spec is not None and self.spec.optimize.quantisation == "none"
        return self.continuous_m if unrounded and self.continuous_m is not None else self.height_m

    @property
    def depths_m(self) -> tuple[float, ...]:
        """All source distances, near ones first, metres."""
        return (*self.near_m, *self.far_m)

    def as_optic(self) -> "HeightOptic | EdgeOptic":
        """The optic of the design as drawn, which `sim.psf` asks for PSFs."""
        from sim.rigorous.edge_optic import optic_as_drawn

        return optic_as_drawn(self.camera, self.height_m, depths_m=self.depths_m or (np.inf,))

    def bare(self) -> "Design":
        """The same without what only its optimisation knew: what other processes need to predict it.

        Its spec stays where it says what light should make.
        """
        spec = self.spec if self.spec is not None and self.spec.aims else None
        return replace(self, continuous_m=None, spec=spec, history=(), folder=None)

    def process(self, process: "Process | str | Path | None" = None) -> Process:
        """Return the process that makes this design, as the design sees it through its masks.

        Args:
            process: a process; the name of a stock process ("contact_aligner"); a TOML file with a process; by default
                that of the spec, or an ideal one.

        Raises:
            InputError: the process cannot be read, or makes another staircase.
        """
        own = None if self.spec is None else self.spec.process
        return with_edge_moves(resolve_process(process, self.levels, own), self.edge_moves_m)

    def plate_errors(
        self,
        process: Process,
        variation: "Variation | str | Path | None" = None,
        seed: int | None = None,
        draw: str = "normal/0",
    ) -> tuple[Variation, str]:
        """Return the errors of one DOE of a process, and a few words on where they come from.

        Args:
            process: the process.
            variation: the errors themselves, SI units, or a TOML file with them.
            seed: seed to draw them from instead; with neither, every error is at its mean.
            draw: which draw of the seed, as in a tolerance study (`fab.draws`).

        Raises:
            InputError: both a variation and a seed, or a file that cannot be read.
        """
        if variation is not None and seed is not None:
            raise InputError("seed", "a plate has one source of errors", "also `variation`", "Leave one of them out.")
        if isinstance(variation, Variation):
            return variation, "given errors"
        if variation is not None and not isinstance(variation, str | Path):
            rule, cure = "must be a fab.Variation or a TOML file", "For example fab.Variation(common_depth_scale=0.02)."
            raise InputError("variation", rule, repr(variation), cure)
        if variation is not None:
            return load_variation(variation), f"errors of {Path(variation).name}"
        if not sources_of(process) and not any(spread.mean for spread in process.spreads.values()):
            words = "the process has no errors, so this plate is the one drawn."
            log.warning(f'{words} Give a process with errors, such as "contact_aligner".')
        key = EXPECTED if seed is None else draw
        errors = variation_at(process, seed or 0, max(self.camera.grid.extent_m), key)
        if seed is not None:
            return errors, f"draw {key} of seed {seed} of the process {process.name}"
        return errors, f"every error of the process {process.name} at its mean"

    def fabricated(
        self,
        process: "Process | str | Path | None" = None,
        seed: int | None = None,
        draw: str = "normal/0",
        variation: "Variation | str | Path | None" = None,
        depths: "str | float | Sequence[str | float] | None" = None,
    ) -> "FabricatedDoe":
        """Predict the DOE that a process (see `process`) makes of this design; see `plate_errors` for the others.

        `depths` are the nearest and the farthest of the sources that it will be looked at from, in metres or with a
        unit; those of the spec by default.

        Raises:
            InputError: a process that cannot be used, or errors beyond the model (`sim.surface.as_fabricated`).
        """
        from sim.psf_bank import depths_from
        from sim.surface import as_fabricated

        made_by = self.process(process)
        errors, _ = self.plate_errors(made_by, variation, seed, draw)
        depths_m = self.depths_m if depths is None else depths_from(depths)
        return as_fabricated(self.level_map.level, self.camera, made_by, errors, depths_m=depths_m)

    def write_phase(
        self, path: "str | Path", wavelength: "str | float", *, side: Literal["exit", "entry"] = "entry"
    ) -> None:
        """Write the phase of the design as a grid phase of Zemax OpticStudio (`fab.solids.height_files`).

        Args:
            path: the file, .DAT.
            wavelength: in vacuum, metres or with a unit. The phase is positive where light is late.
            side: where the relief is: "entry" where it faces the light, "exit" where light leaves through it. The axes
                of Zemax are right-handed, so that the map is mirrored for the former.
        """
        from fab.solids.height_files import write_zemax_phase

        write_zemax_phase(path, self.level_map, float(self.camera.waves_per_metre(metres(wavelength))), side=side)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the level map; on `ax`, or on a new figure. Returns what it drew on."""
        return self.level_map.plot(ax)

    def _repr_html_(self) -> str:
        """Table and picture for notebooks."""
        from fab.figure import html_of

        colours = ", ".join(colour.name for colour in self.camera.colours)
        near, far = (", ".join(format_length(z) for z in depths) or "none" for depths in (self.near_m, self.far_m))
        rows: dict[str, object] = {
            "level map": self.level_map,
            "clear aperture": str(self.camera.opening),
            "lens": self.camera.lens_text
            if self.camera.distance_m
            else f"f = {format_length(self.camera.focal_length_m)}, {self.camera.lens_text}",
            "colours": colours,
            "near": near,
            "far": far,
        }
        if self.history:
            rows["loss"] = f"{self.history[-1]['loss']:.4g} after {len(self.history)} steps"
        return html_of(self.name, rows, self.plot())
