"""What holds for every test: types are checked as the code runs, and randomness is seeded.

Single precision stays on, as in the product, so a test sees the rounding a user sees.
"""

from pathlib import Path

import hypothesis
import numpy as np
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).parent.parent
WITH_ARRAYS = [path for path in (ROOT / "doedesign").rglob("*.py") if "jaxtyping" in path.read_text("utf-8")]

# Before any test imports them: from here on the annotations of all modules with arrays are checked at every call,
# shapes included. (The specs are left to pydantic.) As everywhere in Python, an int may stand for a float.
install_import_hook(
    ["sim", *(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in WITH_ARRAYS)],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

# The same examples in every run, and no clock: a busy machine must not turn a right answer into a failure.
hypothesis.settings.register_profile(
    "repeatable",
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that starts the same in every test."""
    return np.random.default_rng(20260)
