"""Figures that all pictures share: house style, layout, PNG files, scale bars and large maps made small.

A picture is a function that draws and returns what it drew: axes where one panel is enough, a figure (or a sub-figure
at the place of the axes that it was given) where several are. `save` writes it. matplotlib's constrained layout places
everything. Figures are drawn in the house style, whatever the user's settings are; what is drawn on the user's own axes
is in the user's style. Maps are averaged here, not by matplotlib, which would turn rings of three cells into moire.
"""

import base64
import io
import math
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture
from fab.files import write_atomic
from fab.units import MM, format_length, require_kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

INK, FAINT, CHROME, MARK, LINE = "#222222", "#9aa0a6", "#8c8f94", "#d1495b", "#14507a"
HEIGHTS, LIGHT = "viridis", "inferno"
# The hues of M. Okabe and K. Ito, which stay apart for colour-blind readers.
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
SMALL = 8  # points
DPI = 160
_STYLE = {
    "figure.dpi": DPI,
    "figure.constrained_layout.w_pad": 0.06,  # inches
    "figure.constrained_layout.h_pad": 0.06,
    "savefig.dpi": "figure",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlepad": 4,
    "axes.labelpad": 2,
    "axes.linewidth": 0.8,
    "axes.formatter.useoffset": False,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.5,
    "image.origin": "lower",
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "legend.columnspacing": 1.2,
    "lines.linewidth": 1.4,
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
}
# matplotlib keeps its settings for the whole process; one picture at a time changes them, and puts them back.
_STYLING = threading.RLock()


@contextmanager
def _house_style() -> Iterator[None]:
    import matplotlib as mpl

    defaults = {key: value for key, value in mpl.rcParamsDefault.items() if not key.startswith("backend")}
    settings: Any = defaults | _STYLE
    with _STYLING, mpl.rc_context(settings):
        yield


@cache
def _figure_class() -> "type[Figure]":
    from matplotlib.figure import Figure

    class Picture(Figure):
        """A figure that notebooks show, without pyplot."""

        def _repr_png_(self) -> bytes:
            return png_bytes(self)

    return Picture


@contextmanager
def panels(
    ax: "Axes | None",
    size_in: tuple[float, float],
    title: str = "",
    note: str = "",
    layout: Literal["constrained", "compressed"] = "constrained",
) -> "Iterator[FigureBase]":
    """Open a new figure, or a sub-figure in the place of some axes, in the house style; its layout places everything.

    Args:
        ax: axes of a subplot (otherwise ValueError), which the sub-figure replaces; None for a new figure.
        size_in: width and height of a new figure, inches.
        title: a line above all; a long one is shortened.
        note: small text below all, wrapped to the width.
        layout: "compressed" for a grid of pictures of fixed aspect.
    """
    _require_axes(ax)
    with _house_style():
        if ax is None:
            figure = _figure_class()(figsize=size_in, layout=layout)
            # A right margin, which matplotlib's own wrapping would leave out.
            note = textwrap.fill(note, max(20, int(15.5 * size_in[0])))
        else:
            place, parent = ax.get_subplotspec(), ax.get_figure()
            if place is None or parent is None:
                raise ValueError("`ax` must be a subplot (from `pyplot.subplots`), but its place is given by hand")
            ax.remove()
            figure = parent.add_subfigure(place)
        if title:
            line = textwrap.shorten(title, int(12 * size_in[0]), placeholder="…")
            figure.suptitle(line, x=0.01, ha="left", fontsize=12, parse_math=False)
        if note:
            figure.supxlabel(note, x=0.01, ha="left", fontsize=SMALL, wrap=True, linespacing=1.3, parse_math=False)
        yield figure
        # One pass leaves texts some dots off, since panels of fixed aspect move; drawing makes the second.
        root: Any = figure.get_figure(root=True)
        if engine := root.get_layout_engine():
            engine.execute(root)


def _require_axes(ax: object) -> None:
    if ax is not None:
        from matplotlib.axes import Axes

        require_kind("ax", ax, Axes, 'Leave it out for a new figure; fab.figure.save(plate.plot(), "x.png") writes it.')


def legend_above(figure: "FigureBase", handles: Sequence[Any], title: str) -> None:
    """Put a legend above all panels, under a title: `panels` would write the title over it.

    Args:
        figure: the figure.
        handles: its lines and marks.
        title: the title.
    """
    where: dict[str, Any] = {"loc": "outside upper left", "ncols": len(handles), "borderpad": 0.0}
    words = figure.legend(handles=list(handles), title=title, title_fontsize=12, alignment="left", **where).get_title()
    words.set_parse_math(False)


@contextmanager
def single(ax: "Axes | None", size_in: tuple[float, float], title: str = "", note: str = "") -> "Iterator[Axes]":
    """Open axes for a picture of one panel: those given, whose title `title` becomes, or those of a new figure."""
    _require_axes(ax)
    if ax is None:
        with panels(None, size_in, title, note) as figure:
            yield figure.subplots()
    else:
        ax.set_title(title, parse_math=False)
        yield ax


