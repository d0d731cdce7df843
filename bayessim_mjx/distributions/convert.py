"""On the host: theta units -> unit coordinates, and Distribution <-> float64 mixtures."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.distributions import algebra, box, charts, evaluate
from bayessim_mjx.distributions.charts import Parts
from bayessim_mjx.errors import UserError

ROUNDING = 1e-5  # of unit coordinates in float32
OFF = np.float32(-1e9)  # logit of a component that is not in use


def empty(components: int, d: int, centre: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """logits, means, scales of `components` that are not in use."""
    return np.full(components, OFF), np.full((components, d), centre), np.tile(np.eye(d), (components, 1, 1))


def to_mixture(q: Parts) -> algebra.Mixture:
    """Write the density of q (plain or probit) as a part of the prior + weighted, untruncated Gaussians.

    Components of no weight are left out where they are no Gaussians. ValueError where q is no density.
    """
    logits, means, scales = (np.asarray(v, np.float64) for v in (q.logits, q.means, q.scales))
    w0, inside = float(q.prior_weight), float(q.log_inside)
    if not (0 <= w0 <= 1 and np.isfinite(inside) and not np.isnan(logits).any() and np.isfinite(logits).any()):
        raise ValueError(f"no density: weight of the prior {w0:g}, log mass {inside:g}, log weights {logits}")
    shares = logits - np.logaddexp.reduce(logits)
    widths = np.diagonal(scales, axis1=1, axis2=2)
    good = np.isfinite(means).all(axis=1) & np.isfinite(scales).all(axis=(1, 2)) & (widths > 0).all(axis=1)
    if np.any(~good & (shares > np.log(algebra.FAINT))):
        raise ValueError(f"no density: means {means[~good]}, scales {scales[~good]}")
    with np.errstate(divide="ignore"):
        flat, bulk = np.log(w0), np.log1p(-w0) - inside
    weights, means, scales = np.maximum(shares + bulk, -1e12)[good], means[good], scales[good]
    return algebra.Mixture(float(flat), weights, means, scales, charts.PRIOR_PRECISION.get(q.chart, 1.0))


def recharted(q: Parts, chart: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, scales and logits in another chart: moments of each component (of its part inside the cube)."""
    u, log_weights = evaluate.component_points(q, evaluate.POINTS)
    z, log_weights = (np.asarray(v, np.float64) for v in (charts.to_chart(u, chart), log_weights))
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    means = np.einsum("kn,kni->ki", weights, z)
    gap = z - means[:, None]
    least = np.broadcast_to(1e-6 * np.eye(z.shape[-1]), (len(means), z.shape[-1], z.shape[-1]))
    scales = algebra.root(np.concatenate([np.sqrt(weights)[..., None] * gap, least], axis=1))
    # every component keeps its mass inside the cube
    mass = np.logaddexp.reduce(log_weights, axis=1) - np.log(log_weights.shape[1])
    if chart == "plain":
        mass = mass - np.asarray(box.log_masses(jnp.asarray(means, jnp.float32), jnp.asarray(scales, jnp.float32)))
    return means, scales, np.asarray(q.logits, np.float64) + mass


def regrown(q: Parts, space: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, scales and logits over `space`, whose ranges contain those of q; each component keeps its weight.

    Priors keep their kind, so that the old unit coordinates are the new ones but for shift and scale.
    """
    start, end = (np.asarray(space.to_unit(x), np.float64) for x in (q.space.low, q.space.high))
    growth, logits = start + 1 - end, np.asarray(q.logits, np.float64)
    growth = np.where(growth > ROUNDING, growth, 0.0)
    if q.chart == "plain":
        old = jnp.asarray(q.means, jnp.float32), jnp.asarray(q.scales, jnp.float32)
        means = start + (end - start) * np.asarray(old[0], np.float64)
        means = np.where(growth > 0, np.clip(means, 0, 1), means)
        rows = np.swapaxes((end - start)[:, None] * np.asarray(old[1], np.float64), -1, -2)
        more = np.broadcast_to(np.diag(growth / 2), rows.shape)
        scales = algebra.root(np.concatenate([rows, more], axis=1))
        new = jnp.asarray(means, jnp.float32), jnp.asarray(scales, jnp.float32)
        return means, scales, logits + np.asarray(box.log_masses(*old) - box.log_masses(*new), np.float64)
    u = start + (end - start) * np.asarray(evaluate.component_points(q, evaluate.POINTS)[0], np.float64)
    # each point as far as it may lie: evenly between where it is and half the growth to either side
    u = np.clip(u + growth * (np.random.default_rng(0).random(u.shape) - 0.5), 0, 1)
    z = np.asarray(charts.to_chart(jnp.asarray(u, jnp.float32), q.chart), np.float64)
    means = z.mean(axis=1)
    least = np.broadcast_to(1e-6 * np.eye(z.shape[-1]), (len(means), z.shape[-1], z.shape[-1]))
    gap = (z - means[:, None]) / np.sqrt(z.shape[1])
    return means, algebra.root(np.concatenate([gap, least], axis=1)), logits


def padded(mixture: algebra.Mixture, components: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """logits, means, scales of `components` Gaussians, and the log of their summed weights."""
    k, d = mixture.means.shape
    logits, means, scales = empty(components, d)
    total = float(np.logaddexp.reduce(mixture.log_weights))
    logits[:k], means[:k], scales[:k] = mixture.log_weights - total, mixture.means, mixture.scales
    return logits, means, scales, total


def unit_gaussian(space: Any, mean: Any, cov_or_sd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean [d] and lower Cholesky factor [d, d] in unit coordinates; sd below 1e-6 of the box is raised to it."""
    d = len(space)
    theta, spread = np.asarray(mean, np.float64), np.asarray(cov_or_sd, np.float64)
    if theta.shape != (d,) or spread.shape not in ((), (d,), (d, d)):
        raise ValueError(f"{d} parameters {space.names}: mean of shape {theta.shape}, spread of shape {spread.shape}")
    for name, value, low, high in zip(space.names, theta, space.low, space.high, strict=True):
        if not np.float32(low) <= np.float32(value) <= np.float32(high):
            raise UserError(f"mean of {name} is {value:g}, outside [{low:g}, {high:g}]")
    cov = spread if spread.ndim == 2 else np.diag(np.broadcast_to(spread, (d,)) ** 2)
    point = jnp.asarray(theta, jnp.float32)
    u, slope = jax.jvp(space.to_unit, (point,), (jnp.ones_like(point),))
    slope = np.asarray(slope, np.float64)
    if not np.all(np.isfinite(cov)) or np.any(np.diagonal(cov) < 0):
        raise UserError(f"spread of {space.names} must be finite and not negative, not {cov_or_sd}")
    unit = slope[:, None] * cov * slope[None, :] + 1e-12 * np.eye(d)
    return np.asarray(u, np.float64), np.linalg.cholesky(unit)


def check_same_space(a: Any, b: Any) -> None:
    if tuple(a.names) != tuple(b.names) or not (np.allclose(a.low, b.low) and np.allclose(a.high, b.high)):
        raise ValueError(f"distributions over different parameters: {tuple(a.names)} and {tuple(b.names)}")
