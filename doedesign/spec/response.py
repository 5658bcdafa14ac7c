"""Colours of a camera from its spectral response: a CSV file becomes a few wavelengths with weights per colour.

    [optics]
    spectral_response = "camera.csv" # wavelengths in nm, then one column per colour; beside the spec
    lines_per_colour = 5             # wavelengths that stand for each

The file: lines that begin with # are remarks; a line of names may come first ("wavelength_nm,red,green,blue"); three
columns without names are red, green and blue. A column whose name ends in "_qe" holds quantum efficiencies (electrons
per photon), any other the response to energy. The light is taken to have the same energy at every wavelength, so a
quantum efficiency counts times its wavelength: weights are shares of the signal. What a column is scaled by does not
matter, since every colour is white balanced.

The lines are the nodes of Gauss' quadrature for the response, drawn straight between the file's wavelengths: n lines
integrate whatever varies with the wavelength like a polynomial of degree 2n - 1 exactly, with weights above zero and
every line within the response. One line lies at its centroid. The spec that comes out holds the lines themselves, so
a run does not depend on the file.
"""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import read_bytes
from fab.units import NM

RESPONSE_KEYS = ("spectral_response", "lines_per_colour")

LINES, MOST_LINES = 5, 16
_CURE = "Give wavelengths in nm and one column per colour, as in `550,0.1,0.9,0.2`."


class Response(NamedTuple):
    """Signal of a colour per energy, in any scale, straight between rising wavelengths."""

    name: str
    wavelengths_m: NDArray[np.float64]
    values: NDArray[np.float64]


def with_response(raw: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """Put the colours of a response file, which lies beside the spec file `source`, into the tables of the spec."""
    optics = raw.get("optics")
    if not isinstance(optics, dict) or not any(key in optics for key in RESPONSE_KEYS):
        return dict(raw)
    where = f"{source}: optics"
    name, count = optics.get("spectral_response"), optics.get("lines_per_colour", LINES)
    if not isinstance(name, str):
        rule = "must be the name of a CSV file in quotes"
        raise InputError(f"{where}.spectral_response", rule, name, 'For example spectral_response = "camera.csv".')
    if twice := [key for key in ("wavelengths", "colours") if key in optics]:
        got = f"`spectral_response` and `{twice[0]}`"
        raise InputError(f"{where}.{twice[0]}", "the colours must be stated once", got, "Remove one of the two.")
    if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MOST_LINES:
        rule = f"must be a whole number from 1 to {MOST_LINES}"
        raise InputError(f"{where}.lines_per_colour", rule, count, "Five lines are enough for most cameras.")
    colours = []
    for response in read_responses(source.parent / name):
        lines_m, weights = lines_of(response, count)
        # A picometre is far below what a PSF can tell.
        texts = [f"{line / NM:.3f} nm" for line in lines_m]
        colours.append({"name": response.name, "wavelengths": texts, "weights": [float(w) for w in weights]})
    kept = {key: value for key, value in optics.items() if key not in RESPONSE_KEYS}
    return {**raw, "optics": {**kept, "colours": colours}}


def lines_of(response: Response, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`count` wavelengths (metres, the longest first) and weights (sum 1) of Gauss' quadrature for a response."""
    ends = response.wavelengths_m
    # Enough points per step of the file for a straight piece times the polynomials below to be summed exactly.
    places, shares = np.polynomial.legendre.leggauss(count + 1)
    middles, halves = (ends[1:] + ends[:-1]) / 2, np.diff(ends) / 2
    nodes = (middles[:, None] + halves[:, None] * places).ravel()
    density = np.interp(nodes, ends, response.values) * (halves[:, None] * shares).ravel()
    nodes, density = nodes[density > 0], density[density > 0]
    density /= density.sum()
    # Stieltjes' procedure: the recurrence of the polynomials orthogonal under the response, on [-1, 1].
    middle, half = (nodes[-1] + nodes[0]) / 2, max((nodes[-1] - nodes[0]) / 2, 1e-12)
    x = (nodes - middle) / half
    before, now = np.zeros_like(x), np.ones_like(x)
    diagonal, beside, norm = [], [], 1.0
    for k in range(count):
        diagonal.append(np.sum(density * x * now**2) / norm)
        following = (x - diagonal[k]) * now - (beside[-1] if beside else 0.0) * before
        before, now = now, following
        beside.append(np.sum(density * now**2) / norm)
        norm *= beside[-1]
    off = np.sqrt(beside[: count - 1])
    places, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1))
    return (middle + half * places)[::-1], (vectors[0] ** 2 / np.sum(vectors[0] ** 2))[::-1]


def read_responses(path: Path) -> list[Response]:
    """Read a response file."""
    try:
        text = read_bytes(path, 1 << 24).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(str(path), "must be a text file", f"a foreign byte at {error.start}", _CURE) from error
    kept = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    table, rows, begins = csv.reader((line for _, line in kept), strict=True), [], 0
    try:
        for cells in table:
            rows.append((kept[begins][0], [cell.strip() for cell in cells]))
            begins = table.line_num  # of the next row: a cell in quotes may go on over lines
    except csv.Error as error:
        raise InputError(str(path), "must be a table with commas", f'"{error}"', _CURE) from error
    if not rows:
        raise InputError(str(path), "must hold a spectral response", "no line with numbers", _CURE)
    names = None if _is_number(rows[0][1][0]) else rows.pop(0)[1]
    for line, row in rows:
        if len(row) != len(rows[0][1]) or not all(map(_is_number, row)):
            rule = f"every line must hold {len(rows[0][1])} finite numbers"
            raise InputError(f"{path}: line {line}", rule, f'"{",".join(row)}"', _CURE)
    table = np.array([[float(cell) for cell in row] for _, row in rows])
    if len(table) < 2 or table.shape[1] < 2:
        got = f"{len(table)} lines of {table.shape[1] if table.ndim == 2 else 0} numbers"
        raise InputError(str(path), "needs at least two wavelengths and one colour", got, _CURE)
    return _checked(path, names, table)


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _checked(path: Path, names: list[str] | None, table: NDArray[np.float64]) -> list[Response]:
    wavelengths, values = table[:, 0] * NM, table[:, 1:]
    order = np.argsort(wavelengths)
    wavelengths, values = wavelengths[order], values[order]
    if not (wavelengths[0] > 0 and np.all(np.diff(wavelengths) > 0)):
        raise InputError(str(path), "every wavelength must occur once", "one twice or below zero", _CURE)
    count = values.shape[1]
    usual = ["red", "green", "blue"] if count == 3 else [f"colour{k}" for k in range(count)]
    titles = usual if names is None else names[1:]
    if len(titles) != count:
        raise InputError(str(path), f"the line of names must have {count + 1} entries", f"{names}", _CURE)
    found = []
    for title, column in zip(titles, values.T, strict=True):
        low = title.lower()
        signal = column * wavelengths if low.endswith("_qe") else column
        # Measured curves may dip below zero where there is nothing.
        if not signal.max() > 0 or signal.min() < -0.05 * signal.max():
            got = f"values from {column.min():g} to {column.max():g}"
            raise InputError(f"{path}: {title}", "a response must be at least 0 and somewhere above", got, _CURE)
        found.append(Response(low.removesuffix("_qe"), wavelengths, np.maximum(signal, 0.0)))
    return found
