"""Programs of other people as methods: a folder of captures in, a folder of pictures out.

    in/0000.png, in/0001.png, ...               what the program sees, 8-bit sRGB, row 0 at the top
    in/0000_mask.png, ...                       white where the obstruction blocks at least half of a pixel
    out/0000.png, ...                           what it makes of them: same name, same size

The command is split like a line of a shell and run without one; `{in}` and `{out}` in it become the two folders. What
it sees is the conventional capture, or the sharp scene with a black hole ("scene"), which the paper gives to inpainting
methods, or the capture through the proposed plate ("plate").
"""

import os
import shlex
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

from doedesign.runtime.effort import Effort, note_effort
from fab.errors import InputError
from fab.pictures import read_display, write_pixels

Source = Literal["conventional", "scene", "plate"]
GIVEN = {"conventional": "the capture", "scene": "the scene", "plate": "the capture through the plate"}
_WORDS_SHOWN = 400


@dataclass(frozen=True)
class ExternalMethod:
    """A program and what it sees.

    Attributes:
        name: name of its row.
        command: words of its command line, with `{in}` and `{out}` in some of them.
        sees: which pictures it gets.
    """

    name: str
    command: tuple[str, ...]
    sees: Source = "conventional"

    @classmethod
    def parse(cls, text: str) -> "ExternalMethod":
        """Read "name=command {in} {out}" or "name:scene=command {in} {out}".

        Raises:
            InputError: no name, no command, or a folder is not in it.
        """
        head, found, line = text.partition("=")
        name, _, sees = head.strip().partition(":")
        example = 'For example "lama:scene=python predict.py {in} {out}".'
        if not found or not name or not name.replace("_", "").replace("-", "").isalnum():
            raise InputError("method", "must be a name and a command", f'"{text}"', example)
        if sees and sees not in get_args(Source):
            rule = f"what it sees must be one of {', '.join(get_args(Source))}"
            raise InputError("method", rule, f'"{sees}"', example)
        try:
            words = tuple(shlex.split(line))
        except ValueError as error:
            raise InputError("method", "must be a command line", f'"{line}" ({error})', example) from error
        for place in ("{in}", "{out}"):
            if not any(place in word for word in words):
                raise InputError("method", f"its command must name the folder {place}", f'"{line}"', example)
        return cls(name, words, sees or "conventional")  # pyright: ignore[reportArgumentType]


def file_of(number: int) -> str:
    """Name of a pair's picture."""
    return f"{number:04d}.png"


def write_pair(folder: Path, number: int, picture: Float[np.ndarray, "3 y x"], hole: Bool[np.ndarray, "y x"]) -> None:
    """Write what a program sees of a pair: display values with row 0 at the lowest y, and the occluded region."""
    folder.mkdir(parents=True, exist_ok=True)
    write_pixels(folder / file_of(number), _eight_bits(picture))
    write_pixels(folder / f"{number:04d}_mask.png", hole.astype(np.uint8) * 255)


def _eight_bits(picture: Float[np.ndarray, "3 y x"]) -> np.ndarray:
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8).transpose(1, 2, 0)


def run_program(method: ExternalMethod, given: Path, found: Path) -> None:
    """Run a program on a folder of pairs.

    Args:
        method: the program.
        given: folder of what it sees.
        found: folder that it is to fill, which is made.

    Raises:
        InputError: it cannot be started, or ends with an error.
    """
    found.mkdir(parents=True, exist_ok=True)
    places: Mapping[str, str] = {"{in}": str(given.resolve()), "{out}": str(found.resolve())}
    words = [_with(word, places) for word in method.command]
    where, cure = f"method {method.name}", "Try the command by itself on that folder."
    ended_s = _of_ended_s()
    try:
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        got = f'"{error.strerror or error}"'
        raise InputError(where, f"{words[0]} must be a program that can be run", got, "Correct it.") from error
    note_effort(Effort(_of_ended_s() - ended_s, 0))
    if done.returncode:
        said = (done.stderr or done.stdout).strip()[-_WORDS_SHOWN:]
        raise InputError(where, "must end without an error", f"exit code {done.returncode}: {said}", cure)


def _of_ended_s() -> float:
    """Processor time of the processes that this one started and that have ended."""
    now = os.times()
    return now.children_user + now.children_system


def _with(word: str, places: Mapping[str, str]) -> str:
    for name, folder in places.items():
        word = word.replace(name, folder)
    return word


def read_pair(method: str, folder: Path, number: int, shape: tuple[int, int]) -> Float[np.ndarray, "3 y x"]:
    """Read what a program made of a pair, display values `[c, y, x]` with row 0 at the lowest y.

    Raises:
        InputError: no picture, one that cannot be read, or of another size.
    """
    path = folder / file_of(number)
    if not path.is_file():
        raise InputError(f"method {method}", f"must write {path.name} for every pair", "no such file", f"See {folder}.")
    picture = read_display(path)
    if picture.shape[:2] != shape:
        rule, got = f"must keep the size of {shape[1]} x {shape[0]} pixels", f"{picture.shape[1]} x {picture.shape[0]}"
        raise InputError(str(path), rule, got, "Write pictures as large as those that are given.")
    return np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32) / 255
