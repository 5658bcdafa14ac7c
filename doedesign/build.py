"""Values of the physics from the tables of a spec: camera, levels, process, wafer, terms of an order."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from doedesign.spec import (
    DefectsSpec,
    OrderSpec,
    ProcessSpec,
    Spec,
    WaferSpec,
    input_files,
    load_process,
    process_from_json,
)
from fab.errors import InputError
from fab.files import MANIFEST_NAME
from fab.grid import Grid
from fab.layout.wafer import Wafer
from fab.levels import Levels
from fab.order.terms import OrderTerms
from fab.pictures import read_pixels
from fab.process import DEVIATIONS, Defects, Normal, Process, error_names
from fab.stock import IDEAL, STOCK, process_from
from fab.units import format_length, require_kind
from sim.camera import Camera, Colour
from sim.illumination import Beam, EvenBeam, GaussianBeam, MeasuredBeam, power_through

# Attributes that `Process` and a filled `ProcessSpec` have in common, and the rates among the defects.
_SHARED = ("tone", "minimum_line_m", "minimum_space_m", "die_m", "wafer_radius_m", "reduction")
# Share of a beam's power that the aperture must let through; fields of single precision hold no less of it than this.
_LEAST_POWER = 1e-9
_EVENTS = ("particles_per_m2", "pinholes_per_m2", "missed", "doubled")


def camera_from_spec(spec: Spec) -> Camera:
    """Return lens, sensor, substrate and DOE grid of a spec.

    Raises:
        InputError: something other than a spec, a beam whose picture cannot be used, or one that misses the aperture.
    """
    require_kind("spec", spec, Spec, 'Read it by dd.load_spec("spec.toml").')
    camera = Camera(
        grid=Grid(spec.doe.shape, spec.doe.pitch_m),
        # Light passes the opening in the chrome, which is smaller than what is etched.
        aperture=spec.doe.relief.shrunk(spec.process.chrome_overlap_m),
        material=spec.doe.material,
        colours=tuple(Colour(c.name, c.wavelengths_m, c.weights) for c in spec.optics.colours),
        focal_length_m=np.inf if spec.optics.focal_length_m is None else spec.optics.focal_length_m,
        pixel_m=spec.sensor.pixel_m,
        window=spec.sensor.window,
        fill=spec.sensor.fill_factor,
        defocus_m=spec.sensor.defocus_m,
        mapping=spec.optics.mapping,
        distortion=spec.optics.distortion,
        doe_distance_m=spec.optics.doe_distance_m,
        light=spec.optics.light,
        polarisation=spec.optics.polarisation,
        beam=beam_from_spec(spec),
        distance_m=np.inf if spec.sensor.in_angles else spec.sensor.distance_m,
    )
    _require_light(camera)
    camera.require_upright((0.0, 0.0))
    return camera


def _require_light(camera: Camera) -> None:
    """Raise an `InputError` for a beam beside the aperture: of no light there are no shares."""
    if camera.beam is None:
        return
    for colour in camera.colours:
        share = power_through(camera.beam, camera.grid, camera.opening, colour.wavelengths_m[0])
        if not share >= _LEAST_POWER:
            rule = f"light of the beam must reach the aperture of {camera.opening}"
            got = f"{share:.2g} of its power there at {format_length(colour.wavelengths_m[0])}"
            cure = 'Move it, for example centre = ["0 mm", "0 mm"], choose a wider one, or finer cells.'
            raise InputError("illumination.centre", rule, got, cure)


def beam_from_spec(spec: Spec) -> Beam | None:
    """Return the beam that lights the DOE, or None; its picture is read from the file that the spec names.

    Raises:
        InputError: the picture is missing, cannot be read, or is dark.
    """
    light = spec.illumination
    if light is None:
        return None
    centre_m, aslant = _yx(light.centre_m), (_yx(light.angles_rad), _yx(light.tilt_rad))
    if light.kind in ("plane", "point"):
        distance_m = np.inf if light.distance_m is None else light.distance_m
        return EvenBeam(distance_m, *aslant)
    if light.picture is None:
        y, x = _yx(light.diameters_m)
        return GaussianBeam((y / 2, x / 2), light.waist_distance_m, _yx(light.m_squared), centre_m, *aslant)
    path = input_files(spec, "illumination.picture")["illumination.picture"]
    picture = read_pixels(path, others="RGBA")
    if picture.ndim == 3:
        picture = picture[..., : 3 if picture.shape[2] > 2 else 1].mean(axis=2)
    if not picture.any():
        raise InputError(str(path), "a beam must have some light", "a black picture", "Give another picture.")
    assert light.pixel_m is not None
    return MeasuredBeam(picture.astype(np.float64), light.pixel_m, centre_m, *aslant)


def _yx(values: Sequence[float]) -> tuple[float, float]:
    """One number for both axes, or [x, y], as (y, x)."""
    return values[-1], values[0]


def levels_from_spec(spec: ProcessSpec, chosen: Levels | None = None) -> Levels:
    """Return the staircase that a process makes, `chosen` where its spec leaves the depths to the optimisation."""
    depths_m = spec.etch_depths_m
    if isinstance(depths_m, str):
        if chosen is not None:
            return chosen
        cure = f"Give them as numbers; those that a run chose are in its {MANIFEST_NAME}."
        raise InputError("process.etch_depths", "the depths must be known here", f'"{depths_m}"', cure)
    return Levels(spec.levels, spec.level_step_m, depths_m or ())


def process_from_spec(spec: Spec | ProcessSpec, chosen: Levels | None = None) -> Process:
    """Return the process of a whole spec or of its table of one; what that leaves out is its stock process's.

    Its staircase is `chosen` where the spec leaves the depths of the etches to the optimisation; errors whose mean and
    standard deviation are zero are left out of its spreads.

    Raises:
        InputError: something other than these, or the depths are still to be chosen.
    """
    if not isinstance(spec, Spec | ProcessSpec):
        cure = 'Read it by dd.load_spec("spec.toml"); a stock process is fab.process_from("contact_aligner", levels).'
        require_kind("spec", spec, Spec, cure)
    spec = spec.process if isinstance(spec, Spec) else spec
    full = spec.filled()
    defects = full.defects.in_si()
    spreads: dict[str, Normal] = {}
    for error, given in full.errors.given().items():
        names = error_names(spec.masks, error)
        every = zip(names, given.spreads(len(names)), strict=True)
        spreads |= {name: spread for name, spread in every if spread != Normal()}
    return Process(
        levels=levels_from_spec(spec, chosen),
        order=tuple(etch.mask for etch in full.etches),
        spreads=spreads,
        defects=Defects(**defects),
        name=spec.stock or ("custom" if spreads or any(defects[key] for key in _EVENTS) else "ideal"),
        **{key: getattr(full, key) for key in _SHARED},
    )


def wafer_from_spec(spec: WaferSpec) -> Wafer:
    """Return the layout of a wafer, or raise an `InputError` for numbers that do not go together."""
    return Wafer(**spec.model_dump())


def terms_from_spec(spec: OrderSpec) -> OrderTerms:
    """Return the terms of a mask order."""
    return OrderTerms(**spec.model_dump())


def is_process_file(given: object) -> TypeGuard[str | Path]:
    """Whether a process is given by its file: a path, or a name that is neither a stock process's nor "ideal"."""
    return isinstance(given, Path) or (isinstance(given, str) and given not in (*STOCK, IDEAL.name))


