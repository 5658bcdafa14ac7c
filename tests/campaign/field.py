"""What a case runs in: a process, folders of its own, and the ground; and what every case has to keep."""

import re
import shutil
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from tests.campaign.ground import COMMANDS, Ground, differences, leftovers
from tests.campaign.process import End, Worker, content
from tests.campaign.shim import Fault

_WARNING = re.compile(r"\w+Warning: ")


class Field:
    """Where cases run, one after another.

    Attributes:
        ground: what they begin with.
        worker: process that runs the commands.
        beside: a second one.
        place: folder of the case.
    """

    def __init__(self, ground: Ground, folder: Path) -> None:
        self.ground, self.place = ground, folder / "case"
        self.worker, self.beside = Worker(folder / "said"), Worker(folder / "said2")

    def stop(self) -> None:
        """End the processes."""
        self.worker.stop()
        self.beside.stop()


class Family(NamedTuple):
    """Cases of one kind.

    Attributes:
        about: what is done to the commands, in words.
        usual: how many cases are tried by default.
        cases: names of cases, for the ground, a seed and a count.
        problems: what is wrong after a case.
    """

    about: str
    usual: int
    cases: Callable[[Ground, int, int], Iterator[str]]
    problems: Callable[[Field, str], list[str]]


def said_badly(end: End) -> list[str]:
    """What no command may say or do, however it ends."""
    text = end.err + end.out
    found = []
    if end.code is None:
        found.append(f"it takes longer than {end.wall_s:.0f} s")
    elif end.code < 0:
        found.append(f"it dies of signal {-end.code}")
    elif end.code not in (0, 1, 2, 130):
        found.append(f"exit code {end.code}")
    if "Traceback (most recent call last)" in text:
        found.append("a traceback")
    if any(unicodedata.category(sign) in ("Cc", "Cs") and sign not in "\n\t\r" for sign in text):
        found.append("control characters in what it says")
    if _WARNING.search(text):
        found.append("a warning meant for programmers")
    if end.code in (1, 2) and "doedesign: " not in end.err:
        found.append("it fails without a message")
    return [f"{one}: {end}" for one in found]


def disturbed(
    field: Field, name: str, fault: Fault, codes: tuple[int, ...], kill_after_s: float | None = None, words: str = ""
) -> list[str]:
    """Disturb a command, and repeat it undisturbed: nothing is lost, and the bytes are those of a quiet run.

    Args:
        field: where.
        name: the command, a key of `COMMANDS`.
        fault: what happens to it.
        codes: how it may end; 0 only with everything that a quiet run writes.
        kill_after_s: when the process is killed from outside.
        words: what it must say unless it ends with 0.
    """
    command, ground, place = COMMANDS[name], field.ground, field.place
    whole = ground.after(name)
    work = ground.lay(name, place)
    before = content(work)
    end = field.worker.run(command.arguments, place, fault, kill_after_s=kill_after_s)
    found = content(work)
    killed = end.code == -9 and -9 in codes
    problems = [] if killed else said_badly(end)
    if end.code not in (0, *codes):
        problems.append(f"unexpected end: {end}")
    if words and end.code not in (0, None) and not re.search(words, end.err):
        problems.append(f'it does not say "{words}": {end}')
    if end.code == 0 and (wrong := differences(found, whole)):
        problems.append(f"exit 0, but {wrong[:5]} differ from a quiet run")
    # What a quiet run removes, such as a checkpoint, may be renewed before.
    lost = [file for file, data in before.items() if found.get(file) not in (data, whole.get(file)) and file in whole]
    if lost:
        problems.append(f"lost or changed: {lost[:5]}")
    manifest = f"{command.writes}/manifest.json"
    if found.get(manifest) is not None and found[manifest] == whole[manifest] != before.get(manifest):
        missing = [file for file in differences(found, whole) if file.startswith(f"{command.writes}/")]
        # A checkpoint is removed after the manifest is written, and what a killed process was writing by the next one.
        early = [file for file in missing if file in whole]
        if early:
            problems.append(f"finished according to its manifest, but {early[:5]} differ")
    if not killed:
        left = leftovers(set(found) - set(before)) + [f"tmp/{path.name}" for path in (place / "tmp").iterdir()]
        if left:
            problems.append(f"left behind: {left[:5]}")
    again = field.worker.run(command.arguments, place)
    problems += said_badly(again)
    if again.code != 0:
        problems.append(f"the same command again: {again}")
    elif wrong := differences(content(work), whole):
        problems.append(f"the same command again leaves {wrong[:5]} other than a quiet run")
    return problems


def clear(place: Path) -> None:
    """Remove the folder of a case."""
    shutil.rmtree(place, ignore_errors=True)
