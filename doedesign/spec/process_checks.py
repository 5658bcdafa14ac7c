"""Rules that join several values of a process, or of the errors of one DOE; see `doedesign.spec.checks`."""

import math
from collections import Counter
from collections.abc import Iterator

from doedesign.spec.process import ProcessSpec
from doedesign.spec.values.table import toml_key
from doedesign.spec.variation import VariationFile
from fab.errors import InputError
from fab.levels import Levels
from fab.units import format_length

_SET = "process.etch_depths"


def process_problems(process: ProcessSpec) -> Iterator[InputError]:
    """Yield every rule between values, each of them valid by itself, that a process breaks."""
    if isinstance(process.etch_depths_m, tuple):
        try:
            Levels(process.levels, process.level_step_m, process.etch_depths_m)
        except InputError as error:
            yield InputError(_SET, error.rule, str(error.got), error.cure)
    yield from _etches(process)
    yield from _one_value_per_mask(process)
    defects = process.filled().defects
    missed, doubled = defects.missed or 0.0, defects.doubled or 0.0
    if missed + doubled > 1:
        key, rule = "process.defects.doubled", "missed and doubled must sum to at most 1"
        yield InputError(key, rule, f"{missed:g} + {doubled:g}", "Lower one of them.")


def _etches(process: ProcessSpec) -> Iterator[InputError]:
    masks = [etch.mask for etch in process.etches]
    if masks and sorted(masks) != list(range(process.masks)):
        counts = Counter(masks)
        wrong = [f"mask {m}: {counts[m]} times" for m in sorted({*masks, *range(process.masks)}) if counts[m] != 1]
        beyond = [f"mask {m}" for m in counts if m >= process.masks and counts[m] == 1]
        rule = f"every mask of {process.levels} levels, 0 to {process.masks - 1}, must be etched once"
        yield InputError("process.etches", rule, ", ".join(wrong + beyond), "List each mask once.")
    for index, etch in enumerate(process.etches):
        if etch.depth_m is None or etch.mask >= process.masks:
            continue
        key, got = f"process.etches[{index}].depth", format_length(etch.depth_m)
        if process.chooses_depths:
            rule = f"must not be given where {_SET} is to be chosen"
            yield InputError(key, rule, got, f"Leave it out, or give all depths as {_SET}.")
            continue
        due_m = process.depth_m(etch.mask)
        # A part in a million is far below what an etch holds, and above what decimals lose.
        if not math.isclose(etch.depth_m, due_m, rel_tol=1e-6):
            what = f"2^{etch.mask} level steps" if process.etch_depths_m is None else f"as deep as in {_SET}"
            rule = f"mask {etch.mask} must etch {what}, {format_length(due_m)}"
            yield InputError(key, rule, got, "Correct the depth, or leave it out.")


def _one_value_per_mask(process: ProcessSpec) -> Iterator[InputError]:
    for name, spread in process.errors.given().items():
        for part in ("mean", "sigma"):
            values = getattr(spread, part)
            if isinstance(values, tuple) and len(values) != process.masks:
                key = f"process.errors.{toml_key(name)}.{part}"
                rule = f"must have one entry per mask, {process.masks} for {process.levels} levels"
                cure = "Add or remove entries, or give one value for all masks."
                yield InputError(key, rule, f"a list of {len(values)}", cure)


def variation_problems(file: VariationFile) -> Iterator[InputError]:
    """Yield every list of a variation that disagrees with the others about the number of masks."""
    said = file.variation.given()
    lists = {f"variation.{toml_key(name)}": value for name, value in said.items() if isinstance(value, tuple)}
    if not lists:
        return
    first, masks = next((key, len(value)) for key, value in lists.items())
    for key, value in lists.items():
        if len(value) != masks:
            rule = f"must have one entry per mask, {masks} as in {first}"
            yield InputError(key, rule, f"a list of {len(value)}", "Add or remove entries.")
    for index, particle in enumerate(file.particles):
        if particle.mask >= masks:
            rule = f"must be one of the {masks} masks of {first}, counted from 0"
            yield InputError(f"particle[{index}].mask", rule, str(particle.mask), "Correct the mask.")
