"""Names of options in messages: the library names its parameters, the command line its flags."""

from collections.abc import Iterator
from contextlib import contextmanager

from fab.errors import InputError

OPTIONS = {
    "captures": "CAPTURE",
    "count": "--count",
    "devices": "--devices",
    "far_m": "--far-depth",
    "images": "--images",
    "kind": "--kind",
    "learning_rate": "--learning-rate",
    "lpips_weights": "--lpips-weights",
    "near_m": "--near-depth",
    "obstruction": "--obstruction",
    "occlusion": "--occlusion",
    "psf": "--psf",
    "seed": "--seed",
    "size": "--size",
    "steps": "--steps",
    "tile, overlap": "--tile, --overlap",
    "validation": "--validation",
}


@contextmanager
def named_as_options() -> Iterator[None]:
    """Name options where an `InputError` of this block names parameters: as its place, or in backticks."""
    try:
        yield
    except InputError as error:
        where, texts = OPTIONS.get(error.where, error.where), [error.rule, error.cure]
        for name, option in OPTIONS.items():
            texts = [text.replace(f"`{name}`", option) for text in texts]
        raise InputError(where, texts[0], error.got, texts[1]) from error
