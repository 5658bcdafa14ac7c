"""Training of the reconstruction network of a design, with its DOE or behind it.

A folder of a training (`doedesign.training.job`) has besides

    spec.toml           the spec with overrides and defaults; optional keys where they differ
    pictures.json       names of all pictures, trained on and held out, and their licence
    network.npz         the trained network (`doedesign.recon.weights`)
    psf.exr             PSFs of the trained DOE at the depths of the spec, in the middle of the far ones and at infinity
    level_map.npz, height.exr   the DOE as it is to be drawn; height_continuous.exr before rounding, if it was trained
    metrics.json        scores on held-out scenes
    tensorboard/        on request
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign import __version__
from doedesign.build import camera_from_spec
from doedesign.capture.camera import depth_range_m, middle_depth_m
from doedesign.capture.from_spec import (
    obstruction_from_spec,
    occlusion_from_spec,
    plain_parameters,
    rgb_from_channels,
    sensor_side,
)
from doedesign.capture.images import Pictures
from doedesign.capture.scenes import Batch, SceneData
from doedesign.design.design import Design
from doedesign.recon.baselines import noise_to_signal, noise_variance, richardson_lucy, wiener
from doedesign.recon.model import Model
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, camera_facts, write_network
from doedesign.runs.folder import CONTINUOUS, TRAINING
from doedesign.runs.level_maps import write_design
from doedesign.runtime.progress import meter
from doedesign.runtime.stopping import stoppable
from doedesign.spec import Spec, spec_digest, spec_from_json, spec_to_json, spec_to_resolved_toml
from doedesign.spec.training import USUAL_SIZE
from doedesign.training.distance.perceptual import Lpips, Perceptual
from doedesign.training.history import require_tensorboard
from doedesign.training.hosts import join_hosts
from doedesign.training.job import TrainingJob, perceptual_distance, trained_model
from doedesign.training.joint import JointState, Trainer, devices_mesh, layout_of, resting_doe
from doedesign.training.validation import SCENE_SEED, EvaluationResult, HeldOutScene, Split, judge, split_pictures
from fab.errors import InputError
from fab.files import canonical_json, path_of, sha256_bytes, sha256_file, write_atomic
from fab.level_map import LevelMap
from fab.units import require_kind
from sim.imaging.occlusion import Model as OcclusionModel
from sim.light import srgb_from_linear
from sim.obstruction import CameraView, ObstructionKind
from sim.psf_bank import psf
from sim.store import write_bank
from sim.threads import cores

_MOST_THREADS = 8
_LESSON = 1  # apart from the scenes of the steps
_log = logging.getLogger("doedesign")


def train(
    design: Design,
    images: str | Path | None = None,
    out: str | Path | None = None,
    *,
    occlusion: str | None = None,
    obstruction: str | None = None,
    validation: str | Path | None = None,
    lpips_weights: Sequence[Path] = (),
    licence: str | None = None,
    overrides: Sequence[str] = (),
    tensorboard: bool = False,
    devices: int | None = None,
    coordinator: str | None = None,
    hosts: int | None = None,
    host: int | None = None,
    **options: Any,
) -> Model:
    """Train the reconstruction network of a design, jointly with the DOE unless its spec freezes that.

    Args:
        design: the DOE to begin with; its spec says how to train.
        images: folder of pictures; scikit-image's samples if None.
        out: folder, in which a stopped training goes on where it was stopped; a temporary one, which is removed, if
            None.
        occlusion: occlusion model (`sim.imaging.occlusion`); that of the spec if None.
        obstruction: kind, or folder of masks; that of the spec if None.
        validation: folder to take the held-out pictures from; the same one if None.
        lpips_weights: files with the weights of LPIPS; multi-scale SSIM stands in for it without them.
        licence: licence of the pictures, for the record.
        overrides: changes that led to the spec, for the record.
        tensorboard: write for TensorBoard, too.
        devices: number of devices; all if None.
        coordinator: with several hosts, HOST:PORT of host 0, or "auto" (`doedesign.training.hosts`); whoever reaches it
            is trusted.
        hosts: their number.
        host: number of this one, from 0.
        options: changes to how the spec says to train, such as `steps=1000` (`doedesign.spec.training.TrainSpec`).

    Raises:
        InputError: a picture or number that cannot be used, a folder that belongs to something else, or a loss that is
            no longer finite.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    if tensorboard:
        require_tensorboard()
    if coordinator is not None and devices is not None:
        rule = "must be left out with several hosts: every host takes all that it has"
        raise InputError("devices", rule, devices, "Leave it out.")
    join_hosts(coordinator, hosts, host)
    with stoppable():  # which ends the preparation, too
        made = prepared(design, images, validation, occlusion, obstruction, lpips_weights, licence, options)
        design, spec, source, model, kind = made.design, made.spec, made.source, made.occlusion, made.kind
        how, perceptual = spec.train, made.perceptual
        _log.info("preparing propagation")
        at_rest, mesh = design.nominal_height_m, devices_mesh(devices)
        trainer = Trainer.of(spec, source, model, kind, at_rest, perceptual=perceptual, mesh=mesh)
        settings = {"format": TRAINING, "camera": how.camera, **made.settings}
        resolved = spec_to_resolved_toml(spec, overrides).encode()
        job = JointTraining(
            name="training",
            title=spec.name,
            options=how,
            settings=settings,
            remarks={"licence": licence, "overrides": list(overrides)},
            inputs={"spec.toml": resolved, "pictures.json": canonical_json(made.pictures)},
            differs="one with another run, spec, occlusion model, perceptual loss or other pictures",
            design=design,
            trainer=trainer,
            kind=kind,
            data=made.data,
            held_out=made.held_out,
            lpips=made.lpips,
            pictures=made.pictures,
        )
    return trained_model(job, out, tensorboard=tensorboard)


