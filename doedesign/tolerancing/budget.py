"""The inverse budget: how large an error may be for a wanted yield."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.tolerancing.analysis import Yield
from fab.draws import chosen_errors
from fab.process import Process

FACTORS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)


class Budget(NamedTuple):
    """Standard deviation of some errors that gives a wanted yield, all others as they are.

    Attributes:
        what: the errors: a source, an error, or an error of one mask.
        wanted: the wanted yield.
        factors: by which the standard deviations were multiplied, with the yield at each.
        verdict: "found"; "beyond": even the largest factor gives the wanted yield; "out of reach": not even none of
            these errors does.
        factor: the factor that gives the wanted yield; the largest one tried where the verdict is "beyond", and 0 where
            it is "out of reach".
        low: the factor at which the yield is the wanted one or better with 97.5 % confidence; 0 if there is none.
        high: the factor beyond which it is worse with 97.5 % confidence; the largest one tried if there is none.
        sigmas: the standard deviations at the factor, by flat name, SI units.
    """

    what: str
    wanted: float
    factors: tuple[float, ...]
    yields: tuple[Yield, ...]
    verdict: Literal["found", "beyond", "out of reach"]
    factor: float
    low: float
    high: float
    sigmas: Mapping[str, float]

    def yield_at(self, factors: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
        """The smooth curve through the yields from which the factor was read."""
        return _curve(self.factors, np.array([one.share for one in self.yields]))(factors)

    def __str__(self) -> str:
        """For example "overlay x 0.62 (0.48 to 0.75) gives a yield of 90 %"."""
        wanted = f"a yield of {100 * self.wanted:g} %"
        match self.verdict:
            case "found":
                return f"{self.what} x {self.factor:.2f} ({self.low:.2f} to {self.high:.2f}) gives {wanted}"
            case "beyond":
                return f"{self.what} x {self.factor:g} still gives {wanted}"
            case _:
                return f"without {self.what} errors the yield is {self.yields[0]}, so no budget gives {wanted}"


def budget_of(process: Process, what: str, wanted: float, factors: Sequence[float], yields: Sequence[Yield]) -> Budget:
    """The budget from the yields at some factors, which grow from 0; the other arguments as in `Study.budget`."""
    shares, lows, highs = (np.array([getattr(one, side) for one in yields]) for side in ("share", "low", "high"))
    falling = _falling(shares)
    verdict = "out of reach" if falling[0] < wanted else "beyond" if falling[-1] >= wanted else "found"
    factor = _crossing(factors, shares, wanted)
    sigmas = {name: factor * process.spreads[name].sigma for name in chosen_errors(process, what)}
    low, high = _crossing(factors, lows, wanted), _crossing(factors, highs, wanted)
    return Budget(what, wanted, tuple(factors), tuple(yields), verdict, factor, low, high, sigmas)


def _falling(shares: Float[np.ndarray, " factor"]) -> Float[np.ndarray, " factor"]:
    """The nearest curve that never rises: larger errors do not help, whatever few draws say."""
    from scipy.optimize import isotonic_regression

    return isotonic_regression(shares, increasing=False).x


def _curve(
    factors: Sequence[float], shares: Float[np.ndarray, " factor"]
) -> Callable[[Float[np.ndarray, " f"]], Float[np.ndarray, " f"]]:
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(factors, _falling(shares))  # falls wherever the points do


def _crossing(factors: Sequence[float], shares: Float[np.ndarray, " factor"], wanted: float) -> float:
    """Largest factor at which a falling curve through the points is at least `wanted`; 0 where there is none."""
    from scipy.optimize import brentq

    falling = _falling(shares)
    reached = np.flatnonzero(falling >= wanted)
    if not len(reached):
        return 0.0
    last = int(reached[-1])
    if last == len(factors) - 1 or falling[last] == wanted:
        return float(factors[last])
    curve = _curve(factors, shares)
    root = brentq(lambda factor: float(curve(np.asarray(factor))) - wanted, factors[last], factors[last + 1])
    return float(np.asarray(root))
