"""Descent on levels: the last step of a design, when every cell stands on a level.

Cells whose slope promises most move by one level, many at once; the move is kept only if the loss falls, and is halved
otherwise. What is judged is the loss over all depths and over the displacements of a few steps, so no move is paid
for by what one look misses.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from doedesign.design.levels.parametrize import Parameters
from doedesign.design.problem import Problem, SourceSet, value_and_slope
from doedesign.spec import Spec

_FIRST_SHARE = 0.02  # of the cells, that the first move takes
_GROWTH = 1.5  # of a move after one that was kept


def looks_of(scene: SourceSet, seed: int) -> list[Any]:
    """The sources that a judgement looks at: all colours at every depth twice, each with a displacement of its own."""
    scene = scene._replace(in_turn=False)
    count = 1 if scene.whole else max(len(scene.near[0]), len(scene.far[0]), 1)
    return [scene.look(seed, step) for step in range(2 * count)]


def descend(
    spec: Spec,
    problem: Problem,
    scene: SourceSet,
    parameters: Parameters,
    moves: int,
    advance: Callable[[int, float], None] = lambda move, loss: None,
) -> Parameters:
    """Move cells by a level where that lowers the loss.

    Args:
        spec: the spec, whose seed decides the looks.
        problem: the problem.
        scene: its sources.
        parameters: those that the steps ended with; the depths of the etches stay.
        moves: how many moves are tried; each costs as much as the steps that see every depth twice.
        advance: called with the number of moves tried and the loss.

    Returns:
        parameters whose cells stand on their levels, with a loss that is not higher.
    """
    staircase, looks = problem.parametrization, looks_of(scene, spec.optimize.seed)
    step_m, count = staircase.levels.step_m, staircase.levels.count
    level = np.asarray(staircase.level(staircase.continuous_m(parameters.radians))).astype(np.int32)

    def judge(level: np.ndarray) -> tuple[float, np.ndarray]:
        height = jnp.asarray(level * np.float32(step_m), jnp.float32)  # of the pixels that are drawn
        found = [value_and_slope(problem, height, look) for look in looks]
        return float(np.mean([loss for loss, _, _ in found])), np.mean([slope for _, _, slope in found], axis=0)

    best, slope = judge(level)
    share = _FIRST_SHARE
    for move in range(moves):
        cells = max(1, int(share * level.size))
        moved = level - np.sign(slope).astype(np.int32)
        promise = np.where((moved >= 0) & (moved < count), np.abs(slope), 0)  # no cell goes round
        chosen = np.argsort(-promise, axis=None, kind="stable")[:cells]
        tried = level.copy()
        tried.flat[chosen] = np.clip(moved.flat[chosen], 0, count - 1)
        loss, other = judge(tried)
        if loss < best:
            level, best, slope, share = tried, loss, other, min(share * _GROWTH, 0.1)
        elif cells == 1:
            break
        else:
            share /= 2
        advance(move + 1, best)
    return parameters._replace(radians=jnp.asarray(staircase.radians_of(level * step_m)))
