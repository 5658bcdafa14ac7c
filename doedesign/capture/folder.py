"""Simulated captures in a folder.

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

import json
import logging
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from doedesign.capture.camera import CaptureModel, depth_range_m
from doedesign.capture.from_spec import plain_parameters
from doedesign.capture.image_files import read_image, write_image
from doedesign.capture.images import Pictures, picture_files
from doedesign.capture.scenes import SceneData, require_seed
from doedesign.capture.simulate import Psfs, SimulatedCapture, Stage, flat_psfs, photograph, psfs_by_depth
from doedesign.design.design import Design
from doedesign.report.sheet import ContactRow, plot_contact
from doedesign.runs.folder import alone_in
from doedesign.runtime.progress import meter
from doedesign.spec import spec_digest, variation_to_toml
from fab.errors import InputError
from fab.figure import save
from fab.files import (
    MANIFEST_NAME,
    atomic_folder,
    canonical_json,
    clear_killed,
    path_of,
    read_json,
    sha256_bytes,
    sha256_file,
    write_atomic,
)
from fab.process import Process, Variation
from fab.units import is_whole, require_kind
from sim.imaging.occlusion import follows_light
from sim.rigorous.edge_optic import optic_as_drawn
from sim.surface import as_fabricated

FORMAT = "doedesign simulation 1"
_SEAL = "item_sha256"
_ITEM = re.compile(r"\d{4,}_")  # begins the name of an item's folder

_USUAL_COUNT = 6
_log = logging.getLogger("doedesign")


class PlateErrors(NamedTuple):
    """The process and the errors of a DOE as fabricated to look through, and a few words on where they come from."""

    process: Process
    errors: Variation
    words: str


class SimulationResult(NamedTuple):
    """The folder of a simulation, names of its items' folders, and why each skipped picture could not be used."""

    folder: Path
    items: tuple[str, ...]
    skipped: dict[str, str]


def simulate_files(
    design: Design,
    folder: str | Path,
    images: str | Path | None = None,
    *,
    obstruction: str | None = None,
    occlusion: str | None = None,
    count: int | None = None,
    seed: int = 0,
    size: int | None = None,
    plate: PlateErrors | None = None,
    png: bool = False,
) -> SimulationResult:
    """Write simulated captures of many pictures, or go on where an earlier call was stopped.

    Args:
        design: the DOE and its camera, with a spec.
        folder: where to; a new or empty folder, or that of the same simulation.
        images: folder of pictures; scikit-image's samples if None.
        obstruction: see `doedesign.capture.simulate.simulate`, like `occlusion` and `size`.
        occlusion: occlusion model.
        count: how many items; each picture once, and at most six, if None.
        seed: seed of everything.
        size: pixels per side of a frame.
        plate: look through the DOE that a process makes with these errors instead of the DOE as drawn.
        png: write 16-bit PNG instead of EXR.

    Raises:
        InputError: the folder is that of something else, or a picture, name or number cannot be used.
    """
    require_kind("design", design, Design, "Of a run: dd.open_design(folder).")
    if design.spec is None:
        rule = "must have a spec, which says what is photographed"
        raise InputError("design", rule, "none", "Of one picture: dd.simulate(picture, design).")
    folder, images = path_of(folder, "folder"), None if images is None else path_of(images, "images")
    kind, model, view, far_m = Stage.of(design, obstruction, occlusion, size)
    pictures = Pictures(picture_files(images), most_px=2 * max(view.shape))
    count = min(_USUAL_COUNT, len(pictures)) if count is None else count
    require_seed(seed)
    if not is_whole(count, 1):
        cure = "Leave it out for one item per picture, at most six."
        raise InputError("count", "must be at least 1", repr(count), cure)
    data = SceneData(pictures, kind, view, far_m, seed, mirrored=False)
    words = "plate as drawn" if plate is None else f"plate with {plate.words}"
    settings = {
        "format": FORMAT,
        "run": design.spec.name,
        "spec_sha256": spec_digest(design.spec),
        "level_map_sha256": design.level_map.digest,
        "light": design.camera.light,
        "plate": words,
        "obstruction": getattr(kind, "name", type(kind).__name__),
        "parameters": plain_parameters(kind),
        "occlusion": model.occlusion,
        "outside": model.outside,
        "sensor": asdict(model.sensor),
        "pictures_sha256": pictures.digest(),
        "seed": seed,
        "shape": list(view.shape),
        "pixel_m": view.pixel_m,
        "focal_m": view.focal_m,
        "window": model.camera.window,
        "image_files": "16-bit PNG" if png else "OpenEXR",
        "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y; files have the top row first",
    }
    if plate is not None:
        settings["variation"] = variation_to_toml(plate.errors)
        # Where the DOE lies on its wafer, for one.
        settings["process"] = asdict(plate.process)
    size_words = f"{view.shape[1]} x {view.shape[0]} pixels"
    _log.info("%d items of %s, %s, %s; %s", count, size_words, settings["obstruction"], model.occlusion, words)

    depths_m = (*depth_range_m(kind), *far_m)
    drawn = partial(optic_as_drawn, model.camera, design.level_map.height_m, depths_m=depths_m)
    made = partial(as_fabricated, design.level_map.level, model.camera, depths_m=depths_m)
    make = partial(made, *plate[:2]) if plate else drawn
    psfs = psfs_by_depth(make, model.camera), flat_psfs(model.camera)
    names = _write_captures(folder, data, count, model, psfs, settings, png)
    if skips := pictures.skips():
        _log.info("%s", skips)
    return SimulationResult(folder, names, {str(path): why for path, why in sorted(pictures.skipped.items())})


