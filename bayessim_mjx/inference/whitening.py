"""Linear coordinates of standardised summaries that a network may learn faster in; training finds out which."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from bayessim_mjx.inference.densities import density_of
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import product

LIMIT = 512  # features up to which their eigenvectors are worth the cost
FLOOR = 1e-3  # added to the whitened variances: rounding is not to be blown up


def count(settings: InferenceSettings, dim_x: int) -> int:
    """How many bases are tried, each by another member of the ensemble (the last one is linear at first)."""
    whole = settings.embedding is not None or not density_of(settings).whitened or dim_x > LIMIT
    return 1 if whole or settings.ensemble < 3 else 2


def candidates(x: Array, train: Array, tried: int) -> Array:
    """Matrices [tried, D, D] for standardised summaries x [N, D], of which those with train [N] count.

    As they are, and whitened: best where small differences tell much (noise-free trajectories), far worse where they
    are noise.
    """
    as_is = jnp.eye(x.shape[1])
    if tried == 1:
        return as_is[None]
    weights = train.astype(jnp.float32) / jnp.maximum(jnp.sum(train.astype(jnp.float32)), 1.0)
    x = x - (weights @ x)[None, :]
    values, vectors = jnp.linalg.eigh(product((x * weights[:, None]).T, x))
    return jnp.stack([as_is, vectors / jnp.sqrt(jnp.maximum(values, 0.0) + FLOOR)[None, :]])
