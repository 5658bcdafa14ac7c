"""`doedesign tolerance --draw`: one draw of a study in words."""

import json
import math
from pathlib import Path
from typing import Any

from doedesign.spec import variation_to_toml
from doedesign.tolerancing.analysis import QUANTITIES
from doedesign.tolerancing.pool import OutOfModel
from doedesign.tolerancing.studies import study
from fab.units import format_length


def one_draw(run: Path, key: str, as_json: bool, **settings: Any) -> str:
    """One draw of a study: its errors as TOML that other commands read, and its metrics.

    Args:
        run: folder of a finished run.
        key: the draw, such as "normal/17".
        as_json: write JSON instead, SI units.
        settings: of `doedesign.tolerancing.study`; draws depend on the seed and the process alone.

    Raises:
        InputError: no such draw, or something that cannot be used.
    """
    asked = study(run, quiet=True, **{**settings, "workers": 1})
    variation = asked.variation(key)
    asked.sample([key])
    kept = asked.journal.finished[key]
    rows = [] if isinstance(kept, OutOfModel) else kept
    if as_json:
        return json.dumps({"key": key, "variation": vars(variation), "rows": rows}, sort_keys=True)
    lines = [f"draw {key} of {asked.design.name}, seed {asked.seed}"]
    for row in rows:
        found = {name: math.inf if row[name] is None else row[name] for name in QUANTITIES if name in row}
        place = "infinity" if row["depth_m"] is None else format_length(row["depth_m"])
        numbers = ", ".join(f"{name} {value:.6g}" for name, value in found.items())
        lines.append(f"{row['colour']} at {place}: {numbers}")
    return variation_to_toml(variation, lines)
