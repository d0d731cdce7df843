"""Running mean and variance of observations: exact pooled moments, no forgetting."""

import jax
import jax.numpy as jnp
from flax import struct

EPSILON = 1e-4  # added to the standard deviation, in units of the observation
LIMIT = 10.0  # normalised observations are clipped to +- LIMIT, so that a feature seen constant so far cannot explode


@struct.dataclass
class Moments:
    """Moments of all samples seen so far; mean 0 and variance 1 while there are none."""

    mean: jax.Array  # [S]
    var: jax.Array  # [S] population variance
    count: jax.Array  # [] float32, number of samples


def init(size: int) -> Moments:
    """Moments of no samples of dimension `size`: normalising with them leaves observations as they are."""
    return Moments(mean=jnp.zeros(size), var=jnp.ones(size), count=jnp.zeros(()))


def update(moments: Moments, samples: jax.Array, until: float | None = None) -> Moments:
    """Fold in samples [..., S] (Chan, Golub & LeVeque 1979): the result equals the moments of all samples together.

    Once `until` samples were seen, further ones change nothing.
    """
    over = tuple(range(samples.ndim - 1))
    mean, var, n = samples.mean(over), samples.var(over), samples.size // samples.shape[-1]
    count = moments.count + n
    new, old = n / count, moments.count / count  # weights of the two sets, sum 1
    delta = mean - moments.mean
    # var = w_old var_old + w_new var_new + w_old w_new (mean_new - mean_old)^2
    pooled = Moments(
        mean=moments.mean + new * delta,
        var=old * moments.var + new * var + old * new * delta**2,
        count=count,
    )
    if until is None:
        return pooled
    return jax.tree.map(lambda a, b: jnp.where(moments.count < until, a, b), pooled, moments)


def normalise(moments: Moments, x: jax.Array, epsilon: float = EPSILON, limit: float | None = LIMIT) -> jax.Array:
    """(x - mean) / (std + epsilon), clipped to +- limit; x [..., S]."""
    scaled = (x - moments.mean) / (jnp.sqrt(moments.var) + epsilon)
    return scaled if limit is None else jnp.clip(scaled, -limit, limit)
