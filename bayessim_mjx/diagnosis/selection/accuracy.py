"""How accurate a data sheet is, inferred from the logs: one number for each kind of parameter that it lists.

Parameters p of kind k are N(nominal, s_k^2), with s_k^2 ~ scaled inverse chi-squared (`data_sheet`). About a fit the
data are Gaussian in all parameters, so given the s_k the posterior is Gaussian and its evidence is known (Gelman et
al., Bayesian Data Analysis, 2013, ch. 5 and 15). The s_k are summed over a grid, so their uncertainty is in every
interval.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from bayessim_mjx.diagnosis.data_sheet import ACCURACY, SURE
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.statistics import mixture_quantiles

Array = NDArray[np.float64]
# Shares of the nominal value that are summed over: from a seventh of the prior's accuracy to 100 %; 13 of them change
# quantiles by less than 1 % of the interval against 49.
LEVELS = np.geomspace(0.01, 1.0, 13)
ENDS = (0.05, 0.5, 0.95)


@dataclass(frozen=True, eq=False)
class Posterior:
    """A mixture of M Gaussians over the parameters, one for each combination of accuracies.

    Attributes:
        kinds: K of them; shares: `[M, K]`, accuracies; weight: `[M]`.
        mean: `[M, k]`; covariance: `[M, k, k]`.
        evidence: log of what likelihood and priors integrate to, relative to the likelihood at the fit.
    """

    kinds: tuple[str, ...]
    shares: Array
    weight: Array
    mean: Array
    covariance: Array
    evidence: float

    @property
    def middle(self) -> Array:
        """Posterior mean `[k]`."""
        return np.asarray(self.weight @ self.mean)

    def moments(self) -> Array:
        """`[k, k]`, covariance of the mixture."""
        away = self.mean - self.middle
        return np.asarray(np.tensordot(self.weight, self.covariance, 1) + (self.weight * away.T) @ away)

    def together(self) -> Array:
        """`[k, k]`: a Gaussian's covariance with the mixture's 90 % intervals and its correlations."""
        moments = self.moments()
        low, _, high = self.quantiles()
        scale = (high - low) / (2 * 1.645) / np.sqrt(np.maximum(np.diag(moments), 1e-300))
        return np.asarray(moments * scale[:, None] * scale)

    def quantiles(self, ends: Sequence[float] = ENDS) -> Array:
        """`[ends, k]`, of each parameter."""
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 1e-300))
        return mixture_quantiles(self.weight, self.mean, sd, ends)

    def accuracy(self, kind: str) -> tuple[float, float, float]:
        """5, 50 and 95 % quantiles of a kind's accuracy, as a share."""
        shares = self.shares[:, self.kinds.index(kind)]
        each = np.array([self.weight[np.isclose(shares, s)].sum() for s in LEVELS])
        edges = np.concatenate([[0.0], np.cumsum(each)])
        logs = np.log(LEVELS)
        bins = np.concatenate(
            [[1.5 * logs[0] - 0.5 * logs[1]], (logs[1:] + logs[:-1]) / 2, [1.5 * logs[-1] - 0.5 * logs[-2]]]
        )
        low, middle, high = np.exp(np.interp(ENDS, edges, bins))
        return float(low), float(middle), float(high)

    def trust(self) -> dict[str, float]:
        """{kind: mean factor of its priors' precision}."""
        return dict(zip(self.kinds, map(float, self.weight @ (ACCURACY / self.shares) ** 2), strict=True))


def kinds(fit: Fit) -> tuple[str, ...]:
    """Kinds of parameters whose accuracy is inferred."""
    return tuple(sorted({c.kind for c in fit.coordinates if c.kind}))


def posterior(fit: Fit, curvature: Array, pull: Array | None = None) -> Posterior:
    """Of a fit's parameters and of the accuracies behind them.

    Args:
        curvature: `[k, k]` of the data's negative log-likelihood at the fit, in nats, start states eliminated.
        pull: `[k]`, gradient of their log-likelihood there; None: the fit is the posterior's mode.
    """
    coordinates = fit.coordinates
    found = kinds(fit)
    own = np.array([[c.kind == kind for c in coordinates] for kind in found]).reshape(len(found), len(coordinates))
    stated = np.array([c.precision for c in coordinates])
    away = np.array([c.neutral for c in coordinates]) - fit.values
    shares = np.array(list(itertools.product(LEVELS, repeat=len(found))))
    factor = (ACCURACY / shares) ** 2  # [M, K], of precisions
    precision = stated * np.where(own.any(0), factor @ own, 1.0)  # [M, k]
    H = curvature + precision[:, :, None] * np.eye(len(stated))
    pull = -fit.belief() * away if pull is None else pull  # at a mode the data pull as hard as its prior does
    slope = precision * away + pull
    scale = 1 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-300))
    units = H * scale[:, :, None] * scale[:, None, :] + 1e-12 * np.eye(len(stated))
    covariance = np.linalg.inv(units) * scale[:, :, None] * scale[:, None, :]
    move = np.einsum("mij,mj->mi", covariance, slope)
    evidence = 0.5 * np.einsum("mi,mi->m", slope, move) - 0.5 * np.sum(precision * away**2, 1)
    evidence += 0.5 * np.sum(np.log(precision), 1) + np.sum(np.log(scale), 1) - 0.5 * np.linalg.slogdet(units)[1]
    prior = (
        0.5 * SURE * np.sum(np.log(factor) - factor, 1)
    )  # of factors, a gamma density on the grid of their logarithms
    weight = np.exp(evidence + prior - np.max(evidence + prior))
    whole = float(logsumexp(evidence + prior) - logsumexp(prior))
    return Posterior(found, shares, weight / weight.sum(), fit.values + move, covariance, whole)
