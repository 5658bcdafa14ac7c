"""A table of scores: for people as text and pictures, for programs as CSV and JSON, for papers as LaTeX."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from doedesign.capture.from_spec import rgb_from_channels
from doedesign.evaluation.candidates import Candidate, Unscored
from doedesign.evaluation.published import PublishedScores, published_scores
from doedesign.evaluation.rivals.layers import count_of
from doedesign.evaluation.rivals.registry import RIVALS
from doedesign.evaluation.rows import MethodRow
from doedesign.evaluation.scoring import PairWork, RowScores
from doedesign.evaluation.statistics import BootstrapInterval, bootstrap_mean
from fab.figure import SERIES, bare, html_of, panels, save
from fab.files import canonical_json, csv_table, write_atomic
from sim.light import srgb_from_linear

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

REGIONS, SCORES = ("occluded", "full"), ("ssim", "psnr", "closeness")
HEADS = {"ssim": "SSIM", "psnr": "PSNR, dB", "closeness": "1 - LPIPS"}
REFERENCE = "proposed"
LATER = "of a later run: its differences are to that run's own proposed row"
_SHOWN_PAIRS = 3


class PairFacts(NamedTuple):
    """One test pair: its number, photograph, distances (metres), and share of pixels in the occluded region."""

    pair: int
    picture: str
    far_m: float
    near_m: float
    covered: float


Intervals = Mapping[str, Mapping[str, BootstrapInterval | None]]
"""By region and score; None where there is none."""


@dataclass(frozen=True, eq=False)
class TableRow:
    """A row of a table.

    Attributes:
        row: what it is.
        scores: means with intervals; empty where it could not be computed.
        gain: mean differences to the proposed row, pair by pair; empty for that row itself and where there is none.
        paper: the paper's numbers, where it has this row.
        why: why it could not be computed.
        parameters: numbers that its network has learnt; 0 without one.
        original: those of the original, where the network is one after a published idea and they are known.
        run: 1 for the run that the table is of, 2 and more for rows that were joined to it from later ones.
    """

    row: MethodRow
    scores: Intervals
    gain: Intervals
    paper: PublishedScores | None = None
    why: str = ""
    parameters: int = 0
    original: int | None = None
    run: int = 1

    @property
    def label(self) -> str:
        """Name for people, with a dagger if it is of a later run."""
        return self.row.label + (" †" if self.run > 1 else "")


@dataclass(frozen=True, eq=False)
class EvaluationTable:
    """A table of scores on one set of pairs.

    Attributes:
        number: 1 or 2, the paper's table.
        obstruction: kind of obstruction.
        rows: its rows.
        pairs: the pairs.
        study: everything that scores depend on besides rows.
    """

    number: int
    obstruction: str
    rows: tuple[TableRow, ...]
    pairs: tuple[PairFacts, ...]
    study: Mapping[str, Any]

    @property
    def title(self) -> str:
        """A line that says what this is."""
        return f"Table {self.number}: {self.obstruction}, occlusion model {self.study['occlusion']}"

    @property
    def folder_name(self) -> str:
        """Name of its folder."""
        return folder_name(self.number, self.obstruction, self.study["occlusion"])

    @property
    def joined(self) -> bool:
        """Whether it has rows of later runs."""
        return any(one.run > 1 for one in self.rows)

    @property
    def columns(self) -> tuple[str, ...]:
        """Scores that some row has."""
        return tuple(s for s in SCORES if any(one.scores and one.scores["full"].get(s) for one in self.rows))

    def text(self) -> str:
        """The table in plain text: the occluded region, in brackets the full image."""
        lines = [f"{self.title}; {len(self.pairs)} pairs of {len({p.picture for p in self.pairs})} photographs"]
        lines.append(
            f"{'occluded region (full image)':48}" + "".join(f"{HEADS[s]:>18}" for s in self.columns) + "   paper"
        )
        for one in self.rows:
            if one.why:
                lines.append(f"{one.label:48}  {one.why}")
                continue
            cells = "".join(f"{_cell(one.scores, score):>18}" for score in self.columns)
            paper = "" if one.paper is None else f"   {one.paper.psnr:.2f} ({one.paper.full_psnr:.2f}) dB"
            lines.append(f"{one.label:48}{cells}{paper}{_size(one)}")
        return "\n".join([*lines, *([f"† {LATER}"] if self.joined else [])])

    def csv(self) -> str:
        """A line for every row, region and score."""
        return csv_table(list(self._lines()), 6)

    def _lines(self) -> "list[ScoreLine]":
        found = []
        for one in self.rows:
            if one.why:
                found.append(ScoreLine(one.row.name, why_not=one.why))
            for region, values in one.scores.items():
                for score, value in values.items():
                    if value is None:
                        continue
                    gain, paper = one.gain.get(region, {}).get(score), _paper(one.paper, region, score)
                    line = ScoreLine(one.row.name, region, score, **value._asdict(), paper=paper)
                    line = line._replace(parameters=one.parameters, original_parameters=one.original, run=one.run)
                    if gain is not None:
                        line = line._replace(gain=gain.mean, gain_low=gain.low, gain_high=gain.high)
                    found.append(line)
        return found

    def json(self) -> dict[str, Any]:
        """Everything, for programs."""

        def plain(intervals: Intervals) -> dict[str, Any]:
            return {
                region: {score: None if v is None else v._asdict() for score, v in values.items()}
                for region, values in intervals.items()
            }

        rows = [
            {
                "name": one.row.name,
                "label": one.row.label,
                "method": one.row.method,
                "plate": one.row.plate,
                "sees": one.row.sees,
                "fabricated": one.row.fabricated,
                "told": one.row.told,
                "scores": plain(one.scores),
                "gain_over_proposed": plain(one.gain),
                "paper": None if one.paper is None else one.paper._asdict(),
                "parameters": one.parameters,
                "original_parameters": one.original,
                "run": one.run,
                "why_not": one.why or None,
            }
            for one in self.rows
        ]
        return {"table": self.number, "study": dict(self.study), "pairs": len(self.pairs), "rows": rows}

    def latex(self) -> str:
        r"""A `tabular` in the style of booktabs: the occluded region, in brackets the full image; counts of weights."""
        heads = [HEADS[score].replace(" - ", "--") for score in self.columns] + ["$10^6$ weights (original)"]
        lines = [
            f"% {self.title}; {len(self.pairs)} pairs",
            r"\begin{tabular}{l" + "c" * len(heads) + "}",
            r"\toprule",
            f" & {' & '.join(heads)} \\\\",
            r"\midrule",
        ]
        for one in self.rows:
            cells = [_cell(one.scores, score) if not one.why else "--" for score in self.columns]
            lines.append(" & ".join([_escaped(one.label), *cells, _weights(one)]) + r" \\")
        if self.joined:
            lines += [r"\midrule", rf"\multicolumn{{{len(heads) + 1}}}{{l}}{{\footnotesize $^\dagger$ {LATER}}} \\"]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw PSNR in the occluded region with its intervals, a row for each method; return the figure."""
        shown = [one for one in self.rows if one.scores and one.scores["occluded"]["psnr"] is not None]
        values = [value for one in shown if (value := one.scores["occluded"]["psnr"])]
        over = "photographs and seeds" if max((v.seeds for v in values), default=1) > 1 else "photographs, one seed"
        note = f"95 % intervals of the mean over {over}"
        if values and all(value.low is None for value in values):
            note = "one photograph and one seed, which have no interval"
        if any(one.paper for one in shown):
            note += "; hollow: the paper's own pictures and scores"
        if self.joined:
            note += f". † {LATER}"
        with panels(ax, (6.4, 0.24 * len(shown) + 1.1), self.title, note) as figure:
            axes = figure.subplots()
            for place, one in enumerate(reversed(shown)):
                value = one.scores["occluded"]["psnr"]
                assert value is not None
                if value.low is not None and value.high is not None:
                    axes.plot([value.low, value.high], [place, place], color=SERIES[0], lw=2.4, solid_capstyle="butt")
                axes.plot(value.mean, place, "o", color=SERIES[0], ms=5)
                if one.paper is not None:
                    axes.plot(one.paper.psnr, place, "o", color=SERIES[1], ms=5, mfc="none")
            axes.set_yticks(range(len(shown)), [one.label for one in reversed(shown)])
            axes.set_xlabel("PSNR in the occluded region, dB")
            axes.grid(True, axis="x")
        return figure

    def _repr_html_(self) -> str:
        rows = {one.label: one.why or ", ".join(_cell(one.scores, s) for s in self.columns) for one in self.rows}
        return html_of(self.title, rows, self.plot())


