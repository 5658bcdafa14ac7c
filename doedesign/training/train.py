"""Training of the reconstruction network of a design, with its DOE or behind it.

A folder of a training (`doedesign.training.job`) has besides

    spec.toml           the spec with every default and override filled in
    pictures.json       names of all pictures, trained on and held out, and their licence
    network.npz         the trained network (`doedesign.recon.weights`)
    psf.exr             PSFs of the trained DOE at the depths of the spec and at infinity
    level_map.npz, height.exr   the DOE as it is to be drawn; height_continuous.exr before rounding, if it was trained
    metrics.json        scores on held-out scenes
    tensorboard/        on request
"""

import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from doedesign import __version__
from doedesign.build import camera_from_spec
from doedesign.capture.from_spec import obstruction_from_spec, occlusion_from_spec, plain_parameters
from doedesign.capture.images import Pictures
from doedesign.capture.scenes import Batch, SceneData
from doedesign.design.design import Design
from doedesign.recon.model import Model
from doedesign.runs.folder import CONTINUOUS, TRAINING
from doedesign.runtime.stopping import stoppable
from doedesign.spec import Spec, spec_digest, spec_from_json, spec_to_json, spec_to_toml
from doedesign.training.evaluation import EvaluationResult
from doedesign.training.history import require_tensorboard
from doedesign.training.hosts import join_hosts
from doedesign.training.job import TrainingJob, perceptual_distance, run_job
from doedesign.training.joint import JointState, Trainer, devices_mesh, layout_of, rates_at
from doedesign.training.results import HeldOut, height_at_rest_m, heights_before, validate, write_results
from doedesign.training.validation import SCENE_SEED, split_pictures
from fab.errors import InputError
from fab.files import canonical_json, sha256_bytes, sha256_file
from sim.obstruction import CameraView, ObstructionKind

_MOST_THREADS = 8
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
        coordinator: with several hosts, see `doedesign.training.hosts.join_hosts`, like the next two.
        hosts: their number.
        host: number of this one.
        options: changes to how the spec says to train, such as `steps=1000` (`doedesign.spec.training.TrainSpec`).

    Returns:
        the trained model.

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
    place: AbstractContextManager[str | Path] = nullcontext(out) if out is not None else tempfile.TemporaryDirectory()
    with stoppable() as stop, place as folder:
        job = JointTraining.prepare(
            with_options(design, **options),
            None if images is None else Path(images),
            None if validation is None else Path(validation),
            occlusion=occlusion,
            obstruction=obstruction,
            lpips_weights=lpips_weights,
            licence=licence,
            overrides=overrides,
            devices=devices,
        )
        run_job(job, Path(folder), stop, tensorboard=tensorboard)
        if skips := " ".join(filter(None, (data.pictures.skips() for data in (job.data, job.held_out.data)))):
            _log.info("%s", skips)
        model = Model.open(folder)
    return replace(model, folder=None) if out is None else model


def with_options(design: Design, **options: Any) -> Design:
    """The design with a spec whose training has other options.

    Raises:
        InputError: there is no spec, or an option breaks a rule.
    """
    if design.spec is None:
        raise InputError("design", "must have a spec, which says how to train", "none", "Optimise it from a spec.")
    if not options:
        return design
    tables = spec_to_json(design.spec)
    return replace(design, spec=spec_from_json({**tables, "train": {**tables["train"], **options}}, "train"))


