"""Rules that join several values of the process, and the process with the rest of a spec.

A broken rule is an `InputError` whose `where` is the key; a doubt is a sentence. Neither changes the spec.
"""

import math
from collections import Counter
from collections.abc import Iterator

from doedesign.spec.models import Spec
from doedesign.spec.process import ProcessSpec
from doedesign.spec.table import toml_key
from doedesign.spec.values import nearest
from doedesign.spec.variation import VariationFile
from fab.errors import InputError
from fab.levels import Levels
from fab.units import format_length

__all__ = [
    "limit_problems",
    "limit_warnings",
    "printing_warning",
    "process_problems",
    "variation_problems",
    "wafer_problem",
]

_SET = "process.etch_depths"
_DEPTHS_OF = {"ring_to_disc": "near depth", "far_spot": "far depth"}  # all others exist at every depth


def process_problems(process: ProcessSpec) -> Iterator[InputError]:
    """Yield every rule between the values of a process that it breaks.

    Args:
        process: a process whose single values are valid.
    """
    yield from _depths(process)
    yield from _etches(process)
    yield from _one_value_per_mask(process)
    defects = process.filled().defects
    missed, doubled = defects.missed or 0.0, defects.doubled or 0.0
    if missed + doubled > 1:
        got = f"{missed:g} + {doubled:g}"
        yield InputError(
            "process.defects.doubled", "missed and doubled must sum to at most 1", got, "Lower one of them."
        )


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


def _depths(process: ProcessSpec) -> Iterator[InputError]:
    """Yield what is wrong with the set of depths."""
    if not isinstance(process.etch_depths_m, tuple):
        return
    try:
        Levels(process.levels, process.level_step_m, process.etch_depths_m)
    except InputError as error:
        yield InputError(_SET, error.rule, str(error.got), error.cure)


def _one_value_per_mask(process: ProcessSpec) -> Iterator[InputError]:
    for name, spread in process.errors.given().items():
        for part in ("mean", "sigma"):
            values = getattr(spread, part)
            if isinstance(values, tuple) and len(values) != process.masks:
                yield InputError(
                    f"process.errors.{toml_key(name)}.{part}",
                    f"must have one entry per mask, {process.masks} for {process.levels} levels",
                    f"a list of {len(values)}",
                    "Add or remove entries, or give one value for all masks.",
                )


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


def wafer_problem(spec: Spec) -> Iterator[InputError]:
    """Yield the problem of a DOE that does not fit on the wafer."""
    process = spec.process.filled()
    die_m, radius_m = process.die_m or (0.0, 0.0), process.wafer_radius_m or math.inf
    reach_m = math.hypot(*die_m) + spec.doe.aperture_m / 2
    if reach_m > radius_m:
        yield InputError(
            "process.die",
            f"the DOE must lie on the wafer of radius {format_length(radius_m)}",
            f"a DOE that reaches {format_length(float(f'{reach_m:.4g}'))} from its middle",
            "Move the die inward or choose a larger process.wafer_radius.",
        )


def limit_problems(spec: Spec) -> Iterator[InputError]:
    """Yield every limit of a colour that the spec does not have."""
    colours = [colour.name for colour in spec.optics.colours]
    for index, limit in enumerate(spec.limits):
        if limit.colour is not None and limit.colour not in colours:
            rule, cure = "must be a colour channel of the spec", nearest(limit.colour, colours)
            yield InputError(f"limit[{index}].colour", rule, f'"{limit.colour}"', cure)


def limit_warnings(spec: Spec) -> Iterator[str]:
    """Warn of limits that every plate obeys, for there is nothing at the depths of the scene that they apply to."""
    near, far = spec.scene.near_m, spec.scene.far_m
    for index, limit in enumerate(spec.limits):
        where, depths = _DEPTHS_OF.get(limit.quantity, "depth"), (*near, *far)
        if limit.quantity in _DEPTHS_OF:
            depths = near if where == "near depth" else far
        at = "" if limit.depth_m is None else f" at {_depth_text(limit.depth_m)}"
        if limit.depth_m not in (None, *depths) or not depths:
            listed = ", ".join(_depth_text(depth_m) for depth_m in depths) or "none"
            yield f"limit[{index}]: {limit.quantity}{at} limits nothing; the scene's {where}s are: {listed}."


def _depth_text(depth_m: float) -> str:
    return "inf" if math.isinf(depth_m) else format_length(depth_m)


def printing_warning(spec: Spec) -> Iterator[str]:
    """Warn of cells finer than what the lithography prints: bit 0 may have lines of a single cell."""
    process, pitch_m = spec.process.filled(), spec.doe.pitch_m
    for key, smallest_m, what in (
        ("minimum_line", process.minimum_line_m, "lines"),
        ("minimum_space", process.minimum_space_m, "gaps"),
    ):
        if smallest_m and pitch_m < smallest_m * (1 - 1e-9):
            yield (
                f"process.{key}: cells of {format_length(pitch_m)} are finer than the {what} of "
                f"{format_length(smallest_m)} that the process prints, so single cells of the finest mask (bit 0) are "
                "lost. Choose a coarser pitch, a finer process, or accept that they will not be there."
            )
