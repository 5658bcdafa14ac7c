import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim.propagation.pupil import DoeRows, block_size, cis, doe_field, in_blocks
from sim.source import MapColumns


@pytest.mark.parametrize("reach", [0.5, 3.0, 50.0])
def test_cis_against_the_library(rng: np.random.Generator, reach: float):
    waves = np.concatenate([rng.uniform(-reach, reach, 200_000), np.arange(-8, 9) / 8]).astype(np.float32)
    got = np.asarray(cis(jnp.asarray(waves)))
    wanted = np.exp(2j * np.pi * waves.astype(np.float64))
    # The docstring states 4e-6; the reduction to a quarter wave is exact, so the reach does not matter.
    assert np.abs(got - wanted).max() < 4e-6


def test_cis_has_unit_modulus_and_exact_quarters():
    waves = jnp.linspace(-1, 1, 10_001, dtype=jnp.float32)
    assert float(jnp.abs(jnp.abs(cis(waves)) - 1).max()) < 4e-6  # the same bound as above
    assert complex(cis(jnp.float32(0.0))) == 1
    assert complex(cis(jnp.float32(0.5))) == -1


def test_the_derivative_of_cis_is_a_quarter_turn():
    waves = jnp.linspace(-0.7, 0.9, 57, dtype=jnp.float32)
    value, rate = jax.jvp(cis, (waves,), (jnp.ones_like(waves),))
    # By construction the very same cosine and sine, so only the rounding of 2 pi remains.
    np.testing.assert_allclose(np.asarray(rate), 2j * np.pi * np.asarray(value), rtol=1e-6, atol=1e-6)
    sensitivity = jax.grad(lambda w: jnp.sum(cis(w).real))(waves)
    np.testing.assert_allclose(sensitivity, -2 * np.pi * np.sin(2 * np.pi * waves), atol=4e-5)


def test_blocks_are_groups_of_rows_that_divide_them_or_the_last_is_padded():
    """Whole groups of 32 for two threads, of 64 to 256 rows, and near 128."""
    if jax.default_backend() != "cpu":
        pytest.skip("blocks are for a processor's cache")
    assert [block_size(n) for n in (1024, 480, 2400, 192, 64, 320)] == [128, 96, 96, 96, 64, 160]
    assert [block_size(n) for n in (251, 100, 1000)] == [128, 128, 128]
    leaf = jnp.arange(2 * 251 * 3, dtype=jnp.float32).reshape(251, 6)
    (cut,) = in_blocks((leaf,), 128)
    assert cut.shape == (2, 128, 6)
    joined = np.asarray(cut).reshape(-1, 6)
    np.testing.assert_array_equal(joined[:251], leaf)
    assert not joined[251:].any()
    assert in_blocks(leaf[:128], 64).shape == (2, 64, 6)


def test_a_closed_row_gives_no_field():
    rows = DoeRows(jnp.zeros((2, 3)), jnp.full((2, 3), 1e-6), None, jnp.full((2, 3), 0.3))
    assert np.all(np.asarray(doe_field(rows, MapColumns(jnp.float32(8e5)))) == 0)


def test_glass_and_path_add_as_phase():
    rows = DoeRows(jnp.full((1, 1), 0.5), jnp.full((1, 1), 0.5e-6), None, jnp.full((1, 1), 0.125))
    got = complex(np.asarray(doe_field(rows, MapColumns(jnp.float32(5e5))))[0, 0])
    assert got == pytest.approx(0.5 * np.exp(2j * np.pi * 0.375), abs=4e-6)