def _write_captures(
    folder: Path,
    data: SceneData,
    count: int,
    model: CaptureModel,
    psfs: tuple[Psfs, Psfs],
    settings: dict[str, Any],
    png: bool,
) -> tuple[str, ...]:
    """Make every item that is not there yet, and the contact sheet; return the names of the items' folders."""
    digest = sha256_bytes(canonical_json(settings))
    with alone_in(folder):
        _require_own(folder, digest)
        manifest = {**settings, "settings_sha256": digest}
        write_atomic(folder / MANIFEST_NAME, canonical_json({**manifest, "state": "running"}))
        ready = _finished(folder, digest)
        if ready:
            _log.info("%d items are there already", len(ready))
        names = []
        with meter("captures", count) as progress:
            for number in range(count):
                if number not in ready:
                    sample, key = data.item(number), jax.random.fold_in(jax.random.key(data.seed), number)
                    found = photograph(sample, model, *psfs, key)
                    ready[number] = _write_item(folder, number, found, model, digest, png)
                names.append(ready[number])
                progress.advance(number + 1, ready[number])
        _log.info("drawing the contact sheet")
        rows = [_row(folder / name) for name in names]
        title = f"{settings['run']} through {settings['obstruction']}"
        save(plot_contact(rows, title, _words(model, settings)), folder / "contact.png")
        listed = {f"{name}/{MANIFEST_NAME}": sha256_file(folder / name / MANIFEST_NAME) for name in names}
        listed |= {"contact.png": sha256_file(folder / "contact.png")}
        write_atomic(folder / MANIFEST_NAME, canonical_json({**manifest, "state": "done", "results_sha256": listed}))
    return tuple(names)


def _require_own(folder: Path, digest: str) -> None:
    """Refuse a folder of something else, and clear away what a killed simulation was writing."""
    clear_killed(folder, lambda _: True)
    if not (folder / MANIFEST_NAME).is_file():
        if any(folder.iterdir()):
            rule = "a simulation needs a new or empty folder, or its own"
            raise InputError(str(folder), rule, "other content", "Choose another output folder.")
        return
    found = read_json(folder / MANIFEST_NAME)
    begun = {path.name for path in folder.iterdir()} == {MANIFEST_NAME}  # and nothing more: there is nothing to lose
    if found.get("format") != FORMAT or (found.get("settings_sha256") != digest and not begun):
        rule = "the folder must belong to this simulation"
        got = "one with another run, seed, obstruction, model, sensor or other pictures"
        raise InputError(str(folder), rule, got, "Choose another output folder, or remove that one.")


def _finished(folder: Path, digest: str) -> dict[int, str]:
    """Items that are there and whole, by number; damaged ones are removed, and what else lies there stays."""
    found = {}
    for path in sorted(folder.glob(f"*/{MANIFEST_NAME}")):
        if not _ITEM.match(path.parent.name):
            continue
        item = read_json(path)
        if item.get("format") != FORMAT or "number" not in item:  # a whole simulation has no number
            continue
        if item == _sealed(item) and item.get("settings_sha256") == digest and _files_are_whole(path.parent, item):
            found[item["number"]] = path.parent.name
        else:
            shutil.rmtree(path.parent)
    return found


