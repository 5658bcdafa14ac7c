"""Joint training of optics and network (paper §3.4): state, step, devices.

A step is a pure function of the state, the batch and the seed: noise, field points and the errors of plates follow from
the seed and the number of the batch. So a training that goes on from a checkpoint takes the very steps that it would
have taken.

More than one device: the batch is shared out over a mesh with the one axis "data", every device looks at its part with
the same state, and gradients are averaged. With several hosts each hands in its own part of every batch.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Key

from doedesign.build import camera_from_spec, process_from_spec
from doedesign.capture.camera import CaptureModel, depth_range_m
from doedesign.capture.from_spec import sensor_from_spec
from doedesign.capture.scenes import Batch, NamedScene
from doedesign.design.levels.quantisation import ROUNDED, Rounding, rounding_at
from doedesign.design.problem import plans_of
from doedesign.recon.network import Network, NetworkShape
from doedesign.runtime.compiling import compiled_step
from doedesign.spec import Spec
from doedesign.spec.training import TrainSpec
from doedesign.spec.values.table import toml_key
from doedesign.training.hosts import on_all, own_copy, parts_of
from doedesign.training.lesson import Cells, cells_of, taught
from doedesign.training.loss import adam_step, history_line, losses
from doedesign.training.optics import Capture, TrainingDoe, TrainingScene, shots
from fab.draws import variation_at
from fab.errors import InputError
from fab.process import Process
from sim.camera import Camera
from sim.imaging.occlusion import Model
from sim.light import srgb_from_linear
from sim.obstruction import ObstructionKind
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.rigorous.edge_optic import EdgeOptic
from sim.source import SeparableSource
from sim.surface import as_fabricated

AXIS = "data"

# Of noise when scenes that are held out are looked at, instead of the seed of the training.
LOOK_SEED = 3

_SALT_NOISE, _SALT_FIELD = 1, 2
# Depths at which a plate at rest is computed: between two of them its blur disc grows by a few pixels.
_NEAR_DEPTHS, _FAR_DEPTHS = 24, 3


class JointState(NamedTuple):
    """Everything a step changes: steps done, network, parameters of the DOE (None at rest), and Adam's moments.

    With a running mean of the network's weights that, too; it is what the training is for.
    """

    step: int
    network: Network
    free: Array | None
    network_moments: optax.OptState
    optics_moments: optax.OptState | None
    average: Network | None = None

    @property
    def best(self) -> Network:
        """The network to judge and to give away: the mean over steps, or that of the last one."""
        return self.network if self.average is None else self.average


class Rates(NamedTuple):
    """Step sizes of one step; 0 for what stays as it is."""

    network: float
    optics: float


class Trainer(eqx.Module):
    """All that does not change from step to step. `Trainer.of` makes one.

    The DOE, the rest of the camera and the process whose errors every step's plate has, if any; the mesh of devices is
    None for one.
    """

    doe: TrainingDoe
    perceptual: Any
    bench: CaptureModel = eqx.field(static=True)
    process: Process | None = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)
    mesh: Mesh | None = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        spec: Spec,
        source: str,
        model: Model,
        kind: ObstructionKind,
        height_m: Float[np.ndarray, "y x"],
        *,
        perceptual: Any = None,
        mesh: Mesh | None = None,
    ) -> "Trainer":
        """Prepare a training with an occlusion model and a kind of obstruction; messages name the spec's file.

        Heights are those of a DOE that stays at rest; a conventional camera has flat glass instead.

        Raises:
            InputError: a training that is not possible: a sensor with a mosaic, rings off the axis or with errors, a
                batch that the devices do not divide.
        """
        spec, train, sensor = spec.model_copy(update={"objectives": ()}), spec.train, sensor_from_spec(spec)
        if sensor.pattern is not None:
            rule = "must be left out for training: demosaicing has no gradient"
            raise InputError(f"{source}: sensor.bayer", rule, f'"{sensor.pattern}"', "Train on pixels of all colours.")
        if mesh is not None and train.batch % mesh.size:
            rule = f"must be a multiple of the {mesh.size} devices"
            raise InputError(f"{source}: train.batch", rule, train.batch, "Change it, or take fewer devices.")
        for key in ("min_feature_m", "drawn_pixel_m"):
            if train.moves_optics and getattr(spec.optimize, key) is not None:
                rule, got = "a plate of this design would not keep it while it is learnt", toml_key(key)
                raise InputError(f"{source}: optimize.{got}", rule, got, 'Set train.freeze = "optics".')
        camera = replace(camera_from_spec(spec), window=spec.sensor.window | 1)
        if train.camera == "conventional":
            height_m = np.zeros(camera.grid.shape, np.float32)
        alive = train.moves_optics or train.fabricated or train.field == "random"
        doe = _learnt_doe(spec, source) if alive else resting_doe(spec, camera, kind, height_m)
        bench = CaptureModel.make(camera, kind, model, sensor)
        process = process_from_spec(spec.process) if train.fabricated else None
        return cls(doe if mesh is None else on_all(doe, mesh), perceptual, bench, process, spec, mesh)

    def initial(self, height_m: Float[np.ndarray, "*s"]) -> JointState:
        """The state before the first step, from heights (a map or a profile of rings) before quantisation."""
        network = Network.make(layout_of(self.spec, len(self.bench.camera.colours)), self.spec.train.seed)
        adam = optax.scale_by_adam()
        moments = adam.init(eqx.filter(network, eqx.is_inexact_array))
        free, optics_moments = None, None
        if self.doe.parametrization is not None:
            free = jnp.asarray(self.doe.parametrization.radians_of(height_m))
            optics_moments = adam.init(free) if self.spec.train.moves_optics else None
        # A copy: a step uses the memory of the network again.
        average = jax.tree.map(jnp.array, network) if self.spec.train.average else None
        state = JointState(0, network, free, moments, optics_moments, average)
        # Where the step will leave it: otherwise the second step would be compiled anew.
        return state if self.mesh is None else on_all(state, self.mesh)

    def step(self, state: JointState, batch: Batch) -> tuple[JointState, dict[str, Any]]:
        """Take one step, with this host's part of a batch; return the line of the history, too.

        The memory of the state that is given is used again.

        Raises:
            InputError: the loss is no longer finite.
        """
        train = self.spec.train
        rates = rates_at(train, state.step)
        trainer = self._with_errors(state, batch.step)
        seen, keys = self._seen(batch, train.seed, train.field == "random", shared=self.mesh is not None)
        if self.mesh is not None:
            seen, keys = parts_of((seen, keys), self.mesh)
        rounding = rounding_at(self.spec.optimize.quantisation, train.seed, state.step, train.steps)
        learnt = (state.network, state.free)
        moves = (rates.network > 0, rates.optics > 0)
        moments = (state.network_moments, state.optics_moments)
        constants = trainer, seen, keys, rounding, jnp.asarray(rates, jnp.float32), moves
        (network, free), moments, loss, terms = _update()(constants, (learnt, moments))
        cure = "Lower train.learning_rate or train.optics_learning_rate."
        line = history_line("train", state.step, loss, terms, rates._asdict(), cure)
        average = state.average
        if average is not None and rates.network > 0:
            average = _averaged(average, network, jnp.asarray(kept_at(train, state.step), jnp.float32))
        return JointState(state.step + 1, network, free, *moments, average=average), line

    def reconstruct(self, state: JointState, batch: Batch) -> tuple[Capture, Float[Array, "b c y x"]]:
        """Captures of scenes, and their reconstructions in display values, on the axis and without process errors.

        One device does it alone.
        """
        seen, keys = self._seen(batch, LOOK_SEED, False)
        network, free, trainer = state.best, state.free, self
        if self.mesh is not None:
            network, free, trainer = own_copy((network, free, trainer))
        return _look(network, free, trainer, seen, keys)

    def taught(
        self, state: JointState, batches: Iterable[Batch], advance: Callable[[int], None] = lambda done: None
    ) -> JointState:
        """The state with a low-resolution branch that has learnt from these scenes (`doedesign.training.lesson`).

        Every host does all of it; `advance` is told how many batches have been looked at.
        """
        network, free, trainer = state.network, state.free, self
        if self.mesh is not None:
            network, free, trainer = own_copy((network, free, trainer))
        assert network.light is not None  # the spec's rules see to that
        scale, seed = network.layout.multiple, self.spec.train.seed
        found = []
        for done, batch in enumerate(batches, start=1):
            found.append(_lesson(free, trainer, *self._seen(batch, seed, False), scale))
            advance(done)
        cells = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
        network = eqx.tree_at(lambda n: n.light, network, taught(network.light, cells, seed))
        average = None if state.average is None else jax.tree.map(jnp.array, network)
        state = state._replace(network=network, average=average)
        return state if self.mesh is None else on_all(state, self.mesh)

    def _seen(
        self, batch: Batch, seed: int, off_axis: bool, *, shared: bool = False
    ) -> tuple[TrainingScene, Key[Array, " b"]]:
        """A batch, or this host's part of one that is shared, for the compiled step, with a noise key per scene."""
        hosts, host = (jax.process_count(), jax.process_index()) if shared else (1, 0)
        count = len(batch.items) // hosts
        # Scenes are numbered across hosts, so that sharing them out differently changes nothing.
        first = (batch.step * hosts + host) * count

        def sources(depth_m: float, number: int) -> tuple[Any, ...]:
            return self.doe.sources(depth_m, _field_rad(self.spec, seed, number) if off_axis else (0.0, 0.0))

        return scenes_seen(self.bench, sources, batch.items[host * count : (host + 1) * count], first, seed)

    def _with_errors(self, state: JointState, step: int) -> "Trainer":
        """The same with a plate that has this step's errors, where the process makes any."""
        if self.process is None or self.doe.parametrization is None:
            return self
        parametrization, camera = self.doe.parametrization, self.bench.camera
        assert isinstance(state.free, Array)  # learnt depths are refused with errors
        level = np.asarray(parametrization.level(parametrization.continuous_m(state.free))).astype(np.uint8)
        plate_m = max(camera.grid.extent_m)
        errors = variation_at(self.process, self.spec.train.seed, plate_m, f"normal/{step}")
        doe = as_fabricated(level, camera, self.process, errors, whole_cells=True)
        assert isinstance(self.doe.optic, HeightOptic)
        optic = self.doe.optic.made_as(doe, parametrization.drawn_height(level))
        return replace(self, doe=replace(self.doe, optic=optic))


