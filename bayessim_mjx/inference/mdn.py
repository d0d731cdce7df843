"""Mixture density network: standardised features -> mixture of Gaussians over z-scored unit coordinates.

y = (u - 1/2) sqrt(12) has mean 0 and variance 1 under every prior. A component is N(y; mu, (A^T A)^-1) with A lower
triangular, so training needs no solve and its log-determinant is exact (reference/sbi.md section 2.2).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.triangular import inverse_lower, product

Params = dict[str, Any]
RIDGE_LIMIT = 1024  # features up to which linear_start is worth its cost
SPREAD = np.float32(np.sqrt(12.0))  # 1 / sd of Uniform[0, 1]


def to_y(u: Array) -> Array:
    """Unit coordinates -> coordinates of the network."""
    return (u - 0.5) * SPREAD


def from_y(y: Array) -> Array:
    """Coordinates of the network -> unit coordinates."""
    return y / SPREAD + 0.5


def head_size(d: int, settings: InferenceSettings) -> int:
    """Outputs of the network: logits, means, log diagonals, strictly lower entries."""
    lower = d * (d - 1) // 2 if settings.fullCovariance else 0
    return settings.components * (1 + 2 * d + lower)


def init(key: Array, settings: InferenceSettings, dim_x: int, d: int) -> Params:
    """Network weights: hidden layers, a small last layer, a linear path from input to output, spread mean biases."""
    sizes = (dim_x, *settings.hiddenLayers, head_size(d, settings))
    keys = jax.random.split(key, len(sizes))
    gains = [1.0] * (len(sizes) - 2) + [0.1]
    layers = [
        {"w": jax.random.normal(k, (n, m)) * np.float32(gain / np.sqrt(n)), "b": jnp.zeros(m)}
        for k, n, m, gain in zip(keys, sizes, sizes[1:], gains, strict=False)
    ]
    k = settings.components
    biases = layers[-1]["b"].at[k : k + k * d].set(0.7 * jax.random.normal(keys[-1], (k * d,)))
    layers[-1] = {**layers[-1], "b": biases}
    return {"layers": layers, "skip": jnp.zeros((dim_x, sizes[-1]))}


def linear_start(params: Params, x: Array, y: Array, weights: Array, settings: InferenceSettings) -> Params:
    """Set the linear path to the ridge regression of y [n, d] on x [n, D] and every component to its residuals.

    Training then starts at the best linear-Gaussian posterior instead of the prior; components keep their spread, in
    units of the residual sd. `weights` [n] are 1 for rows to use and 0 for the rest. No change beyond RIDGE_LIMIT
    features, where the normal equations would cost more than they save.
    """
    (dim_x, d), k = (x.shape[1], y.shape[1]), settings.components
    if dim_x > RIDGE_LIMIT or d == 0:
        return params
    n = jnp.maximum(jnp.sum(weights), 1.0)
    gram = product((x * weights[:, None]).T, x) / n + 1e-3 * jnp.eye(dim_x)
    mean = weights @ y / n
    slope = jnp.linalg.solve(gram, product((x * weights[:, None]).T, y - mean[None, :]) / n)  # [D, d]
    residual = (y - mean[None, :] - x @ slope) * weights[:, None]
    chol = jnp.linalg.cholesky(residual.T @ residual / n + 1e-4 * jnp.eye(d))
    sd = jnp.sqrt(jnp.sum(chol * chol, axis=1))
    factor = inverse_lower(chol)
    if not settings.fullCovariance:
        factor = jnp.diag(1.0 / sd)
    last = params["layers"][-1]
    spread = last["b"][k : k + k * d].reshape(k, d)
    log_diagonal = 8 * jnp.arctanh(jnp.log(jnp.diagonal(factor)) / 8)
    parts = [jnp.zeros(k), (mean[None, :] + spread * sd[None, :]).reshape(-1), jnp.tile(log_diagonal, k)]
    if settings.fullCovariance:
        parts.append(jnp.tile(factor[np.tril_indices(d, -1)], k))
    skip = params["skip"].at[:, k : k + k * d].set(jnp.tile(slope, (1, k)))
    return {"layers": [*params["layers"][:-1], {**last, "b": jnp.concatenate(parts)}], "skip": skip}


def forward(params: Params, x: Array, d: int, settings: InferenceSettings) -> tuple[Array, Array, Array]:
    """Standardised x [n, D] -> logits [n, K], means [n, K, d], precision factors A [n, K, d, d] in y coordinates."""
    n, k = x.shape[0], settings.components
    h = x
    for layer in params["layers"][:-1]:
        h = jax.nn.silu(h @ layer["w"] + layer["b"][None, :])
    last = params["layers"][-1]
    out = h @ last["w"] + last["b"][None, :] + x @ params["skip"]
    logits, means, diagonal, lower = jnp.split(out, np.cumsum([k, k * d, k * d]), axis=1)
    # A_ii = exp(8 tanh(r / 8)): between exp(-8) and exp(8), slope 1 at r = 0
    diagonal = jnp.exp(8 * jnp.tanh(diagonal.reshape(n, k, d) / 8))
    factors = diagonal[..., None] * jnp.eye(d)[None, None]
    if settings.fullCovariance and d > 1:
        rows, columns = np.tril_indices(d, -1)
        factors = factors.at[:, :, rows, columns].set(lower.reshape(n, k, -1))
    return logits, means.reshape(n, k, d), factors


def log_prob(params: Params, x: Array, y: Array, settings: InferenceSettings) -> Array:
    """Untruncated log density of y [n, d] given standardised x [n, D] -> [n]."""
    d = y.shape[-1]
    logits, means, factors = forward(params, x, d, settings)
    z = jnp.sum(factors * (y[:, None, :] - means)[:, :, None, :], axis=-1)  # A (y - mu)
    log_det = jnp.sum(jnp.log(jnp.diagonal(factors, axis1=-2, axis2=-1)), axis=-1)
    constant = np.float32(0.5 * d * np.log(2 * np.pi))
    component = log_det - 0.5 * jnp.sum(z * z, axis=-1) - constant
    return jax.nn.logsumexp(jax.nn.log_softmax(logits) + component, axis=-1)


def mixture(params: Params, x: Array, d: int, settings: InferenceSettings) -> tuple[Array, Array, Array]:
    """Mixture in unit coordinates: logits [n, K], means [n, K, d], Cholesky factors of the covariances [n, K, d, d]."""
    logits, means, factors = forward(params, x, d, settings)
    # covariance (A^T A)^-1 = A^-1 A^-T, and A^-1 is lower triangular
    return logits, 0.5 + means / SPREAD, inverse_lower(factors) / SPREAD
