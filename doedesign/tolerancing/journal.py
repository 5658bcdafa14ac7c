"""Lines of finished draws in the journal of a study (`doedesign.runs.journal`)."""

import math
from collections.abc import Mapping
from typing import Any

from doedesign.tolerancing.pool import OutOfModel, Rows
from sim.metrics import METRICS, without_infinities


class DrawLines:
    """The rows of a draw, or why it is beyond the model. An infinite number is kept as None, for JSON has none."""

    file = "draws.jsonl"
    noun = "draw"

    def encode(self, key: str, found: Rows | OutOfModel) -> dict[str, Any]:
        """The line of one draw."""
        if isinstance(found, OutOfModel):
            return {"key": key, "beyond": found.reason}
        return {"key": key, "rows": without_infinities(found)}

    def decode(self, line: Mapping[str, Any]) -> tuple[str, Rows | OutOfModel]:
        """The key of a draw and its result, or a ValueError, KeyError or TypeError for something else."""
        key = line["key"]
        if "beyond" in line:
            reason = line["beyond"]
            if not (isinstance(key, str) and isinstance(reason, str)):
                raise ValueError("a key and a reason must be text")
            return key, OutOfModel(reason)
        rows = [dict(row) for row in line["rows"]]
        for row in rows:
            numbers = [row["depth_m"], *(value for name, value in row.items() if name in METRICS)]
            if not isinstance(row["colour"], str) or not all(map(_is_number, numbers)):
                raise ValueError("a row must hold a colour, a depth and numbers")
        if not isinstance(key, str) or not rows:
            raise ValueError("a draw must have a key and rows")
        return key, rows


def _is_number(value: Any) -> bool:
    """Whether a value of JSON is a finite number, or None, which stands for an infinite one."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value))
