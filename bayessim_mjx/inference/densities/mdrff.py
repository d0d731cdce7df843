"""MDRFF[_<kernel>[_<bandwidth>]]: a mixture on random Fourier features of a kernel (features.py)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from bayessim_mjx.config.names import kernel_of
from bayessim_mjx.inference import features
from bayessim_mjx.inference.densities.density import Density, Drop, Params, register
from bayessim_mjx.inference.ridge import LIMIT, ridge
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import product

MULTIPLES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # of the median distance: bandwidths tried by validation


def _start(key: Array, settings: InferenceSettings, dim_x: int) -> tuple[Params, tuple[int, ...]]:
    kernel, bandwidth = settings.density[1]
    omega = features.frequencies(kernel, dim_x, settings.fourierFeatures)
    rate = jnp.asarray(1 / (bandwidth if isinstance(bandwidth, float) else 1.0), jnp.float32)
    return {"omega": jnp.asarray(omega), "rate": rate}, (2 * settings.fourierFeatures,)


def _hidden(params: Params, x: Array, drop: Drop | None = None) -> Array:
    return features.fourier(x, params["omega"], params["rate"])


def _prepare(params: Params, x: Array, y: Array, train: Array, held: Array, settings: InferenceSettings) -> Params:
    """Set the bandwidth from the data, where it is not given as a number."""
    bandwidth = settings.density[1][1]
    if isinstance(bandwidth, float):
        return params
    median = features.median_distance(x, train)
    if bandwidth == "median" or x.shape[1] + 2 * settings.fourierFeatures > LIMIT:
        return {**params, "rate": 1 / median}

    def held_out(rate: Array) -> Array:
        """log det of the held-out residuals' covariance."""
        design = jnp.concatenate([features.fourier(x, params["omega"], rate), x], axis=1)
        mean, slope = ridge(design, y, train.astype(jnp.float32))
        residual = jnp.where(held[:, None], y - mean[None, :] - product(design, slope), 0.0)
        cov = product(residual.T, residual) / jnp.maximum(jnp.sum(held.astype(jnp.float32)), 1.0)
        return jnp.linalg.slogdet(cov + 1e-6 * jnp.eye(y.shape[1]))[1]

    rates = 1 / (median * jnp.asarray(MULTIPLES, jnp.float32))
    return {**params, "rate": rates[jnp.argmin(jax.lax.map(held_out, rates))]}


MDRFF = register(
    Density(
        "MDRFF", _start, _hidden, kernel_of, fixed=("omega", "rate"), prepare=_prepare, regressed=True, whitened=False
    )
)
