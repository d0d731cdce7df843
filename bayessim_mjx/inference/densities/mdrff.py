"""MDRFF[_<kernel>[_<bandwidth>]]: a mixture on quasi-random Fourier features of a stationary kernel.

phi(x) . phi(y) / (2 M) -> k(|x - y| / bandwidth). Spectral densities: RBF is Gaussian; Matern nu is a multivariate
Student t with 2 nu degrees of freedom. The entries of a vector share one chi-square, so the kernel is isotropic.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats
from scipy.special import ndtri
from scipy.stats import qmc

from bayessim_mjx.config.names import kernel_of
from bayessim_mjx.inference.densities.density import Density, Drop, Params, register
from bayessim_mjx.inference.numbers import FEW
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import REGRESSED, product, ridge

NU = {"RBF": np.inf, "Laplace": 0.5, "Matern12": 0.5, "Matern32": 1.5, "Matern52": 2.5}
# bandwidths tried by validation, in median distances; source: rule of thumb, not counted
MULTIPLES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)


def frequencies(kernel: str, dim: int, count: int, seed: int = 0, sequence: str = "sobol") -> np.ndarray:
    """Frequencies [dim, count] of a kernel of bandwidth 1, from a scrambled Sobol or Halton sequence; host only."""
    if kernel not in NU:
        raise ValueError(f"kernel = {kernel!r}: there are {', '.join(NU)}")
    if sequence not in ("sobol", "halton"):
        raise ValueError(f"sequence = {sequence!r}: there are sobol, halton")
    rng = np.random.default_rng(seed)
    if sequence == "sobol":  # balanced in powers of two
        points = qmc.Sobol(dim + 1, scramble=True, rng=rng).random_base2(int(np.ceil(np.log2(max(count, 2)))))[:count]
    else:
        points = qmc.Halton(dim + 1, scramble=True, rng=rng).random(count)
    points = np.clip(points, 1e-9, 1 - 1e-9)
    omega, nu = ndtri(points[:, :dim]), NU[kernel]
    if np.isfinite(nu):
        # t = z sqrt(2 nu / chi^2_{2 nu})
        omega = omega * np.sqrt(2 * nu / stats.chi2.ppf(points[:, dim:], 2 * nu))
    return np.ascontiguousarray(omega.T, np.float32)


def kernel(name: str, distance: np.ndarray) -> np.ndarray:
    """k(r) at distances r in units of the bandwidth."""
    r = np.asarray(distance)
    if name == "RBF":
        return np.exp(-0.5 * r**2)
    s = np.sqrt(2 * NU[name]) * r
    polynomial = {0.5: 1.0, 1.5: 1 + s, 2.5: 1 + s + s**2 / 3}[NU[name]]
    return polynomial * np.exp(-s)


def fourier(x: Array, omega: Array, rate: Array) -> Array:
    """sqrt(2) [cos, sin](x omega / bandwidth): x [n, D], omega [D, M], rate = 1 / bandwidth [] -> [n, 2 M]."""
    phase = product(x * rate, omega)
    return np.float32(np.sqrt(2)) * jnp.concatenate([jnp.cos(phase), jnp.sin(phase)], axis=1)


def median_distance(x: Array, use: Array) -> Array:
    """Median distance between the first rows of x [n, D] with use [n] (bool)."""
    rows = jnp.argsort(~use)[:FEW]
    x, use = x[rows], use[rows]
    squares = jnp.sum(x * x, axis=1)
    squared = squares[:, None] + squares[None, :] - 2 * product(x, x.T)
    pair = use[:, None] & use[None, :] & ~jnp.eye(len(rows), dtype=bool)
    median = jnp.nanmedian(jnp.where(pair, jnp.sqrt(jnp.maximum(squared, 0.0)), jnp.nan))
    return jnp.where(median > 0, median, 1.0)  # a single row, or all alike


def _start(key: Array, settings: InferenceSettings, dim_x: int) -> tuple[Params, tuple[int, ...]]:
    kernel, bandwidth = settings.density[1]
    omega = frequencies(kernel, dim_x, settings.fourierFeatures)
    rate = jnp.asarray(1 / (bandwidth if isinstance(bandwidth, float) else 1.0), jnp.float32)
    return {"omega": jnp.asarray(omega), "rate": rate}, (2 * settings.fourierFeatures,)


def _hidden(params: Params, x: Array, drop: Drop | None = None) -> Array:
    return fourier(x, params["omega"], params["rate"])


def _prepare(params: Params, x: Array, y: Array, train: Array, held: Array, settings: InferenceSettings) -> Params:
    """Set the bandwidth from the data, where it is not given as a number."""
    bandwidth = settings.density[1][1]
    if isinstance(bandwidth, float):
        return params
    median = median_distance(x, train)
    if bandwidth == "median" or x.shape[1] + 2 * settings.fourierFeatures > REGRESSED:
        return {**params, "rate": 1 / median}

    def held_out(rate: Array) -> Array:
        """log det of the held-out residuals' covariance."""
        design = jnp.concatenate([fourier(x, params["omega"], rate), x], axis=1)
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