def scenes_seen(
    bench: CaptureModel,
    sources: Callable[[float, int], tuple[Any, ...]],
    items: Sequence[NamedScene],
    first: int,
    seed: int,
) -> tuple[TrainingScene, Key[Array, " b"]]:
    """Scenes for a compiled step, with a noise key for each.

    Args:
        bench: the camera, which says the colours.
        sources: describes a point source of the DOE at a depth, metres, for the scene of a number.
        items: the scenes.
        first: number of the first of them since the beginning of the training.
        seed: seed of the noise.
    """
    found = []
    for k, item in enumerate(items):
        # In single precision, as the compiled step has them.
        scene = jax.tree.map(np.float32, bench.scene(item.scene))
        depths = scene.background_depth_m, scene.obstructions[0].depth_m
        found.append(TrainingScene(scene, *(sources(float(depth), first + k) for depth in depths)))
    seen: TrainingScene = jax.tree.map(lambda *leaves: np.stack(leaves), *found)
    root = jax.random.fold_in(jax.random.key(seed), _SALT_NOISE)
    return seen, jax.vmap(lambda k: jax.random.fold_in(root, k))(jnp.arange(first, first + len(found)))


def layout_of(spec: Spec, colours: int) -> NetworkShape:
    """Shape of a spec's network."""
    return NetworkShape(colours, **dict(spec.network))


