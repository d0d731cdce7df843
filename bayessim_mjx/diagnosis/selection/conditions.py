"""Known parameters that move between operating conditions, or sit at a bound: something may be missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.tried import Tried

Array = NDArray[np.float64]


def structural(tried: Tried, model: Model) -> dict[str, str]:
    """Known parameters that sit at a bound or move between operating conditions (Wald test, Bonferroni)."""
    from scipy import stats  # takes long to import

    out = {}
    base = len(tried.fitter.base)
    groups = len(model.estimates)
    for i, c in enumerate(model.fit.coordinates[:base]):
        value, width = model.fit.values[i], c.high - c.low
        if min(value - c.low, c.high - value) < 1e-3 * width:
            out[c.name] = phrases.stuck(value)
    if groups < 3:
        return out
    each, deviation = per_condition(tried, model)
    for i, c in enumerate(model.fit.coordinates[:base]):
        z2 = float(
            np.sum(((each[:, i] - np.average(each[:, i], weights=1 / deviation[:, i] ** 2)) / deviation[:, i]) ** 2)
        )
        p = float(stats.chi2.sf(z2, groups - 1)) * base
        spread = float(np.std(each[:, i]))
        if p < 1e-3 and spread > 0.05 * (c.high - c.low) and c.name not in out:
            out[c.name] = phrases.moves(spread, groups, tried.fitter.simulator.windows.blocks)
    return out


def per_condition(tried: Tried, model: Model) -> tuple[Array, Array]:
    """Each condition's own estimate and standard deviation, `[G, k]`, one Newton step from the common fit."""
    q, _ = model.fit.quadratic(tried.fitter.spread)
    _, _, low, high = model.fit.prior()
    precision = model.fit.belief()
    pull = precision * (np.array([c.neutral for c in model.fit.coordinates]) - model.fit.values)
    group = tried.fitter.simulator.windows.group
    each, deviation = [], []
    inflation = max(model.total / model.fit.r.size, 0.5) * model.fit.r.size / model.samples
    for name in np.unique(group):
        g, S = q.weighted(model.fit.weight * (group == name))
        H = S / inflation + np.diag(precision)
        covariance = np.linalg.pinv(H)
        each.append(model.fit.values + np.clip(covariance @ (g / inflation + pull), low, high))
        deviation.append(np.sqrt(np.diag(covariance)))
    return np.array(each), np.array(deviation)
