"""Networks with weights as large as a test wants them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from doedesign.recon.network import Network, NetworkShape


def drawn(layout: NetworkShape, spread: float = 0.1) -> Network:
    """A network whose weights, regularisers among them, are drawn with a given standard deviation."""
    rng = np.random.default_rng(0)
    network = Network.make(layout, 0)

    def fill(leaf):
        return jnp.asarray(rng.normal(0, spread, leaf.shape), jnp.float32) if eqx.is_array(leaf) else leaf

    return jax.tree.map(fill, network)


def count_parameters(tree: Any) -> int:
    """Count of the numbers that are learnt."""
    return sum(int(leaf.size) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)))
