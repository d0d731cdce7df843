"""Independent draws of a posterior that moved draws have found: importance sampling from Gaussians fitted to these.

Moved draws are worth few independent ones, and a mixture of Gaussians that is fitted to few follows their chance: its
regions hold less of the posterior than they say. Where Gaussians fit, almost every draw from them counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from bayessim_mjx.inference.pareto import effective, smoothed
from bayessim_mjx.inference.weighted import Mixture

DRAWS = 4096
FREEDOM = 5.0  # degrees of freedom of what is drawn from: its tails are heavier than a posterior's
WIDER = 1.2  # standard deviations, times
TRIED = 64  # draws for each that is asked for, at most: the others lie beyond the unit cube


@dataclass(frozen=True, eq=False)
class Weighted:
    """Independent draws.

    Attributes:
        u: `[N, d]` in the unit cube.
        weights: `[N]`, their sum is 1.
        shape: k of the Pareto tail of the weights, before they were smoothed; see `pareto.UNRELIABLE`.
    """

    u: np.ndarray
    weights: np.ndarray
    shape: float

    @property
    def worth(self) -> float:
        """How many draws of the posterior itself they are worth."""
        return effective(self.weights)


def independent(
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
    for _ in range(TRIED):
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


__all__ = ["Weighted", "independent"]
