"""Ridge regression, whose normal equations are cheap up to a thousand features."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from bayessim_mjx.linalg import product

LIMIT = 1024  # features up to which it is worth its cost
RIDGE = 1e-3  # of the features' variance


def ridge(design: Array, y: Array, weights: Array) -> tuple[Array, Array]:
    """Ridge regression of y [n, d] on design [n, H] with weights [n] of 0 or 1 -> mean [d], slope [H, d]."""
    n = jnp.maximum(jnp.sum(weights), 1.0)
    mean = weights @ y / n
    weighted = (design * weights[:, None]).T
    gram = product(weighted, design) / n + RIDGE * jnp.eye(design.shape[1])
    return mean, jnp.linalg.solve(gram, product(weighted, y - mean[None, :]) / n)
