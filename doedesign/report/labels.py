"""Errors of a process in words, and their values with units."""

import math

from fab.process import DEVIATIONS

__all__ = ["error_label", "number_text", "value_text"]


def error_label(name: str) -> str:
    """An error in words: "overlay x, mask 3" for "overlay_x_m[2]"; people count masks from 1, as the run sheet does."""
    key, _, mask = name.partition("[")
    words = key.removesuffix("_m").removesuffix("_rad").replace("_", " ")
    return f"{words}, mask {int(mask.removesuffix(']')) + 1}" if mask else words


def value_text(name: str, value: float, sigma: float | None = None) -> str:
    """An error with its unit, and its standard deviation: "-120 ± 4 nm"; as many digits as mean something."""
    key = name.partition("[")[0]
    units = {"m": (1e9, "nm"), "rad": (math.degrees(1.0), "°"), "1": (100.0, "%")}
    factor, unit = (1e6, "ppm") if key == "magnification" else units[DEVIATIONS[key].unit]
    return number_text(value, sigma or 0.0, factor, unit)


def number_text(value: float, sigma: float, factor: float = 1.0, unit: str = "") -> str:
    """A number times `factor` with its unit, and its standard deviation unless that is 0, as many digits as count."""
    unit = unit and f" {unit}"
    if not sigma > 0:
        return f"{factor * value:.3g}{unit}"
    digits = max(0, 1 - math.floor(math.log10(factor * sigma)))
    return f"{factor * value:.{digits}f} ± {factor * sigma:.{digits}f}{unit}"
