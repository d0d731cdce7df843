"""Draws of the prior where a posterior is: within an ellipsoid around it, in the coordinates of its chart."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtr, ndtri
from scipy.stats import chi2

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.charts import EDGE, from_chart, to_chart
from bayessim_mjx.linalg import inverse_lower, product

# choices; other values were not measured
MASS = 1e-3  # of a Gaussian that an ellipsoid leaves outside, before it is made wider
WIDER = 2.0  # standard deviations, times: with the posterior itself as region, its ends would look like knowledge
POOL = 4096  # draws behind its mean and covariance
STEPS = 32  # of a walk, times the number of parameters


def draw(key: Array, near: Distribution, count: int, wider: float = WIDER) -> tuple[Array, Array, Array]:
    """Draws of the prior within the ellipsoid of the chart's coordinates mean + scale y, |y| < 1.

    By hit-and-run from draws of `near` (Smith 1984): along a random direction anywhere within the ellipsoid and the
    box, both convex, by the prior. Rejection would find hardly any with ten parameters.

    Args:
        key: consumed.
        near: a posterior in plain or probit coordinates; its share of the prior is left out.
        count: of draws.
        wider: factor on its standard deviations.

    Returns:
        y [count, d], mean [d], scale [d, d] lower triangular.
    """
    radius = wider * float(np.sqrt(chi2.ppf(1 - MASS, len(near.names))))
    return _draw(key, replace(near, prior_weight=jnp.zeros_like(near.prior_weight)), radius, count)


@partial(jax.jit, static_argnames="count")
def _draw(key: Array, near: Distribution, radius: Array, count: int) -> tuple[Array, Array, Array]:
    k_pool, k_walk = jax.random.split(key)
    theta = near.sample(k_pool, max(POOL, count))
    z = to_chart(jnp.clip(jax.vmap(near.space.to_unit)(theta), EDGE, 1 - EDGE), near.chart)
    mean, d = jnp.mean(z, axis=0), z.shape[1]
    away = z - mean[None, :]
    scale = radius * jnp.linalg.cholesky(product(away.T, away) / len(z) + 1e-12 * jnp.eye(d))
    y = product(away[:count], inverse_lower(scale).T)
    y = y * jnp.minimum(1.0, 0.99 / jnp.maximum(jnp.linalg.norm(y, axis=1, keepdims=True), 1e-9))

    def step(y: Array, key: Array) -> tuple[Array, None]:
        k_way, k_far = jax.random.split(key)
        way = jax.random.normal(k_way, y.shape)
        way = way / jnp.linalg.norm(way, axis=1, keepdims=True)
        low, high = _chord(y, way, mean, scale, near.chart)
        far = jax.random.uniform(k_far, (count,), minval=1e-6, maxval=1 - 1e-6)
        if near.chart == "plain":
            return y + (low + far * (high - low))[:, None] * way, None
        moved = product(way, scale.T)
        size = jnp.linalg.norm(moved, axis=1)  # along the way the prior is N(middle, 1 / size)
        middle = -jnp.sum(moved * (mean + product(y, scale.T)), axis=1) / size**2
        a, b = ndtr((low - middle) * size), ndtr((high - middle) * size)
        by = middle + ndtri(jnp.clip(a + far * (b - a), 1e-7, 1 - 1e-7)) / size
        return y + jnp.clip(by, low, high)[:, None] * way, None

    y, _ = jax.lax.scan(step, y, jax.random.split(k_walk, STEPS * d))
    return y, mean, scale


def _chord(y: Array, way: Array, mean: Array, scale: Array, chart: str) -> tuple[Array, Array]:
    """How far one can go back and forth along `way` [n, d] from y [n, d] within the ball and, if plain, the cube."""
    along = jnp.sum(y * way, axis=1)
    half = jnp.sqrt(jnp.maximum(along**2 + 1 - jnp.sum(y**2, axis=1), 0.0))
    low, high = -along - half, -along + half
    if chart != "plain":
        return low, high
    z, by = mean + product(y, scale.T), product(way, scale.T)
    by = jnp.where(jnp.abs(by) < 1e-12, 1e-12, by)
    ends = jnp.stack([-z / by, (1 - z) / by])
    low = jnp.maximum(low, jnp.max(jnp.min(ends, axis=0), axis=1))
    high = jnp.minimum(high, jnp.min(jnp.max(ends, axis=0), axis=1))
    return jnp.minimum(low, 0.0), jnp.maximum(high, 0.0)


def theta(near: Distribution, z: Array) -> Array:
    """theta [N, d] at coordinates z [N, d] of the chart."""
    u = jnp.clip(from_chart(z, near.chart), 0.0, 1.0)
    return jnp.clip(jax.vmap(near.space.from_unit)(u), jnp.asarray(near.space.low), jnp.asarray(near.space.high))


__all__ = ["draw", "theta"]
