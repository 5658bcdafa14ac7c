"""`doedesign simulate`: what a camera with the DOE of a run will see through dirt, drops or a fence."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.capture.camera import CaptureModel
from doedesign.capture.from_spec import obstruction_from_spec, occlusion_from_spec, plain_parameters, sensor_from_spec
from doedesign.capture.images import Pictures, picture_files
from doedesign.capture.scenes import SceneData
from doedesign.capture.simulate import flat_psfs, plate_psfs
from doedesign.commands.fabricated import errors_of_plate
from doedesign.commands.psf import Say
from doedesign.design.design import Design
from doedesign.runs.folder import Run, open_run, spec_with
from doedesign.runs.level_maps import open_design
from doedesign.spec import Spec, spec_digest, variation_to_toml
from fab.errors import InputError
from fab.process import Process, Variation
from sim.camera import Camera
from sim.obstruction import CameraView, ObstructionKind

FORMAT = "doedesign simulation 1"

_USUAL_COUNT = 6
_USUAL_SIDE = 512
# What may be changed after the plate was designed.
_FREE = ("scene", "sensor", "obstruction")


@dataclass(frozen=True)
class SimulationSettings:
    """What to simulate.

    Attributes:
        images: folder of pictures; scikit-image's samples if None.
        obstruction: kind, or folder of masks; that of the spec if None.
        occlusion: occlusion model; that of the spec if None.
        count: how many items; six at most if None, and each picture once.
        seed: seed of everything.
        size: pixels (binned) per side of a frame; at most 512, and what the sensor has, if None.
        overrides: changes to [scene], [sensor] and [obstruction] of the run's spec.
        png: write 16-bit PNG instead of EXR.
    """

    images: Path | None = None
    obstruction: str | None = None
    occlusion: str | None = None
    count: int | None = None
    seed: int = 0
    size: int | None = None
    overrides: Sequence[str] = ()
    png: bool = False


@dataclass(frozen=True)
class Fabrication:
    """Which plate as fabricated to look through; see `doedesign.commands.fabricated`.

    Attributes:
        process: TOML file with a [process] table; the run's own process if None.
        variation: TOML file with the errors of the plate.
        seed: take the errors from this seed of the process.
        draw: which draw of it.
    """

    process: Path | None = None
    variation: Path | None = None
    seed: int | None = None
    draw: str = "normal/0"


class SimulationResult(NamedTuple):
    """What a simulation left behind.

    Attributes:
        folder: the folder.
        items: names of the items' folders.
        skipped: why each picture that could not be used was skipped.
    """

    folder: Path
    items: tuple[str, ...]
    skipped: dict[str, str]


def simulate(
    run_folder: Path,
    out: Path | None = None,
    request: SimulationSettings | None = None,
    *,
    masks: Path | None = None,
    fabrication: Fabrication | None = None,
    say: Say = lambda _: None,
) -> SimulationResult:
    """Write simulated captures of a run.

    Args:
        run_folder: a finished run.
        out: folder; RUN/simulated by default.
        request: what to simulate.
        masks: the run's mask order; `masks/NAME` if there is one.
        fabrication: look through a plate with errors instead of the plate as drawn.
        say: told what is going on.

    Raises:
        InputError: a run, picture, mask or number that cannot be used, or no occlusion model.
    """
    with named_as_options():
        return _simulated(open_run(run_folder), out, request or SimulationSettings(), masks, fabrication, say)


def _simulated(
    run: Run,
    out: Path | None,
    request: SimulationSettings,
    masks: Path | None,
    fabrication: Fabrication | None,
    say: Say,
) -> SimulationResult:
    source = str(run.path("spec.toml"))
    spec = spec_with(run, request.overrides, _FREE)
    model = occlusion_from_spec(spec, source, request.occlusion)
    kind = obstruction_from_spec(spec, source, request.obstruction)
    design = open_design(run, masks)
    camera = replace(design.camera, window=design.camera.window | 1)  # odd: the capture lies on the scene
    view = _view(spec, camera, request.size)
    pictures = Pictures(picture_files(request.images), most_px=2 * max(view.shape))
    count = min(_USUAL_COUNT, len(pictures)) if request.count is None else request.count
    if count < 1:
        raise InputError("count", "must be at least 1", count, "Leave it out for one item per picture, at most six.")
    far = spec.scene.far_m
    data = SceneData(pictures, kind, view, (min(far), max(far)), request.seed, mirrored=False)
    made_by, errors, plate = _plate(design, fabrication)
    psfs = plate_psfs(design, camera, made_by, errors), flat_psfs(camera)
    bench = CaptureModel.make(camera, kind, model, sensor_from_spec(spec))
    settings = _settings(run, spec, request, design, plate, kind, bench, pictures, view)
    if errors is not None:
        settings["variation"] = variation_to_toml(errors)
    folder = out or run.path("simulated")
    say(f"{count} items of {view.shape[1]} x {view.shape[0]} pixels, {settings['obstruction']}, {model}; {plate}")
    names = write_captures(folder, data, count, bench, psfs, settings, png=request.png)
    if skips := pictures.skips():
        say(skips)
    return SimulationResult(folder, names, {str(path): why for path, why in sorted(pictures.skipped.items())})


def _view(spec: Spec, camera: Camera, size: int | None) -> CameraView:
    width, height = (n // spec.sensor.binning for n in spec.sensor.resolution)
    side = min(_USUAL_SIDE, width, height) if size is None else size
    if not 16 <= side <= min(width, height):
        rule = f"must lie from 16 to the {min(width, height)} binned pixels of the sensor's shorter side"
        raise InputError("size", rule, side, "Choose another size.")
    return CameraView((side, side), camera.pixel_m, camera.sensor_distance_m)


def _plate(design: Design, fabrication: Fabrication | None) -> tuple[Process | None, Variation | None, str]:
    """What makes the plate, its errors, and a few words on it; no process for the plate as drawn."""
    if fabrication is None:
        return None, None, "plate as drawn"
    made_by = design.process(fabrication.process)
    errors, said = errors_of_plate(design, made_by, fabrication.variation, fabrication.seed, fabrication.draw)
    return made_by, errors, f"plate with {said}"


def _settings(
    run: Run,
    spec: Spec,
    request: SimulationSettings,
    design: Design,
    plate: str,
    kind: ObstructionKind,
    bench: CaptureModel,
    pictures: Pictures,
    view: CameraView,
) -> dict[str, Any]:
    """Everything that an item depends on, but for its number."""
    return {
        "format": FORMAT,
        "run": run.spec.name,
        "spec_sha256": spec_digest(spec),
        "level_map_sha256": design.level_map.digest,
        "plate": plate,
        "obstruction": getattr(kind, "name", type(kind).__name__),
        "parameters": plain_parameters(kind),
        "occlusion": bench.occlusion,
        "outside": bench.outside,
        "sensor": asdict(bench.sensor),
        "pictures_sha256": pictures.digest(),
        "seed": request.seed,
        "shape": list(view.shape),
        "pixel_m": view.pixel_m,
        "focal_m": view.focal_m,
        "window": bench.camera.window,
        "image_files": "16-bit PNG" if request.png else "OpenEXR",
        "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y; files have the top row first",
    }
