"""A rival's file and folder.

    network.npz     an archive (`fab.archive`)
        header      format, name of the rival, layout, what it is about
        .trunk.down[0][0].weights ...       one array for each place in the network

What it is about has the facts of `doedesign.recon.weights` on the camera, what the network was shown, its own count of
weights and the original's, and what it was trained on and how.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import RivalNetwork
from doedesign.evaluation.rivals.registry import RIVALS, Rival
from doedesign.recon.weights import NETWORK_NAME, stored_arrays, with_arrays
from doedesign.spec.values import nearest
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import sha256_file

FORMAT = "doedesign rival network 1"

_LEAST_WEIGHTS = 1000  # that every rival has, times the square of its width

_CURE = "Copy it again from where it was made, or train again."


@dataclass(frozen=True, eq=False)
class TrainedRival:
    """A trained rival.

    Attributes:
        rival: which one, and what it is shown.
        network: the network.
        about: all that its file says of it.
        folder: where it was read from; None for one that was not.
        digest: SHA-256 of its file.
    """

    rival: Rival
    network: RivalNetwork
    about: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | None = None
    digest: str = ""

    def restored(
        self, picture: Float[np.ndarray, "c y x"], mask: Float[np.ndarray, "y x"]
    ) -> Float[np.ndarray, "c y x"]:
        """Restore one picture of any size, mirrored beyond its edges where its sides do not fit the network.

        Args:
            picture: display values of what the rival is shown (`Rival.given`).
            mask: the true mask; one that is not shown masks gets none.

        Returns:
            display values, not clipped.
        """
        multiple, (y, x) = self.network.multiple, mask.shape
        more = [max(-(-side // multiple), 2) * multiple - side for side in (y, x)]
        margins = ((0, more[0]), (0, more[1]))
        seen = np.pad(picture, ((0, 0), *margins), mode="symmetric").transpose(1, 2, 0)
        given = np.pad(mask, margins, mode="symmetric")
        found = _answered(self.network, jnp.asarray(seen[None]), jnp.asarray(self.shown(given)[None]))
        return np.asarray(found)[0, :y, :x].transpose(2, 0, 1)

    def shown(self, mask: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """The mask as the rival is shown it: nothing blocked where it is not shown any."""
        return mask if self.rival.mask_given else np.zeros_like(mask)


def rival_named(name: str) -> Rival:
    """Return the rival of a name.

    Raises:
        InputError: there is none.
    """
    if name not in RIVALS:
        raise InputError("rival", f"must be one of {', '.join(RIVALS)}", f'"{name}"', nearest(name, tuple(RIVALS)))
    return RIVALS[name]


def write_rival(path: str | Path, name: str, network: RivalNetwork, about: Mapping[str, Any]) -> None:
    """Write a rival's network.

    Args:
        path: the file.
        name: the rival's name.
        network: the network.
        about: what it is about, for JSON.

    Raises:
        InputError: a weight is not finite, or the system refuses the path.
        ValueError: `about` holds what JSON cannot say.
    """
    header = {"format": FORMAT, "rival": name, "layout": network.layout, "about": dict(about)}
    write_archive(path, header, stored_arrays(path, network))


def read_rival(path: str | Path) -> TrainedRival:
    """Read what `write_rival` wrote.

    Raises:
        InputError: the file is missing, cut off, changed since, of another format, of a rival or a layout that this
            version does not know, or lacks an array.
    """
    path = Path(path)
    header, arrays = read_archive(path, "rival's network file", _CURE)
    if header.get("format") != FORMAT:
        cure = "Give the network.npz of a rival's training, written by this version."
        raise InputError(str(path), f'the format must be "{FORMAT}"', repr(header.get("format")), cure)
    name, about = header.get("rival"), header.get("about")
    if not isinstance(name, str) or name not in RIVALS:
        cure = "Use the version that wrote it."
        raise InputError(str(path), f"the rival must be one of {', '.join(RIVALS)}", repr(name), cure)
    if not isinstance(about, dict):
        raise InputError(str(path), "must say what it is about", repr(about), _CURE)
    try:
        empty = _empty(RIVALS[name], header.get("layout"), sum(array.size for array in arrays.values()))
    except (TypeError, ValueError) as error:
        rule, cure = "the layout must be one that this version knows", "Use the version that wrote it."
        raise InputError(str(path), rule, f'"{error}"', cure) from error
    return TrainedRival(RIVALS[name], with_arrays(path, empty, arrays), about, path.parent, sha256_file(path))


def open_rival(folder: str | Path) -> TrainedRival:
    """Read the trained rival of a folder.

    Args:
        folder: the folder of its training.

    Raises:
        InputError: there is none, or its file cannot be used (`read_rival`).
    """
    path = Path(folder) / NETWORK_NAME
    if not path.is_file():
        raise InputError(str(folder), f"must hold a trained rival ({NETWORK_NAME})", "none", "Train it first.")
    return read_rival(path)


def detached(found: TrainedRival) -> TrainedRival:
    """The same without the folder that it was read from."""
    return replace(found, folder=None)


def _empty(rival: Rival, said: Any, weights: int) -> RivalNetwork:
    """The network of a layout that a file of so many weights says, with shapes in the places of arrays.

    TypeError or ValueError if it cannot be.
    """
    if not isinstance(said, dict):
        raise TypeError(f"a layout of {said!r}")
    for key, least in (("colours", 1), ("width", _LEAST_WEIGHTS)):
        # It is made before anything else, and must not be much larger than the file.
        if type(said.get(key)) is not int or said[key] < 1 or least * said[key] ** 2 > weights:
            raise ValueError(f"{key} is {said.get(key)!r} for {weights} weights")
    return eqx.filter_eval_shape(rival.make, seed=0, **said)


@eqx.filter_jit
def _answered(network: RivalNetwork, picture: Array, mask: Array) -> Array:
    return network(picture, mask).picture
