"""What a calibration looks for: some errors of a process, what is believed of them beforehand, and their limits.

Beliefs are those of the process, mean and standard deviation of every error; an error that the process calls constant
but the user asks for is believed to lie within `ASSUMED`. Where masks lie is known only relative to each other: a
common shift moves the relief within an aperture a thousand times as wide. Mask 0 is the reference and stays at its
mean; the others' places are relative to it, with the belief that follows.

The search works on scores: independent standard normals beforehand, value = mean + root @ score.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.process import DEVIATIONS, Normal, Process, Variation, error_names, variation_of

DEFAULT = ("common_depth_scale", "common_cd_bias_m", "overlay_y_m", "overlay_x_m")

# Standard deviations of errors on which a process is silent; what a careless lab would still not exceed twice.
ASSUMED: Mapping[str, float] = MappingProxyType(
    {
        "common_depth_scale": 0.05,
        "depth_scale": 0.03,
        "radial_nonuniformity": 0.05,
        "linear_nonuniformity_y": 0.03,
        "linear_nonuniformity_x": 0.03,
        "overlay_y_m": 1e-6,
        "overlay_x_m": 1e-6,
        "rotation_rad": 3e-4,
        "magnification": 3e-5,
        "common_cd_bias_m": 0.3e-6,
        "cd_bias_m": 0.2e-6,
        "corner_radius_m": 0.5e-6,
        "sidewall_rad": 0.1,
        "etch_lag": 0.05,
        "chrome_y_m": 2e-6,
        "chrome_x_m": 2e-6,
        "chrome_diameter_m": 4e-6,
    }
)
_REACH = 5.0  # standard deviations within which values are looked for
# Shares of a cell that the model can follow while it is differentiated.
_WIDEST_BIAS, _LARGEST_SHIFT, _LARGEST_CORNER = 0.45, 2.5, 0.49
_STEEPEST = 0.7  # radians


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Errors to find.

    Attributes:
        masks: number of masks.
        names: flat names of the errors.
        mean: what they are believed to be.
        root: lower triangle that makes values of independent standard normals.
        low: smallest values looked at.
        high: largest ones.
        start: where the search begins.
        fixed: the other errors of the process by flat name, at their means (`definite_means`).
        assumed: those of `names` whose belief is not the process's but `ASSUMED`.
    """

    masks: int
    names: tuple[str, ...]
    mean: NDArray[np.float64]
    root: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    start: NDArray[np.float64]
    fixed: Mapping[str, float]
    assumed: tuple[str, ...]

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations believed beforehand."""
        return np.sqrt(np.diag(self.root @ self.root.T)).astype(np.float64)

    def values(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values of the errors."""
        return self.mean + self.root @ scores

    def scores(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of `values`."""
        return np.asarray(np.linalg.solve(self.root, values - self.mean), np.float64)

    def relative(self, name: str) -> bool:
        """Whether an error is that of a mask relative to mask 0."""
        return _relative(name)

    def variation(self, values: Any) -> Variation:
        """The plate with these errors; `values` may be traced."""
        return variation_of(self.masks, {**self.fixed, **{name: values[i] for i, name in enumerate(self.names)}})


def unknowns_of(process: Process, errors: Sequence[str] = (), pitch_m: float = np.inf) -> Unknowns:
    """Choose what to look for.

    Args:
        process: the process, with what is believed of its errors.
        errors: names of `fab.process.DEVIATIONS`, with or without unit, flat names, or sources such as "overlay"; by
            default depth and line width common to all masks, and overlay.
        pitch_m: pitch of the DOE's cells, which bounds what can be followed.

    Raises:
        InputError: an unknown error, or one that no single plate has in a definite way (roughness).
    """
    names = tuple(n for n in chosen_names(process.masks, errors or DEFAULT) if not (_relative(n) and n.endswith("[0]")))
    if not names:
        cure = "Choose another error: a process of one mask has no overlay."
        raise InputError("--errors", "something must be left to find", ", ".join(errors), cure)
    sigma = np.array([_belief(process, name).sigma for name in names])
    assumed = tuple(name for name, s in zip(names, sigma, strict=True) if s == 0)
    sigma = np.array([s or ASSUMED[_key(n)] for n, s in zip(names, sigma, strict=True)])
    mean = np.array([_belief(process, name).mean for name in names])
    covariance = np.diag(sigma**2)
    for i, one in enumerate(names):
        for j, other in enumerate(names):
            if _relative(one) and _key(one) == _key(other):
                reference = _belief(process, f"{_key(one)}[0]").sigma
                covariance[i, j] += (reference or ASSUMED[_key(one)]) ** 2
    root = np.linalg.cholesky(covariance)
    reach = _REACH * np.sqrt(np.diag(covariance))
    limits = np.array([_limit(name, names, process, pitch_m) for name in names])
    low, high = np.maximum(mean - reach, -limits), np.minimum(mean + reach, limits)
    one_sided = np.array([DEVIATIONS[_key(name)].one_sided for name in names])
    low = np.where(one_sided, np.maximum(low, 0.0), low)
    # What a rounded corner does grows with its radius squared: at zero nothing says which way is better.
    start = np.clip(np.where(one_sided & (mean < sigma / 2), sigma / 2, mean), low, high)
    fixed = {name: mean for name, mean in definite_means(process).items() if name not in names}
    return Unknowns(process.masks, names, mean, root, low, high, start, MappingProxyType(fixed), assumed)


def definite_means(process: Process) -> dict[str, float]:
    """Mean of every error of a process by flat name, without roughness.

    Which roughness a plate has cannot be known; of light at this wavelength a usual one takes a ten-thousandth.
    """
    return {n: s.mean for n, s in process.spreads.items() if DEVIATIONS[_key(n)].source != "roughness"}


def _key(name: str) -> str:
    return name.partition("[")[0]


def _relative(name: str) -> bool:
    """Whether an error is known only relative to mask 0."""
    error = DEVIATIONS[_key(name)]
    return error.source == "overlay" and error.per_mask


def _belief(process: Process, name: str) -> Normal:
    return process.spreads.get(name, Normal())


def _plain(key: str) -> str:
    return key.removesuffix("_m").removesuffix("_rad")


def _keys(error: str) -> tuple[str, ...]:
    """Keys of `DEVIATIONS` that are meant by one word."""
    bare = _key(error)
    keys = tuple(k for k, e in DEVIATIONS.items() if bare in (k, _plain(k), e.source) and k in ASSUMED)
    if not keys:
        choices = [_plain(k) for k in ASSUMED] + sorted({DEVIATIONS[k].source for k in ASSUMED})
        close = get_close_matches(bare, choices, n=1)
        cure = f"Did you mean {close[0]}?" if close else f"One of {', '.join(choices)}."
        raise InputError("--errors", "must be an error that a plate has in a definite way", error, cure)
    return keys


def chosen_names(masks: int, errors: Sequence[str]) -> tuple[str, ...]:
    """Flat names of the errors that are meant by some words, in the order of `DEVIATIONS`.

    Args:
        masks: number of masks.
        errors: names of `fab.process.DEVIATIONS`, with or without unit, flat names such as "overlay_x[2]", or sources.

    Raises:
        InputError: an unknown error, one that no single plate has in a definite way, or a mask that is not there.
    """
    known = error_names(masks, *ASSUMED)
    chosen: set[str] = set()
    for error in errors:
        _, bracket, mask = error.partition("[")
        names = [f"{key}[{mask}" for key in _keys(error)] if bracket else list(error_names(masks, *_keys(error)))
        if not set(names) <= set(known):
            rule = f"must be an error of the plate, or of one of the masks 0 to {masks - 1}"
            raise InputError("--errors", rule, error, "Mend the number in brackets.")
        chosen |= set(names)
    return tuple(name for name in known if name in chosen)


def _limit(name: str, names: Sequence[str], process: Process, pitch_m: float) -> float:
    """Largest size of an error that the model follows."""
    key = _key(name)
    if DEVIATIONS[key].source == "cd":
        # The common bias and a mask's own add up.
        both = len({_key(n) for n in names if DEVIATIONS[_key(n)].source == "cd"})
        return _WIDEST_BIAS * pitch_m / both
    if key in ("overlay_y_m", "overlay_x_m"):
        return _LARGEST_SHIFT * pitch_m
    return {"corner_radius_m": _LARGEST_CORNER * pitch_m, "sidewall_rad": _STEEPEST}.get(key, np.inf)
