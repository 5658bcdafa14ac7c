"""`doedesign simulate`: what a camera with the plate of a run will see through dirt, drops or a fence.

    OUT/
        manifest.json       what this was made with, and the digests of all items when done
        contact.png         the items side by side
        0000_NAME/          one folder per item; it appears whole or not at all
            clean           the scene alone, sharp, linear light with white 1
            conventional    the developed capture of the same camera with a flat plate
            capture         the developed capture with the DOE
            mask            share of each pixel's direction that the obstruction blocks, sharp
            alpha           share of the background's light that the model takes away, with the DOE
            depth           metres to what is seen: the obstruction where the mask is at least a half
            manifest.json   digests, what the numbers mean, and what was drawn for it

A stopped simulation goes on with the item it stopped at; the same seed gives the same bytes.
"""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from doedesign.capture.from_spec import (
    obstruction_from_spec,
    occlusion_from_spec,
    outside_from_kind,
    plain_parameters,
    rgb_from_channels,
    sensor_from_spec,
)
from doedesign.capture.image_files import Stored, read_image, write_image
from doedesign.capture.images import Pictures, picture_files, told_skips
from doedesign.capture.scenes import SceneData, SceneItem
from doedesign.capture.simulate import CameraPair, SimulatedCapture, captured, flat_psfs, plate_psfs, shadow_window
from doedesign.commands.fabricated import errors_of_plate
from doedesign.commands.psf import Say
from doedesign.design.design import Design
from doedesign.report.contact import ContactRow
from doedesign.report.pictures import draw_contact
from doedesign.runs.folder import Run, alone_in, open_run, spec_with
from doedesign.runs.level_maps import open_design
from doedesign.runtime.progress import meter
from doedesign.spec import Spec, spec_digest, variation_to_toml
from fab.errors import InputError
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, read_json, sha256_bytes, sha256_file, write_atomic
from fab.process import Process, Variation
from sim.camera import Camera
from sim.imaging.occlusion import follows_light
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
    request = request or SimulationSettings()
    run = open_run(run_folder)
    source = str(run.path("spec.toml"))
    spec = spec_with(run, request.overrides, _FREE)
    model = occlusion_from_spec(spec, source, request.occlusion)
    kind = obstruction_from_spec(spec, source, request.obstruction)
    design = open_design(run, masks)
    camera = replace(design.camera, window=design.camera.window | 1)  # odd: the capture lies on the scene
    view = _view(spec, camera, request.size)
    pictures = Pictures(picture_files(request.images), most_px=2 * max(view.shape), say=say)
    count = min(_USUAL_COUNT, len(pictures)) if request.count is None else request.count
    if count < 1:
        raise InputError("--count", "must be at least 1", count, "Leave it out for one item per picture, at most six.")
    far = spec.scene.far_m
    data = SceneData(pictures, kind, view, (min(far), max(far)), request.seed, mirrored=False)
    made_by, errors, plate = _plate(design, fabrication)
    plate_at, flat_at = plate_psfs(design, camera, made_by, errors), flat_psfs(camera)
    window = shadow_window(kind, camera)
    bench = CameraPair(camera, plate_at, flat_at, model, outside_from_kind(kind), sensor_from_spec(spec), window)
    settings = _settings(run, spec, request, design, plate, kind, bench, pictures, view)
    if errors is not None:
        settings["variation"] = variation_to_toml(errors)
    folder = out or run.path("simulated")
    say(f"{count} items of {view.shape[1]} x {view.shape[0]} pixels, {settings['obstruction']}, {model}; {plate}")
    with alone_in(folder):
        names = _work(folder, data, count, bench, settings, request.png, say)
    if told := told_skips(pictures):
        say(told)
    return SimulationResult(folder, names, {str(path): why for path, why in sorted(pictures.skipped.items())})


