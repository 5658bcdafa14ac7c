"""Pictures that are never trained on, and what the network makes of them.

Without a folder of their own they are the last of the training folder in an order shuffled by the seed; whatever has
the same bytes as one of them under another name is not trained on either. (Neighbouring frames of a film are almost the
same picture: hold out another film, in a folder of its own.) Their scenes are the same at every look: one crop, one
obstruction and one noise each. Another seed of the training deals the same obstructions out to other pictures.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.capture.from_spec import channels_from_rgb
from doedesign.capture.images import picture_files
from doedesign.capture.scenes import Batch, SceneData
from fab.errors import InputError
from fab.files import explain_os_error, sha256_file
from sim.camera import Camera
from sim.light import srgb_from_linear

SCENE_SEED = 0

_ORDER = 1  # apart from the epochs' orders


class Split(NamedTuple):
    """Two sets of picture files without a picture in common.

    Attributes:
        training: pictures to train on, in the order of names.
        held_out: pictures that are never trained on.
    """

    training: tuple[Path, ...]
    held_out: tuple[Path, ...]


def split_pictures(images: Path | None, validation: Path | None, count: int, seed: int) -> Split:
    """Find pictures to train on, and some to keep away from training.

    Args:
        images: folder of pictures; scikit-image's samples if None.
        validation: folder to take the held-out ones from; the same folder if None.
        count: number to hold out; all of the folder of their own if it has fewer.
        seed: seed of the order that they are the last of.

    Raises:
        InputError: a folder that cannot be used, or nothing left to train on.
    """
    files = picture_files(images)
    pool = files if validation is None else picture_files(validation)
    where = str(images or "scikit-image's pictures")
    if validation is None and len(files) <= count:
        cure = f"Set train.validation below {len(files)}, or give the pictures to hold out a folder of their own."
        raise InputError(where, f"must hold more than the {count} pictures of train.validation", len(files), cure)
    order = np.random.default_rng((seed, _ORDER)).permutation(len(pool))[-count:]
    held_out = tuple(pool[k] for k in order)
    training = _without(files, held_out if validation is None else pool)
    if not training:
        cure = "Hold out other pictures than those to train on."
        raise InputError(where, "a picture must be left to train on", "only those held out", cure)
    return Split(training, held_out)


def _without(files: Sequence[Path], held_out: Sequence[Path]) -> tuple[Path, ...]:
    """Files whose content is not that of one held out."""
    try:
        sizes = {path.stat().st_size for path in held_out}
        digests = {sha256_file(path) for path in held_out}
        return tuple(p for p in files if p.stat().st_size not in sizes or sha256_file(p) not in digests)
    except OSError as error:
        raise explain_os_error(error, str(error.filename)) from error


class ValidationSample(NamedTuple):
    """One held-out scene, in the camera's colours and display values, 0 to 1.

    Attributes:
        name: name of the picture's file.
        shown: `[c, y, x]` pictures by name: "capture", "reconstruction", others.
        scene: `[c, y, x]` what was to be seen.
        mask: `[y, x]` share of each direction that is blocked.
    """

    name: str
    shown: dict[str, Float[np.ndarray, "c y x"]]
    scene: Float[np.ndarray, "c y x"]
    mask: Float[np.ndarray, "y x"]


Show = Callable[[Batch], Mapping[str, Float[np.ndarray, "c y x"]]]


def looks(data: SceneData, count: int, camera: Camera, show: Show) -> Iterator[ValidationSample]:
    """Look at held-out scenes one by one.

    Args:
        data: held-out scenes, one to a batch.
        count: how many.
        camera: the camera, for its colours.
        show: batch -> pictures by name in display values.
    """
    with data.batches(stop=count) as batches:
        for batch in batches:
            shown = {name: np.clip(image, 0, 1) for name, image in show(batch).items()}
            name, scene = batch.items[0]
            clean = srgb_from_linear(channels_from_rgb(np.asarray(scene.background), camera))
            yield ValidationSample(name, shown, clean, np.asarray(scene.obstructions[0].mask))
