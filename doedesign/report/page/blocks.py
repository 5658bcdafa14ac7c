"""Values that a page shows; each is drawn by the macro of its `kind` in templates/blocks.html.j2."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

_MOST_COLUMNS, _MOST_LETTERS = 7, 72  # of a table in half of the page


class ChartSeries(NamedTuple):
    """One line of a chart; a value is None where there is none. Lines of one `hue` have one colour."""

    label: str
    y: tuple[float | None, ...]
    dashed: bool = False
    hue: int | None = None


class PageImage(NamedTuple):
    """A picture as a data URI, and its size in pixels."""

    source: str
    width: int
    height: int


class Bar(NamedTuple):
    """One number as a bar from 0 to `end`.

    Attributes:
        label: what it is.
        value: the number.
        text: the number in words.
        end: value at the right end of the bar.
        low: least of the values that `value` stands for; None where it is one value.
        high: largest of them.
        mark: the number to compare with: a ceiling, a bound or a limit; None without one.
        mark_text: the mark in words.
        state: "met", "missed" or "" where there is nothing to meet.
    """

    label: str
    value: float
    text: str
    end: float
    low: float | None = None
    high: float | None = None
    mark: float | None = None
    mark_text: str = ""
    state: str = ""


@dataclass(frozen=True)
class TextBlock:
    """Paragraphs, or preformatted lines."""

    lines: tuple[str, ...]
    preformatted: bool = False
    title: str = ""
    kind: ClassVar[str] = "text"


@dataclass(frozen=True)
class CommandBlock:
    """Commands that make a run and its results again; the template writes their options, texts are quoted.

    Attributes:
        title: of the block.
        run: the run folder.
        order: the folder of its mask order; None without one.
        changes: changes of the spec.
        results: folders of results in the run, each with the options of its command, as far as they are known: name
            and value, which is empty of an option without one.
    """

    title: str
    run: str
    order: str | None
    changes: tuple[str, ...]
    results: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]
    kind: ClassVar[str] = "commands"


@dataclass(frozen=True)
class BarBlock:
    """Numbers as bars."""

    title: str
    bars: tuple[Bar, ...]
    note: str = ""
    kind: ClassVar[str] = "bars"


@dataclass(frozen=True)
class TableBlock:
    """A table; `folded` shows its title alone until it is opened."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    folded: bool = False
    kind: ClassVar[str] = "table"

    @property
    def wide(self) -> bool:
        """Whether it needs the whole width of the page."""
        longest = max((sum(map(len, row)) for row in self.rows), default=0)
        return not self.folded and (len(self.head) > _MOST_COLUMNS or longest > _MOST_LETTERS)


@dataclass(frozen=True)
class ChartBlock:
    """Lines over a common axis, or histograms (`steps`)."""

    title: str
    x_label: str
    y_label: str
    x: tuple[float, ...]
    series: tuple[ChartSeries, ...]
    x_log: bool = False
    y_log: bool = False
    steps: bool = False
    markers: bool = False
    note: str = ""
    kind: ClassVar[str] = "chart"


@dataclass(frozen=True)
class PictureBlock:
    """A picture; `ink` says that it is drawn in dark ink on white, so that a dark page may turn it round."""

    title: str
    alt: str
    image: PageImage
    note: str = ""
    ink: bool = True
    kind: ClassVar[str] = "picture"


@dataclass(frozen=True)
class DividerBlock:
    """Two pictures of the same scene with a divider between them; several scenes to choose from."""

    title: str
    scenes: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]  # name, and (label, data URI) of every picture
    note: str = ""
    kind: ClassVar[str] = "divider"


@dataclass(frozen=True)
class MapBlock:
    """A map to pan and zoom, its views, and places that break a rule.

    Attributes:
        title: what it is.
        data: pyramid, views and places, for the viewer (`doedesign.report.page.maps`).
        views: names of the views.
        places: table of the marked places: mask, kind, size, place in micrometres.
        note: what a reader must know.
        linked: whether it moves with the other linked maps of the page.
    """

    title: str
    data: dict[str, Any]
    views: tuple[str, ...]
    places: tuple[tuple[str, ...], ...] = ()
    note: str = ""
    linked: bool = False
    kind: ClassVar[str] = "map"


@dataclass(frozen=True)
class PsfBlock:
    """PSFs by bank, depth and colour.

    Attributes:
        title: what it is.
        banks: names of the banks.
        depths: depths in words.
        colours: names of the colours.
        data: pictures and scales, for the viewer (`doedesign.report.page.light`).
        note: what a reader must know.
        beside: whether all banks are shown side by side, and not one at a time.
    """

    title: str
    banks: tuple[str, ...]
    depths: tuple[str, ...]
    colours: tuple[str, ...]
    data: dict[str, Any]
    note: str = ""
    beside: bool = False
    kind: ClassVar[str] = "psf"


@dataclass(frozen=True)
class ModelBlock:
    """A solid to turn: a GLB file, packed by gzip, in base 64; heights are drawn `higher` times as high."""

    title: str
    file: str
    data: str
    higher: int = 1
    note: str = ""
    kind: ClassVar[str] = "model"


PageBlock = (
    TextBlock
    | CommandBlock
    | BarBlock
    | TableBlock
    | ChartBlock
    | PictureBlock
    | DividerBlock
    | MapBlock
    | PsfBlock
    | ModelBlock
)


@dataclass(frozen=True)
class PageSection:
    """A part of the page: its anchor, its title and its blocks."""

    name: str
    title: str
    blocks: tuple[PageBlock, ...]


@dataclass(frozen=True)
class PageContent:
    """All that a page shows.

    Attributes:
        title: of the page.
        summary: lines under the title.
        sections: its parts, those without blocks left out.
        facts: small table beside the title: name and value.
    """

    title: str
    summary: tuple[str, ...]
    sections: tuple[PageSection, ...]
    facts: tuple[tuple[str, str], ...] = field(default=())


def section(name: str, title: str, blocks: Sequence[PageBlock | None]) -> PageSection | None:
    """A part of the page, or None if it has nothing to show.

    Args:
        name: its anchor.
        title: its title.
        blocks: what it shows; None is left out.
    """
    there = tuple(block for block in blocks if block is not None)
    return PageSection(name, title, there) if there else None
