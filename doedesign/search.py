"""Searches for the least loss over a few bounded values, by NLopt (S. G. Johnson, https://nlopt.readthedocs.io).

A search has stages. Each begins at the best values so far: a global one looks through the whole range, a local one
follows it down. None of them takes a gradient, and the same seed gives the same values.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

# Global: dividing rectangles (D. R. Jones et al. 1993), controlled random search (P. Kaelo and M. M. Ali 2006), local
# searches from many starts (A. H. G. Rinnooy Kan and G. T. Timmer 1987), evolution (T. P. Runarsson and X. Yao 2005).
# Local: subspaces of Nelder and Mead's simplex (T. Rowan 1990), quadratic models (M. J. D. Powell 2009).
ALGORITHMS = {
    "direct": "GN_DIRECT_L",
    "crs": "GN_CRS2_LM",
    "mlsl": "G_MLSL_LDS",
    "isres": "GN_ISRES",
    "sbplx": "LN_SBPLX",
    "bobyqa": "LN_BOBYQA",
}
_FINEST = 1e-3  # of the first step, at which local searches of "mlsl" end


def least(
    loss: Callable[[np.ndarray], float],
    low: Sequence[float],
    high: Sequence[float],
    stages: Sequence[tuple[str, int]],
    *,
    step: float,
    start: Sequence[float] | None = None,
    seed: int = 0,
    settled: float = 0.0,
) -> list[float]:
    """Where a loss of a few values is least.

    Args:
        loss: the loss of values `[n]`.
        low: their lowest values.
        high: their highest values.
        stages: names among `ALGORITHMS`, and how often each may evaluate the loss.
        step: first step of local searches, in all values.
        start: values to begin with; the middle of the range by default.
        seed: of everything random.
        settled: change of the values at which a local stage ends before its evaluations do.

    Returns:
        the best of all values that were looked at.
    """
    import nlopt

    first = (np.array(low) + np.array(high)) / 2 if start is None else np.array(start, float)
    best, lowest = first, np.inf

    def followed(values: np.ndarray, _gradient: np.ndarray) -> float:
        nonlocal best, lowest
        found = loss(values)
        if found < lowest:
            best, lowest = values.copy(), found
        return found

    for name, evaluations in stages:
        search = nlopt.opt(getattr(nlopt, ALGORITHMS[name]), len(first))
        search.set_lower_bounds(low)
        search.set_upper_bounds(high)
        search.set_initial_step(step)
        search.set_maxeval(max(evaluations, 1))
        if name in ("sbplx", "bobyqa") and settled:
            search.set_xtol_abs(settled)
        if name == "mlsl":
            search.set_local_optimizer(_local(nlopt, len(first), step))
        nlopt.srand(seed + 1)  # 0 would take the time
        try:
            run_search(search, followed, best)
        except nlopt.RoundoffLimited:
            continue  # as near as numbers allow
    return [float(value) for value in best]


def run_search(search: Any, loss: Callable[[np.ndarray, np.ndarray], float], start: np.ndarray) -> None:
    """Run a search of NLopt; an error in the loss, or Ctrl-C, ends it and is raised as it is.

    Left to NLopt, it would not end a controlled random search that draws its first points, which then calls the loss
    with the error still in flight.

    Args:
        search: the search, an `nlopt.opt`.
        loss: the loss of values, which keeps what is found; the gradient that it is given is empty.
        start: values to begin with.
    """
    raised: list[BaseException] = []

    def guarded(values: np.ndarray, gradient: np.ndarray) -> float:
        if raised:
            return 0.0
        try:
            return loss(values, gradient)
        except BaseException as error:
            raised.append(error)
            search.force_stop()
            return 0.0

    search.set_min_objective(guarded)
    try:
        search.optimize(start)
    except Exception:  # of NLopt, which may end in several ways
        if not raised:
            raise
    if raised:
        raise raised[0]


def _local(nlopt: Any, count: int, step: float) -> Any:
    search = nlopt.opt(nlopt.LN_SBPLX, count)
    search.set_initial_step(step)
    search.set_xtol_abs(step * _FINEST)
    return search