def folder_name(table: int, obstruction: str, occlusion: str) -> str:
    """Name of the folder of a table, of a kind of obstruction (or a folder of masks) and an occlusion model."""
    return f"table{table}-{Path(obstruction).name}-{occlusion}"


class ScoreLine(NamedTuple):
    """A line of the CSV: a mean and its interval, the mean difference to the proposed row and its own, the paper's."""

    row: str
    region: str = ""
    score: str = ""
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    pairs: int = 0
    pictures: int = 0
    seeds: int = 0
    gain: float | None = None
    gain_low: float | None = None
    gain_high: float | None = None
    paper: float | None = None
    parameters: int = 0
    original_parameters: int | None = None
    run: int = 1
    why_not: str = ""


def _cell(scores: Intervals, score: str) -> str:
    digits = 2 if score == "psnr" else 3
    found = (scores[region].get(score) for region in REGIONS)
    inner, whole = ("-" if value is None else f"{value.mean:.{digits}f}" for value in found)
    return f"{inner} ({whole})"


def _size(one: TableRow) -> str:
    """Numbers that a network after a published idea has, beside the original's."""
    if one.row.method != "rival":
        return ""
    original = "a number that is not stated" if one.original is None else f"{one.original / 1e6:.3g}"
    return f"   {one.parameters / 1e6:.2f} million weights (original {original})"


def _weights(one: TableRow) -> str:
    """The same in millions, of any network."""
    if not one.parameters:
        return ""
    original = "not stated" if one.original is None else f"{one.original / 1e6:.3g}"
    return f"{one.parameters / 1e6:.2f}" + (f" ({original})" if one.row.method == "rival" else "")


