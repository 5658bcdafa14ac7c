"""Draws of a study as items of work, for the workers of `doedesign.runtime.pool` and `doedesign.runtime.cluster`."""

import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from fab.errors import InputError
from fab.process import Process, Variation

if TYPE_CHECKING:
    from doedesign.design.design import Design
    from sim.psf_bank import PsfBank

Rows = list[dict[str, Any]]
Evaluate = Callable[["Design", Process, Variation], Any]
"""Evaluation of a draw; a study needs `Rows`."""

BYTES_PER_CELL = 350  # measured: what a prediction holds per DOE cell at its peak


class OutOfModel(NamedTuple):
    """Result of a draw whose errors are larger than the evaluation can describe."""

    reason: str


@dataclass(frozen=True, eq=False)
class DrawModel:
    """Model of a study: how a draw is evaluated, of which design and process; its copies in workers share a token."""

    evaluate: Evaluate
    design: "Design"
    process: Process
    noun: ClassVar[str] = "draw"
    token: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __call__(self, variation: Variation) -> Any:
        """Evaluate one draw; `OutOfModel` where the evaluation raises `InputError`."""
        try:
            return self.evaluate(self.design, self.process, variation)
        except InputError as error:
            return OutOfModel(f"{error.where}: {error.rule}, but got {error.got}")


def predicted_rows(design: "Design", process: Process, variation: Variation) -> Rows:
    """Metrics of one draw, a row per colour and depth (`doedesign.prediction`)."""
    from doedesign.prediction import predict

    return predict(design, process, variation).rows


def predicted_bank(design: "Design", process: Process, variation: Variation) -> "PsfBank":
    """PSFs of one draw."""
    from doedesign.prediction import predict

    return predict(design, process, variation).bank
