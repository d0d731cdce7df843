"""Posteriors made wider by one factor on their standard deviations, and the factor that held-out truths ask for."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from bayessim_mjx.distributions import Distribution, box, charts
from bayessim_mjx.linalg import inverse_lower, lower_factor, product

TEMPERATURES = np.geomspace(1.0, 4.0, 15).astype(np.float32)
FEW = 64  # points behind the mass of a Gaussian in the box; Distribution.from_unit takes 512


def tempered(posterior: Distribution, factor: float | Array) -> Distribution:
    """Standard deviations of every component times `factor`, but never beyond the prior's; for jax.vmap too."""
    q = posterior
    return Distribution.from_unit(q.space, q.logits, *_spread(q, factor), q.prior_weight, q.chart)


def _spread(q: Distribution, factor: float | Array) -> tuple[Array, Array]:
    """Means and scales of the components of (q / p)^(1 / factor^2) p, p as Gaussian as the chart has it."""
    if q.chart == "plain":  # p is flat
        return q.means, q.scales * factor
    centre, sd = charts.NEUTRAL[q.chart]
    power = 1 / jnp.square(jnp.asarray(factor, jnp.float32))
    inverse = inverse_lower(q.scales)
    prior = jnp.broadcast_to(jnp.eye(q.scales.shape[-1]), q.scales.shape) * jnp.sqrt(1 - power) / np.float32(sd)
    # precision P power + (1 - power) / sd^2 = C C^T, P = S^-T S^-1
    c = lower_factor(jnp.concatenate([jnp.swapaxes(inverse, -1, -2) * jnp.sqrt(power), prior], axis=-1))
    scales = lower_factor(jnp.swapaxes(inverse_lower(c), -1, -2))
    shift = product(inverse, (q.means - np.float32(centre))[..., None])
    shift = product(jnp.swapaxes(inverse, -1, -2), shift) * power
    means = product(scales, product(jnp.swapaxes(scales, -1, -2), shift))[..., 0] + np.float32(centre)
    return means, scales


def temperature(posteriors: Distribution, thetas: Array, weights: ArrayLike | None = None) -> float:
    """The factor >= 1 on standard deviations that gives batched posteriors the highest mean log density at thetas.

    thetas [n, d]; weights [n], 0 for pairs to leave out.
    """
    thetas = jnp.asarray(thetas)
    weights = jnp.ones(thetas.shape[0]) if weights is None else jnp.asarray(weights, jnp.float32)
    return float(TEMPERATURES[int(np.argmax(np.asarray(_scores(posteriors, thetas, weights))))])


def gain_at(q: Distribution, theta: Array, factor: Array) -> Array:
    """log_gain of `tempered(q, factor)` at theta [d], -> []; its mass in the box by FEW points: for many weighings."""
    means, scales = _spread(q, factor)
    masses = box.log_masses(means, scales, FEW) if q.chart == "plain" else jnp.zeros_like(q.logits)
    inside = jax.nn.logsumexp(jax.nn.log_softmax(q.logits) + masses)
    return replace(q, means=means, scales=scales, log_inside=inside).log_gain(theta)


@jax.jit
def _scores(posteriors: Distribution, thetas: Array, weights: Array) -> Array:
    def at(factor: Array) -> Array:
        gain = jax.vmap(gain_at, in_axes=(0, 0, None))(posteriors, thetas, factor)
        return jnp.mean(jnp.where(jnp.isfinite(gain), gain, 0.0) * weights)

    return jax.lax.map(at, jnp.asarray(TEMPERATURES))


@jax.jit
def widened(posteriors: Distribution, factor: float | Array) -> Distribution:
    """Batched posteriors, `tempered`."""
    return jax.vmap(tempered, in_axes=(0, None))(posteriors, factor)
