"""Unknowns of a calibration: some errors of a process, their prior and their limits.

The prior is that of the process, mean and standard deviation of every error; an error that the process calls constant
but the user asks for has the `prior_sigma` of `fab.process.DEVIATIONS`. Where masks lie is known only relative to each
other: a common shift moves the relief within an aperture a thousand times as wide. Mask 0 is the reference and stays at
its mean; the others' places are relative to it, with the prior that follows.

The search works on scores: independent standard normals a priori, value = mean + root @ score.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.process import DEVIATIONS, Normal, Process, Variation, deviation_of, error_names, short_name, variation_of

_DEFAULT = ("common_depth_scale", "common_cd_bias_m", "overlay_y_m", "overlay_x_m")
_KNOWABLE = tuple(key for key, error in DEVIATIONS.items() if error.prior_sigma)
_REACH = 5.0  # standard deviations within which values are looked for
# Shares of a cell that the model can follow while it is differentiated.
_WIDEST_BIAS, _LARGEST_SHIFT, _LARGEST_CORNER = 0.45, 2.5, 0.49
_STEEPEST = 0.7  # radians


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Errors to find by flat name, SI units: prior mean and root of the covariance, range, and start of the search.

    The other errors of the process stay at their means (`definite_means`).
    """

    process: Process
    names: tuple[str, ...]
    mean: NDArray[np.float64]
    root: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    start: NDArray[np.float64]

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Prior standard deviations."""
        return np.sqrt(np.diag(self.root @ self.root.T)).astype(np.float64)

    @property
    def assumed(self) -> tuple[str, ...]:
        """Errors on whose standard deviation the process is silent."""
        return tuple(name for name in self.names if not self.process.spreads.get(name, Normal()).sigma)

    def values(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values of the errors."""
        return self.mean + self.root @ scores

    def scores(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of `values`."""
        return np.asarray(np.linalg.solve(self.root, values - self.mean), np.float64)

    def variation(self, values: Any) -> Variation:
        """The DOE with these errors; `values` may be traced."""
        found = {name: values[i] for i, name in enumerate(self.names)}
        return variation_of(self.process.masks, {**definite_means(self.process), **found})


def unknowns_of(
    process: Process, errors: Sequence[str] = (), pitch_m: float = np.inf, radius_m: float = 0.0
) -> Unknowns:
    """Choose what to look for.

    Args:
        process: the process, whose means and standard deviations are the prior.
        errors: names of `fab.process.DEVIATIONS`, with or without unit, flat names such as "overlay_x[2]", or sources
            such as "overlay"; by default depth and line width common to all masks, and overlay.
        pitch_m: pitch of the DOE's cells, which bounds what can be followed.
        radius_m: distance of the DOE's corners from its middle, where masks that are turned lie off most.

    Raises:
        InputError: an unknown error, or one that no single DOE has in a definite way (roughness).
    """
    names = tuple(n for n in chosen_names(process.masks, errors or _DEFAULT) if not (relative(n) and n.endswith("[0]")))
    if not names:
        cure = "Choose another error: a process of one mask has no overlay."
        raise InputError("errors", "something must be left to find", ", ".join(errors), cure)
    sigma = np.array([prior_sigma(process, name) for name in names])
    mean = np.array([process.spreads.get(name, Normal()).mean for name in names])
    covariance = np.diag(sigma**2)
    for i, one in enumerate(names):
        for j, other in enumerate(names):
            if relative(one) and _key(one) == _key(other):
                covariance[i, j] += _reference_sigma(process, _key(one)) ** 2
    root = np.linalg.cholesky(covariance)
    reach = _REACH * np.sqrt(np.diag(covariance))
    limits = np.array([_limits(name, names, process, pitch_m, radius_m) for name in names])
    low, high = np.maximum(mean - reach, limits[:, 0]), np.minimum(mean + reach, limits[:, 1])
    one_sided = np.array([deviation_of(name).one_sided for name in names])
    low = np.where(one_sided, np.maximum(low, 0.0), low)
    for name, least, most in zip(names, low, high, strict=True):
        if least >= most:
            rule = "must have a mean that the model follows, and room about it"
            got = f"{process.spreads.get(name, Normal()).mean:g}"
            raise InputError(f"process: {name}", rule, got, "Leave this error out, or choose a process nearer to it.")
    # What a rounded corner does grows with its radius squared: at zero nothing says which way is better.
    start = np.clip(np.where(one_sided & (mean < sigma / 2), sigma / 2, mean), low, high)
    return Unknowns(process, names, mean, root, low, high, start)


def prior_sigma(process: Process, name: str) -> float:
    """Standard deviation of an error before a calibration, by its flat name: the process's, or else what is assumed."""
    return process.spreads.get(name, Normal()).sigma or deviation_of(name).prior_sigma


def _reference_sigma(process: Process, key: str) -> float:
    """Prior standard deviation of mask 0, which all others are relative to: 0 where a process says so of it alone."""
    said = [process.spreads.get(f"{key}[{mask}]", Normal()).sigma for mask in range(process.masks)]
    return said[0] if any(said) else prior_sigma(process, f"{key}[0]")


def definite_means(process: Process) -> dict[str, float]:
    """Mean of every error of a process by flat name, without roughness.

    Which roughness a DOE has cannot be known; of light at this wavelength a usual one takes a ten-thousandth.
    """
    return {name: spread.mean for name, spread in process.spreads.items() if deviation_of(name).prior_sigma}


def relative(name: str) -> bool:
    """Whether an error is known only relative to mask 0."""
    error = deviation_of(name)
    return error.source == "overlay" and error.per_mask


def _key(name: str) -> str:
    return name.partition("[")[0]


def chosen_names(masks: int, errors: Sequence[str], where: str = "errors") -> tuple[str, ...]:
    """Flat names of the errors that some words mean (`unknowns_of`), in the order of `DEVIATIONS`; `where` they stand.

    Raises:
        InputError: an unknown error, one that no single DOE has in a definite way, or a mask that is not there.
    """
    known = error_names(masks, *_KNOWABLE)
    chosen: set[str] = set()
    for error in errors:
        word, bracket, mask = error.partition("[")
        keys = [k for k in _KNOWABLE if word in (k, short_name(k), DEVIATIONS[k].source)]
        if not keys:
            choices = [short_name(k) for k in _KNOWABLE] + sorted({DEVIATIONS[k].source for k in _KNOWABLE})
            close = get_close_matches(word, choices, n=1)
            cure = f"Did you mean {close[0]}?" if close else f"One of {', '.join(choices)}."
            raise InputError(where, "must be an error that a plate has in a definite way", error, cure)
        names = [f"{key}[{mask}" for key in keys] if bracket else error_names(masks, *keys)
        if not set(names) <= set(known):
            rule = f"must be an error of the plate, or of one of the masks 0 to {masks - 1}"
            raise InputError(where, rule, error, "Correct the number in brackets.")
        chosen.update(names)
    return tuple(name for name in known if name in chosen)


def _limits(name: str, names: Sequence[str], process: Process, pitch_m: float, radius_m: float) -> tuple[float, float]:
    """Least and greatest value of an error that the model follows."""
    key = _key(name)
    if deviation_of(name).source == "cd":
        return _bias_limits_m(name, names, process, _WIDEST_BIAS * pitch_m)
    farthest_m = float(np.hypot(*process.die_m)) + radius_m  # from the middle of the wafer
    limit = {
        **dict.fromkeys(("overlay_y_m", "overlay_x_m"), _LARGEST_SHIFT * pitch_m),
        **dict.fromkeys(("rotation_rad", "magnification"), _LARGEST_SHIFT * pitch_m / (farthest_m or 1e-9)),
        "corner_radius_m": _LARGEST_CORNER * pitch_m,
        "sidewall_rad": _STEEPEST,
    }.get(key, np.inf)
    return -limit, limit


def _bias_limits_m(name: str, names: Sequence[str], process: Process, widest_m: float) -> tuple[float, float]:
    """Limits of a bias: that of a mask and the common one add up, and those not looked for stay at their means."""
    both = len({_key(n) for n in names if deviation_of(n).source == "cd"}) > 1
    beside = error_names(process.masks, "cd_bias_m" if name == "common_cd_bias_m" else "common_cd_bias_m")
    means = [process.spreads.get(n, Normal()).mean for n in beside if n not in names]
    least, most = min(means, default=0.0), max(means, default=0.0)
    low, high = -widest_m - least, widest_m - most
    return (max(low, -widest_m / 2), min(high, widest_m / 2)) if both else (low, high)
