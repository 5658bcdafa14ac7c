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
        draws: plates that a step looks at; each pair has errors of opposite sign.
        measure: risk that the steps minimise, of the losses of these plates: their "mean"; "cvar", the mean of the
            worst; or "yield", the share of plates whose loss exceeds `limit`, with a soft edge.
        share: of the plates, that "cvar" looks at.
        limit: loss of a good plate, for "yield".
        walls: cost of a wall of a mask, as a multiple of the light that goes astray beside it where the mask is off by
            the process's errors of its edges, as if its neighbours stayed.
        learning_rate: step size of Adam, in radians of phase at the design wavelength.
    """

    steps: Steps = 40
    draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 4
    measure: Literal["mean", "cvar", "yield"] = "mean"
    share: Annotated[float, Field(strict=True, gt=0, le=1)] = 0.5
    limit: Positive | None = optional()
    walls: NotNegative = 0.3
    learning_rate: Positive = 0.1


def robust_problems(spec: "Spec") -> Iterator[InputError]:
    """Return every rule that a robust design breaks."""
    robust, optimize = spec.robust, spec.optimize
    if robust is None:
        return
    if robust.measure == "yield" and robust.limit is None:
        cure = "For example limit = 1.5; history.jsonl has the losses of a run."
        yield InputError("robust.limit", '"yield" needs the loss of a good plate', "nothing", cure)
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