def resolve_process(
    given: "Process | ProcessSpec | str | Path | None", levels: Levels, default: ProcessSpec | None = None
) -> Process:
    """Return a process for a staircase: one that is given, by itself, its spec, its stock name or its TOML file.

    None stands for the `default`, the process of the design's spec, or else for the ideal process.
    """
    source = default if given is None else given
    read: Any = load_process(source, levels) if is_process_file(source) else source
    if isinstance(read, ProcessSpec):
        read = process_from_spec(read, levels)
        if read.levels != levels:
            where = str(source) if is_process_file(source) else "process"
            raise InputError(where, f"must be for {levels}", read.levels, "Give a process for this design.")
    return process_from(read, levels)


def with_edge_moves(process: Process, edge_moves_m: Sequence[float]) -> Process:
    """Return a process with the line-width bias that is left where masks draw edges moved outward, metres by mask."""
    if not any(edge_moves_m):
        return process
    names = [f"cd_bias_m[{mask}]" for mask in range(process.masks)]
    old = [process.spreads.get(name, Normal()) for name in names]
    moved = {name: Normal(one.mean + move, one.sigma) for name, one, move in zip(names, old, edge_moves_m, strict=True)}
    return replace(process, spreads={**process.spreads, **moved})


def spec_from_process(process: Process, like: ProcessSpec | None = None) -> ProcessSpec:
    """Return the spec of a process, with every number given; the overlap of the chrome is that of `like`."""
    errors = {}
    for error in DEVIATIONS:
        spreads = [process.spreads.get(name, Normal()) for name in error_names(process.masks, error)]
        if any(spread != Normal() for spread in spreads):
            parts = {part: [float(getattr(spread, part)) for spread in spreads] for part in ("mean", "sigma")}
            errors[error] = {part: v[0] if len(set(v)) == 1 else tuple(v) for part, v in parts.items()}
    in_order = process.order == Process(process.levels).order
    data: dict[str, Any] = {
        "levels": process.levels.count,
        "level_step_m": process.levels.step_m,
        **({} if process.levels.is_binary else {"etch_depths_m": process.levels.depths_m}),
        **({} if like is None else {"chrome_overlap_m": like.chrome_overlap_m}),
        "etches": [] if in_order else [{"mask": k, "depth_m": process.depths_m()[k]} for k in process.order],
        "errors": errors,
        "defects": DefectsSpec.from_si(vars(process.defects)),
        **{key: getattr(process, key) for key in _SHARED},
    }
    return process_from_json(data, f"process {process.name}")
