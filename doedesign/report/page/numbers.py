"""Numbers and names in words."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from fab.units import format_length

# Names of the numbers of `sim.metrics.METRICS` and of the tables of aims, which would need jax to be asked.
LABELS: Mapping[str, str] = MappingProxyType(
    {
        "zeroth_order": "0th order",
        "strehl": "relative Strehl ratio",
        "throughput": "throughput",
        "outside_window": "light outside the window",
        "chrome": "light by chrome",
        "ring_to_disc": "ring:disc",
        "disc_radius_m": "radius of the defocus disc",
        "concentration": "concentration",
        "concentration_bound": "least concentration",
        "far_spot": "far spot",
        "spot_radius_m": "radius of the far spot",
        "on_target": "light on the target",
        "uniformity_error": "uniformity error",
        "contrast": "contrast",
        "focus_width": "largest width of the foci over that wanted",
    }
)
SHARES = frozenset(
    (
        "zeroth_order",
        "throughput",
        "outside_window",
        "chrome",
        "far_spot",
        "on_target",
        "uniformity_error",
        "contrast",
        "focus_width",
    )
)


def label_of(name: str) -> str:
    """A number's name in words."""
    return LABELS.get(name, name.removesuffix("_m").removesuffix("_rad").replace("_", " "))


def value_of(name: str, value: float | None) -> str:
    """A metric with its unit: shares in per cent, lengths with a unit of length."""
    if value is None:
        return "–"
    if name in SHARES:
        return percent(value)
    if name.endswith("_m"):
        return length(value)
    return f"{math.degrees(value):.4g}°" if name.endswith("_rad") else number(value)


def number(value: Any, digits: int = 4) -> str:
    """A number with so many digits; text as it is, nothing as a dash."""
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return f"{value:.{digits}g}"


def percent(value: float | None) -> str:
    """A share in per cent, to a hundredth: "30.52 %"."""
    return "–" if value is None else f"{100 * value:.2f} %"


def length(value: float | None) -> str:
    """A length with its unit, "1.85 µm"; None is infinity."""
    if value is None or math.isinf(value):
        return "∞"
    return format_length(float(f"{value:.4g}")).replace("um", "µm")


def rounded(value: float | None, digits: int = 6) -> float | None:
    """A number with no more digits than a chart shows; None for what is not finite."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.{digits}g}")
