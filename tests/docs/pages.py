"""Pages of the documentation, and the code blocks in them."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "masks" / "README.md",
        *(ROOT / "docs").rglob("*.md"),
    ]
)
_FENCE = re.compile(r"(?ms)^ *(?:<!-- ([^>]*) -->\n\s*)?```(\w*)[^\n]*\n(.*?)^ *```$")
LANGUAGES = {"python", "sh", "toml", "text"}


class Block(NamedTuple):
    """A fenced code block.

    Attributes:
        page: its page, relative to the repository.
        line: number of its first line.
        language: what it is written in.
        text: what it says.
        note: the comment above it: "with: NAME" names the spec that a fragment changes.
    """

    page: str
    line: int
    language: str
    text: str
    note: str

    @property
    def where(self) -> str:
        """Page and line."""
        return f"{self.page}:{self.line}"

    @property
    def lines(self) -> list[str]:
        """Its commands, without comments and prompts, lines that go on joined."""
        joined = self.text.replace("\\\n", " ")
        found = (re.sub(r"(^|\s+)#.*$", "", line).strip() for line in joined.splitlines())
        return [line for line in found if line]


def blocks(*languages: str) -> list[Block]:
    """Blocks of some languages, or all, page by page."""
    found = []
    for page in PAGES:
        text = page.read_text("utf-8")
        for match in _FENCE.finditer(text):
            note, language, inside = match.groups()
            line = text.count("\n", 0, match.start(3)) + 1
            found.append(Block(page.relative_to(ROOT).as_posix(), line, language, inside, note or ""))
    return [block for block in found if not languages or block.language in languages]
