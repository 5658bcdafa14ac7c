"""Training of the network for lamps (`doedesign.hdr.network`): the same for every camera.

Examples are captures of scenes with lamps through plates as fabricated, with what the solver makes of them; the solver
and the network are given the PSFs as drawn. They are made once. A step takes some of them, turned and mirrored at
random together with the PSFs, and lowers the two scores that count (`doedesign.hdr.scores`):

    loss = log10 of the squared mu-law error where the scene saturates
           + half of log10 of that of display values elsewhere.

A folder of a training holds

    examples.npz     examples, once they are made
    checkpoint.npz   the state after some steps; only while it is unfinished
    lamps.npz        the network, when done

and the same call goes on where an earlier one was stopped.
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from doedesign.hdr.capture import LampCamera, LinePsfs
from doedesign.hdr.network import Kernel, LampNetwork, LampView, Veil, compressed_light, viewed
from doedesign.hdr.scenes import LampScenes
from doedesign.hdr.solver import LampSolver
from doedesign.recon.weights import stored_arrays, with_arrays
from doedesign.runtime.compiling import compiled_step
from doedesign.training.checkpoint import read_checkpoint, settled, write_checkpoint
from doedesign.training.loss import adam_step
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import canonical_json, sha256_bytes
from sim.light import srgb_from_linear

FORMAT = "doedesign lamp network 1"
LAMP_NETWORK_NAME = "lamps.npz"
_EXAMPLES, _CHECKPOINT = "examples.npz", "checkpoint.npz"
_CURE = "Remove it, and train again."
_LEAST_ERROR = (1e-4, 1e-5)  # of lamps and elsewhere: beyond 40 and 50 dB nothing is gained
_ELSEWHERE = 0.5
_WARM_UP = 20
_WAYS = 8  # to turn and mirror a square

_log = logging.getLogger("doedesign")


@dataclass(frozen=True)
class LampTraining:
    """Numbers of a training.

    Attributes:
        steps: steps.
        batch: examples of a step.
        examples: examples in all.
        rate: step size of Adam, which falls to nothing along a cosine.
        width: features of the network's finest scale.
        seed: of weights and batches.
        checkpoint_every: steps after which the state is stored.
    """

    steps: int = 400
    batch: int = 2
    examples: int = 64
    rate: float = 2e-3
    width: int = 20
    seed: int = 0
    checkpoint_every: int = 100

    def __post_init__(self) -> None:
        """Raise an InputError for a number that is not positive, or fewer examples than a batch has."""
        for name in ("steps", "batch", "examples", "rate", "width", "checkpoint_every"):
            if not getattr(self, name) > 0:
                raise InputError(f"training.{name}", "must be positive", f"{getattr(self, name):g}", "Correct it.")
        if self.examples < self.batch:
            raise InputError("training.examples", "must fill a batch", f"{self.examples}", "Make more examples.")

    def rate_at(self, step: int) -> float:
        """Step size of a step, the first one 0."""
        warm = min((step + 1) / _WARM_UP, 1.0)
        return self.rate * warm * 0.5 * (1 + float(np.cos(np.pi * step / self.steps)))


class LampExamples(NamedTuple):
    """Examples of one camera.

    Attributes:
        view: pictures that the network is given, `[n, y, x, ...]`.
        truth: `[n, y, x, c]` light of the scenes.
        saturated: `[n, y, x, c]` 1 where the scene saturates.
    """

    view: LampView
    truth: Float[np.ndarray, "n y x c"]
    saturated: Float[np.ndarray, "n y x c"]


class LampState(NamedTuple):
    """Everything that a step changes: steps done, network, and Adam's moments."""

    step: int
    network: LampNetwork
    moments: optax.OptState


def lamp_examples(
    camera: LampCamera,
    scenes: LampScenes,
    plates: Sequence[LinePsfs],
    known: Kernel,
    numbers: Iterable[int],
    solver: LampSolver | None = None,
) -> LampExamples:
    """Make examples.

    Args:
        camera: the camera.
        scenes: scenes to train on, with square frames.
        plates: PSFs of optics as fabricated, with glare; scene i is seen through the i-th, in turn.
        known: `[c, v, u]` PSFs of white light as they are known.
        numbers: of the scenes; scenes without a saturated pixel are left out.
        solver: whose estimate the network goes on from.

    Raises:
        InputError: no scene has a saturated pixel.
    """
    solver = solver or LampSolver()
    views, truths, bright = [], [], []
    for number in numbers:
        scene = scenes.scene(number, camera.weights)
        saturated = camera.saturated(scene)
        if not saturated.any():
            continue
        capture = camera.capture(scene, plates[number % len(plates)], number)
        views.append(viewed(capture, solver.solve(capture, known).light, known))
        truths.append(np.moveaxis(scene.light(), 0, -1))
        bright.append(np.moveaxis(saturated, 0, -1).astype(np.float32))
    if not views:
        cure = "Make more examples, or brighter lamps."
        raise InputError("training.examples", "some must have saturated pixels", "none", cure)
    view = LampView(*(np.stack(each) for each in zip(*views, strict=True)))
    return LampExamples(view, np.stack(truths), np.stack(bright))


