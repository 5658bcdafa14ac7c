"""The mask sets that are released with the project: whole, and as small as a worked example may be."""

from pathlib import Path

import pytest

from fab.order.verify import verify

MASKS = Path(__file__).parents[2] / "masks"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["example"])
def test_a_released_set_is_whole(name):
    report = verify(MASKS / name)
    assert report.passed, report.differences
    assert sum(path.stat().st_size for path in (MASKS / name).iterdir()) < 10e6
    assert list((MASKS / name).glob("*_RUNSHEET.html"))
