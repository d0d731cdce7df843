"""Densities, draws and moments of a Distribution: jitted functions of its leaves, all in unit coordinates inside."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtri

from bayessim_mjx.compat import brief
from bayessim_mjx.distributions import box, charts
from bayessim_mjx.distributions.charts import Parts
from bayessim_mjx.linalg import lower_factor, product, solve_lower

LEVEL_OUT = 0.01  # nats between the ends of the range, by which regions of a flat density are chosen
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
    """Map unit coordinates [n, d] to theta [n, d], kept in the box against float32 rounding."""
    low, high = jnp.asarray(space.low), jnp.asarray(space.high)
    return jnp.clip(rowwise(space.from_unit, u), low[None, :], high[None, :])


@partial(brief, static_argnames="points")
def log_inside(logits: Array, means: Array, scales: Array, points: int = box.MASS_POINTS) -> Array:
    return jax.nn.logsumexp(jax.nn.log_softmax(logits) + box.log_masses(means, scales, points))


def log_unit(q: Parts, u: Array) -> Array:
    """Unit-cube log density of u [n, d] (taken to be inside) -> [n]."""
    z = charts.to_chart(u, q.chart)
    mog = jax.nn.logsumexp(jax.nn.log_softmax(q.logits)[None, :] + box.log_density(z, q.means, q.scales), axis=1)
    mog = mog + charts.log_slope(z, q.chart) - q.log_inside
    return jnp.logaddexp(jnp.log(q.prior_weight), jnp.log1p(-q.prior_weight) + mog)


def placed(q: Parts, rows: Array) -> tuple[Array, Array]:
    """Whether thetas [n, d] lie in the box [n], and their unit coordinates [n, d]; of the others any."""
    inside = jax.vmap(q.space.contains)(rows)
    safe = jnp.where(inside[:, None], rows, jnp.asarray(q.space.nominal)[None, :])
    return inside, jnp.clip(rowwise(q.space.to_unit, safe), 0, 1)


@brief
def log_gain(q: Parts, theta: Array) -> Array:
    inside, u = placed(q, as_rows(theta))
    return jnp.where(inside, log_unit(q, u), -jnp.inf).reshape(theta.shape[:-1])


def sample(q: Parts, key: Array, n: int) -> Array:
    """Draw theta [n, d]; of what is called by itself more are drawn, so that hardly any n needs another program.

    The first of more draws are those of fewer (`jax_threefry_partitionable`).
    """
    inside = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((q, key)))
    return _sample(q, key, n) if inside else _sample(q, key, max(POINTS, 1 << (n - 1).bit_length()))[:n]


@partial(brief, static_argnames="n")
def _sample(q: Parts, key: Array, n: int) -> Array:
    key_flat, key_u, key_mog = jax.random.split(key, 3)
    flat = jax.random.uniform(key_flat, (n,)) < q.prior_weight
    u = jax.random.uniform(key_u, (n, q.means.shape[-1]))
    if q.chart == "plain":
        u = box.draw(key_mog, q.logits, q.means, q.scales, flat, u, TRIES, SPARE)
    else:
        u = jnp.where(
            flat[:, None], u, charts.from_chart(box.propose(key_mog, q.logits, q.means, q.scales, n), q.chart)
        )
    return to_theta(q.space, u)


def candidates(q: Parts, key: Array, n: int) -> tuple[Array, Array]:
    """n points [n, d] in unit coordinates and which of them [n] are draws of q: a random number, nearly all as a rule.

    Without a loop, for many distributions at once.
    """
    key_flat, key_mog = jax.random.split(key)
    w = jax.random.uniform(key_flat, (n, 2 + q.means.shape[-1]))
    if q.chart == "plain":
        u, drawn = box.candidates(key_mog, q.logits, q.means, q.scales, n)
        most = jax.nn.logsumexp(jax.nn.log_softmax(q.logits) + box.log_bounds(q.scales))
        thinned = w[:, 0] < jnp.exp(q.log_inside - most)  # the prior's share has to lose as many as the mixture does
    else:
        u = charts.from_chart(box.propose(key_mog, q.logits, q.means, q.scales, n), q.chart)
        thinned = drawn = jnp.ones(n, bool)
    flat = w[:, 1] < q.prior_weight
    return jnp.where(flat[:, None], w[:, 2:], u), jnp.where(flat, thinned, drawn)


@partial(brief, static_argnames="points")
def component_points(q: Parts, points: int) -> tuple[Array, Array]:
    """Place points [K, n, d] of each component inside the cube, with log weights [K, n] whose mean is its mass."""
    w = jnp.asarray(box.lattice(points, q.means.shape[-1]))
    if q.chart == "plain":
        return jax.vmap(lambda m, s: box.separate(m, s, w))(q.means, q.scales)
    z = q.means[:, None, :] + jnp.einsum("kij,nj->kni", q.scales, ndtri(w), precision=jax.lax.Precision.HIGHEST)
    return charts.from_chart(z, q.chart), jnp.zeros((q.components, points), jnp.float32)


def prior_points(space: Any) -> Array:
    """Points of the prior, spread evenly: theta [POINTS, d]."""
    return rowwise(space.from_unit, jnp.asarray(box.lattice(POINTS, len(space))))


@partial(brief, static_argnames="points")
def quadrature(q: Parts, points: int) -> tuple[Array, Array]:
    u, log_weight = component_points(q, points)
    mass = jax.nn.softmax((jax.nn.log_softmax(q.logits)[:, None] + log_weight).reshape(-1))
    weights = jnp.concatenate([jnp.full((points,), 1 / points) * q.prior_weight, (1 - q.prior_weight) * mass])
    flat = jnp.asarray(box.lattice(points, q.means.shape[-1]))
    return to_theta(q.space, jnp.concatenate([flat, as_rows(u)])), weights


@brief
def moments(q: Parts) -> tuple[Array, Array]:
    theta, weights = quadrature(q, POINTS)
    mean = weights @ theta
    deviation = theta - mean[None, :]
    return mean, (deviation * weights[:, None]).T @ deviation


def centres_unit(q: Parts) -> Array:
    """Centres of the Gaussians in unit coordinates, kept in the cube [K, d]."""
    return jnp.clip(charts.from_chart(q.means, q.chart), 0, 1)


@brief
def mode(q: Parts) -> Array:
    theta, _ = quadrature(q, POINTS)
    centres = to_theta(q.space, centres_unit(q))
    candidates = jnp.concatenate([centres, moments(q)[0][None, :], theta])
    return candidates[jnp.argmax(log_gain(q, candidates))]


def _ranked(q: Parts, rows: Array) -> Array:
    """Log density of thetas [n, d] by which regions are chosen.

    Where it is flat one part of the range is as good a region as another, and rounding would choose point by point: a
    slope that changes densities by less than LEVEL_OUT chooses the same part for all of them.
    """
    inside, u = placed(q, rows)
    return jnp.where(inside, log_unit(q, u) - LEVEL_OUT * jnp.mean(u, axis=-1), -jnp.inf)


@brief
def credible_level(q: Parts, theta: Array) -> Array:
    points, weights = quadrature(q, POINTS)
    here, there = _ranked(q, as_rows(theta)), _ranked(q, points)
    level = (there[None, :] > here[:, None]).astype(jnp.float32) @ weights
    return level.reshape(theta.shape[:-1])


@partial(brief, static_argnums=1)
def marginal(q: Parts, index: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """logits, means and scales of the coordinates `index`; each component keeps its mass inside the cube."""
    ids = np.asarray(index)
    rows = q.scales[:, ids, :]
    means, scales = q.means[:, ids], lower_factor(rows)
    logits = jax.nn.log_softmax(q.logits)
    if q.chart == "plain":
        logits = logits + box.log_masses(q.means, q.scales) - box.log_masses(means, scales)
    return logits, means, scales


@partial(brief, static_argnums=(1, 2))
def conditional(q: Parts, given: tuple[int, ...], free: tuple[int, ...], u: Array) -> tuple[Array, Array, Array, Array]:
    """logits, means, scales and prior weight of the coordinates `free` where those `given` are u [g]. Exact."""
    # the factor of the coordinates in this order: its blocks are those of the marginal and of the conditional
    ids, g = np.asarray(given + free), len(given)
    means, lower = q.means[:, ids], lower_factor(q.scales[:, ids, :])
    z = charts.to_chart(u, q.chart)[None, :]
    evidence = box.log_density(z, means[:, :g], lower[:, :g, :g])[0] + charts.log_slope(z, q.chart)
    gap = solve_lower(lower[:, :g, :g], (z - means[:, :g])[:, :, None])
    means, scales = means[:, g:] + product(lower[:, g:, :g], gap)[:, :, 0], lower[:, g:, g:]
    logits = jax.nn.log_softmax(q.logits) + evidence
    mass = logits + box.log_masses(means, scales) if q.chart == "plain" else logits
    bulk = jnp.log1p(-q.prior_weight) - q.log_inside + jax.nn.logsumexp(mass)
    weight = jax.nn.sigmoid(jnp.log(q.prior_weight) - bulk)
    return logits, means, scales, weight