@dataclass(frozen=True, eq=False, kw_only=True)
class JointTraining(TrainingJob):
    """A training of a network behind a DOE.

    Attributes:
        design: the DOE to begin with, with the spec of the training.
        trainer: what a step does.
        kind: obstruction.
        data: scenes to train on.
        held_out: scenes to judge by.
        pictures: names of the pictures, and their licence.
    """

    design: Design
    trainer: Trainer
    kind: ObstructionKind
    data: SceneData
    held_out: HeldOut
    pictures: Mapping[str, Any]

    @classmethod
    def prepare(
        cls,
        design: Design,
        images: Path | None,
        validation: Path | None,
        *,
        occlusion: str | None,
        obstruction: str | None,
        lpips_weights: Sequence[Path],
        licence: str | None,
        overrides: Sequence[str],
        devices: int | None,
    ) -> "JointTraining":
        """Prepare a training; see `train`."""
        assert design.spec is not None
        spec, options = design.spec, design.spec.train
        source = str((design.folder or Path()) / "spec.toml")
        model = occlusion_from_spec(spec, source, occlusion)
        kind = obstruction_from_spec(spec, source, obstruction)
        camera = camera_from_spec(spec)
        view = CameraView((options.size, options.size), camera.pixel_m, camera.sensor_distance_m)
        lpips, perceptual = perceptual_distance(options, options.size, f"{source}: train.size", lpips_weights)
        _require_possible(spec, source)
        split = split_pictures(images, validation, options.validation, options.seed)
        far = (min(spec.scene.far_m), max(spec.scene.far_m))
        trained_on, judged_by = (Pictures(files, most_px=2 * options.size) for files in split)
        threads = min(_MOST_THREADS, max(2, os.cpu_count() or 1))
        data = SceneData(trained_on, kind, view, far, options.seed, options.batch, threads)
        held_out = HeldOut(SceneData(judged_by, kind, view, far, SCENE_SEED, mirrored=False), options.validation, lpips)
        _log.info("preparing propagation")
        # Objectives are done with, and the files that they name lie beside the spec that the run was made from.
        bare = spec.model_copy(update={"objectives": ()})
        at_rest, mesh = height_at_rest_m(design, camera), devices_mesh(devices)
        trainer = Trainer.of(bare, {}, source, model, kind, at_rest, perceptual=perceptual, mesh=mesh)
        settings = {
            "format": TRAINING,
            "run": spec.name,
            "spec_sha256": spec_digest(spec),
            "height_sha256": _height_digest(design),
            "occlusion": model,
            "obstruction": getattr(kind, "name", type(kind).__name__),
            "obstruction_parameters": plain_parameters(kind),
            "camera": options.camera,
            "pictures_sha256": trained_on.digest(),
            "held_out_sha256": judged_by.digest(),
            "perceptual": "none" if perceptual is None else perceptual.name,
            "perceptual_sha256": "" if perceptual is None else perceptual.digest,
            "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y",
        }
        pictures = {"licence": licence} | {
            name: [_name(path, folder) for path in files]
            for name, files, folder in (
                ("training", split.training, images),
                ("held_out", split.held_out, validation or images),
            )
        }
        comments = ["every default filled in", *(f"--set {override}" for override in overrides)]
        return cls(
            name="training",
            title=spec.name,
            options=options,
            settings=settings,
            remarks={"licence": licence},
            inputs={"spec.toml": spec_to_toml(spec, comments).encode(), "pictures.json": canonical_json(pictures)},
            differs="one with another run, spec, occlusion model, perceptual loss or other pictures",
            design=design,
            trainer=trainer,
            kind=kind,
            data=data,
            held_out=held_out,
            pictures=pictures,
        )

    def initial(self) -> JointState:
        """The state before the first step."""
        return self.trainer.initial(heights_before(self.design, self.trainer))

    def batches(self, start: int, stop: int) -> AbstractContextManager[Any]:
        """Scenes from step `start` to step `stop`."""
        return self.data.batches(start, stop)

    def step(self, state: JointState, batch: Batch) -> tuple[JointState, dict[str, Any]]:
        """Take one step with this host's part of a batch."""
        rates, hosts, here = rates_at(self.options, state.step), jax.process_count(), jax.process_index()
        count = len(batch.items) // hosts
        state, record = self.trainer.step(state, batch._replace(items=batch.items[here * count : (here + 1) * count]))
        return state, {**record._asdict(), "learning_rates": rates._asdict()}

    def evaluate(self, state: JointState) -> EvaluationResult:
        """Judge a state by the held-out scenes."""
        return validate(self.trainer, state, self.held_out)

    def caption(self, state: JointState) -> tuple[str, str]:
        """Title and words for a picture of validation."""
        words = f"occlusion model {self.settings['occlusion']}, camera {self.settings['camera']}; PSNR in brackets: "
        return f"{self.title}, step {state.step}", words + "where it is covered"

    def write_results(self, folder: Path, state: JointState) -> list[str]:
        """Write network, DOE, PSFs and scores."""
        about = {**self.settings, "steps": state.step, "pictures": self.pictures, "version": __version__}
        return write_results(folder, self.design, self.trainer, state, self.held_out, self.kind, about)


def _height_digest(design: Design) -> str:
    """SHA-256 of the heights to begin with: of their file where there is one."""
    if design.folder is not None:
        return sha256_file(design.folder / CONTINUOUS)
    assert design.continuous_m is not None  # that of an optimised design
    return sha256_bytes(design.continuous_m.tobytes())


def _name(path: Path, folder: Path | None) -> str:
    return path.name if folder is None else path.relative_to(folder).as_posix()


def _require_possible(spec: Spec, source: str) -> None:
    """Check what the tables of a spec allow each for itself.

    Raises:
        InputError: a frame larger than the sensor, or a network that the camera's colours do not fit.
    """
    side = min(spec.sensor.resolution) // spec.sensor.binning
    if spec.train.size > side:
        rule = f"must be at most the {side} binned pixels of the sensor's shorter side"
        raise InputError(f"{source}: train.size", rule, spec.train.size, "Choose a smaller size.")
    try:
        layout_of(spec, len(spec.optics.colours))
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError(f"{source}: network", rule.replace("`", ""), got, "Change [network].") from error
