"""The two errors that a caller is expected to catch; everything else is a defect."""

import unicodedata
from collections.abc import Sequence

# Control characters (an escape begins a terminal's command), marks that turn the direction of text, bytes that are no
# text, and ends of lines.
_NOT_SHOWN = ("Cc", "Cf", "Cs", "Zl", "Zp")
_LONGEST = 1000


def printable(text: str, keep: str = "") -> str:
    """Return text as a terminal may show it: what would move the cursor or hide something is written as an escape."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        c.encode("unicode_escape").decode() if unicodedata.category(c) in _NOT_SHOWN and c not in keep else c
        for c in text
    )


def _short(got: object) -> str:
    """Return a value as a message shows it: of a long one, its beginning."""
    text = str(got)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({len(text)} characters)"


class InputError(ValueError):
    """A mistake in what the user gave: a file, a key, a value (exit code 2).

    The message is one sentence and its cure, ``{where}: {rule}, but got {got}. {cure}``: the file or "file: key" with
    the mistake, what has to hold (no full stop), what came instead, and what to do about it, a full sentence.
    """

    def __init__(self, where: str, rule: str, got: object, cure: str) -> None:
        self.where = where
        self.rule = rule
        self.got = got
        self.cure = cure
        super().__init__(where, rule, got, cure)

    def __str__(self) -> str:
        """Return the one-line message that the command line prints."""
        return printable(f"{self.where}: {self.rule}, but got {_short(self.got)}. {self.cure}")


class CheckFailed(Exception):
    """Differences that a verification found, each naming its file (exit code 1); the input itself is not wrong."""

    def __init__(self, differences: Sequence[str]) -> None:
        self.differences = tuple(differences)
        super().__init__(self.differences)

    def __str__(self) -> str:
        """Return the differences, one per line."""
        return "\n".join(map(printable, self.differences))
