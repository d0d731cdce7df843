"""The integral over a model's parameters: their prior, the data sheet's accuracies, and bounds.

Within bounds the posterior is Gaussian for each combination of accuracies (`selection.accuracy`). A parameter that ends
at a bound has its probability in a layer beside it, as thick as the density falls (Laplace's method at a boundary).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp, ndtr

from bayessim_mjx.diagnosis.evidence.gaussian import Belief, Learnt
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.accuracy import Posterior, posterior

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Integrated:
    """A model's evidence.

    Attributes:
        nats: log marginal likelihood, up to a constant that all models of these windows have in common.
        posterior: of the parameters that are free; free: `[k]`, which those are.
    """

    nats: float
    posterior: Posterior
    free: NDArray[np.bool_]


def belief_of(fit: Fit) -> Belief:
    """The prior of a fit's step, with the data sheet's accuracies as the fit believes them."""
    neutral = np.array([c.neutral for c in fit.coordinates])
    low = np.array([c.low for c in fit.coordinates]) - fit.values
    high = np.array([c.high for c in fit.coordinates]) - fit.values
    return Belief(fit.belief(), neutral - fit.values, low, high)


def integrated(fit: Fit, learnt: Learnt, effects: Sequence[Mapping[int, bool]] = ()) -> Integrated:
    """The evidence of a fit with its best hyperparameters.

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
    found = posterior(reduced, S[np.ix_(free, free)], g[free])
    nats = learnt.without_parameters - 0.5 * float(c) + found.evidence
    layers = {i: _layer(belief, i, p[i], slope[i], S[i, i]) for i in np.flatnonzero(at).tolist()}
    nats += sum(layers.values(), 0.0) - sum(map(_truncated, fit.coordinates))
    nats += sum(_without(fit, found, free, layers, own) for own in effects if len(own) > 1 and not all(own.values()))
    return Integrated(nats, found, free)


def _without(
    fit: Fit, found: Posterior, free: NDArray[np.bool_], layers: dict[int, float], own: Mapping[int, bool]
) -> float:
    """What the evidence gains where each of an effect's numbers may be neutral, with probability 1/2.

    Not all that are no shapes: that would be the model without the effect.

    Savage and Dickey's ratio (Dickey, Ann. Math. Stat. 42, 1971): the evidence without a number is the posterior over
    the prior density at its neutral value.
    """
    at, middle, covariance = np.flatnonzero(free), found.middle, found.moments()
    neutral = np.array([c.neutral for c in fit.coordinates])
    usable = [i for i in own if free[i] or fit.values[i] == neutral[i]]
    amplitudes = {i for i, shape in own.items() if not shape}
    terms = [0.0]
    for some in itertools.chain.from_iterable(itertools.combinations(usable, n) for n in range(1, len(own))):
        if amplitudes <= {*some}:
            continue
        inner = [int(np.searchsorted(at, i)) for i in some if free[i]]
        delta = sum(_truncated(fit.coordinates[i]) - layers.get(i, 0.0) for i in some)
        if inner:
            away, C = neutral[at[inner]] - middle[inner], covariance[np.ix_(inner, inner)]
            delta -= 0.5 * float(away @ np.linalg.solve(C, away) + np.linalg.slogdet(C)[1])
            delta -= 0.5 * float(sum(np.log(fit.coordinates[i].precision) for i in some if free[i]))
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


def _truncated(c: Coordinate) -> float:
    """Log of the prior probability that the bounds leave of an effect's Gaussian prior."""
    root = c.precision**0.5
    inside = ndtr((c.high - c.neutral) * root) - ndtr((c.low - c.neutral) * root)
    return 0.0 if c.stated else float(np.log(max(inside, 1e-300)))