def _view(spec: Spec, camera: Camera, size: int | None) -> CameraView:
    width, height = (n // spec.sensor.binning for n in spec.sensor.resolution)
    side = min(_USUAL_SIDE, width, height) if size is None else size
    if not 16 <= side <= min(width, height):
        rule = f"must lie from 16 to the {min(width, height)} binned pixels of the sensor's shorter side"
        raise InputError("--size", rule, side, "Choose another size.")
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
    bench: CameraPair,
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
        "occlusion": bench.model,
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


def _work(
    folder: Path, data: SceneData, count: int, bench: CameraPair, settings: dict[str, Any], png: bool, say: Say
) -> tuple[str, ...]:
    """Make every item that is not there yet, and the sheet."""
    digest = sha256_bytes(canonical_json(settings))
    _require_own(folder, digest)
    write_atomic(folder / MANIFEST_NAME, canonical_json({**settings, "settings_sha256": digest, "state": "running"}))
    names = []
    ready = _finished(folder, digest)
    if ready:
        say(f"{len(ready)} items are there already")
    with meter("captures", count) as progress:
        for number in range(count):
            name = ready.get(number) or _make(folder, data, number, bench, digest, png)
            names.append(name)
            progress.advance(number + 1, name)
    say("drawing the contact sheet")
    rows = [_row(folder / name, bench) for name in names]
    title = f"{settings['run']} through {settings['obstruction']}"
    draw_contact(folder / "contact.png", rows, title, _words(bench, settings))
    listed = {f"{name}/{MANIFEST_NAME}": sha256_file(folder / name / MANIFEST_NAME) for name in names}
    listed |= {"contact.png": sha256_file(folder / "contact.png")}
    done = {**settings, "settings_sha256": digest, "state": "done", "results_sha256": listed}
    write_atomic(folder / MANIFEST_NAME, canonical_json(done))
    return tuple(names)


def _require_own(folder: Path, digest: str) -> None:
    """Refuse a folder of something else, and clear away what a killed simulation was writing."""
    for path in folder.iterdir():
        if path.name.startswith(".") and (".new." in path.name or path.name.startswith((".manifest", ".contact"))):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    if not (folder / MANIFEST_NAME).is_file():
        if any(folder.iterdir()):
            rule = "a simulation needs a new or empty folder, or its own"
            raise InputError(str(folder), rule, "other content", "Choose another --out.")
        return
    if {path.name for path in folder.iterdir()} == {MANIFEST_NAME}:
        return  # begun and nothing more: there is nothing to lose, whatever it was
    found = read_json(folder / MANIFEST_NAME)
    if found.get("format") != FORMAT or found.get("settings_sha256") != digest:
        rule = "the folder must belong to this simulation"
        got = "one with another run, seed, obstruction, model, sensor or other pictures"
        raise InputError(str(folder), rule, got, "Choose another --out, or remove that folder.")


def _finished(folder: Path, digest: str) -> dict[int, str]:
    """Items that are there and whole, by number."""
    found = {}
    for path in sorted(folder.glob(f"*/{MANIFEST_NAME}")):
        item = read_json(path)
        files = item.get("sha256", {})
        whole = all(
            (path.parent / name).is_file() and sha256_file(path.parent / name) == s for name, s in files.items()
        )
        if item.get("settings_sha256") == digest and files and whole:
            found[int(item["number"])] = path.parent.name
        else:
            shutil.rmtree(path.parent)
    return found


def _make(folder: Path, data: SceneData, number: int, bench: CameraPair, digest: str, png: bool) -> str:
    """Make one item; return the name of its folder."""
    item = data.item(*divmod(number, len(data.pictures)))
    name = f"{number:04d}_{''.join(c if c.isalnum() or c in '-_' else '-' for c in Path(item.name).stem)[:40]}"
    found = captured(item, bench, jax.random.fold_in(jax.random.key(data.seed), number))
    with atomic_folder(folder / name) as fresh:
        stored = _write_images(fresh, found, item, bench, png)
        described = {
            "format": FORMAT,
            "number": number,
            "settings_sha256": digest,
            "picture": item.name,
            "depth_m": item.depth_m,
            "background_depth_m": None if np.isinf(item.background_depth_m) else item.background_depth_m,
            "covered": float(found.mask.mean(dtype=np.float64)),
            "images": {title: one.described() for title, one in stored.items()},
            "sha256": {one.file: sha256_file(fresh / one.file) for one in stored.values()},
        }
        (fresh / MANIFEST_NAME).write_bytes(canonical_json(described))
    return name


def _write_images(
    folder: Path, found: SimulatedCapture, item: SceneItem, bench: CameraPair, png: bool
) -> dict[str, Stored]:
    colours = ("R", "G", "B") if len(found.clean) == 3 else ("Y",)

    def light(image: np.ndarray) -> np.ndarray:
        return rgb_from_channels(image, bench.camera) if len(image) == 3 else image

    most = max(1.0, bench.sensor.most_light(len(found.clean)))
    share = colours if len(found.alpha) == len(colours) else ("A",)
    images = {
        "clean": (light(found.clean), colours, "scene without obstruction", 1.0, False),
        "conventional": (light(found.conventional), colours, "capture with a flat plate", most, False),
        "capture": (light(found.doe), colours, "capture with the DOE", most, False),
        "mask": (found.mask[None], ("M",), "share of each direction that is blocked", 1.0, False),
        "alpha": (light(found.alpha), share, "share of the background's light that is lost", 1.0, False),
        "depth": (found.depth_m[None], ("Z",), "metres to what is seen", 1 / item.depth_m, png),
    }
    return {
        name: write_image(folder, name, image, channels, what, png=png, full_scale=scale, inverse=inverse)
        for name, (image, channels, what, scale, inverse) in images.items()
    }


def _row(folder: Path, bench: CameraPair) -> ContactRow:
    """An item as the sheet shows it, read back from its files."""
    described = read_json(folder / MANIFEST_NAME)
    images = {name: read_image(folder, stored) for name, stored in described["images"].items()}
    clean, conventional, doe = (
        np.repeat(images[name], 3 // len(images[name]), axis=0) for name in ("clean", "conventional", "capture")
    )
    far = described["background_depth_m"]
    behind = "infinity" if far is None else f"{far:.3g} m"
    covered = 100 * described["covered"]
    label = f"{folder.name}: {covered:.0f} % covered at {100 * described['depth_m']:.3g} cm, scene at {behind}"
    alpha = images["alpha"].mean(axis=0)
    return ContactRow(label, clean, conventional, doe, images["mask"][0], alpha)


def _words(bench: CameraPair, settings: dict[str, Any]) -> str:
    sensor = bench.sensor
    noise = (
        f"full well {sensor.full_well_e:g} electrons, white at {100 * sensor.exposure:g} % of it, read noise "
        f"{sensor.read_noise_e:g} electrons"
        if sensor.noise == "physical"
        else f"noise model {sensor.noise}"
    )
    caution = "" if follows_light(bench.model) else " (passes light that never reaches the aperture: see README)"
    return (
        f"occlusion model {bench.model}{caution}; {settings['plate']}; {noise}; the conventional camera has a flat "
        "plate of the same glass; captures are developed and shown as sRGB, without gain"
    )
