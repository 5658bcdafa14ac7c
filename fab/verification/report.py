"""The answers that a verification gives."""

from dataclasses import dataclass

from fab.errors import CheckFailed
from fab.figure import html_of


@dataclass(frozen=True)
class Check:
    """One question about a file, and its answer: a sentence per difference, none if it holds."""

    file: str
    question: str
    problems: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing differs."""
        return not self.problems


@dataclass(frozen=True)
class VerificationReport:
    """Verification of a mask order.

    Attributes:
        checks: all checks, in the order they were made.
        notes: a sentence on everything that was not compared.
    """

    checks: tuple[Check, ...]
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every check holds."""
        return all(check.passed for check in self.checks)

    @property
    def differences(self) -> tuple[str, ...]:
        """One sentence per difference, each naming its file first."""
        return tuple(f"{c.file}: {c.question}: {problem}" for c in self.checks for problem in c.problems)

    def _repr_html_(self) -> str:
        rows = {f"{c.file}: {c.question}": "; ".join(c.problems) or "passed" for c in self.checks}
        return html_of(f"{sum(check.passed for check in self.checks)} of {len(self.checks)} checks passed", rows)

    def require(self) -> None:
        """Raise `CheckFailed` with the differences, if there are any."""
        if not self.passed:
            raise CheckFailed(self.differences)
