"""What a training makes: scores and pictures of scenes it never saw, the trained plate, its PSFs, and the network."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign.capture.camera import depth_range_m
from doedesign.capture.from_spec import rgb_from_channels
from doedesign.capture.scenes import Batch, SceneData
from doedesign.design.design import Design
from doedesign.recon.baselines import noise_to_signal, noise_variance, richardson_lucy, wiener
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, camera_facts, write_network
from doedesign.runs.level_maps import write_design
from doedesign.training.evaluation import EvaluationResult, judge
from doedesign.training.joint import JointState, Trainer, resting_doe
from doedesign.training.perceptual import Lpips
from doedesign.training.validation import looks
from fab.errors import InputError
from fab.files import canonical_json, write_atomic
from fab.level_map import LevelMap
from sim.camera import Camera
from sim.light import srgb_from_linear
from sim.obstruction import ObstructionKind
from sim.psf_bank import psf
from sim.store import write_bank


class HeldOut(NamedTuple):
    """Scenes that are never trained on.

    Attributes:
        data: where they come from, one to a batch.
        scenes: how many.
        lpips: weights of LPIPS, if at hand.
    """

    data: SceneData
    scenes: int
    lpips: Lpips | None


def validate(
    trainer: Trainer, state: JointState, held_out: HeldOut, most_rows: int = 4, *, baselines: bool = False
) -> EvaluationResult:
    """Look at held-out scenes with the network as it is now.

    Args:
        trainer: the training.
        state: its state.
        held_out: the scenes.
        most_rows: scenes to keep for a picture.
        baselines: judge the rows of Table 1 that need no training, too (`doedesign.recon.baselines`).
    """
    camera = trainer.bench.camera
    trainer, state = _at_rest(trainer, state, held_out.data.kind)
    seen = looks(held_out.data, held_out.scenes, camera, lambda batch: _shown(trainer, state, batch, baselines))
    return judge(seen, held_out.lpips, lambda image: rgb_from_channels(image, camera), most_rows)


def _at_rest(trainer: Trainer, state: JointState, kind: ObstructionKind) -> tuple[Trainer, JointState]:
    """The same with the plate that is to be drawn, and its exact PSFs.

    Within a step PSFs are estimates: samples may be sparse, and a near source lights the cells obliquely, which plans
    for all depths leave out (`sim.propagation.farfield`): at 5 cm that is up to a fifth of the light in the window.
    """
    if trainer.doe.parametrization is None:
        return trainer, state
    doe = resting_doe(trainer.spec, trainer.bench.camera, kind, _design_of(trainer, state).nominal_height_m)
    return eqx.tree_at(lambda t: t.doe, trainer, doe), state._replace(free=None)


def _shown(trainer: Trainer, state: JointState, batch: Batch, baselines: bool) -> dict[str, Float[np.ndarray, "c y x"]]:
    """What the camera records of a scene, and what the network and others make of it, in display values."""
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
    return {name: srgb_from_linear(image) for name, image in found.items()} | {
        "reconstruction": np.asarray(picture, np.float32)[0]
    }


def height_at_rest_m(design: Design, camera: Camera) -> Float[np.ndarray, "y x"]:
    """Heights of a design, or of flat glass where its spec wants a conventional camera."""
    assert design.spec is not None
    conventional = design.spec.train.camera == "conventional"
    return np.zeros(camera.grid.shape, np.float32) if conventional else design.nominal_height_m


def heights_before(design: Design, trainer: Trainer) -> Float[np.ndarray, "*s"]:
    """The heights that training begins with: those of the design before rounding; of rings, their profile."""
    if trainer.spec.train.camera == "conventional":
        learns = trainer.doe.parametrization is not None
        return np.zeros(trainer.doe.learnt.shape if learns else trainer.bench.camera.grid.shape, np.float32)
    heights = design.continuous_m
    if heights is None:
        rule, cure = "must have its heights before rounding", "Give one that was optimised, or the run of one."
        raise InputError("design", rule, "level numbers alone", cure)
    if trainer.doe.parametrization is None:
        return heights
    found = trainer.doe.learnt.heights_of(heights)
    assert found is not None  # `optimize` writes a raster of rings for a radial design
    return found


def design_after(design: Design, trainer: Trainer, state: JointState) -> Design:
    """The design of a state: as it was, or as `doedesign.design.optimize.finished_design` makes it of parameters."""
    if not trainer.spec.train.moves_optics or trainer.doe.parametrization is None:
        return replace(design, continuous_m=None)
    return _design_of(trainer, state)


def _design_of(trainer: Trainer, state: JointState) -> Design:
    """The design that parameters make."""
    parametrization = trainer.doe.learning
    # A finished run has chosen its depths, so only the map is free.
    assert isinstance(state.free, jax.Array)
    continuous = trainer.doe.learnt.raster(np.asarray(parametrization.continuous_m(state.free)))
    level = np.asarray(parametrization.level(jnp.asarray(continuous))).astype(np.uint8)
    spec, camera = trainer.spec, trainer.bench.camera
    level_map = LevelMap(level, parametrization.levels, camera.grid, spec.doe.aperture_m, spec.name)
    return Design(level_map, camera, spec.scene.near_m, spec.scene.far_m, continuous_m=continuous, spec=spec)


def write_results(
    folder: Path,
    design: Design,
    trainer: Trainer,
    state: JointState,
    held_out: HeldOut,
    kind: ObstructionKind,
    about: Mapping[str, Any],
) -> list[str]:
    """Write network, plate, PSFs and scores.

    Args:
        folder: where to.
        design: the design that the training began with.
        trainer: the training.
        state: its last state.
        held_out: scenes to judge it by.
        kind: obstruction.
        about: what the network's file says beside the camera's facts.

    Returns:
        names of the files.
    """
    spec, camera = trainer.spec, trainer.bench.camera
    near = spec.scene.near_m or depth_range_m(kind)
    names = [NETWORK_NAME, BANK_NAME, "metrics.json"]
    height = np.zeros(camera.grid.shape, np.float32)
    if spec.train.camera == "doe":
        trained = design_after(design, trainer, state)
        height = trained.nominal_height_m
        names += write_design(folder, trained)
    depths = tuple(dict.fromkeys((*near, *spec.scene.far_m, np.inf)))
    bank = psf(height, camera, depths, propagation=spec.optics.propagation)
    write_bank(folder / BANK_NAME, bank, {"design": spec.name})
    found = validate(trainer, state, held_out, baselines=True)
    write_atomic(folder / "metrics.json", canonical_json({**found.means, "scenes": found.scenes}))
    write_network(folder / NETWORK_NAME, state.network, {**camera_facts(camera, near), **about})
    return names
