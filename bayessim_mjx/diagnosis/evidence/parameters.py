"""The integral over a model's parameters: their prior, the data sheet's accuracies, and bounds.

The accuracy of a data sheet is inferred too: one number for each kind of parameter that it lists. Parameters p of kind
k are N(nominal, s_k^2), with s_k^2 ~ scaled inverse chi-squared (`data_sheet`). About a fit the data are Gaussian in
all parameters, so given the s_k the posterior is Gaussian and its evidence is known (Gelman et al., Bayesian Data
Analysis, 2013, ch. 5 and 15). The s_k are summed over a grid, so their uncertainty is in every interval.

A parameter that ends at a bound has its probability in a layer beside it, as thick as the density falls (Laplace's
method at a boundary).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import hyperu, log_ndtr, logsumexp, ndtr

from bayessim_mjx.diagnosis.data_sheet import ACCURACY, SURE
from bayessim_mjx.diagnosis.evidence.gaussian import Belief, Learnt
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.numbers import PRIORS
from bayessim_mjx.diagnosis.statistics import Z90, mixture_quantiles

Array = NDArray[np.float64]
# Shares of the nominal value that are summed over: from a seventh of the prior's accuracy to 100 %; 9 of them change
# quantiles by .3 % of the interval against 49 (19 of 20; all by less than 1.5 %), the evidence by less than .04 nats.
LEVELS = np.geomspace(0.01, 1.0, 9)
ENDS = tuple(map(float, ndtr([-Z90, 0.0, Z90])))  # of a 90 % interval, and its middle


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
        scale = (high - low) / (2 * Z90) / np.sqrt(np.maximum(np.diag(moments), 1e-300))
        return np.asarray(moments * scale[:, None] * scale)

    def quantiles(self, ends: Sequence[float] = ENDS) -> Array:
        """Return `[ends, k]`, of each parameter."""
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 1e-300))
        return mixture_quantiles(self.weight, self.mean, sd, ends)

    def accuracy(self, kind: str) -> tuple[float, float, float]:
        """5, 50 and 95 % quantiles of a kind's accuracy, as a share."""
        shares = self.shares[:, self.kinds.index(kind)]
        each = np.array([self.weight[np.isclose(shares, s)].sum() for s in LEVELS])
        edges = np.concatenate([[0.0], np.cumsum(each)])
        logs = np.log(LEVELS)
        half = (logs[1] - logs[0]) / 2
        bins = np.append(logs - half, logs[-1] + half)
        low, middle, high = np.exp(np.interp(ENDS, edges, bins))
        return float(low), float(middle), float(high)


def posterior(fit: Fit, curvature: Array, pull: Array | None = None) -> Posterior:
    """Of a fit's parameters and of the accuracies behind them.

    Args:
        curvature: `[k, k]` of the data's negative log-likelihood at the fit, in nats, start states eliminated.
        pull: `[k]`, gradient of their log-likelihood there; None: the fit is the posterior's mode.
    """
    coordinates = fit.coordinates
    found = tuple(sorted({c.kind for c in coordinates if c.kind}))  # whose accuracy is inferred
    own = np.array([[c.kind == kind for c in coordinates] for kind in found]).reshape(len(found), len(coordinates))
    stated = np.array([c.precision for c in coordinates])
    away = -fit.away
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


def unlikely(coordinates: Sequence[Coordinate], away: Array) -> float:
    """Minus the log prior density of known parameters so far from the data sheet `[k]`, up to a constant.

    Of a kind whose accuracy nobody stated a multivariate Student t, of stated ones a Gaussian.
    """
    squares = np.array([c.precision for c in coordinates]) * away**2
    kinds = np.array([c.kind for c in coordinates])
    total = 0.5 * float(squares[[c.stated and not c.kind for c in coordinates]].sum())
    for kind in {k for k in kinds if k}:
        own = squares[kinds == kind]
        total += 0.5 * (SURE + len(own)) * float(np.log1p(own.sum() / SURE))
    return total


@dataclass(frozen=True, eq=False)
class Integrated:
    """A model's evidence.

    Attributes:
        nats: log marginal likelihood, up to a constant that all models of these windows have in common.
        posterior: of the parameters that are free; free: `[k]`, which those are.
        beside: `[k]`, of the others: root mean square distance from their bound; 0 of those that are free.
    """

    nats: float
    posterior: Posterior
    free: NDArray[np.bool_]
    beside: Array


def belief_of(fit: Fit) -> Belief:
    """Return the prior of a fit's step, with the data sheet's accuracies as the fit believes them."""
    low = np.array([c.low for c in fit.coordinates]) - fit.values
    high = np.array([c.high for c in fit.coordinates]) - fit.values
    return Belief(fit.belief(), -fit.away, low, high)


