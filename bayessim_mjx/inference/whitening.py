"""Linear coordinates of standardised summaries that a network may learn faster in; training finds out which."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from bayessim_mjx.inference.densities import density_of
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import product

LIMIT = 512  # features up to which their eigenvectors are worth the cost
FLOOR = 1e-3  # added to the noise's variances: rounding is not to be blown up
EPS = 1e-6  # of a direction that neither parameters nor noise move


def count(settings: InferenceSettings, dim_x: int) -> int:
    """How many bases are tried, each by another member of the ensemble (the last one is linear at first)."""
    whole = settings.embedding is not None or not density_of(settings).whitened or dim_x > LIMIT
    return 1 if whole or settings.ensemble < 3 else 2


def candidates(x: Array, train: Array, tried: int, noise: Array | None = None) -> Array:
    """Matrices [tried, D, D] for standardised summaries x [N, D], of which those with train [N] count.

    As they are, and whitened: best where small differences tell much. Where these are noise, whitening would blow it
    up: by its covariance `noise` [D, D], if known, each direction gets unit variance of what the parameters do, times
    the share of that in its variance (Wiener's filter).
    """
    as_is = jnp.eye(x.shape[1])
    if tried == 1:
        return as_is[None]
    weights = train.astype(jnp.float32) / jnp.maximum(jnp.sum(train.astype(jnp.float32)), 1.0)
    x = x - (weights @ x)[None, :]
    noise = jnp.zeros_like(as_is) if noise is None else noise
    unit = jax.lax.rsqrt(jnp.diagonal(noise) + FLOOR)  # features in units of their noise
    noise, cov = (unit[:, None] * c * unit[None, :] for c in (noise, product((x * weights[:, None]).T, x)))
    values, vectors = jnp.linalg.eigh(cov - noise)
    told, chance = jnp.maximum(values, 0.0), jnp.sum(vectors * product(noise, vectors), axis=0)
    share = (told + EPS) / (told + jnp.maximum(chance, 0.0) + EPS)
    return jnp.stack([as_is, unit[:, None] * vectors * (share * jax.lax.rsqrt(told + 1.0))[None, :]])


def noise_of(first: Array, second: Array, used: Array) -> Array:
    """Covariance [D, D] of the measurement noise, from two measurements [N, D] of the rows with used [N]."""
    apart = jnp.where(used[:, None], first - second, 0.0)
    return product(apart.T, apart) / (2 * jnp.maximum(jnp.sum(used.astype(jnp.float32)), 1.0))
