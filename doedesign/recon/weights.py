"""A network's file: its weights, its shape, and what it was trained on and with.

    network.npz     an archive (`fab.archive`)
        header      format, layout, what it is about
        .down[0].blocks[0].weights ...      one array for each place in the network

In half precision it takes half the room, and every weight keeps three digits.

What a file is about has to say which camera it was trained for, in these keys; `camera_facts` takes them from a camera:

    colours         names of the channels, in their order
    wavelengths_m   mean wavelength of each
    pixel_m         pixel pitch, metres
    near_m          depths of obstructions it was trained on, metres

and may say

    far_m           distance of the scene that it is told of where nobody states another, metres; the farthest of its
                    PSFs without

Anything else that JSON can say may stand beside them: digests of spec and design, occlusion model, pictures, licences.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from doedesign.recon.network import Network, NetworkShape, Variant
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from sim.camera import Camera
from sim.metrics import mean_wavelength_m

FORMAT = "doedesign network 1"
NETWORK_NAME, BANK_NAME = "network.npz", "psf.exr"  # as they lie beside each other in a model's folder

_Tree = TypeVar("_Tree")

_NEWER = ("global_light",)
_CURE = "Copy it again from where it was made, or train again."


def camera_facts(camera: Camera, near_m: Sequence[float]) -> dict[str, Any]:
    """Entries of a network's file on its camera, and on the depths of obstructions (at least one, metres)."""
    return {
        "colours": [colour.name for colour in camera.colours],
        "wavelengths_m": [mean_wavelength_m(colour) for colour in camera.colours],
        "pixel_m": camera.pixel_m,
        "near_m": [float(depth) for depth in near_m],
    }


def write_network(path: str | Path, network: Network, about: Mapping[str, Any], *, half: bool = False) -> None:
    """Write a network and, for JSON, its camera and training (see the top of this file); in float16 if `half`.

    Raises:
        InputError: a weight is not finite (or too large for float16), or the system refuses the path.
        ValueError: `about` holds what JSON cannot say.
    """
    header = {"format": FORMAT, "layout": _said(network.layout), "about": dict(about)}
    write_archive(path, header, stored_arrays(path, network, half=half))


def stored_arrays(path: str | Path, network: Any, *, half: bool = False) -> dict[str, np.ndarray]:
    """Arrays of a network by where they stand in it, as a file holds them, in float16 if `half`.

    Raises:
        InputError: a weight is not finite (or too large for float16); the message names the file's path.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named(network).items()}
    with np.errstate(over="ignore"):  # what float16 cannot hold becomes infinite and is refused below
        stored = {name: array.astype(np.float16) if half else array for name, array in arrays.items()}
    for name, array in stored.items():
        if not np.isfinite(array).all():
            cure = "Go back to a checkpoint before training broke."
            raise InputError(str(path), "weights must be finite", f"others in {name}", cure)
    return stored


def read_network(path: str | Path) -> tuple[Network, dict[str, Any]]:
    """Read a network, its weights in single precision, and `about` from a file of `write_network`.

    Raises:
        InputError: the file is missing, cut off, changed since, of another format or a layout that this version does
            not know, or lacks an array.
    """
    path = Path(path)
    header, arrays = read_archive(path, "network file", _CURE)
    if header.get("format") != FORMAT:
        cure = "Give the network.npz of a training or of a released model, written by this version."
        raise InputError(str(path), f'the format must be "{FORMAT}"', repr(header.get("format")), cure)
    try:
        layout = _layout(header.get("layout"), sum(array.size for array in arrays.values()))
    except (TypeError, ValueError) as error:
        rule, cure = "the layout must be one that this version knows", "Use the version that wrote it."
        raise InputError(str(path), rule, f'"{error}"', cure) from error
    about = header.get("about")
    if not isinstance(about, dict):
        raise InputError(str(path), "must say what it is about", repr(about), _CURE)
    # Its weights are not drawn.
    return with_arrays(path, eqx.filter_eval_shape(Network.make, layout, 0), arrays), about


def _said(layout: NetworkShape) -> dict[str, Any]:
    """The layout for the file; a part that older files do not know is left out where the network has none."""
    return {name: value for name, value in asdict(layout).items() if name not in _NEWER or value}


def _layout(said: Any, weights: int) -> NetworkShape:
    """The layout that a file says, for so many weights; a TypeError or ValueError if it cannot be."""
    layout = NetworkShape(**said)
    for field in fields(layout):
        if type(value := getattr(layout, field.name)) is not type(field.default):
            raise TypeError(f"{field.name} is {value!r}")
    if layout.variant not in get_args(Variant):
        raise ValueError(f"variant is {layout.variant!r}")
    # A network to compare with is made before anything else, and must not be much larger than the file: its last block
    # at the coarsest scale, 3 x 3 pixels from twice as many features, has a good part of all weights.
    if 18 * layout.widths[-1] ** 2 > weights:
        raise ValueError(f"a width of {layout.width} for {weights} weights")
    return layout


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _named(tree: Any) -> dict[str, Any]:
    """Arrays of a tree, or their shapes, by where they stand."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, _is_array))
    return {jax.tree_util.keystr(where): leaf for where, leaf in leaves}


def with_arrays(path: Path, empty: _Tree, arrays: Mapping[str, np.ndarray]) -> _Tree:
    """A network with the weights of a file, in single precision, from one that has shapes in their places.

    Raises:
        InputError: an array is missing, of another shape or kind, not finite, or one too many.
    """
    slots = _named(empty)
    for name, slot in slots.items():
        if name not in arrays:
            raise InputError(str(path), "every array of the layout must be there", f"no {name}", _CURE)
        if arrays[name].shape != slot.shape or arrays[name].dtype.kind != "f":
            rule = f"{name} must hold floats of shape {slot.shape}"
            raise InputError(str(path), rule, f"{arrays[name].dtype} of shape {arrays[name].shape}", _CURE)
        if not np.isfinite(arrays[name]).all():
            raise InputError(str(path), "weights must be finite", f"others in {name}", _CURE)
    if extra := sorted(arrays.keys() - slots.keys()):
        raise InputError(str(path), "must hold the layout's arrays alone", f"also {extra[0]}", _CURE)

    def filled(where: Any, leaf: Any) -> Any:
        return jnp.asarray(arrays[jax.tree_util.keystr(where)].astype(leaf.dtype)) if _is_array(leaf) else leaf

    return jax.tree_util.tree_map_with_path(filled, empty)
