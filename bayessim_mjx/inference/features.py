"""Quasi-random Fourier features of stationary kernels: phi(x) . phi(y) / (2 M) -> k(|x - y| / bandwidth).

Spectral densities: RBF is Gaussian; Matern nu is a multivariate Student t with 2 nu degrees of freedom. The entries of
a vector share one chi-square, so the kernel is isotropic.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats
from scipy.special import ndtri
from scipy.stats import qmc

from bayessim_mjx.linalg import product

NU = {"RBF": np.inf, "Laplace": 0.5, "Matern12": 0.5, "Matern32": 1.5, "Matern52": 2.5}
PAIRED = 512  # rows behind the median heuristic


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
    rows = jnp.argsort(~use)[:PAIRED]
    x, use = x[rows], use[rows]
    squares = jnp.sum(x * x, axis=1)
    squared = squares[:, None] + squares[None, :] - 2 * product(x, x.T)
    pair = use[:, None] & use[None, :] & ~jnp.eye(len(rows), dtype=bool)
    median = jnp.nanmedian(jnp.where(pair, jnp.sqrt(jnp.maximum(squared, 0.0)), jnp.nan))
    return jnp.where(median > 0, median, 1.0)  # a single row, or all alike