def png_bytes(drawn: "Axes | FigureBase") -> bytes:
    """PNG file of the whole figure that a picture was drawn on; a fresh drawing of the same gives the same bytes."""
    stream = io.BytesIO()
    figure: Any = drawn.get_figure(root=True)
    with _house_style():
        # The default metadata would name the version of matplotlib.
        figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def save(drawn: "Axes | FigureBase", path: str | Path) -> None:
    """Write the figure that a picture was drawn on as a PNG file."""
    write_atomic(path, png_bytes(drawn))


class PictureSaver(Protocol):
    """Has a picture drawn and saved."""

    def __call__(self, path: Path, plot: "Callable[..., Axes | FigureBase]", /, *given: Any, **more: Any) -> None:
        """Save what a function draws of some arguments."""


@contextmanager
def drawn_beside() -> Iterator[PictureSaver]:
    """Draw pictures one after another in a thread, while this one computes.

    Yields:
        a function that takes a file, a function that draws, and its arguments. All are drawn when the block ends; an
        error of one is raised there, and an error within the block leaves out those that have not begun.
    """
    with ThreadPoolExecutor(1) as pool:
        begun: list[Future[None]] = []

        def draw(path: Path, plot: "Callable[..., Axes | FigureBase]", /, *given: Any, **more: Any) -> None:
            begun.append(pool.submit(lambda: save(plot(*given, **more), path)))

        try:
            yield draw
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        for one in begun:
            one.result()


def html_of(title: str, rows: Mapping[str, object], drawn: "Axes | FigureBase | None" = None) -> str:
    """HTML for notebooks: a title, a table of named values, and a picture as an inline PNG."""
    lines = "".join(f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>" for name, value in rows.items())
    image = ""
    if drawn is not None:
        encoded = base64.b64encode(png_bytes(drawn)).decode()
        image = f'<img alt="{escape(title)}" style="max-width: 100%" src="data:image/png;base64,{encoded}">'
    return f"<div><strong>{escape(title)}</strong><table>{lines}</table>{image}</div>"


def length_text(length_m: float) -> str:
    """A length in words for a picture: "1.85 µm", and "∞" for a source at infinity."""
    if math.isinf(length_m):
        return "∞"
    return format_length(float(f"{length_m:.4g}")).replace("um", "µm")


def aperture_text(aperture: Aperture) -> str:
    """An aperture in words for a picture: its diameter, "2 mm × 1 mm", or "mask of 2 mm × 1 mm"."""
    sizes = " × ".join(map(length_text, aperture.sizes_m))
    return f"mask of {sizes}" if isinstance(aperture, MaskAperture) else sizes


def bare(axes: "Axes") -> None:
    """Take the numbers off both axes."""
    axes.set_xticks([])
    axes.set_yticks([])


def scale_bar(axes: "Axes", width_m: float) -> None:
    """Replace the axes' numbers by a bar of a round length, a quarter of the width `width_m` or less, below them."""
    bare(axes)
    wanted = width_m / 4
    power = 10.0 ** math.floor(math.log10(wanted))
    length = power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))
    share = length / width_m
    line: Any = {"color": INK, "lw": 2.5, "solid_capstyle": "butt", "clip_on": False}
    axes.plot([0, share], [-0.05, -0.05], transform=axes.transAxes, scalex=False, scaley=False, **line)
    axes.text(share + 0.03, -0.05, length_text(length), transform=axes.transAxes, va="center", fontsize=SMALL)


def extent_of(shape: tuple[int, ...], pitch_m: float, unit_m: float = MM) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of a centred raster ``(ny, nx)``, in a unit."""
    up, right = (n * pitch_m / unit_m / 2 for n in shape)
    return -right, right, -up, up


def evenly_spaced(count: int, most: int) -> list[int]:
    """Positions of at most `most` of `count` entries, the first and the last among them."""
    if count <= most:
        return list(range(count))
    return [round(i * (count - 1) / max(most - 1, 1)) for i in range(most)]


def _mean_over_parts(values: NDArray[Any], count: int) -> NDArray[np.float32]:
    """Means over `count` equal parts of the first axis, whose borders may lie within a sample."""
    size = len(values)
    whole, rest = np.divmod(np.linspace(0, size, count + 1)[:, None], 1)
    first = whole[:, 0].astype(np.intp)
    sums = np.add.reduceat(values, first[:-1], axis=0, dtype=np.float64)
    # What of the sample at each border belongs to the part before it.
    before = rest * values[np.minimum(first, size - 1)]
    return ((sums - before[:-1] + before[1:]) * (count / size)).astype(np.float32)


def shrunk(values: NDArray[Any], most: int, kind: Literal["mean", "smooth"] = "mean") -> NDArray[Any]:
    """Average a map ``[y, x]`` so that neither side has more than `most` samples; a smaller map is returned as it is.

    "mean" averages over equal parts of the map, which keeps its total; "smooth" is a Lanczos filter, which leaves no
    moire of fine regular structure.
    """
    ny, nx = (min(n, most) for n in values.shape)
    if (ny, nx) == values.shape:
        return values
    if kind == "mean":
        return _mean_over_parts(_mean_over_parts(values, ny).T, nx).T
    from PIL import Image

    return np.asarray(Image.fromarray(values.astype(np.float32)).resize((nx, ny), Image.Resampling.LANCZOS))
