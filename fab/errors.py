"""The two errors that a caller is expected to catch; everything else is a defect."""

from collections.abc import Sequence


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
        return f"{self.where}: {self.rule}, but got {self.got}. {self.cure}"


class CheckFailed(Exception):
    """Differences that a verification found, each naming its file (exit code 1); the input itself is not wrong."""

    def __init__(self, differences: Sequence[str]) -> None:
        self.differences = tuple(differences)
        super().__init__(self.differences)

    def __str__(self) -> str:
        """Return the differences, one per line."""
        return "\n".join(self.differences)
