"""A posterior of several trajectories by a network that sees them together, trained where their posterior lies.

A product of the posteriors of single trajectories multiplies an error of their network by their number. Here sets of as
many trajectories are simulated at draws of the prior within the product's region (as truncated proposals, Deistler et
al. 2022), and a second network learns theta from a set, so that it makes no more of a set than sets turned out to tell.
It is a deep set (Zaheer et al. 2017): a trajectory's embedding is its summary and what the network of single
trajectories makes of it, pooled by means, which have no order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtr, ndtri
from scipy.stats import chi2

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.charts import EDGE, from_chart, to_chart
from bayessim_mjx.inference import ensemble
from bayessim_mjx.inference.fit import FitInfo, FitState, condition, fit, init
from bayessim_mjx.inference.numbers import AT_ONCE, DRAWS, EPS, FEW
from bayessim_mjx.inference.whitening import LIMIT
from bayessim_mjx.linalg import inverse_lower, lower_factor, product
from bayessim_mjx.parameters import Parameter, ParameterSpace

Simulate = Callable[[Array, Array], Array]  # key, theta [m, d] -> summaries [m, D]


@dataclass(frozen=True)
class SetNetwork:
    """A network of sets, in coordinates in which its region is a ball of radius 1.

    Attributes:
        network: of single trajectories, which embeds.
        state: of the network of sets.
        mean, scale: [d] and [d, d] lower triangular; the region is at mean + scale y in the coordinates of a chart.
        chart: of the posterior that the region is around.
        info: of the fit.
    """

    network: FitState
    state: FitState
    mean: Array
    scale: Array
    chart: str
    info: FitInfo

    def posteriors(self, columns: Iterable[Array]) -> Distribution:
        """Batched posteriors of m sets, given as n columns of summaries [m, D]."""
        local = condition(self.state, pooled(self.network, columns))
        means = self.mean + product(2 * local.means - 1, self.scale.T)
        scales = product(2 * self.scale, local.scales)
        return _posteriors(self.network.space, local.logits, means, scales, self.chart)


@partial(jax.jit, static_argnames="chart")
def _posteriors(space: ParameterSpace, logits: Array, means: Array, scales: Array, chart: str) -> Distribution:
    return jax.vmap(partial(Distribution.from_unit, space, chart=chart))(logits, means, scales)


def learn(
    key: Array, network: FitState, near: Distribution, simulate: Simulate, trajectories: int, sets: int
) -> SetNetwork:
    """Learn a network of sets of so many trajectories.

    Args:
        key: consumed.
        network: of single trajectories.
        near: where theta may be, in plain or probit coordinates: the product of the trajectories' posteriors, as wide
            as it should be.
        simulate: summaries of one trajectory of each set.
        trajectories: n, of a set.
        sets: how many are simulated.
    """
    k_theta, k_init, k_fit, *keys = jax.random.split(key, 3 + trajectories)
    y, mean, scale = draw_region(k_theta, near, sets)
    thetas = theta_at(near, mean + product(y, scale.T))
    features = pooled(network, (simulate(k, thetas) for k in keys))
    settings = replace(network.settings, embedding=None, coordinates="plain", restandardise=False)
    # the same space for every region: nothing is compiled again
    ball = ParameterSpace([Parameter(name, 0.0, -1.0, 1.0) for name in near.names])
    state, info = fit(k_fit, init(k_init, settings, ball, features.shape[1]), y, features)
    return SetNetwork(network, state, mean, scale, near.chart, info)


class _Pool(NamedTuple):
    """Sums over the trajectories of m sets so far."""

    pull: Array  # [m, d] precision times mean of each posterior
    lower: Array  # [m, d, d] factor of the sum of the precisions
    summaries: Array  # [m, D] standardised


def pooled(network: FitState, columns: Iterable[Array]) -> Array:
    """Features [m, F] of m sets, given as n columns of summaries [m, D]; whatever the order of the columns.

    They are the mean of the standardised summaries (where these have no more than LIMIT features), and of the
    product of the Gaussians that have the moments of each posterior the mean [d] and the log precisions [d].
    """
    each = [_pool(network, x) for x in columns]
    total = reduce(_sum, each)
    back = inverse_lower(total.lower)
    centre = product(jnp.swapaxes(back, -1, -2), product(back, total.pull[..., None]))[..., 0]
    parts = [centre, jnp.log(jnp.diagonal(total.lower, axis1=-2, axis2=-1))]
    if total.summaries.shape[1] <= LIMIT:
        parts.append(total.summaries / len(each))
    return jnp.concatenate(parts, axis=1)


@jax.jit
def _sum(a: _Pool, b: _Pool) -> _Pool:
    lower = lower_factor(jnp.concatenate([a.lower, b.lower], axis=-1))  # no precision is formed
    return _Pool(a.pull + b.pull, lower, a.summaries + b.summaries)


@jax.jit
def _pool(network: FitState, x: Array) -> _Pool:
    return jax.lax.map(lambda row: _embedded(network, row), x, batch_size=AT_ONCE)


def _embedded(network: FitState, x: Array) -> _Pool:
    """Find the Gaussian with the moments of the posterior of one summary [D], in the chart of the network."""
    z = network.inputs(x[None])
    logits, means, scales = (leaf[0] for leaf in ensemble.mixtures(network, z))
    root = jnp.sqrt(jax.nn.softmax(logits))
    mean = (root**2) @ means
    within = (root[:, None, None] * scales).transpose(1, 0, 2).reshape(len(mean), -1)
    spread = lower_factor(jnp.concatenate([within, (root[:, None] * (means - mean)).T], axis=1))
    half = inverse_lower(spread)
    return _Pool(half.T @ (half @ mean), lower_factor(half.T), z[0])


def draw_region(key: Array, near: Distribution, count: int) -> tuple[Array, Array, Array]:
    """Draws of the prior within the ellipsoid of the chart's coordinates mean + scale y, |y| < 1.

    By hit-and-run from draws of `near` (Smith 1984): along a random direction anywhere within the ellipsoid and the
    box, both convex, by the prior. Rejection would find hardly any with ten parameters.

    Args:
        key: consumed.
        near: a posterior in plain or probit coordinates; its share of the prior is left out.
        count: of draws.

    Returns:
        y [count, d], mean [d], scale [d, d] lower triangular.
    """
    # all of a Gaussian but rounding: ends of a narrower region would look like knowledge
    radius = float(np.sqrt(chi2.isf(EPS, len(near.names))))
    return _draw_region(key, replace(near, prior_weight=jnp.zeros_like(near.prior_weight)), radius, count)


@partial(jax.jit, static_argnames="count")
def _draw_region(key: Array, near: Distribution, radius: Array, count: int) -> tuple[Array, Array, Array]:
    k_pool, k_walk = jax.random.split(key)
    theta = near.sample(k_pool, max(DRAWS, count))
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

    y, _ = jax.lax.scan(step, y, jax.random.split(k_walk, FEW * d))
    return y, mean, scale


def _chord(y: Array, way: Array, mean: Array, scale: Array, chart: str) -> tuple[Array, Array]:
    """Distances back and forth along `way` [n, d] from y [n, d] to the ends of the ball and, if plain, the cube."""
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


def theta_at(near: Distribution, z: Array) -> Array:
    """theta [N, d] at coordinates z [N, d] of the chart."""
    u = jnp.clip(from_chart(z, near.chart), 0.0, 1.0)
    return jnp.clip(jax.vmap(near.space.from_unit)(u), jnp.asarray(near.space.low), jnp.asarray(near.space.high))


__all__ = ["SetNetwork", "draw_region", "learn", "pooled", "theta_at"]
