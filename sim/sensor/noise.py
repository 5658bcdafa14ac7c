"""Noise of a sensor: fast Poisson counts, and noise models whose gradients pass through the draw.

**Counts.** JAX's own Poisson sampler rejects and repeats, and takes a hundred times as long as a normal draw. Here a
count is one uniform number put through the inverse of the cumulative distribution. Below a mean of 8 that inverse is
summed up term by term, exactly. Above, the inverse of the distribution's smooth continuation Q(x, mean) is expanded in
powers of 1 / sqrt(mean) with a standard normal w, and rounded down:

    x = mean + sqrt(mean) w + (w^2 + 2) / 6 - w (w^2 + 2) / (72 sqrt(mean)) + (3 w^4 + 7 w^2 - 16) / (810 mean)
        + w (2684 - 548 w^2 - 207 w^4) / (155520 mean^(3/2))

The first terms: M. B. Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution function",
ACM TOMS 42 (2016); the last one follows from the same differential equation, dx/dmean = g dx/dw / phi(w), with g the
Poisson weight at x - 1 and phi the normal density. At a mean of 8 the total variation distance to the Poisson
distribution is 7.1e-5 and it falls like 1 / mean^2; mean and variance are off by less than 2e-5 of themselves. Tails
rarer than 1e-7 are cut, as they are for normal draws in single precision.

**Gradients.** A draw n of mean x and variance v(x) is taken for x + sqrt(v(x)) z with a fixed z, so dn/dx is
1 + (n - x) v'(x) / (2 v(x)). The value itself stays the draw, to the last bit.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

# Where the expansion takes over, and how many terms the sum below it needs for every uniform number of 24 bits.
_SUMMED_BELOW = 8.0
_TERMS = 29
RELEASE_WIDTH = 0.008
TSENG_SCALE, TSENG_SIGMA = 4e-5, 1e-5


@eqx.filter_jit
def poisson(key: Key[Array, ""], mean: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Poisson counts, whole numbers as float32 without gradient, of means from 0 to 2^24 (0 for what is below)."""
    mean = jax.lax.stop_gradient(jnp.maximum(mean, 0.0).astype(jnp.float32))
    # Both ends of the interval are left out, where the normal quantile is infinite.
    centred = jax.random.uniform(key, mean.shape, jnp.float32, minval=np.nextafter(np.float32(-1), np.float32(0)))
    high = _expanded(jnp.maximum(mean, _SUMMED_BELOW), np.float32(np.sqrt(2)) * jax.lax.erf_inv(centred))

    def with_dark() -> Array:
        low = _summed(jnp.minimum(mean, _SUMMED_BELOW), 0.5 + 0.5 * centred)
        return jnp.where(mean < _SUMMED_BELOW, low, high)

    # A picture without dark places is spared the sum, which takes half of the time.
    return jax.lax.cond(jnp.min(mean, initial=np.inf) < _SUMMED_BELOW, with_dark, lambda: high)


def _summed(mean: Array, uniform: Array) -> Array:
    """Count how many values of the cumulative distribution lie below the uniform number."""
    share = jnp.exp(-mean)
    total, count = share, (uniform > share).astype(jnp.float32)
    for k in range(1, _TERMS):
        share = share * (mean * np.float32(1 / k))
        total = total + share
        count = count + (uniform > total)
    return count


def _expanded(mean: Array, w: Array) -> Array:
    r, w2 = jax.lax.rsqrt(mean), w * w
    first = (w2 + 2) * (1 / 6 - (1 / 72) * r * w)
    second = r * r * (((3 * w2 + 7) * w2 - 16) * (1 / 810) + r * w * (2684 - (548 + 207 * w2) * w2) * (1 / 155520))
    return jnp.floor(jnp.maximum(mean + mean * r * w + first + second, 0.0))


@eqx.filter_jit
def photon_noise(
    key: Key[Array, ""], signal: Float[Array, "*s"], sigma: float, *, scale: float = 1.0, most: float = np.inf
) -> Float[Array, "*s"]:
    """Shot noise and Gaussian noise: `scale` Poisson(signal / scale), saturated, plus a normal of deviation `sigma`.

    `signal` is in electrons where `scale`, the signal of one count, is 1. Counts above `most` saturate and have no
    gradient. In the gradient the variance `scale` signal + sigma^2 counts as at least that of one count, so that a
    photon in the dark does not weigh without bounds.
    """
    shot, read = jax.random.split(key)
    signal = jnp.maximum(signal, 0.0)
    counted = scale * poisson(shot, signal / scale)
    drawn = jnp.minimum(counted, most) + sigma * jax.random.normal(read, signal.shape)
    variance = jnp.maximum(scale * signal + sigma**2, scale**2)
    slope = jnp.where(counted <= most, 1 + (drawn - signal) * scale / (2 * variance), 0.0)
    return _with_slope(drawn, signal, slope)


def uniform_noise(key: Key[Array, ""], signal: Float[Array, "*s"], width: float) -> Float[Array, "*s"]:
    """Add a number drawn evenly between -`width` and `width` to every sample."""
    return signal + jax.random.uniform(key, signal.shape, minval=-width, maxval=width)


def clipped(values: Float[Array, "*s"], low: float, high: float) -> Float[Array, "*s"]:
    """Clip to an interval; the gradient is 1 on it, ends included, and 0 beyond."""
    inside = (values >= low) & (values <= high)
    return jnp.where(inside, values, jax.lax.stop_gradient(jnp.clip(values, low, high)))


def rounded(values: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Round to whole numbers; the gradient passes as if nothing had been rounded."""
    return _with_slope(jnp.round(values), values, 1.0)


def _with_slope(value: Array, of: Array, slope: Array | float) -> Array:
    """Return a value as it is, with a given derivative by `of`."""
    hold = jax.lax.stop_gradient
    return hold(value) + (of - hold(of)) * hold(slope)