def rates_at(train: TrainSpec, step: int) -> Rates:
    """Step sizes of Adam: along a cosine to a tenth, and 0 for what does not move in this step."""
    share = 1.0
    if train.schedule == "cosine":
        share = 0.1 + 0.9 * 0.5 * (1 + float(np.cos(np.pi * min(step / max(train.steps, 1), 1.0))))
    turn = train.mode == "alternating" and train.moves_optics and train.moves_network
    optics_turn = step % train.period == train.period - 1
    moves_network = train.moves_network and not (turn and optics_turn)
    moves_optics = train.moves_optics and not (turn and not optics_turn)
    return Rates(share * train.learning_rate * moves_network, share * train.optics_learning_rate * moves_optics)


def kept_at(train: TrainSpec, step: int) -> float:
    """Share that the running mean of weights keeps in a step: less at first, so that it forgets how it began."""
    return min(train.average, (1 + step) / (10 + step))


@eqx.filter_jit
def _averaged(average: Network, network: Network, kept: Array) -> Network:
    """The running mean of weights after one more step."""
    return jax.tree.map(lambda old, new: kept * old + (1 - kept) * new, average, network)


def devices_mesh(count: int | None = None) -> Mesh | None:
    """A mesh of devices, all on all hosts by default; None for a single one.

    Raises:
        InputError: more than there are.
    """
    devices = jax.devices()
    wanted = len(devices) if count is None else count
    if not 1 <= wanted <= len(devices):
        rule = f"must lie from 1 to the {len(devices)} that there are"
        raise InputError("devices", rule, wanted, "Leave it out to take all.")
    return None if wanted == 1 else Mesh(np.array(devices[:wanted]), (AXIS,))


