"""The look and the bytes that all pictures share.

A picture is laid out by hand, in inches from the lower left corner, because its panels are square and must keep
their pixels. Large maps are shrunk here and not by the drawing library, which would drop rows and columns: a ring of
three cells would turn into moiré, and a bright spot of one pixel would vanish.
"""

import io
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from fab.files import write_atomic
from fab.units import format_length
from sim.camera import Colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sim.psf_bank import PsfBank
    from sim.transfer import TransferBank

INK, FAINT, CHROME, MARK, LINE = "#222222", "#9aa0a6", "#8c8f94", "#d1495b", "#14507a"
HEIGHTS, LIGHT = "viridis", "inferno"
SMALL = 8
DPI = 160

# The hues of M. Okabe and K. Ito, which stay apart for colour-blind readers.
_RED, _GREEN, _BLUE = "#d55e00", "#009e73", "#0072b2"
SERIES = (_BLUE, _RED, _GREEN, "#cc79a7", "#e69f00", "#56b4e9")
_LOOK = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlepad": 4,
    "axes.linewidth": 0.8,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
}


@contextmanager
def picture(path: str | Path, size_in: tuple[float, float], title: str = "") -> Iterator["Figure"]:
    """Open an empty figure and write it as PNG when the body has drawn on it.

    Args:
        path: the PNG file.
        size_in: width and height, inches.
        title: what stands above the picture; a long one is cut.

    Yields:
        The figure. The user's own settings of the drawing library do not touch it.

    Raises:
        InputError: the system refuses the path.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    settings: Any = {key: value for key, value in mpl.rcParamsDefault.items() if not key.startswith("backend")} | _LOOK
    stream = io.BytesIO()
    with mpl.rc_context(settings):
        figure = Figure(figsize=size_in, dpi=DPI)
        FigureCanvasAgg(figure)
        if title:
            line = textwrap.shorten(title, int(12 * size_in[0]), placeholder="…")
            figure.text(0.12 / size_in[0], 1 - 0.1 / size_in[1], line, fontsize=12, va="top", parse_math=False)
        yield figure
        # The default metadata would name the version of the drawing library.
        figure.savefig(stream, format="png", metadata={"Software": None})
    write_atomic(path, stream.getvalue())


def place(figure: "Figure", left: float, bottom: float, width: float, height: float) -> "Axes":
    """Add axes at a place given in inches from the lower left corner of the figure."""
    across, up = figure.get_size_inches()
    return figure.add_axes((left / across, bottom / up, width / across, height / up))


def wrapped(words: str, width_in: float) -> str:
    """Break small words into lines that fit a width."""
    return textwrap.fill(words, max(20, int(17 * width_in)))


def note(figure: "Figure", left: float, bottom: float, words: str) -> None:
    """Write small words at a place given in inches."""
    across, up = figure.get_size_inches()
    figure.text(left / across, bottom / up, words, fontsize=SMALL, va="bottom", linespacing=1.3)


def length_text(length_m: float) -> str:
    """A length in words for a picture: "1.85 µm", and "∞" for a star."""
    if math.isinf(length_m):
        return "∞"
    return format_length(float(f"{length_m:.4g}")).replace("um", "µm")


def scale_bar(axes: "Axes", width_m: float) -> None:
    """Draw a bar of a round length, about a quarter of the width, below a picture that is `width_m` wide."""
    wanted = width_m / 4
    power = 10.0 ** math.floor(math.log10(wanted))
    length = power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))
    share = length / width_m
    bar = {"color": INK, "lw": 2.5, "solid_capstyle": "butt", "clip_on": False}
    axes.plot([0, share], [-0.05, -0.05], transform=axes.transAxes, **bar)
    axes.text(share + 0.03, -0.05, length_text(length), transform=axes.transAxes, va="center", fontsize=SMALL)


def colour_label(colour: Colour) -> str:
    """Name and wavelength of a colour channel: "red, 656 nm"; only the wavelength where the name says no more."""
    mean = "mean " if len(colour.wavelengths_m) > 1 else ""
    wavelength = length_text(float(np.dot(colour.wavelengths_m, colour.weights)))
    return (
        wavelength
        if colour.name == wavelength.replace(" ", "").replace(".", "p")
        else f"{colour.name}, {mean}{wavelength}"
    )


def wavelength_order(colours: Sequence[Colour]) -> list[int]:
    """Positions of the colours from the longest mean wavelength to the shortest."""
    return sorted(range(len(colours)), key=lambda i: -float(np.dot(colours[i].wavelengths_m, colours[i].weights)))


def line_colours(colours: Sequence[Colour]) -> list[str]:
    """A line colour for every colour channel, from the longest wavelength's red to the shortest one's blue."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    count = len(colours)
    fixed = {1: [LINE], 2: [_RED, _BLUE], 3: [_RED, _GREEN, _BLUE]}
    hues = fixed.get(count) or [to_hex(colormaps["plasma"](0.9 * (1 - i / (count - 1)))) for i in range(count)]
    order = wavelength_order(colours)
    return [hues[order.index(i)] for i in range(count)]


def spread(count: int, most: int) -> list[int]:
    """Positions of at most `most` of `count` entries, evenly spread, the first and the last among them."""
    if count <= most:
        return list(range(count))
    return [round(i * (count - 1) / max(most - 1, 1)) for i in range(most)]


def depth_positions(bank: "PsfBank | TransferBank", depths_m: Sequence[float], most: int) -> list[int]:
    """Positions in a bank of at most `most` of some depths.

    Raises:
        ValueError: a depth is not in the bank.
    """
    positions = []
    for depth in (depths_m[i] for i in spread(len(depths_m), most)):
        # A bank that was read from a file may have rounded its depths.
        same = [i for i, other in enumerate(bank.depths_m) if math.isclose(depth, other, rel_tol=1e-6)]
        if not same:
            raise ValueError(f"depth {depth:g} m must be in the bank, but its depths are {bank.depths_m}")
        positions.append(same[0])
    return positions


def _shares(count: int, wanted: int, kind: Literal["mean", "smooth"]) -> Float[np.ndarray, "wanted count"]:
    """How much of every sample enters each of `wanted` averages; every row sums to 1."""
    factor = count / wanted
    sample = np.arange(count)[None, :]
    place = np.arange(wanted)[:, None]
    if kind == "mean":
        low, high = place * factor, (place + 1) * factor
        shares = np.clip(np.minimum(sample + 1, high) - np.maximum(sample, low), 0.0, None)
    else:
        # At half a picture pixel, periods that would turn into moiré keep less than 1 % of their contrast.
        distance = (sample + 0.5 - (place + 0.5) * factor) / (factor / 2)
        shares = np.where(np.abs(distance) < 4, np.exp(-(distance**2) / 2), 0.0)
    return (shares / shares.sum(axis=1, keepdims=True)).astype(np.float32)


def shrunk(
    values: Float[np.ndarray, "y x"], most: int, kind: Literal["mean", "smooth"] = "mean"
) -> Float[np.ndarray, "v u"]:
    """Average a map so that neither side has more than `most` samples; a smaller map is returned as it is.

    Args:
        values: `[y, x]` the map.
        most: samples per side that the picture can show.
        kind: "mean" over equal parts of the map, which keeps its total, or "smooth" under a Gaussian, which leaves no
            moiré of fine regular structure.
    """
    from scipy.sparse import csr_array

    out = values
    for _ in range(2):
        if out.shape[0] > most:
            out = csr_array(_shares(out.shape[0], most, kind)) @ out
        out = out.T
    return out