def turned(picture: np.ndarray, way: int, axes: tuple[int, int]) -> np.ndarray:
    """A picture in one of the eight ways in which a square falls on itself.

    Args:
        picture: any array.
        way: 0 to 7; 0 leaves it as it is.
        axes: its y and x.
    """
    found = np.rot90(picture, way % 4, axes)
    return np.flip(found, axes[1]) if way >= _WAYS // 2 else found


def lamp_losses(network: LampNetwork, batch: LampExamples, veil: Veil) -> tuple[Array, Array]:
    """Log10 of squared errors of every scene: `[b]` where the scene saturates, `[b]` elsewhere.

    Args:
        network: the network.
        batch: examples.
        veil: of the PSF that is known, turned as the examples are.
    """
    found, truth, bright = network(batch.view, veil), jnp.asarray(batch.truth), jnp.asarray(batch.saturated)
    errors = (
        compressed_light(found) - compressed_light(truth),
        srgb_from_linear(jnp.clip(found, 0, 1)) - srgb_from_linear(jnp.clip(truth, 0, 1)),
    )
    parts = [
        jnp.log10(jnp.sum(part * error**2, axis=(1, 2, 3)) / jnp.maximum(jnp.sum(part, axis=(1, 2, 3)), 1) + least)
        for part, error, least in zip((bright, 1 - bright), errors, _LEAST_ERROR, strict=True)
    ]
    return parts[0], parts[1]


class _Given(NamedTuple):
    batch: LampExamples
    transfer: Array
    size: tuple[int, int]
    rate: Array


@eqx.filter_value_and_grad
def _slopes(network: LampNetwork, given: _Given) -> Array:
    lamps, elsewhere = lamp_losses(network, given.batch, Veil(given.transfer, given.size))
    return jnp.mean(lamps) + _ELSEWHERE * jnp.mean(elsewhere)


def _take(given: _Given, changing: tuple[LampNetwork, Any]) -> tuple[tuple[LampNetwork, Any], Array]:
    network, moments = changing
    loss, slope = _slopes(network, given)
    # One scene that goes wrong must not undo what many others taught.
    size = jnp.sqrt(sum(jnp.sum(one**2) for one in jax.tree.leaves(slope)))
    slope = jax.tree.map(lambda one: one / jnp.maximum(size, 1.0), slope)
    return adam_step(network, slope, moments, given.rate), loss


@cache
def _update() -> Callable[[_Given, Any], Any]:
    return compiled_step(_take)


def trained_lamp_network(
    folder: Path,
    made: Callable[[], LampExamples],
    known: Kernel,
    how: LampTraining,
    settings: dict[str, Any],
    progress: Callable[[int, float], None] | None = None,
) -> LampNetwork:
    """Train a network, or go on where an earlier call was stopped.

    Args:
        folder: its folder.
        made: makes the examples, where the folder has none yet.
        known: `[c, v, u]` PSFs of white light as they are known.
        how: numbers of the training.
        settings: what else the result depends on, for JSON; a folder of other settings is refused.
        progress: is told steps done and the loss.

    Raises:
        InputError: files of another training or damaged ones, or a loss that is no longer finite.
    """
    told = {"how": {**asdict(how), "checkpoint_every": 0}, **settings}
    owner = sha256_bytes(canonical_json(told))
    if (folder / LAMP_NETWORK_NAME).is_file():
        network, about = read_lamp_network(folder / LAMP_NETWORK_NAME)
        if about.get("owner") != owner:
            _refuse(folder)
        (folder / _CHECKPOINT).unlink(missing_ok=True)  # it was killed just before
        return network
    examples = _examples(folder, made, {"how": {"examples": how.examples}, **settings})
    if len(examples.truth) < how.batch:
        got = f"{len(examples.truth)} of {how.examples} with saturated pixels"
        raise InputError("training.examples", "must fill a batch", got, "Make more examples, or brighter lamps.")
    veils = _veils(known, examples.truth.shape[1])
    network = LampNetwork.make(how.seed, len(known), how.width)
    state = settled(LampState(0, network, optax.scale_by_adam().init(eqx.filter(network, eqx.is_inexact_array))))
    if stored := read_checkpoint(folder / _CHECKPOINT, state, owner):
        state = stored[0]
    while state.step < how.steps:
        rng = np.random.default_rng((how.seed, state.step))
        way = int(rng.integers(_WAYS))
        which = np.sort(rng.choice(len(examples.truth), how.batch, replace=False))
        batch = jax.tree.map(lambda one: jnp.asarray(turned(one[which], way, (1, 2))), examples)  # noqa: B023
        given = _Given(batch, jnp.asarray(veils[way].transfer), veils[way].size, jnp.float32(how.rate_at(state.step)))
        (network, moments), loss = _update()(given, tuple(state[1:]))
        if not np.isfinite(loss):
            cure = "Lower the step size."
            raise InputError(f"training of lamps, step {state.step}", "must stay finite", float(loss), cure)
        state = LampState(state.step + 1, network, moments)
        if progress:
            progress(state.step, float(loss))
        if state.step % how.checkpoint_every == 0:
            write_checkpoint(folder / _CHECKPOINT, state, state.step, owner)
    write_lamp_network(folder / LAMP_NETWORK_NAME, state.network, {**told, "owner": owner})
    (folder / _CHECKPOINT).unlink(missing_ok=True)
    return state.network


