"""How pictures name and colour the channels of a camera, and which depths of a bank they show."""

import math
from collections.abc import Sequence

from fab.figure import LINE, SERIES, evenly_spaced, length_text
from fab.units import NM
from sim.camera import Colour
from sim.metrics import mean_wavelength_m

_BLUE, _RED, _GREEN = SERIES[:3]


def colour_label(colour: Colour) -> str:
    """Name and wavelength of a colour channel: "red, 656 nm"; only the wavelength where the name says no more."""
    mean = "mean " if len(colour.wavelengths_m) > 1 else ""
    middle_m = mean_wavelength_m(colour)
    wavelength, same = length_text(middle_m), colour.name == f"{middle_m / NM:.6g}nm".replace(".", "p")
    return wavelength if same else f"{colour.name}, {mean}{wavelength}"


def wavelength_order(colours: Sequence[Colour]) -> list[int]:
    """Positions of the colours from the longest mean wavelength to the shortest."""
    return sorted(range(len(colours)), key=lambda i: -mean_wavelength_m(colours[i]))


def line_colours(colours: Sequence[Colour]) -> list[str]:
    """A line colour for every colour channel, from the longest wavelength's red to the shortest one's blue."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    count = len(colours)
    fixed = {1: [LINE], 2: [_RED, _BLUE], 3: [_RED, _GREEN, _BLUE]}
    hues = fixed.get(count) or [to_hex(colormaps["plasma"](0.9 * (1 - i / (count - 1)))) for i in range(count)]
    order = wavelength_order(colours)
    return [hues[order.index(i)] for i in range(count)]


def depth_positions(of_m: Sequence[float], depths_m: Sequence[float], most: int) -> list[int]:
    """Positions among the depths `of_m` of a bank of at most `most` of some depths, which must be there."""
    positions = []
    for depth in (depths_m[i] for i in evenly_spaced(len(depths_m), most)):
        # A bank that was read from a file may have rounded its depths.
        same = [i for i, other in enumerate(of_m) if math.isclose(depth, other, rel_tol=1e-6)]
        if not same:
            raise ValueError(f"depth {depth:g} m must be in the bank, but its depths are {tuple(of_m)}")
        positions.append(same[0])
    return positions
