import jax
import jax.numpy as jnp
import numpy as np

from sim.imaging.scene import Obstruction, Scene


def scene(depth_m, value: float) -> Scene:
    light = np.full((3, 4, 5), value, np.float32)
    return Scene(light, np.inf, (Obstruction(light[0], light, depth_m),))


def test_scenes_of_several_depths_stack():
    """Depths are leaves, so a batch is one tree of arrays."""
    batch = jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), scene(0.05, 1), scene(0.1, 2)
    )
    assert batch.background.shape == (2, 3, 4, 5)
    np.testing.assert_allclose(batch.obstructions[0].depth_m, [0.05, 0.1])


def test_a_new_depth_compiles_nothing():
    traces = []

    @jax.jit
    def total(given: Scene):
        traces.append(1)
        return jnp.sum(given.background) * given.obstructions[0].depth_m

    for depth in (0.05, 0.06, 0.07):
        total(scene(depth, 1.0))
    assert len(traces) == 1