def _refuse(folder: Path) -> None:
    raise InputError(str(folder), "must belong to this training", "other settings", "Choose another folder.")


def _veils(known: Kernel, side: int) -> list[Veil]:
    """Veils of a square frame, turned in all ways."""
    return [Veil.of(turned(known, way, (1, 2)), (side, side)) for way in range(_WAYS)]


def _examples(folder: Path, made: Callable[[], LampExamples], settings: dict[str, Any]) -> LampExamples:
    """Examples of a folder, made if there are none."""
    path, owner = folder / _EXAMPLES, sha256_bytes(canonical_json(settings))
    if not path.is_file():
        _log.info("making examples")
        found = made()
        arrays = {**found.view._asdict(), "truth": found.truth, "saturated": found.saturated}
        write_archive(path, {"format": FORMAT, "owner": owner}, arrays)
        return found
    header, arrays = read_archive(path, "set of examples", _CURE)
    if header.get("owner") != owner or arrays.keys() != {*LampView._fields, "truth", "saturated"}:
        _refuse(folder)
    return LampExamples(LampView(*(arrays[name] for name in LampView._fields)), arrays["truth"], arrays["saturated"])


def write_lamp_network(path: Path, network: LampNetwork, about: dict[str, Any]) -> None:
    """Write a network.

    Args:
        path: the file.
        network: the network.
        about: what it was trained on and with, for JSON.

    Raises:
        InputError: a weight is not finite, or the system refuses the path.
    """
    header = {"format": FORMAT, "layout": {"colours": network.colours, "width": network.width}, "about": about}
    write_archive(path, header, stored_arrays(path, network))


def read_lamp_network(path: Path) -> tuple[LampNetwork, dict[str, Any]]:
    """Read what `write_lamp_network` wrote: the network, and what it is about.

    Args:
        path: the file.

    Raises:
        InputError: a missing, damaged or foreign file.
    """
    header, arrays = read_archive(path, "network for lamps", _CURE)
    if header.get("format") != FORMAT:
        raise InputError(str(path), f"must be of format {FORMAT!r}", repr(header.get("format")), _CURE)
    layout, about, weights = header.get("layout"), header.get("about"), sum(array.size for array in arrays.values())
    colours, width = (layout.get(key) if isinstance(layout, dict) else None for key in ("colours", "width"))
    # A network to compare with is made before anything else, and must not be much larger than the file.
    if not all(type(n) is int and n > 0 for n in (colours, width)) or not _fits(colours, width, weights):
        rule, cure = "the layout must be one that this version knows", "Use the version that wrote it."
        raise InputError(str(path), rule, f"{layout!r} for {weights} weights", cure)
    if not isinstance(about, dict):
        raise InputError(str(path), "must say what it is about", repr(about), _CURE)
    return with_arrays(path, eqx.filter_eval_shape(LampNetwork.make, 0, colours, width), arrays), about


def _fits(colours: Any, width: Any, weights: int) -> bool:
    """Whether so many weights can be those of a network: its first block and its coarsest have some."""
    return 9 * (28 * colours * width + (2 * width) ** 2) <= weights
