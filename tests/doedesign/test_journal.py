"""Journals of finished items: lines that no journal wrote."""

import json
from pathlib import Path
from typing import Any

import pytest

from doedesign.evaluation.scoring import ScoreLines
from doedesign.runs.journal import STUDY_NAME, Journal
from doedesign.tolerancing.journal import DrawLines
from fab.errors import InputError

BEYOND = 10**400  # JSON has it, no float holds it


@pytest.mark.parametrize(
    ("lines", "line"),
    [
        (ScoreLines(), {"key": "a", "scores": [1]}),
        (ScoreLines(), {"key": "a", "scores": {"all": 1}}),
        (ScoreLines(), {"key": "a", "scores": {"all": {"psnr": BEYOND}}}),
        (DrawLines(), {"key": "normal/0", "rows": [{"colour": "green", "depth_m": BEYOND}]}),
    ],
)
def test_a_line_of_another_shape_is_named(tmp_path: Path, lines: Any, line: Any):
    """Earlier versions wrote no digest, so that one may be missing."""
    (tmp_path / STUDY_NAME).write_text('{"pairs": 1}')
    (tmp_path / lines.file).write_text(json.dumps(line) + "\n")
    with (
        pytest.raises(InputError, match=rf"{lines.file}, line 1: must be one finished {lines.noun}.*Remove"),
        Journal(tmp_path, {"pairs": 1}, lines).open(),
    ):
        pytest.fail("opened")
