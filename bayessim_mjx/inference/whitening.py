"""Linear coordinates of standardised summaries that a network may learn faster in; training finds out which."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.inference.densities import density_of
from bayessim_mjx.inference.numbers import DRAWS, EPS
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import product, ridge

LIMIT = 512  # features up to which they are whitened; source: 3262ad5, Ant's 600 features
FLOOR = EPS**0.5  # added to the noise's variances: rounding is not to be blown up


def width(settings: InferenceSettings, dim_x: int, d: int) -> int:
    """Count the inputs of a network of d parameters: all D features, or two `regressed` ones for each parameter."""
    return min(2 * d, dim_x) if LIMIT < dim_x <= DRAWS and _may_change(settings) and d else dim_x


def count(settings: InferenceSettings, dim_x: int) -> int:
    """Count the bases that are tried, each by another member of the ensemble (the last one is linear at first)."""
    if not _may_change(settings) or dim_x > LIMIT or settings.ensemble < 3:
        return 1
    # a regression on the parameters too, where there are more features than units that learn of them
    return 2 + (dim_x > max(settings.hiddenLayers, default=0))


def _may_change(settings: InferenceSettings) -> bool:
    """Whether inputs may be other than the features: not of an embedding, nor where distances between them count."""
    return settings.embedding is None and density_of(settings).whitened


def candidates(x: Array, y: Array, train: Array, tried: int, noise: Array | None = None) -> Array:
    """Matrices [tried, D, D] for standardised summaries x [N, D] of parameters y [N, d]; rows with train [N] count.

    As they are, `whitened` and `regressed`.
    """
    every = [jnp.eye(x.shape[1])]
    every += [whitened(x, train, noise)] if tried > 1 else []
    every += [padded(regressed(x, y, train))] if tried > 2 else []
    return jnp.stack(every)


def padded(basis: Array) -> Array:
    """Pad a basis [D, few] to [D, D]: other inputs are 0, and these so large that first weights for D see as much."""
    dim_x, few = basis.shape
    return jnp.zeros((dim_x, dim_x)).at[:, :few].set(basis * np.sqrt(dim_x / few))


def is_padded(basis: Array) -> Array:
    """Whether a basis [D, D] is one of `padded`: the others have no column without any weight."""
    return ~jnp.any(basis[:, -1])


def whitened(x: Array, train: Array, noise: Array | None = None) -> Array:
    """Directions of unit variance [D, D]: best where small differences tell much.

    Where these are noise, whitening would blow it up: by its covariance `noise` [D, D], if known, each direction gets
    unit variance of what the parameters do, times the share of that in its variance (Wiener's filter).
    """
    weights = train.astype(jnp.float32) / jnp.maximum(jnp.sum(train.astype(jnp.float32)), 1.0)
    x = x - (weights @ x)[None, :]
    noise = jnp.zeros((x.shape[1],) * 2) if noise is None else noise
    unit = jax.lax.rsqrt(jnp.diagonal(noise) + FLOOR)  # features in units of their noise
    noise, cov = (unit[:, None] * c * unit[None, :] for c in (noise, product((x * weights[:, None]).T, x)))
    values, vectors = jnp.linalg.eigh(cov - noise)
    signal, chance = jnp.maximum(values, 0.0), jnp.sum(vectors * product(noise, vectors), axis=0)
    share = (signal + EPS) / (signal + jnp.maximum(chance, 0.0) + EPS)
    return unit[:, None] * vectors * (share * jax.lax.rsqrt(signal + 1.0))[None, :]


def regressed(x: Array, y: Array, train: Array) -> Array:
    """Linear regressions of each parameter and of its square [D, 2 d], with unit variance.

    A network that sees hundreds of features, few of which tell something, learns by heart what the others do in the
    rows that it is trained on. The posterior's mean is a summary that loses little (Fearnhead and Prangle 2012,
    https://doi.org/10.1111/j.1467-9868.2011.01010.x); squares add what a line does not see.
    """
    weights = train.astype(jnp.float32)
    n = jnp.maximum(jnp.sum(weights), 1.0)
    centred = y - (weights @ y / n)[None, :]
    _, slope = ridge(x, jnp.concatenate([centred, centred**2], axis=1)[:, : x.shape[1]], weights)
    shown = product(x, slope)
    variance = weights @ (shown - (weights @ shown / n)[None, :]) ** 2 / n
    return slope * jax.lax.rsqrt(variance + EPS)[None, :]


def noise_of(first: Array, second: Array, used: Array) -> Array:
    """Covariance [D, D] of the measurement noise, from two measurements [N, D] of the rows with used [N]."""
    apart = jnp.where(used[:, None], first - second, 0.0)
    return product(apart.T, apart) / (2 * jnp.maximum(jnp.sum(used.astype(jnp.float32)), 1.0))