def _files_are_whole(folder: Path, item: Mapping[str, Any]) -> bool:
    files = {folder / name: expected for name, expected in item["sha256"].items()}
    return all(file.is_file() and sha256_file(file) == expected for file, expected in files.items())


def _sealed(item: Mapping[str, Any]) -> dict[str, Any]:
    """The description of an item with a digest of all else that it says."""
    rest = {key: value for key, value in item.items() if key != _SEAL}
    return {**rest, _SEAL: sha256_bytes(json.dumps(rest, sort_keys=True).encode())}


def _write_item(folder: Path, number: int, found: SimulatedCapture, model: CaptureModel, digest: str, png: bool) -> str:
    """Write one item; return the name of its folder."""
    name = f"{number:04d}_{''.join(c if c.isalnum() or c in '-_' else '-' for c in Path(found.name).stem)[:40]}"
    with atomic_folder(folder / name) as fresh:
        stored = _write_images(fresh, found, max(1.0, model.sensor.most_light(len(found.clean))), png)
        described = {
            "format": FORMAT,
            "number": number,
            "settings_sha256": digest,
            "picture": found.name,
            "depth_m": found.depth_near_m,
            "background_depth_m": None if np.isinf(found.depth_far_m) else found.depth_far_m,
            "covered": float(found.mask.mean(dtype=np.float64)),
            "images": stored,
            "sha256": {one["file"]: sha256_file(fresh / one["file"]) for one in stored.values()},
        }
        (fresh / MANIFEST_NAME).write_bytes(canonical_json(_sealed(described)))
    return name


def _write_images(folder: Path, found: SimulatedCapture, most: float, png: bool) -> dict[str, Any]:
    colours = ("R", "G", "B") if len(found.clean) == 3 else ("Y",)
    share = colours if len(found.alpha) == len(colours) else ("A",)
    images = {
        "clean": (found.rgb(found.clean), colours, "scene without obstruction", 1.0, False),
        "conventional": (found.rgb(found.conventional), colours, "capture with a flat plate", most, False),
        "capture": (found.rgb(found.doe), colours, "capture with the DOE", most, False),
        "mask": (found.mask[None], ("M",), "share of each direction that is blocked", 1.0, False),
        "alpha": (found.rgb(found.alpha), share, "share of the background's light that is lost", 1.0, False),
        "depth": (found.depth_m[None], ("Z",), "metres to what is seen", 1 / found.depth_near_m, png),
    }
    return {
        name: write_image(folder, name, image, channels, what, png=png, full_scale=scale, inverse=inverse)
        for name, (image, channels, what, scale, inverse) in images.items()
    }


def _row(folder: Path) -> ContactRow:
    """An item as the contact sheet shows it, read back from its files."""
    described = read_json(folder / MANIFEST_NAME)
    images = {name: read_image(folder, stored) for name, stored in described["images"].items()}
    clean, conventional, doe = (
        np.repeat(images[name], 3 // len(images[name]), axis=0) for name in ("clean", "conventional", "capture")
    )
    far = described["background_depth_m"]
    behind = "infinity" if far is None else f"{far:.3g} m"
    covered = 100 * described["covered"]
    label = f"{folder.name}: {covered:.0f} % covered at {100 * described['depth_m']:.3g} cm, scene at {behind}"
    return ContactRow(label, clean, conventional, doe, images["mask"][0], images["alpha"].mean(axis=0))


def _words(model: CaptureModel, settings: dict[str, Any]) -> str:
    sensor = model.sensor
    noise = (
        f"full well {sensor.full_well_e:g} electrons, white at {100 * sensor.exposure:g} % of it, read noise "
        f"{sensor.read_noise_e:g} electrons"
        if sensor.noise == "physical"
        else f"noise model {sensor.noise}"
    )
    where = "see docs/explanation/occlusion.md"
    caution = "" if follows_light(model.occlusion) else f" (passes light that never reaches the aperture: {where})"
    return (
        f"occlusion model {model.occlusion}{caution}; {settings['plate']}; {noise}; the conventional camera has a flat "
        "plate of the same glass; captures are developed and shown as sRGB, without gain"
    )
