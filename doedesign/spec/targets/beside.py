"""Rules for the tables beside one that says where light should go."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from doedesign.spec.values.table import toml_key
from fab.errors import InputError
from fab.units import format_length

if TYPE_CHECKING:
    from doedesign.spec.models import Spec

# Keys of [optimize] that spots, areas and foci decide themselves.
_OWN = (
    "parametrization",
    "start",
    "start_options",
    "learning_rate",
    "quantisation",
    "sampling",
    "colours",
    "polish",
    "min_feature_m",
    "drawn_pixel_m",
)


def beside_problems(spec: "Spec", table: str) -> Iterator[InputError]:
    """Return every rule that the other tables of a spec break beside its `table`, "spots", "area" or "focus"."""
    if spec.objectives:
        yield InputError(table, "takes the place of objectives", "both", f"Remove [{table}] or every [[objective]].")
    if spec.scene.near_m or spec.scene.far_m != (math.inf,):
        rule, cure = (
            'the light is a collimated beam: far = ["inf"]',
            "Change it, or describe the beam by [illumination].",
        )
        yield InputError("scene.far", rule, "others", cure)
    if spec.optics.propagation != "far_field":
        rule, got = f"[{table}] chooses by itself how light is computed", f'"{spec.optics.propagation}"'
        yield InputError("optics.propagation", rule, got, "Leave it out.")
    if spec.process.chooses_depths:
        yield InputError("process.etch_depths", "the depths must be known", '"optimize"', "Give them, or leave it out.")
    for name in _OWN:
        got = getattr(spec.optimize, name)
        if got != type(spec.optimize).model_fields[name].default:
            rule = "spots, areas and foci have starts, steps and levels of their own"
            shown = f'"{got}"' if isinstance(got, str) else format_length(got) if name.endswith("_m") else got
            if name == "start_options":
                shown = ", ".join(got)
            yield InputError(f"optimize.{toml_key(name)}", rule, shown, "Leave it out.")


def in_focus(spec: "Spec") -> Iterator[InputError]:
    """Return the broken rules that spots lie in the focal plane of a lens or at angles; orders of a cell need none."""
    if spec.sensor.distance_m is not None and spec.spots is not None and spec.spots.period_m is None:
        cure = "Give optics.focal_length, sensor.pixel_angle for spots in angles, or spots.period for orders of a cell."
        yield InputError("sensor.distance", "spots lie in the focus of a lens", "a distance", cure)
    if spec.sensor.defocus_m and not spec.sensor.in_angles:
        got = format_length(spec.sensor.defocus_m)
        yield InputError("sensor.defocus", "spots lie in the focal plane", got, "Leave it out.")