def _escaped(text: str) -> str:
    return text.replace("&", r"\&").replace("%", r"\%").replace("_", r"\_").replace(" †", r"$^\dagger$")


def _paper(paper: PublishedScores | None, region: str, score: str) -> float | None:
    return None if paper is None else getattr(paper, score if region == "occluded" else f"full_{score}")


def table_of(
    number: int,
    obstruction: str,
    candidates: Sequence[Candidate],
    scored: Mapping[str, Mapping[int, RowScores]],
    pairs: tuple[PairFacts, ...],
    left: Sequence[Unscored],
    study: Mapping[str, Any],
) -> EvaluationTable:
    """Put scores together.

    Args:
        number: 1 or 2.
        obstruction: kind of obstruction.
        candidates: rows with scores, one for every seed.
        scored: scores by the candidates' keys and by pair.
        pairs: the pairs.
        left: rows without scores.
        study: what scores depend on.
    """
    published = published_scores(number, obstruction)
    names = [p.picture for p in pairs]
    by_row: dict[str, list[Candidate]] = {}
    for one in candidates:
        by_row.setdefault(one.row.name, []).append(one)

    def values(name: str, region: str, score: str) -> np.ndarray:
        """`[seed, pair]` scores; NaN where there is none."""
        found = [[scored[one.key].get(p.pair, {}).get(region, {}).get(score) for p in pairs] for one in by_row[name]]
        return np.array(found, np.float64)

    def each(make: Any) -> Intervals:
        return {region: {score: make(region, score) for score in SCORES} for region in REGIONS}

    def gain(name: str, region: str, score: str) -> BootstrapInterval | None:
        one, reference = values(name, region, score), values(REFERENCE, region, score)
        # A row of a single seed stands beside every seed of the other.
        return bootstrap_mean(one - reference, names)

    rows = []
    for name, group in by_row.items():
        row = group[0].row
        compared = name != REFERENCE and REFERENCE in by_row
        rows.append(
            TableRow(
                row,
                each(lambda region, score, name=name: bootstrap_mean(values(name, region, score), names)),
                each(lambda region, score, name=name: gain(name, region, score)) if compared else {},
                published.get(row.paper) if row.paper else None,
                parameters=count_of(group[0].network),
                original=RIVALS[row.training].original_parameters if row.training and row.training in RIVALS else None,
            )
        )
    rows += [TableRow(row, {}, {}, published.get(row.paper) if row.paper else None, why) for row, why in left]
    return EvaluationTable(number, obstruction, tuple(rows), pairs, study)


def write_table(folder: Path, table: EvaluationTable, work: PairWork) -> None:
    """Write a table as CSV, JSON, LaTeX and pictures, and the list of its pairs, into a folder."""
    write_atomic(folder / "pairs.csv", csv_table(list(table.pairs), 6).encode())
    write_atomic(folder / "table.csv", table.csv().encode())
    write_atomic(folder / "table.json", canonical_json(table.json()))
    write_atomic(folder / "table.tex", table.latex().encode())
    if any(one.scores for one in table.rows):
        save(table.plot(), folder / "table.png")
        save(plot_pairs(table, work), folder / "pictures.png")


def plot_pairs(table: EvaluationTable, work: PairWork) -> "FigureBase":
    """Draw some pairs as every row of the first seed shows them, the scene first; return the figure.

    Those are taken whose occluded region is nearest to the mean one.
    """
    mean = np.mean([p.covered for p in table.pairs])
    shown, names = [], set()
    for one in sorted(table.pairs, key=lambda p: abs(p.covered - mean)):
        if one.picture not in names and len(shown) < _SHOWN_PAIRS:
            shown.append(one)
            names.add(one.picture)
    first = {one.row.name: one for one in reversed(work.candidates)}
    rows = [row for row in table.rows if row.row.name in first]
    columns = min(6, len(rows) + 1)
    lines = -(-(len(rows) + 1) // columns)
    camera = work.pairs.model.camera

    def display(image: np.ndarray) -> np.ndarray:
        return np.clip(rgb_from_channels(image, camera), 0, 1).transpose(1, 2, 0)

    with panels(None, (1.75 * columns, 1.95 * lines * len(shown) + 0.5), table.title, layout="compressed") as figure:
        grid = figure.subplots(lines * len(shown), columns, squeeze=False)
        for axes in grid.ravel():
            bare(axes)
            axes.set_visible(False)
        for block, pair in enumerate(shown):
            scene, _ = work.pairs.shown(work.pairs.scene(pair.pair))
            cells = [("scene", srgb_from_linear(scene))]
            cells += [(row.row.label, work.picture(pair.pair, first[row.row.name])) for row in rows]
            for place, (label, image) in enumerate(cells):
                axes = grid[block * lines + place // columns, place % columns]
                axes.set_visible(True)
                axes.imshow(display(image), origin="lower")
                axes.set_title(_wrapped(label), fontsize=6)
    return figure


def _wrapped(label: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(label, 26))
