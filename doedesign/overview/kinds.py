"""Kinds of folders of results, by what their records say of themselves."""

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.runs.folder import FORMAT, RELEASED, TRAINING
from doedesign.runs.journal import STUDY_NAME
from fab.errors import InputError
from fab.files import MANIFEST_NAME, read_json

_KINDS = {
    FORMAT: "run",
    TRAINING: "training",
    RELEASED: "released model",
    "doedesign fine-tuning 1": "fine-tuning",
    "doedesign mask order 2": "order",
    "doedesign psf 1": "PSFs",
    "doedesign reconstructions 1": "reconstructions",
    "doedesign rival training 1": "training of a rival",
}
TABLE_NAME = "table.json"  # of an evaluation
_NAMED = re.compile(r"doedesign (\S.*) \d+")
_MANY = 1 << 20


class Record(NamedTuple):
    """Record of a folder.

    Attributes:
        kind: what the folder holds, such as "run" or "order".
        name: name of the design, as far as the record says.
        found: the record itself; empty of a study that is not finished.
        finished: whether it is the record of a finished piece of work.
    """

    kind: str
    name: str
    found: dict[str, Any]
    finished: bool


def has_record(folder: Path) -> bool:
    """Whether a folder is one of results, finished or not."""
    # Of a folder that must not be read, too, nobody knows of a record.
    return any(os.path.isfile(folder / name) for name in (MANIFEST_NAME, STUDY_NAME))


def record_of(folder: Path) -> Record:
    """Read what a folder says of itself.

    Args:
        folder: the folder.

    Raises:
        InputError: no folder of results, or a record that cannot be read.
    """
    if (folder / MANIFEST_NAME).is_file():
        found = read_json(folder / MANIFEST_NAME)
        kind = _kind(str(found.get("format")))
        if kind is None:
            rule = "must be the manifest of results of this program"
            raise InputError(str(folder / MANIFEST_NAME), rule, f"format {found.get('format')!r}", "Remove the folder.")
        name = found.get("name") or found.get("run") or folder.name
        return Record(kind, str(name), found, found.get("state", "done") == "done")
    if (folder / STUDY_NAME).is_file():
        study = read_json(folder / STUDY_NAME)
        kind = _kind(str(study.get("format"))) or "study"
        # An evaluation has no manifest; its table is written last.
        done = kind == "evaluation" and (folder / TABLE_NAME).is_file()
        design = study.get("design")
        name = design.get("name") if isinstance(design, dict) else design  # a study of plates tells more of it
        return Record(kind, str(name or folder.name), study, done)
    if not folder.is_dir():
        got = "a file" if folder.exists() else "nothing"
        raise InputError(str(folder), "must be a folder of results", got, "Check the path.")
    cure = "Give a run folder, an order, or a folder inside one."
    raise InputError(str(folder), f"a folder of results has a {MANIFEST_NAME}", "none", cure)


def _kind(text: str) -> str | None:
    named = _NAMED.fullmatch(text)
    return _KINDS.get(text) or (named[1] if named else None)
