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
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import ensemble, region
from bayessim_mjx.inference.fit import FitInfo, FitState, condition, fit, init
from bayessim_mjx.linalg import inverse_lower, lower_factor, product
from bayessim_mjx.parameters import Parameter, ParameterSpace

LONGEST = 512  # features of a summary up to which they are pooled too: a choice, others were not measured
AT_ONCE = 1024  # trajectories embedded at once, for the memory

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
    """A network of sets of so many trajectories.

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
    y, mean, scale = region.draw(k_theta, near, sets)
    thetas = region.theta(near, mean + product(y, scale.T))
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

    They are the mean of the standardised summaries (where these have no more than LONGEST features), and of the
    product of the Gaussians that have the moments of each posterior the mean [d] and the log precisions [d].
    """
    each = [_pool(network, x) for x in columns]
    total = reduce(_sum, each)
    back = inverse_lower(total.lower)
    centre = product(jnp.swapaxes(back, -1, -2), product(back, total.pull[..., None]))[..., 0]
    parts = [centre, jnp.log(jnp.diagonal(total.lower, axis1=-2, axis2=-1))]
    if total.summaries.shape[1] <= LONGEST:
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
    """Of one summary [D]: the Gaussian that has the moments of its posterior, in the chart of the network."""
    z = network.inputs(x[None])
    logits, means, scales = (leaf[0] for leaf in ensemble.mixtures(network, z))
    root = jnp.sqrt(jax.nn.softmax(logits))
    mean = (root**2) @ means
    within = (root[:, None, None] * scales).transpose(1, 0, 2).reshape(len(mean), -1)
    spread = lower_factor(jnp.concatenate([within, (root[:, None] * (means - mean)).T], axis=1))
    half = inverse_lower(spread)
    return _Pool(half.T @ (half @ mean), lower_factor(half.T), z[0])


__all__ = ["SetNetwork", "learn", "pooled"]