class Prepared(NamedTuple):
    """The common part of trainings behind a design, whatever the network.

    Attributes:
        design: the design, whose spec has the options of the training.
        spec: that spec.
        source: name of its file for messages.
        occlusion: occlusion model.
        kind: the obstruction.
        data: scenes to train on.
        held_out: scenes to judge by.
        lpips: weights of LPIPS, if at hand.
        perceptual: the distance of the loss, if it has one.
        settings: what the result depends on, as far as it is said here.
        pictures: names and licence of the pictures for the record.
    """

    design: Design
    spec: Spec
    source: str
    occlusion: OcclusionModel
    kind: ObstructionKind
    data: SceneData
    held_out: SceneData
    lpips: Lpips | None
    perceptual: Perceptual | None
    settings: dict[str, Any]
    pictures: dict[str, Any]


def prepared(
    design: Design,
    images: str | Path | None,
    validation: str | Path | None,
    occlusion: str | None,
    obstruction: str | None,
    lpips_weights: Sequence[Path],
    licence: str | None,
    options: Mapping[str, Any],
) -> Prepared:
    """Prepare a training behind a design; arguments and errors are those of `train`."""
    design, spec = _with_options(design, options)
    source, how = str((design.folder or Path()) / "spec.toml"), spec.train
    model = occlusion_from_spec(spec, source, occlusion)
    kind = obstruction_from_spec(spec, source, obstruction)
    lpips, perceptual = perceptual_distance(how, how.size, f"{source}: train.size", lpips_weights)
    _require_possible(spec, source)
    folders = {"images": images, "validation": validation}
    given, own = (None if folder is None else path_of(folder, name) for name, folder in folders.items())
    split = split_pictures(given, own, how.validation, how.seed)
    data, held_out = _scenes(spec, kind, split)
    settings = {
        "run": spec.name,
        "spec_sha256": spec_digest(spec),
        "height_sha256": _height_digest(design),
        "occlusion": model,
        "obstruction": getattr(kind, "name", type(kind).__name__),
        "obstruction_parameters": plain_parameters(kind),
        "pictures_sha256": data.pictures.digest(),
        "held_out_sha256": held_out.pictures.digest(),
        "perceptual": "none" if perceptual is None else perceptual.name,
        "perceptual_sha256": "" if perceptual is None else perceptual.digest,
        "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y",
    }
    pictures = {
        "licence": licence,
        "training": [_name(path, given) for path in split.training],
        "held_out": [_name(path, own or given) for path in split.held_out],
    }
    return Prepared(design, spec, source, model, kind, data, held_out, lpips, perceptual, settings, pictures)


def _with_options(design: Design, options: Mapping[str, Any]) -> tuple[Design, Spec]:
    """The design with a spec whose training has other options and a size that the sensor has, and that spec."""
    require_kind("design", design, Design, "Of a run: dd.open_design(folder).")
    if design.spec is None:
        raise InputError("design", "must have a spec, which says how to train", "none", "Optimise it from a spec.")
    spec = design.spec
    if options:
        tables = spec_to_json(spec)
        spec = spec_from_json({**tables, "train": {**tables.get("train", {}), **options}}, "train", spec.file)
    size = training_size(spec)
    if size != spec.train.size:
        _log.info("training pictures of %d pixels per side, what the sensor has", size)
        spec = spec.model_copy(update={"train": spec.train.model_copy(update={"size": size})})
    return replace(design, spec=spec), spec


