"""Densities, draws and moments of a Distribution: jitted functions of its leaves, all in unit coordinates inside."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import box
from bayessim_mjx.triangular import lower_factor

if TYPE_CHECKING:
    from bayessim_mjx.distributions.distribution import Distribution

POINTS = 1024  # quadrature points per component behind mean, cov, mode, credible_level
TRIES, SPARE = 50, 32  # rejection rounds of sample, and points per row that is then still outside


def rowwise(function: Any, x: Array) -> Array:
    """Apply a function of one vector [d] over all leading axes."""
    rows = jax.vmap(function)(as_rows(x))
    return rows.reshape(x.shape[:-1] + rows.shape[1:])


def as_rows(x: Array) -> Array:
    """[..., d] -> [n, d], also for d = 0."""
    return x.reshape(math.prod(x.shape[:-1]), x.shape[-1])


def to_theta(space: Any, u: Array) -> Array:
    """Unit coordinates [n, d] -> theta [n, d], kept in the box against float32 rounding."""
    low, high = jnp.asarray(space.low), jnp.asarray(space.high)
    return jnp.clip(rowwise(space.from_unit, u), low[None, :], high[None, :])


@jax.jit
def log_inside(logits: Array, means: Array, scales: Array) -> Array:
    return jax.nn.logsumexp(jax.nn.log_softmax(logits) + box.log_masses(means, scales))


def log_unit(q: Distribution, u: Array) -> Array:
    """Unit-cube log density of u [n, d] (taken to be inside) -> [n]."""
    mog = jax.nn.logsumexp(jax.nn.log_softmax(q.logits)[None, :] + box.log_density(u, q.means, q.scales), axis=1)
    return jnp.logaddexp(jnp.log(q.prior_weight), jnp.log1p(-q.prior_weight) + mog - q.log_inside)


@jax.jit
def log_gain(q: Distribution, theta: Array) -> Array:
    rows = as_rows(theta)
    inside = jax.vmap(q.space.contains)(rows)
    u = jnp.clip(
        rowwise(q.space.to_unit, jnp.where(inside[:, None], rows, jnp.asarray(q.space.nominal)[None, :])), 0, 1
    )
    return jnp.where(inside, log_unit(q, u), -jnp.inf).reshape(theta.shape[:-1])


@partial(jax.jit, static_argnames="n")
def sample(q: Distribution, key: Array, n: int) -> Array:
    key_flat, key_u, key_mog = jax.random.split(key, 3)
    flat = jax.random.uniform(key_flat, (n,)) < q.prior_weight
    u = jax.random.uniform(key_u, (n, q.means.shape[-1]))
    u = box.draw(key_mog, q.logits, q.means, q.scales, flat, u, TRIES, SPARE)
    return to_theta(q.space, u)


@partial(jax.jit, static_argnames="points")
def quadrature(q: Distribution, points: int) -> tuple[Array, Array]:
    d = q.means.shape[-1]
    w = jnp.asarray(box.lattice(points, d))
    u, log_weight = jax.vmap(lambda m, s: box.separate(m, s, w))(q.means, q.scales)
    mass = jax.nn.softmax((jax.nn.log_softmax(q.logits)[:, None] + log_weight).reshape(-1))
    weights = jnp.concatenate([jnp.full((points,), 1 / points) * q.prior_weight, (1 - q.prior_weight) * mass])
    return to_theta(q.space, jnp.concatenate([w, as_rows(u)])), weights


@jax.jit
def moments(q: Distribution) -> tuple[Array, Array]:
    theta, weights = quadrature(q, POINTS)
    mean = weights @ theta
    deviation = theta - mean[None, :]
    return mean, (deviation * weights[:, None]).T @ deviation


@jax.jit
def mode(q: Distribution) -> Array:
    theta, _ = quadrature(q, POINTS)
    centres = to_theta(q.space, jnp.clip(q.means, 0, 1))
    candidates = jnp.concatenate([centres, moments(q)[0][None, :], theta])
    return candidates[jnp.argmax(log_gain(q, candidates))]


@jax.jit
def credible_level(q: Distribution, theta: Array) -> Array:
    points, weights = quadrature(q, POINTS)
    here, there = log_gain(q, as_rows(theta)), log_gain(q, points)
    level = (there[None, :] > here[:, None]).astype(jnp.float32) @ weights
    return level.reshape(theta.shape[:-1])


@partial(jax.jit, static_argnums=1)
def marginal(q: Distribution, index: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """logits, means and scales of the coordinates `index`; each component keeps its mass inside the cube."""
    ids = np.asarray(index)
    rows = q.scales[:, ids, :]
    means, scales = q.means[:, ids], lower_factor(rows)
    logits = jax.nn.log_softmax(q.logits) + box.log_masses(q.means, q.scales) - box.log_masses(means, scales)
    return logits, means, scales