def integrated(fit: Fit, learnt: Learnt, effects: Sequence[Mapping[int, bool]] = ()) -> Integrated:
    """Return the evidence of a fit with its best hyperparameters.

    effects: of each {index of its number: whether it is a shape}; numbers may be neutral (`_without`).
    """
    Q, p, belief = learnt.Q, learnt.step, belief_of(fit)
    c, g, S = Q[0, 0], Q[1:, 0], Q[1:, 1:]
    slope = g - S @ p + belief.precision * (belief.mean - p)
    at = ((p <= belief.low) & (slope < 0)) | ((p >= belief.high) & (slope > 0))
    free, held = ~at, np.where(at, p, 0.0)
    c, g = c - 2 * g @ held + held @ S @ held, g - S @ held
    some = tuple(x for x, f in zip(fit.coordinates, free, strict=True) if f)
    reduced = replace(fit, coordinates=some, values=fit.values[free])
    data = S[np.ix_(free, free)], g[free]
    found = posterior(reduced, *data)
    nats = learnt.without_parameters - 0.5 * float(c) + found.evidence
    held_at = np.flatnonzero(at).tolist()
    layers = {i: _layer(belief, i, p[i], slope[i], S[i, i]) for i in held_at}
    beside = np.zeros(len(p))
    beside[held_at] = [_depth(slope[i], S[i, i] + belief.precision[i]) for i in held_at]
    nats += sum(layers.values(), 0.0) - sum(map(_truncated, fit.coordinates))
    nats += sum(_sized(fit, found, free, layers, own, data) for own in effects)
    # of a model so far off that rounding of its products leaves no covariance, nothing is known: it explains nothing
    return Integrated(nats if np.isfinite(nats) else -np.inf, found, free, beside)


def _sized(
    fit: Fit,
    found: Posterior,
    free: NDArray[np.bool_],
    layers: dict[int, float],
    own: Mapping[int, bool],
    data: tuple[Array, Array],
) -> float:
    """Return the evidence's gain where an effect may be small: its range and its parts are as likely (`Priors.sizes`).

    A prior as wide as the range alone would hold a small payload for less likely than a small error of a data sheet
    that does the same.

    Args:
        own: as in `integrated`; data: curvature and slope of the free numbers, as in `posterior`.
    """
    some = [i for i, shape in own.items() if free[i] and not shape and not fit.coordinates[i].stated]
    several = len(own) > 1 and not all(own.values())
    wide, terms = sum(_truncated(fit.coordinates[i]) for i in some), []
    for scale in PRIORS.sizes if some else PRIORS.sizes[:1]:
        every = [
            replace(c, precision=c.precision / scale**2 if i in some else c.precision)
            for i, c in enumerate(fit.coordinates)
        ]
        here = tuple(c for c, f in zip(every, free, strict=True) if f)
        there = found if scale == 1.0 else posterior(replace(fit, coordinates=here, values=fit.values[free]), *data)
        ratio = there.evidence - found.evidence + wide - sum(_truncated(every[i]) for i in some)
        terms.append(ratio + (_without(every, fit, there, free, layers, own) if several else 0.0))
    return float(logsumexp(terms) - np.log(len(terms)))


def _without(
    coordinates: Sequence[Coordinate],
    fit: Fit,
    found: Posterior,
    free: NDArray[np.bool_],
    layers: dict[int, float],
    own: Mapping[int, bool],
) -> float:
    """Return the gain in evidence where each of an effect's numbers may be neutral, with probability 1/2.

    Not all that are no shapes: that would be the model without the effect.

    Savage and Dickey's ratio (Dickey, Ann. Math. Stat. 42, 1971): the evidence without a number is the posterior over
    the prior density at its neutral value.
    """
    middle, covariance, at = found.middle, found.moments(), np.cumsum(free) - 1
    neutral, inside = np.array([c.neutral for c in coordinates]), [_truncated(c) for c in coordinates]
    usable = [i for i in own if free[i] or fit.values[i] == neutral[i]]
    amplitudes = {i for i, shape in own.items() if not shape}
    terms = [0.0]
    for some in itertools.chain.from_iterable(itertools.combinations(usable, n) for n in range(1, len(own))):
        if amplitudes <= {*some}:
            continue
        delta = sum(inside[i] - layers.get(i, 0.0) for i in some)
        if moving := [i for i in some if free[i]]:
            inner = at[moving]
            away, C = neutral[moving] - middle[inner], covariance[np.ix_(inner, inner)]
            delta -= 0.5 * float(away @ np.linalg.solve(C, away) + np.linalg.slogdet(C)[1])
            delta -= 0.5 * float(sum(np.log(coordinates[i].precision) for i in moving))
        terms.append(delta)
    cases = (2 ** len(amplitudes) - 1) * 2 ** (len(own) - len(amplitudes))
    return float(logsumexp(terms) - np.log(cases))


def _layer(belief: Belief, i: int, p: float, slope: float, curvature: float) -> float:
    """Log of prior and likelihood beside a bound: density there times the width over which it falls."""
    precision = belief.precision[i]
    density = 0.5 * np.log(precision) - 0.5 * precision * (p - belief.mean[i]) ** 2
    bend = np.sqrt(curvature + precision)
    x = abs(slope) / bend  # int_0^inf exp(-slope t - bend^2 t^2 / 2) dt, over sqrt(2 pi)
    return float(density - np.log(bend) + 0.5 * x**2 + log_ndtr(-x))


def _depth(slope: float, curvature: float) -> float:
    """Root mean square distance from a bound under the density exp(-|slope| t - curvature t^2 / 2), t >= 0.

    Moments of that density are Tricomi functions (Abramowitz and Stegun, 1964, eq. 13.2.5).
    """
    bend = np.sqrt(curvature)
    half = 0.5 * (slope / bend) ** 2
    return float(np.sqrt(hyperu(1.5, 0.5, half) / hyperu(0.5, 0.5, half)) / bend)


def _truncated(c: Coordinate) -> float:
    """Log of the prior probability that the bounds leave of an effect's Gaussian prior."""
    root = c.precision**0.5
    inside = ndtr((c.high - c.neutral) * root) - ndtr((c.low - c.neutral) * root)
    return 0.0 if c.stated else float(np.log(max(inside, 1e-300)))