def training_size(spec: Spec) -> int:
    """Pixels per side of a spec's training pictures: on a sensor with fewer than the usual ones, what it has.

    Raises:
        InputError: a spec without a sensor, or one that does not say how many photosites it has.
    """
    coarsest = 2**spec.network.depth
    fitting = sensor_side(spec) // coarsest * coarsest
    return fitting if spec.train.size == USUAL_SIZE > fitting >= 2 * coarsest else spec.train.size


def _scenes(spec: Spec, kind: ObstructionKind, split: Split) -> tuple[SceneData, SceneData]:
    """Scenes to train on, and scenes to judge by."""
    camera, how = camera_from_spec(spec), spec.train
    view = CameraView((how.size, how.size), camera.pixel_m, camera.sensor_distance_m)
    far = (min(spec.scene.far_m), max(spec.scene.far_m))
    # A window of the least share of a picture shall have the pixels of a crop.
    most_px = 2 * how.size if how.zoom is None else math.ceil(how.size / how.zoom[0])
    trained_on, judged_by = Pictures(split.training, most_px), Pictures(split.held_out, 2 * how.size)
    threads = min(_MOST_THREADS, max(2, cores()))
    data = SceneData(trained_on, kind, view, far, how.seed, how.batch, threads, zoom=how.zoom)
    return data, SceneData(judged_by, kind, view, far, SCENE_SEED, mirrored=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class JointTraining(TrainingJob):
    """A training of a network behind a design's DOE and a kind of obstruction.

    Held-out scenes come one to a batch; `pictures` are names and licence of the pictures for the record.
    """

    design: Design
    trainer: Trainer
    kind: ObstructionKind
    data: SceneData
    held_out: SceneData
    pictures: Mapping[str, Any]

    def initial(self) -> JointState:
        """The state before the first step.

        It has the heights of the design before rounding, those of its levels where they are not at hand or stay as they
        are, and of rings their profile.
        """
        doe, heights = self.trainer.doe, self.design.continuous_m
        learnt = None if doe.parametrization is None else doe.learnt
        if self.options.camera == "conventional":
            shape = self.trainer.bench.camera.grid.shape if learnt is None else learnt.shape
            return self.trainer.initial(np.zeros(shape, np.float32))
        if heights is None or not self.options.moves_optics:
            heights = self.design.nominal_height_m
        if learnt is not None:
            heights = learnt.heights_of(heights)
            assert heights is not None  # `optimize` writes a raster of rings for a radial design
        return self.trainer.initial(heights)

    def begun(self, state: JointState) -> JointState:
        """Teach the low-resolution branch by itself, if that is asked for."""
        if not (count := self.options.light_scenes):
            return state
        scenes, batches = replace(self.data, seed=self.options.seed + (_LESSON << 32)), -(-count // self.data.batch)
        with scenes.batches(stop=batches) as stream, meter("scenes for veil and gain", batches) as progress:
            return self.trainer.taught(state, stream, progress.advance)

    def step(self, state: JointState, batch: Batch) -> tuple[JointState, dict[str, Any]]:
        """Take one step."""
        return self.trainer.step(state, batch)

    def evaluate(self, state: JointState, *, baselines: bool = False) -> EvaluationResult:
        """Judge a state by the held-out scenes, and on request the rows of Table 1 that need no training, too.

        The DOE is the one that is to be drawn, with its exact PSFs. Within a step PSFs are estimates: samples may be
        sparse, and a near source lights the cells obliquely, which plans for all depths leave out
        (`sim.propagation.farfield`): at 5 cm that is up to a fifth of the light in the window.
        """
        trainer, camera = self.trainer, self.trainer.bench.camera
        if trainer.doe.parametrization is not None:
            doe = resting_doe(trainer.spec, camera, self.kind, self._design_of(state).nominal_height_m)
            trainer, state = eqx.tree_at(lambda t: t.doe, trainer, doe), state._replace(free=None)

        def looks() -> Iterator[HeldOutScene]:
            with self.held_out.batches(stop=self.options.validation) as batches:
                for batch in batches:
                    name, scene = batch.items[0]
                    clean = srgb_from_linear(np.asarray(trainer.bench.scene(scene).background))
                    shown = _shown(trainer, state, batch, baselines)
                    yield HeldOutScene(name, shown, clean, np.asarray(scene.obstructions[0].mask))

        return judge(looks(), self.lpips, lambda image: rgb_from_channels(image, camera))

    def caption(self, state: JointState) -> tuple[str, str]:
        """Title and words for a picture of validation."""
        words = f"occlusion model {self.settings['occlusion']}, camera {self.settings['camera']}; PSNR in brackets: "
        return f"{self.title}, step {state.step}", words + "where it is covered"

    def write_results(self, folder: Path, state: JointState) -> list[str]:
        """Write network, DOE, PSFs and scores."""
        spec, camera = self.trainer.spec, self.trainer.bench.camera
        near = trained_near_m(spec, self.kind)
        names = [NETWORK_NAME, BANK_NAME, "metrics.json"]
        height = np.zeros(camera.grid.shape, np.float32)
        if spec.train.camera == "doe":
            learnt = spec.train.moves_optics and self.trainer.doe.parametrization is not None
            trained = self._design_of(state) if learnt else replace(self.design, continuous_m=None)
            height = trained.nominal_height_m
            names += write_design(folder, trained)
        far_m = middle_depth_m(spec.scene.far_m)
        depths = tuple(dict.fromkeys((*near, *spec.scene.far_m, far_m, np.inf)))
        bank = psf(height, camera, depths, propagation=spec.propagation)
        write_bank(folder / BANK_NAME, bank, {"design": spec.name})
        found = self.evaluate(state, baselines=True)
        write_atomic(folder / "metrics.json", canonical_json({**found.means, "scenes": found.scenes}))
        told = {**camera_facts(camera, near), "far_m": None if np.isinf(far_m) else far_m}
        about = {**self.settings, "steps": state.step, "pictures": self.pictures, "version": __version__}
        write_network(folder / NETWORK_NAME, state.best, {**told, **about})
        for data in (self.data, self.held_out):
            if skips := data.pictures.skips():
                _log.info("%s", skips)
        return names

    def _design_of(self, state: JointState) -> Design:
        """The design that learnt parameters make, as `doedesign.design.optimize.finished_design` does."""
        doe, spec, camera = self.trainer.doe, self.trainer.spec, self.trainer.bench.camera
        # A finished run has chosen its depths, so only the map is free.
        assert isinstance(state.free, jax.Array)
        continuous = doe.learnt.raster(np.asarray(doe.learning.continuous_m(state.free)))
        level = np.asarray(doe.learning.level(jnp.asarray(continuous))).astype(np.uint8)
        level_map = LevelMap(level, doe.learning.levels, camera.grid, spec.doe.relief, spec.name)
        return Design(level_map, camera, spec.scene.near_m, spec.scene.far_m, continuous_m=continuous, spec=spec)


def _shown(trainer: Trainer, state: JointState, batch: Batch, baselines: bool) -> dict[str, Float[np.ndarray, "c y x"]]:
    """Capture and reconstructions of a scene in display values, by name."""
    shot, picture = trainer.reconstruct(state, batch)
    light, far, near = (np.asarray(image, np.float32)[0] for image in shot)
    found = {"capture": light}
    if baselines:
        variance = noise_variance(light, trainer.bench.sensor)
        ratio = noise_to_signal(light, variance)
        found |= {
            "wiener_far": np.asarray(wiener(light, far, ratio)),
            "wiener_near": np.asarray(wiener(light, near, ratio)),
            "richardson_lucy_far": np.asarray(richardson_lucy(light, far, noise_variance=variance)),
        }
    display = {name: srgb_from_linear(image) for name, image in found.items()}
    return {**display, "reconstruction": np.asarray(picture, np.float32)[0]}


def trained_near_m(spec: Spec, kind: ObstructionKind) -> tuple[float, ...]:
    """Depths of obstructions that a network is trained on, metres: those of a spec at which its kind is drawn.

    Args:
        spec: the spec.
        kind: the obstruction, whose own depth comes before the spec's near ones.
    """
    least, most = depth_range_m(kind)
    within = tuple(depth for depth in spec.scene.near_m if least <= depth <= most)
    return within or (least, most)


def _height_digest(design: Design) -> str:
    """SHA-256 of the heights to begin with: of their file where there is one."""
    if design.folder is not None and (design.folder / CONTINUOUS).is_file():
        return sha256_file(design.folder / CONTINUOUS)
    heights = design.nominal_height_m if design.continuous_m is None else design.continuous_m
    return sha256_bytes(heights.tobytes())


def _name(path: Path, folder: Path | None) -> str:
    return path.name if folder is None else path.relative_to(folder).as_posix()


def _require_possible(spec: Spec, source: str) -> None:
    """Refuse a frame larger than the sensor, and a network that the camera's colours do not fit."""
    side = sensor_side(spec)
    if spec.train.size > side:
        rule = f"must be at most the {side} binned pixels of the sensor's shorter side"
        raise InputError(f"{source}: train.size", rule, spec.train.size, "Choose a smaller size.")
    try:
        layout_of(spec, len(spec.optics.colours))
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError(f"{source}: network", rule.replace("`", ""), got, "Change the network's shape.") from error
