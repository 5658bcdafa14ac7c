"""Checkpoints of training: every bit comes back, and nothing else does."""

import errno
import os
import pickle
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.training.checkpoint import read_checkpoint, settled, write_checkpoint
from fab.archive import read_archive, write_archive
from fab.errors import InputError


class Part(eqx.Module):
    """Arrays beside what a checkpoint does not hold."""

    weights: jax.Array
    bias: jax.Array | None
    act: Any = eqx.field(static=True, default="relu")


class Whole(NamedTuple):
    """A state as training has it."""

    step: int
    network: tuple[Part, ...]
    free: jax.Array | None
    moment: jax.Array
    half: jax.Array


def state(seed: int = 0, size: int = 5) -> Whole:
    keys = jax.random.split(jax.random.key(seed), 3)
    parts = (Part(jax.random.normal(keys[0], (3, size)), None), Part(jnp.full(2, 0.25), jnp.zeros((0,))))
    half = jax.random.normal(keys[2], (4,)).astype(jnp.bfloat16)
    return Whole(seed, parts, jax.random.normal(keys[1], (4, 4)), jnp.int32(7), half)


def bits(tree: Any) -> list[tuple[Any, ...]]:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return [(leaf.dtype.name, leaf.shape, leaf.tobytes()) for leaf in leaves]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "checkpoint.npz"


def test_every_bit_comes_back(path: Path):
    assert read_checkpoint(path, state(1), "me") is None
    write_checkpoint(path, state(0), 12, "me")
    found = read_checkpoint(path, state(1), "me")
    assert found is not None
    again, step = found
    assert step == 12
    assert type(again.step) is int
    assert (again.network[0].act, again.network[0].bias) == ("relu", None)
    assert bits(again) == bits(state(0)) != bits(state(1))


def test_the_same_state_gives_the_same_bytes(path: Path):
    write_checkpoint(path, state(), 3, "me")
    first = path.read_bytes()
    write_checkpoint(path, state(), 3, "me")
    assert path.read_bytes() == first


def test_a_fresh_state_is_settled_like_one_that_was_read(path: Path):
    """`jnp.full` with a number of Python's makes an array of a weaker type, for which a step would be compiled anew."""
    fresh = state()
    write_checkpoint(path, fresh, 3, "me")
    found = read_checkpoint(path, fresh, "me")
    assert found is not None
    kinds = [[(leaf.aval, leaf.sharding) for leaf in jax.tree.leaves(s.network)] for s in (settled(fresh), found[0])]
    assert kinds[0] == kinds[1]
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(settled(fresh).network))
    assert bits(settled(fresh)) == bits(fresh)


def test_what_is_of_another_training(path: Path):
    write_checkpoint(path, state(), 3, "me")
    for like, owner in ((state(), "you"), (state(size=6), "me"), (state()._replace(free=None), "me")):
        with pytest.raises(InputError, match="another one") as caught:
            read_checkpoint(path, like, owner)
        assert caught.value.cure.startswith("Remove checkpoint.npz")


@pytest.mark.parametrize("change", ["dtype", "shape", "fewer", "text", "step", "nan"])
def test_a_checkpoint_that_was_sealed_again_with_other_content_is_refused(path: Path, change: str):
    write_checkpoint(path, state(0), 12, "me")
    header, arrays = read_archive(path, "checkpoint", "")
    name = next(iter(arrays))
    first = {"dtype": arrays[name].astype(np.complex64), "shape": np.zeros((9, 9)), "text": np.array("text")}
    if change == "nan":  # JSON of its own that names a number which JSON does not have
        path.write_bytes(path.read_bytes().replace(b'"step": 12', b'"step":NaN'))
    elif change == "text":
        np.savez(path, header=np.frombuffer(b'{"sha256": ""}', np.uint8), **{**arrays, name: first[change]})
    else:
        arrays = {**arrays, name: first.get(change, arrays[name])}
        arrays = dict(list(arrays.items())[1:]) if change == "fewer" else arrays
        write_archive(path, {**header, "step": "12"} if change == "step" else header, arrays)
    with pytest.raises(InputError, match=r"checkpoint.*Remove checkpoint\.npz"):
        read_checkpoint(path, state(1), "me")


def test_damage_is_found_or_harmless(path: Path):
    """Cut or flipped anywhere, a checkpoint is refused with a cure, or gives exactly what was saved."""
    write_checkpoint(path, state(), 3, "me")
    whole = path.read_bytes()
    damaged = [whole[:n] for n in range(0, len(whole), 97)]
    for where in range(0, len(whole), 11):
        data = bytearray(whole)
        data[where] ^= 1 << (where % 8)
        damaged.append(bytes(data))
    refused = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            found = read_checkpoint(path, state(1), "me")
        except InputError as error:
            refused += error.cure.startswith("Remove checkpoint.npz")
            continue
        assert found is not None
        assert found[1] == 3
        assert bits(found[0]) == bits(state())
    # Names, times and padding of the archive, of which a state this small has many, are not guarded.
    assert refused > len(damaged) / 2


def test_numbers_that_are_changed_with_their_checksum(path: Path):
    """An archive may be whole, and still not what was written."""
    write_checkpoint(path, state(), 3, "me")
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["array00001"] = arrays["array00001"] + 1
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="a file changed since"):
        read_checkpoint(path, state(), "me")


def test_a_state_that_is_not_finite_replaces_nothing(path: Path):
    write_checkpoint(path, state(), 3, "me")
    before = path.read_bytes()
    for bad in (
        state()._replace(free=jnp.full((4, 4), np.nan)),
        state()._replace(half=jnp.full(4, np.inf, jnp.bfloat16)),
    ):
        with pytest.raises(InputError, match=r"step 4.*must stay finite.*learning_rate"):
            write_checkpoint(path, bad, 4, "me")
    assert path.read_bytes() == before


def test_a_full_disk_leaves_the_old_one(path: Path, monkeypatch: pytest.MonkeyPatch):
    write_checkpoint(path, state(0), 3, "me")
    before = path.read_bytes()

    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match=r"checkpoint\.npz.*No space left"):
            write_checkpoint(path, state(1), 4, "me")
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


class Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_checkpoint_is_never_unpickled(path: Path, tmp_path: Path):
    bomb = Bomb(tmp_path / "exploded")
    path.write_bytes(pickle.dumps(bomb))
    with pytest.raises(InputError, match="whole checkpoint"):
        read_checkpoint(path, state(), "me")
    np.savez(path, allow_pickle=True, header=np.array([bomb], dtype=object))
    with pytest.raises(InputError, match="whole checkpoint"):
        read_checkpoint(path, state(), "me")
    assert not (tmp_path / "exploded").exists()
