"""Steps of L-BFGS with a line search, for loss functions that are cheap enough to be called several times a step."""

from collections.abc import Callable
from typing import Any

import jax
import optax
from jaxtyping import Array

_MOST_TRIES = 12  # of a line search


def lbfgs_memory(parameters: Array, steps: int) -> Any:
    """Memory of L-BFGS before its first step, with room for so many of them.

    Its types are those of the memory after a step, so that the second step needs no compilation of its own.
    """
    memory = _optimiser(steps).init(parameters)
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), memory)  # none of them weak


def lbfgs_step(loss: Callable[[Array], Array], parameters: Array, memory: Any, steps: int) -> tuple[Array, Any, Array]:
    """Do one step.

    Args:
        loss: of parameters, a scalar that jax can differentiate.
        parameters: where it begins.
        memory: of the steps before.
        steps: how many of them are kept.

    Returns:
        parameters, memory, and the loss before the step.
    """
    optimiser = _optimiser(steps)
    value: Any
    value, gradient = optax.value_and_grad_from_state(loss)(parameters, state=memory)
    updates, memory = optimiser.update(gradient, memory, parameters, value=value, grad=gradient, value_fn=loss)
    moved: Any = optax.apply_updates(parameters, updates)
    return moved, memory, value


def _optimiser(steps: int) -> optax.GradientTransformationExtraArgs:
    search = optax.scale_by_zoom_linesearch(max_linesearch_steps=_MOST_TRIES, initial_guess_strategy="one")
    return optax.lbfgs(memory_size=steps, linesearch=search)
