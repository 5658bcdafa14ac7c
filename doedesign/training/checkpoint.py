"""Checkpoints of training: one file that holds everything a step changes, whole or not at all.

    checkpoint.npz      an archive (`fab.archive`)
        header          format, whose it is, step; name, shape and kind of every array
        array00000 ...  the arrays, in the order of the state's leaves

What else training depends on follows from the spec and the step: the scenes of a batch (`doedesign.capture.scenes`),
every random key, and the step sizes. So a training that goes on from a checkpoint ends with the bytes of one that was
never stopped.

A full disk or a kill leaves the checkpoint before, and a state that is not finite never replaces one that is.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from fab.archive import read_archive, write_archive
from fab.errors import InputError

FORMAT = "doedesign training checkpoint 1"

_State = TypeVar("_State")


def write_checkpoint(path: Path, state: Any, step: int, owner: str) -> None:
    """Store arrays and numbers of a state after a number of steps; its shapes and functions belong to the spec.

    `owner` is a digest of all that the training depends on.

    Raises:
        InputError: the state is not finite, or the system refuses the path; an earlier checkpoint stays.
    """
    leaves = _leaves(state)
    for name, array in leaves:
        if not np.isfinite(array).all():
            cure = "Lower train.learning_rate or train.optics_learning_rate; the earlier checkpoint stays."
            rule, got = "every number must stay finite", f"one that is not in {name}"
            raise InputError(f"training, step {step}", rule, got, cure)
    header = {
        "format": FORMAT,
        "owner": owner,
        "step": step,
        "arrays": [[name, list(array.shape), array.dtype.name] for name, array in leaves],
    }
    write_archive(path, header, {f"array{k:05d}": _plain(array) for k, (_, array) in enumerate(leaves)})


def read_checkpoint(path: Path, like: _State, owner: str) -> tuple[_State, int] | None:
    """Read the state and the number of steps that `write_checkpoint` stored, or None if there is no checkpoint.

    Structure, and the devices that arrays are bound to, are those of the state `like` of the same training.

    Raises:
        InputError: the file is cut off, corrupt, or of another training.
    """
    if not path.exists():
        return None
    cure = f"Remove {path.name} to start this training again from the beginning."
    header, arrays = read_archive(path, "checkpoint", cure)
    expected = [[name, list(array.shape), array.dtype.name] for name, array in _leaves(like)]
    # What the header says of the arrays, and what they are.
    wanted = [(array.shape, array.dtype) for array in (_plain(array) for _, array in _leaves(like))]
    same = [(array.shape, array.dtype) for array in arrays.values()] == wanted
    said = (header.get("format"), header.get("owner"), header.get("arrays"))
    if said != (FORMAT, owner, expected) or not same or type(header.get("step")) is not int:
        raise InputError(str(path), "must belong to this training", "a checkpoint of another one", cure)
    return _rebuilt(like, list(arrays.values())), header["step"]


def settled(state: _State) -> _State:
    """A fresh state as a checkpoint would give it back, so that the same compiled step serves both.

    Otherwise arrays that were made of Python's numbers have a weaker type, and a step compiled for them may round
    differently.
    """
    return _rebuilt(state, [array for _, array in _leaves(state)])


def _leaves(state: Any) -> list[tuple[str, np.ndarray]]:
    """Arrays and numbers of a state with their places in it."""
    found, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(state, eqx.is_array_like))
    return [(jax.tree_util.keystr(place), np.asarray(value)) for place, value in found]


def _plain(array: np.ndarray) -> np.ndarray:
    """Kinds of number that a file of numpy has no name for (bfloat16), as integers of the same bits."""
    return array.view(f"u{array.dtype.itemsize}") if array.dtype.kind == "V" else array


def _rebuilt(like: _State, arrays: Sequence[np.ndarray]) -> _State:
    """The state whose leaves are the arrays, as `_leaves` lists them."""
    numbers, rest = eqx.partition(like, eqx.is_array_like)
    leaves, tree = jax.tree.flatten(numbers)
    values = [_as(leaf, array) for leaf, array in zip(leaves, arrays, strict=True)]
    return eqx.combine(jax.tree.unflatten(tree, values), rest)


def _as(leaf: Any, array: np.ndarray) -> Any:
    if isinstance(leaf, bool | int | float):
        return type(leaf)(array)
    value = array if array.dtype == leaf.dtype else array.view(leaf.dtype)
    if isinstance(leaf, jax.Array):
        # A copy: a step reuses the memory of the state that it is given.
        fresh = jnp.array(value)
        # What was bound to no device goes to where the step wants it.
        return jax.device_put(fresh, leaf.sharding) if leaf.committed else fresh
    return np.array(value)
