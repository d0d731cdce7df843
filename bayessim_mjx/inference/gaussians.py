"""Integrals of Gaussians against Gaussians, for training: batches of small matrices without LAPACK (see linalg.py)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.linalg import product

LOG_2PI = float(np.log(2 * np.pi))


def overlap(means: Array, factors: Array, centres: Array, scales: Array) -> Array:
    """log of the integral of N(y; centre, S S^T) exp(-|A (y - mu)|^2 / 2).

    It is the evidence N(A mu; A centre, I + A S S^T A^T) less its constant: nothing is inverted, nothing cancels.
    """
    spread = product(factors, scales)
    gap = product(factors, (means - centres)[..., None])
    gram = product(spread, jnp.swapaxes(spread, -1, -2)) + jnp.eye(means.shape[-1])[(None,) * (spread.ndim - 2)]
    return log_gaussian(gap[..., 0], gram)


@jax.custom_jvp
def log_gaussian(v: Array, cov: Array) -> Array:
    """log N(v; 0, cov) + d/2 log 2 pi: v [..., d], cov [..., d, d] -> [...].

    Elimination row by row with the batch as the last axis: in training many times faster than loops over batches of
    small matrices, and no LAPACK (see linalg.py).
    """
    d = v.shape[-1]
    rows = jnp.moveaxis(cov.reshape(-1, d, d), 0, -1)  # [d, d, n]

    def eliminate(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        rows, right, value = carry
        pivot = jnp.maximum(rows[0, 0], 1e-20)
        value = value - 0.5 * jnp.log(pivot) - 0.5 * right[0] * right[0] / pivot
        column = rows[1:, 0] / pivot[None]
        right = jnp.pad(right[1:] - column * right[:1], ((0, 1), (0, 0)))
        rows = jnp.pad(rows[1:, 1:] - column[:, None] * rows[:1, 1:], ((0, 1), (0, 1), (0, 0)))
        return (rows, right, value), None

    start = rows, v.reshape(-1, d).T, jnp.zeros(rows.shape[-1], v.dtype)
    return jax.lax.scan(eliminate, start, length=d)[0][2].reshape(v.shape[:-1])


@log_gaussian.defjvp
def _log_gaussian_slope(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """d log N(v; 0, C) = -a dv + (a a^T - C^-1) : dC / 2, a = C^-1 v: a tenth of the time of going back by each row."""
    (v, cov), (dv, dcov) = primals, tangents
    inverse = _inverse(cov)
    a = jnp.sum(inverse * v[..., None, :], axis=-1)
    by_cov = 0.5 * (a[..., :, None] * a[..., None, :] - inverse)
    return log_gaussian(v, cov), jnp.sum(by_cov * dcov, axis=(-2, -1)) - jnp.sum(a * dv, axis=-1)


def _inverse(cov: Array) -> Array:
    """Inverse of symmetric positive definite matrices [..., d, d], by sweeping every pivot; the batch as last axis."""
    d = cov.shape[-1]
    place = jnp.arange(d, dtype=jnp.int32)[:, None]

    def sweep(k: Array, rows: Array) -> Array:
        row, column = (jax.lax.dynamic_index_in_dim(rows, k, axis, keepdims=False) for axis in (0, 1))  # [d, n]
        pivot = jnp.maximum(jax.lax.dynamic_index_in_dim(row, k, 0), 1e-20)  # [1, n]
        row, column = (jnp.where(place == k, side, side / pivot) for side in (row, column))
        swept = rows - (column * pivot)[:, None] * row[None]
        swept = jnp.where((place == k)[None], column[:, None], swept)
        swept = jnp.where((place == k)[:, None], row[None], swept)
        both = (place == k)[None] & (place == k)[:, None]
        return jnp.where(both, -1 / pivot[None], swept)

    rows = jax.lax.fori_loop(0, d, sweep, jnp.moveaxis(cov.reshape(-1, d, d), 0, -1))
    return -jnp.moveaxis(rows, -1, 0).reshape(cov.shape)
