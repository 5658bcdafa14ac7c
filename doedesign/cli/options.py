"""Options that several commands share, and how their values are read."""

from collections.abc import Callable, Collection, Mapping
from inspect import signature
from typing import Annotated

from cyclopts import Parameter

from fab.errors import InputError

Overrides = Annotated[
    tuple[str, ...],
    Parameter(name="--set", negative="", show_default=False, help="Change one value of the spec, KEY=VALUE."),
]
Flag = Annotated[bool, Parameter(negative="", show_default=False)]
AsJson = Annotated[bool, Parameter(name="--json", negative="", show_default=False, help="Print JSON instead of paths.")]
Texts = Annotated[tuple[str, ...], Parameter(negative="", show_default=False)]


def length_of(option: str, text: str | None) -> float | None:
    """A length in metres, or None where none was given."""
    if text is None:
        return None
    from fab.units import parse_length

    try:
        return parse_length(text)
    except ValueError as error:
        raise InputError(option, "must be a length with a unit", f'"{text}"', 'For example "75 nm".') from error


def refuse_options(command: Callable[..., object], given: Mapping[str, object], rule: str, cure: str) -> None:
    """Refuse options that would do nothing.

    Args:
        command: the function of the command.
        given: their values by the names of its arguments; one that has its default was not given.
        rule: why they do nothing.
        cure: what to do about it.

    Raises:
        InputError: one of them was given.
    """
    usual = signature(command).parameters
    for name, value in given.items():
        if value != usual[name].default:
            word = name.rstrip("_").replace("_", "-")
            raise InputError(f"--no-{word}" if value is False else f"--{word}", rule, _told(value), cure)


def _told(value: object) -> str:
    """A value of an option in words; of a flag that it is there."""
    if isinstance(value, bool):
        return "the option"
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


# What the library calls in its own words is an option here.
_PLACES = {
    "captures": "CAPTURE",
    "far_m": "--far-depth",
    "near_m": "--near-depth",
    "overrides": "--set",
    "step_m": "--step",
    "depths_m": "--depths",
    "formats: mesh_cells": "--mesh-cells",
    "etch_depths_m": "--etch-depths",
    "pitch_m": "--pitch",
    "probe_m": "--probe",
    "pixel_m": "--pixel",
    "scale_m": "--scale",
    "aperture_m": "--aperture",
    "tile, overlap": "--tile, --overlap",
    "propagation": "optics.propagation",
    "camera.mapping": "optics.mapping",
    "camera.doe_distance": "optics.doe_distance",
    "mapping": "optics.mapping",
    "distortion": "optics.distortion",
    "camera.window": "sensor.window",
    "sensor.pattern": "sensor.bayer",
}
_OPTIONS = {
    "overrides: ": "--set: ",
    "Give the pitch of a pixel": 'Add --pitch "1.85 um" with the pitch of a pixel',
    "Give the scale": "Add --scale",
    "Give `levels`.": "Add --levels 16.",
    "Give `step`.": 'Add --step "75 nm".',
    "another output folder": "another --out",
    "have the level map repaired": "take --on-violation fix",
    "take the mesh alone": "take the mesh alone (--mesh-patch)",
    "or mesh a window.": "or mesh a window (--mesh-patch).",
    "also `variation`": "also --variation",
    "Train one (`doedesign.train`)": "Train one with doedesign train RUN --images DIR",
    "or its masks.": "or its masks (--order).",
    "Give `obstruction`,": "Add [obstruction] to the spec, or give --obstruction,",
    "Give `occlusion`:": "Add occlusion to [scene], or give --occlusion:",
    "Give the function by `objectives`, if you trust it.": "Add --allow-code, if you trust the spec.",
    "give `overwrite`": "give --overwrite",
    "take plates at 1:1 by `one_to_one`": "take plates at 1:1 by --one-to-one",
    "leave `images` out": "leave --images out",
    "Choose another folder": "Choose another --out",
    "take fewer workers.": "take fewer workers (--workers).",
    "or evaluate it alone.": "or see what it is with --draw.",
    "Give limits, such as": "Add [[limit]] to the spec, or --limit, such as",
    'Give a process with errors, such as "contact_aligner".': (
        'Write stock = "contact_aligner" in [process], or give --process contact_aligner.'
    ),
    "add a zero layer of chrome marks": "add a zero layer of chrome marks (`[wafer] zero_layer = true`)",
    "into a folder of their own: doedesign masks RUN.": (
        "into a folder of their own: doedesign masks RUN --out masks/OTHER."
    ),
}


def in_options(error: InputError, options: Collection[str] = (), given: Collection[str] = ()) -> str:
    """Message of an error with command-line options in place of the library's arguments.

    Args:
        error: the error.
        options: names of arguments that are options.
        given: words of the command line; one of them is a path, whatever option has its name.
    """
    text = str(error)
    # Where values have rules of a spec, its key follows the argument.
    where = "depths_m" if error.where.startswith("depths_m: ") else error.where
    if where not in given and (where in _PLACES or where in options):
        text = _PLACES.get(where, f"--{where.replace('_', '-')}") + text.removeprefix(where)
    return words_in_options(text)


def words_in_options(text: str) -> str:
    """Words of the library with command-line options and keys of a spec in place of its arguments.

    Args:
        text: a message.
    """
    for words, option in _OPTIONS.items():
        text = text.replace(words, option)
    return text
