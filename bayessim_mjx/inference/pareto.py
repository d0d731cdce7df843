"""Importance weights: how many draws they are worth, and their tail smoothed (PSIS, Vehtari et al. 2024)."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

UNRELIABLE = 0.7  # k from which on smoothed weights may be far off (Vehtari et al. 2024, section 3.2.4)


def normalised(log_weights: np.ndarray) -> np.ndarray:
    """Weights [N] that sum to 1."""
    weights = np.exp(log_weights - np.max(log_weights))
    return weights / weights.sum()


def effective(weights: np.ndarray) -> float:
    """Effective number of draws of weights [N] that sum to 1."""
    return float(1.0 / np.sum(weights**2)) if len(weights) else 0.0


def smoothed(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights [N] that sum to 1, their largest ones replaced by quantiles of the fitted Pareto tail; and its shape k.

    Vehtari, Simpson, Gelman, Yao, Gabry (2024): Pareto smoothed importance sampling. k is inf where the tail is too
    short to be fitted.
    """
    weights = normalised(log_weights)
    count = int(min(0.2 * len(weights), 3 * np.sqrt(len(weights))))
    order = np.argsort(weights)
    if count < 5 or weights[order[-count - 1]] <= 0:
        return weights, np.inf
    cut, tail = weights[order[-count - 1]], weights[order[-count:]]
    shape, scale = generalised_pareto(tail - cut)
    if not np.isfinite(shape):
        return weights, np.inf
    p = (np.arange(count) + 0.5) / count
    quantiles = -scale * np.log1p(-p) if abs(shape) < 1e-9 else scale / shape * np.expm1(-shape * np.log1p(-p))
    out = weights.copy()
    out[order[-count:]] = np.minimum(cut + quantiles, weights.max())
    return out / out.sum(), float(shape)


def generalised_pareto(x: np.ndarray) -> tuple[float, float]:
    """(shape k, scale) of exceedances x [n] > 0, ascending: Zhang and Stephens (2009), with PSIS's prior on k."""
    n = len(x)
    grid = 30 + int(np.sqrt(n))
    quartile = x[int(n / 4 + 0.5) - 1]
    if not quartile > 0:
        return np.nan, np.nan
    theta = 1 / x[-1] + (1 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3 * quartile)
    shapes = np.array([np.log1p(-t * x).mean() for t in theta])
    profile = n * (np.log(-theta / shapes) - shapes - 1)
    weight = np.exp(profile - logsumexp(profile))
    best = float(np.sum(theta * weight))
    shape = float(np.log1p(-best * x).mean())
    scale = -shape / best
    return (n * shape + 10 * 0.5) / (n + 10), scale
