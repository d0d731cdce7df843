"""Independent draws of a posterior that moved draws have found: importance sampling from Gaussians fitted to these.

The effective sample size of moved draws is small. A mixture of Gaussians that is fitted to few draws follows their
chance: its regions hold less of the posterior than they say. Where Gaussians fit, almost every draw from them counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from bayessim_mjx.inference.mixture_fit import Mixture
from bayessim_mjx.inference.numbers import DRAWS, FEW, WIDER
from bayessim_mjx.inference.smc import ess_of, normalised

# degrees of freedom of Student's t that draws are proposed from: heavier tails; source: rule of thumb, not counted
FREEDOM = 5.0
UNRELIABLE = 0.7  # k above which smoothed weights may be far off; source: Vehtari et al. 2024, section 3.2.4


@dataclass(frozen=True, eq=False)
class Weighted:
    """Independent draws.

    Attributes:
        u: `[N, d]` in the unit cube.
        weights: `[N]`, their sum is 1.
        shape: k of the Pareto tail of the weights, before they were smoothed; see UNRELIABLE.
    """

    u: np.ndarray
    weights: np.ndarray
    shape: float

    @property
    def ess(self) -> float:
        """Effective sample size."""
        return ess_of(self.weights)


def final_importance_sampling(
    rng: np.random.Generator, q: Mixture, log_posterior: Callable[[np.ndarray], np.ndarray], each: int
) -> Weighted | None:
    """Weighted draws of the posterior; None where the unit cube holds too little of the Gaussians.

    Args:
        rng: randomness.
        q: Gaussians in the unit cube.
        log_posterior: of u [each, d], up to a constant.
        each: draws of one call.
    """
    wide = Mixture(q.weights, q.means, q.covariances * WIDER**2)
    parts = [
        multivariate_t(m, c, df=FREEDOM, allow_singular=True) for m, c in zip(wide.means, wide.covariances, strict=True)
    ]
    inside = np.zeros((0, q.means.shape[1]))
    for _ in range(FEW):  # most draws may lie beyond the unit cube
        part = rng.choice(len(q.weights), DRAWS, p=q.weights / q.weights.sum())
        noise = rng.standard_normal((DRAWS, q.means.shape[1])) * np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (DRAWS, 1)))
        fresh = wide.means[part] + np.einsum("nij,nj->ni", np.linalg.cholesky(wide.covariances)[part], noise)
        inside = np.concatenate([inside, fresh[np.all((fresh > 0) & (fresh < 1), axis=1)]])
        if len(inside) >= DRAWS:
            break
    count = min(len(inside), DRAWS) // each * each
    if count == 0:
        return None
    u = inside[:count]
    value = np.concatenate([np.asarray(log_posterior(x), np.float64) for x in u.reshape(-1, each, u.shape[1])])
    density = logsumexp([np.log(w) + part.logpdf(u) for w, part in zip(q.weights, parts, strict=True)], axis=0)
    logs = np.where(np.isfinite(value), value - density, -np.inf)
    return Weighted(u, *smoothed(logs)) if np.isfinite(logs).any() else None


def smoothed(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights [N] that sum to 1, their largest ones replaced by quantiles of the fitted Pareto tail; and its shape k.

    Vehtari, Simpson, Gelman, Yao, Gabry (2024): Pareto smoothed importance sampling. k is inf where the tail is too
    short to be fitted.
    """
    weights = normalised(log_weights)
    # draws of the tail and the fewest that are fitted: as in PSIS
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


__all__ = ["UNRELIABLE", "Weighted", "final_importance_sampling", "generalised_pareto", "smoothed"]
