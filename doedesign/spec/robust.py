"""Robust design: the table [robust], steps that look at plates with the errors of the process."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from doedesign.spec.values import NotNegative, Positive, Steps
from doedesign.spec.values.table import SpecTable, optional
from fab.errors import InputError

if TYPE_CHECKING:
    from doedesign.spec.models import Spec


class RobustSpec(SpecTable, frozen=True):
    """Steps after those of [optimize], which look at plates as fabricated (`doedesign.design.robust`).

    Attributes:
        steps: number of these steps.
        draws: plates that some steps look at before others are drawn: for the "mean" one pair with errors of opposite
            sign in a step, of 40 plates at most, or else all of them.
        measure: risk that the steps minimise, of the losses of these plates: their "mean"; "cvar", the mean of the
            worst; or "yield", the share of plates whose loss exceeds `limit`, with a soft edge.
        share: share of the plates, the worst ones, that "cvar" looks at.
        limit: loss of a good plate, for "yield".
        walls: cost of a wall of a mask, as a multiple of the light that goes astray beside it where the mask is off by
            the process's errors of its edges, as if its neighbours stayed.
        depths: "listed" looks at the depths of the scene, "range" anywhere between the nearest and the farthest near
            and far ones, evenly in their inverse.
        field: "random" looks from a field angle of its own within the sensor at every step, "off" from the axis.
        learning_rate: step size of Adam, in radians of phase at the design wavelength.
    """

    steps: Steps = 120
    draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 4
    measure: Literal["mean", "cvar", "yield"] = "mean"
    share: Annotated[float, Field(strict=True, gt=0, le=1)] = 0.5
    limit: Positive | None = optional(example="1.5")
    walls: NotNegative = 0.3
    depths: Literal["listed", "range"] = "listed"
    field: Literal["off", "random"] = "off"
    learning_rate: Positive = 0.1


_MOST_SEEN = 40  # plates in a round of 20 steps, a pair in each (`doedesign.design.robust.ROUND`)


def robust_problems(spec: "Spec") -> Iterator[InputError]:
    """Return every rule that a robust design breaks."""
    robust, optimize = spec.robust, spec.optimize
    if robust is None:
        return
    if robust.measure == "yield" and robust.limit is None:
        cure = "For example limit = 1.5; history.jsonl has the losses of a run."
        yield InputError("robust.limit", '"yield" needs the loss of a good plate', "nothing", cure)
    if robust.measure == "mean" and robust.draws > _MOST_SEEN:
        rule = f'"mean" looks at {_MOST_SEEN} plates at most before others are drawn'
        yield InputError("robust.draws", rule, robust.draws, "Choose fewer, or another measure.")
    yield from _source_problems(spec, robust)
    if not spec.objectives:
        yield InputError("robust", "it minimises the loss of [[objective]]", "none", "Add one, or remove [robust].")
    refused = (
        ("optimize.polish", optimize.polish > 0, "moves of cells would undo it", "Leave polish out."),
        ("optimize.quantisation", optimize.quantisation == "none", "masks have levels", "Choose another."),
        ("optimize.parametrization", optimize.parametrization == "radial", "masks are of cells", 'Use "freeform".'),
        (
            "optics.light",
            spec.optics.light == "edges",
            "light is scalar",
            "Judge the result with edges, or leave it out.",
        ),
        ("optics.propagation", spec.optics.propagation == "fresnel", "it takes the far field", "Leave it out."),
        ("process.etch_depths", spec.process.chooses_depths, "the depths must be known", "Give them."),
    )
    for key, broken, rule, cure in refused:
        if broken:
            got = getattr(getattr(spec, key.partition(".")[0]), key.partition(".")[2].replace("depths", "depths_m"))
            yield InputError(key, f"in a robust design, {rule}", f"{got}", cure)


def _source_problems(spec: "Spec", robust: RobustSpec) -> Iterator[InputError]:
    """Rules of sources beside the listed depths and the axis."""
    if robust.depths == "range" and any(objective.compares for objective in spec.objectives):
        cure = 'Use depths = "listed", or objectives for all depths alike.'
        yield InputError("robust.depths", "no objective may compare depths or name some", '"range"', cure)
    if robust.field == "off":
        return
    sensor, optics = spec.sensor, spec.optics
    if sensor.resolution is None or sensor.pitch_m is None:
        cure = "Give sensor.resolution and sensor.pitch."
        yield InputError("robust.field", "field angles end where the sensor does", "no size of it", cure)
    if optics.mapping != "sine" or any(optics.distortion):
        cure = 'Set field = "off", or leave mapping and distortion out.'
        yield InputError("robust.field", "the lens images sines, without distortion", '"random"', cure)
    if spec.sensor.distance_m is not None:
        rule, cure = "without a lens, light from beside the axis makes other images", 'Set field = "off".'
        yield InputError("robust.field", rule, '"random"', cure)
    if spec.illumination is not None:
        yield InputError("robust.field", "a beam has its own direction", '"random"', 'Set field = "off".')
