"""The weights that a first training starts from: those of the best linear-Gaussian posterior."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.inference import mdn
from bayessim_mjx.inference.densities import Params, density_of
from bayessim_mjx.inference.ridge import LIMIT, ridge
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import inverse_lower, product

WEAK = 0.05  # smallest precision beyond the prior's that is given to a component of the probit chart


def linear_start(params: Params, x: Array, y: Array, weights: Array, settings: InferenceSettings) -> Params:
    """Set the linear path to the ridge regression of y [n, d] on x [n, D] and every component to its residuals.

    Training then starts at the best linear-Gaussian posterior instead of the prior; components keep their spread, in
    units of the residual sd. Features that do not change in training are regressed on too. No change beyond LIMIT
    features, where the normal equations would cost more than they save.

    Args:
        params: of one member.
        x: [n, D] as the network takes them in.
        y: [n, d] in the network's coordinates.
        weights: [n] 1 for rows to use and 0 for the rest.
        settings: of the network.
    """
    (dim_x, d), k = (x.shape[1], y.shape[1]), settings.components
    regressed = density_of(settings).regressed
    design = jnp.concatenate([mdn.hidden(params, x, settings), x], axis=1) if regressed else x
    if design.shape[1] > LIMIT or d == 0:
        return params
    mean, slope = ridge(design, y, weights)
    residual = (y - mean[None, :] - product(design, slope)) * weights[:, None]
    cov = product(residual.T, residual) / jnp.maximum(jnp.sum(weights), 1.0) + 1e-4 * jnp.eye(d)
    sd = jnp.sqrt(jnp.diagonal(cov))
    if mdn.bounded(settings):
        mean, slope, cov = _beyond_prior(mean, slope, cov)
    factor = inverse_lower(jnp.linalg.cholesky(cov))  # A^T A = cov^-1
    if not settings.fullCovariance:
        factor = jnp.diag(1.0 / jnp.sqrt(jnp.diagonal(cov)))
    last = params["layers"][-1]
    spread = last["b"][k : k + k * d].reshape(k, d)
    log_diagonal = 8 * jnp.arctanh(jnp.clip(jnp.log(jnp.diagonal(factor)) / 8, -0.99, 0.99))
    parts = [jnp.zeros(k), (mean[None, :] + spread * sd[None, :]).reshape(-1), jnp.tile(log_diagonal, k)]
    if settings.fullCovariance:
        parts.append(jnp.tile(factor[np.tril_indices(d, -1)], k))
    columns = jnp.tile(slope, (1, k))
    weight = last["w"]
    if regressed:
        weight = weight.at[:, k : k + k * d].add(columns[:-dim_x])
    skip = params["skip"].at[:, k : k + k * d].set(columns[-dim_x:])
    layers = [*params["layers"][:-1], {"w": weight, "b": jnp.concatenate(parts)}]
    return {**params, "layers": layers, "skip": skip}


def _beyond_prior(mean: Array, slope: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Centre mu, its slope and (A^T A)^-1 of the component of precision I + A^T A with that posterior mean and cov."""
    values, vectors = jnp.linalg.eigh(cov)
    extra = jnp.maximum(1 / values - 1, WEAK)  # eigenvalues of A^T A
    stretch = product(vectors * ((1 + extra) / extra)[None, :], vectors.T)  # m = (I + A^T A)^-1 A^T A mu
    return stretch @ mean, product(slope, stretch), product(vectors / extra[None, :], vectors.T)
