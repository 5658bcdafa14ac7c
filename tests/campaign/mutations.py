"""Damaged and hostile files: any file that a command reads is changed, and the whole command is run on it."""

import hashlib
import os
import unicodedata
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.campaign.field import Family, Field, said_badly
from tests.campaign.ground import COMMANDS, Ground, in_turn, leftovers
from tests.campaign.mutate import changed
from tests.campaign.process import content

# Of a process that is refused, and of one that is not and computes; what the imports take is not counted.
REFUSED_S, DONE_S, MOST_BYTES = 5.0, 60.0, 1 << 30
# Its bytes are named in the manifest that the reader trusts.
_SEALED = ("run/level_map.npz", "run/height.exr", "run/height_continuous.exr")


def inputs(ground: Ground, name: str) -> list[str]:
    """Files that a command reads: what it needs, and what it finds in a folder where it was finished."""
    folder, end = ground.whole(name)
    return [file for file in end.read if (folder / file).is_file()]


def _cases(ground: Ground, seed: int, count: int) -> Iterator[str]:
    rng = np.random.default_rng(seed)
    for name in in_turn(tuple(COMMANDS), seed, count):
        yield f"{name}:{rng.integers(2**32)}"


def _problems(field: Field, case: str) -> list[str]:
    name, number = case.split(":")
    rng, command = np.random.default_rng(int(number)), COMMANDS[name]
    files = inputs(field.ground, name)
    # By kind, so that a kind with many files does not hide the others.
    kinds = sorted({Path(file).suffix for file in files})
    kind = kinds[rng.integers(len(kinds))]
    alike = [file for file in files if Path(file).suffix == kind]
    file = alike[rng.integers(len(alike))]
    work = field.ground.lay(name, field.place)
    path = work / file
    if not path.exists():  # a result: the command is repeated where it was finished
        field.ground.lay_whole(name, field.place)
    sealed = rng.random() < 0.5
    done = _change(rng, work, path, sealed)
    before = content(work)
    end = field.worker.run(command.arguments, field.place, limit_s=DONE_S)
    about = f"{file}: {done}{', its digests made to fit' if sealed else ''}"
    problems = said_badly(end)
    if end.peak_bytes > MOST_BYTES:
        problems.append(f"it takes {end.peak_bytes / 1e9:.1f} GB: {end}")
    if end.code in (1, 2) and end.cpu_s > REFUSED_S:
        problems.append(f"it is refused after {end.cpu_s:.1f} processor seconds: {end}")
    found = content(work)
    own = (f"{command.writes}/", f"{command.writes}") if command.writes else ()
    lost = [each for each, data in before.items() if found.get(each) != data and not each.startswith(own or "\0")]
    if lost:
        problems.append(f"lost or changed: {lost[:5]}")
    if end.code is not None and end.code >= 0 and (left := leftovers(set(found) - set(before))):
        problems.append(f"left behind: {left[:5]}")
    if end.code == 0 and not sealed and done != "nothing" and _is_sealed(name, file):
        problems.append(f"changed bytes pass: {end}")
    # A folder in the place of a height map is taken for a run.
    if end.code == 2 and done != "a folder" and not _named(end.err, file):
        problems.append(f"it does not name the file or a folder of it: {end}")
    return [f"{about}: {problem}" for problem in problems]


def _is_sealed(name: str, file: str) -> bool:
    return file in _SEALED or (name == "verify" and not file.endswith("manifest.json"))


def _named(said: str, file: str) -> bool:
    last = "".join(sign for sign in said if unicodedata.category(sign) != "Cc")
    parts = [Path(file).name, *(parent.name for parent in Path(file).parents)]
    return any(part and part in last for part in parts)


def _change(rng: np.random.Generator, work: Path, path: Path, sealed: bool) -> str:
    """Change a file in place; returns what was done."""
    data = path.read_bytes()
    odd = int(rng.integers(60))
    if odd < 5:
        path.unlink()
        if odd == 1:
            path.mkdir()
        elif odd == 2:
            os.mkfifo(path)
        elif odd == 3:
            path.symlink_to("/nowhere")
        elif odd == 4:
            path.symlink_to(path.name)
        return ("missing", "a folder", "a pipe", "a link to nowhere", "a link to itself")[odd]
    others = sorted(other for other in work.rglob("*") if other.is_file() and other != path)
    if odd == 5 and others:
        new, done = others[rng.integers(len(others))].read_bytes(), "another file's content"
    else:
        new, done = changed(rng, path.name, data)
    path.write_bytes(new)
    if new == data:
        return "nothing"
    if sealed:
        old, fits = (hashlib.sha256(bytes_).hexdigest().encode() for bytes_ in (data, new))
        for manifest in work.rglob("*.json"):
            if manifest.is_file() and manifest != path and old in (text := manifest.read_bytes()):
                manifest.write_bytes(text.replace(old, fits))
    return done


MUTATIONS = Family("changed files of every kind through each command", 400, _cases, _problems)