def _learnt_doe(spec: Spec, source: str) -> TrainingDoe:
    """A DOE that is learnt, or looked at off the axis, or with errors."""
    drawn = spec.optimize.model_copy(update={"drawn_pixel_m": None})
    odd = spec.sensor.model_copy(update={"window": spec.sensor.window | 1})
    # Of a DOE with errors, the light of walls comes with its deviation from thin heights.
    light = spec.optics.model_copy(update={"light": "scalar"} if spec.train.fabricated else {})
    problem = plans_of(spec.model_copy(update={"sensor": odd, "optics": light, "optimize": drawn}))
    optic = problem.optic
    if isinstance(optic, HeightOptic | EdgeOptic):  # one compiled step serves all depths and fields
        optic = replace(optic, source_kind=SeparableSource)
    elif spec.train.field == "random" or spec.train.fabricated:
        key = "field" if spec.train.field == "random" else "fabricated"
        cure = 'Use parametrization = "freeform" with this design as its start.'
        raise InputError(f"{source}: train.{key}", "must be left out for a design of rings", "it", cure)
    return TrainingDoe(optic, problem.plans, problem.parametrization)


def resting_doe(spec: Spec, camera: Camera, kind: ObstructionKind, height_m: Float[np.ndarray, "y x"]) -> TrainingDoe:
    """A DOE that stays as it is, by exact PSFs over all depths that scenes may have."""
    bank = psf(height_m, camera, resting_depths_m(spec, kind), propagation=spec.propagation)
    return TrainingDoe.at_rest(bank.as_optic())


def resting_depths_m(spec: Spec, kind: ObstructionKind) -> tuple[float, ...]:
    """Depths at which a plate at rest is computed: those of the obstruction, and those of the background."""
    least, most = depth_range_m(kind)
    near = 1 / np.linspace(1 / most, 1 / least, _NEAR_DEPTHS)
    far = spec.scene.far_m
    with np.errstate(divide="ignore"):  # of infinity
        backs = 1 / np.linspace(1 / max(far), 1 / min(far), _FAR_DEPTHS)
    return tuple(dict.fromkeys(float(depth) for depth in (*backs, *near)))


def _field_rad(spec: Spec, seed: int, number: int) -> tuple[float, float]:
    """Field angles (y, x) of a scene, anywhere on the sensor."""
    share = np.random.default_rng((seed, _SALT_FIELD, number)).uniform(-0.5, 0.5, 2)
    y, x = np.arctan(share * 2 * np.array(spec.half_field))
    return float(y), float(x)


