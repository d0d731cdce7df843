"""Standard deviations of identified numbers and intervals of shares: clustered by operating condition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fit import Fitter
from bayessim_mjx.diagnosis.models import Model

Array = NDArray[np.float64]
LEVEL = 0.9


def deviations(fitter: Fitter, model: Model) -> Array:
    """Standard deviations `[k]` of the model's parameters.

    The larger of the formal one, inflated by the misfit and the residuals' correlation, and the jackknife over
    operating conditions (Quenouille, 1956): model errors repeat within a condition, so windows are not independent.
    """
    q, _ = model.job.quadratic(fitter.spread)
    precision, _, _, _ = model.job.prior()
    _, S = q.weighted(model.job.weight)
    covariance = np.linalg.pinv(S + np.diag(precision))
    count = model.job.r.size
    inflation = max(model.total / count, 0.5) * count / model.samples
    formal = np.diag(covariance) * inflation
    estimates = model.estimates
    g = len(estimates)
    jackknife = (g - 1) / g * np.sum((estimates - estimates.mean(0)) ** 2, axis=0) if g > 1 else 0.0
    return np.sqrt(np.maximum(formal, jackknife))


def bootstrap_weights(group: NDArray[np.int64], count: int, rng: np.random.Generator) -> Array:
    """Bayesian bootstrap `[count, W]` over conditions; over windows where there are fewer than five conditions."""
    names, index = np.unique(group, return_inverse=True)
    if len(names) < 5:
        index = np.arange(len(group))
    draws = rng.dirichlet(np.ones(index.max() + 1), size=count) * (index.max() + 1)
    return np.asarray(draws[:, index])


def interval(samples: Array) -> tuple[float, float]:
    """Central 90 % interval."""
    low, high = np.quantile(samples, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def win_share(models: list[Model], group: NDArray[np.int64], noise: float, rng: np.random.Generator) -> Array:
    """Pseudo-BMA+ weights (Yao et al., 2018, arXiv:1704.02030): held-out log scores under a Bayesian bootstrap."""
    draws = bootstrap_weights(group, 500, rng)
    totals = np.stack([draws @ m.cost for m in models], 1) + 1e-9  # [draws, models]
    samples = min(m.samples for m in models)
    score = -0.5 * samples * np.log(totals)
    weight = np.exp(score - score.max(1, keepdims=True))
    return np.asarray((weight / weight.sum(1, keepdims=True)).mean(0))