@partial(eqx.filter_value_and_grad, has_aux=True)
def _slopes(
    moving: Any, still: Any, trainer: Trainer, seen: TrainingScene, keys: Array, rounding: Rounding
) -> tuple[Array, Array]:
    """The loss and its terms, with the gradient by all that moves."""
    network, free = eqx.combine(moving, still)
    train = trainer.spec.train
    found = shots(seen, trainer.doe, free, rounding, trainer.bench, keys)
    half, checkpointed = train.precision == "mixed", train.checkpointing
    picture = _picture(network, found, train, half=half, checkpointed=checkpointed)
    reference, mask = srgb_from_linear(jnp.asarray(seen.scene.background)), seen.scene.obstructions[0].mask
    return losses(picture, reference, jnp.asarray(mask), train, trainer.perceptual)


def _mean_slopes(
    moving: Any, still: Any, trainer: Trainer, seen: TrainingScene, keys: Array, rounding: Rounding
) -> Any:
    """`_slopes`, averaged over all devices of the trainer."""
    if trainer.mesh is None:
        return _slopes(moving, still, trainer, seen, keys, rounding)
    arrays, rest = eqx.partition((still, trainer), eqx.is_array)

    def local(moving: Any, arrays: Any, seen: TrainingScene, keys: Array, rounding: Rounding) -> Any:
        still, trainer = eqx.combine(arrays, rest)
        found = _slopes(moving, still, trainer, seen, keys, rounding)
        return jax.tree.map(lambda leaf: jax.lax.pmean(leaf, AXIS), found)

    here, shared = PartitionSpec(AXIS), PartitionSpec()
    specs = (shared, shared, here, here, shared)
    call = jax.shard_map(local, mesh=trainer.mesh, in_specs=specs, out_specs=shared, check_vma=False)
    return call(moving, arrays, seen, keys, rounding)


_Learnt = tuple[Network, Any]
_Constants = tuple[Trainer, TrainingScene, Array, Rounding, Array, tuple[bool, bool]]


def _take(constants: _Constants, changing: tuple[_Learnt, tuple[Any, Any]]) -> Any:
    """One step in arrays."""
    trainer, seen, keys, rounding, rates, moves = constants
    learnt, moments = changing
    chosen = tuple(
        jax.tree.map(lambda leaf, move=move: move and eqx.is_inexact_array(leaf), part)
        for part, move in zip(learnt, moves, strict=True)
    )
    moving, still = eqx.partition(learnt, chosen)
    (loss, terms), slopes = _mean_slopes(moving, still, trainer, seen, keys, rounding)
    fresh = [
        adam_step(part, slope, moment, rate) if move else (part, moment)
        for part, slope, moment, rate, move in zip(learnt, slopes, moments, rates, moves, strict=True)
    ]
    return tuple(part for part, _ in fresh), tuple(moment for _, moment in fresh), loss, terms


@cache
def _update() -> Callable[[_Constants, tuple[_Learnt, tuple[Any, Any]]], Any]:
    """The compiled step. Made on first use: several hosts have to find each other first."""
    return compiled_step(_take)


@eqx.filter_jit
def _lesson(free: Any, trainer: Trainer, seen: TrainingScene, keys: Array, scale: int) -> Cells:
    """Cells of a batch, on the axis and without process errors."""

    def of_one(given: tuple[TrainingScene, Array]) -> Cells:
        one, key = given
        far, near = (trainer.doe.psf(free, ROUNDED, sources) for sources in (one.far, one.near))
        found = cells_of(trainer.bench, jax.tree.map(jnp.asarray, one.scene), far, near, key, scale)
        return jax.tree.map(lambda part: part[0], found)

    return jax.lax.map(of_one, (seen, keys))


@eqx.filter_jit
def _look(network: Network, free: Any, trainer: Trainer, seen: TrainingScene, keys: Array) -> tuple[Capture, Array]:
    found = shots(seen, trainer.doe, free, ROUNDED, trainer.bench, keys)
    return found, _picture(network, found, trainer.spec.train)


def _picture(network: Network, found: Capture, train: TrainSpec, **how: bool) -> Array:
    """Pictures that the loss is of, display values: reconstructions, or captures themselves where no network learns."""
    if not train.moves_network:
        return srgb_from_linear(found.capture)
    return network(found.capture, found.far, found.near, **how)
