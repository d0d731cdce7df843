"""Numbers of the answer by its posterior: their means and covariance, with what the sets beside it say of them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence import terms
from bayessim_mjx.diagnosis.evidence.gaussian import PRIORS, marginal, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.evidence.weighing import Scored, Weighing
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.models import Model, scored
from bayessim_mjx.diagnosis.selection.selected import Size, size_of
from bayessim_mjx.diagnosis.selection.sets import Estimated, Key, Weighed

Array = NDArray[np.float64]
Say = Callable[[str, int, int], None]
MOVES = 3  # of a model to its mean
MOVED = 0.1  # standard deviations by which a number moves at least: a smaller move is not simulated
WORSE = 1.0  # nats that moves which do not come to an end may cost


def at_its_mean(weighing: Weighing, key: Key) -> Model:
    """The model at its posterior mean, held-out estimates refitted; where it was if that is no better place.

    A mean far from the fit is the step of a linear model: from there it is looked for again.
    """
    fitter, pool, old = weighing.pool.fitter, weighing.pool, weighing.scored[key]
    low, high = (np.array([getattr(c, end) for c in old.model.fit.coordinates]) for end in ("low", "high"))
    for _ in range(MOVES):
        here = weighing.scored[key]
        mean, covariance = _own(here)
        mean, sd = np.clip(mean, low, high), np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        if np.all(np.abs(mean - here.model.fit.values) <= MOVED * sd):
            break
        moved = fitter.refresh(replace(here.model.fit, values=mean, history=()))
        pool.models[key] = scored(fitter, moved, old.model.effects)
        weighing.score([key])
    else:
        if weighing.scored[key].found.nats < old.found.nats - WORSE:
            pool.models[key], weighing.scored[key] = old.model, old
    (model,) = heldout.refitted(fitter, [pool.models[key]])
    pool.models[key] = model
    weighing.scored[key] = replace(weighing.scored[key], model=model)
    return model


def estimated(weighing: Weighing, found: Weighed) -> Estimated:
    """Of the answer's numbers; known parameters with all sets that are possible, by their probabilities."""
    answer, base = weighing.scored[found.answer], len(weighing.pool.fitter.base)
    mean, covariance = _own(answer)
    covariance[:base, :base] += _beside(answer, base)
    keys = found.possible
    share = np.array([found.sets[k] for k in keys])
    share /= share.sum()
    known = np.zeros((base, base))
    for key, weight in zip(keys, share, strict=True):
        own_mean, own = _own(weighing.scored[key])
        away = own_mean[:base] - mean[:base]
        known += weight * (own[:base, :base] + _beside(weighing.scored[key], base) + np.outer(away, away))
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    wider = np.ones(len(sd))
    wider[:base] = np.sqrt(np.maximum(np.diag(known), sd[:base] ** 2)) / sd[:base]
    covariance = covariance * wider[:, None] * wider
    away = np.where(
        np.arange(len(sd)) < base, 0.0, mean - answer.model.fit.values
    )  # effects' numbers are those of the fit
    covariance = covariance + np.diag(away**2)
    step = functools.partial(_step, weighing, answer)
    above = np.maximum(answer.learnt.hyper.amplitude**2 - PRIORS.least**2, 0.0)  # less is there for any law
    size = weighing.scale * np.sqrt(above)
    covariance = covariance + terms.covariance(weighing.pool.fitter, weighing.D, size, step, answer.fit.r)
    return Estimated(mean, covariance, answer.found.posterior, answer.learnt.hyper.noise, step)


def size_in(of: Scored, effect: Candidate) -> Size:
    """How large one of the model's effects is."""
    mean, covariance = _own(of)
    own = [of.model.fit.names.index(c.name) for c in effect.coordinates]
    return size_of(effect, mean[own], np.sqrt(np.diag(covariance)[own]))


def _step(weighing: Weighing, of: Scored, r: Array) -> Array:
    """The most probable step `[k]` of the model's numbers, of other residuals at their values."""
    fit, sizes = of.fit, (weighing.pool.fitter.spread, weighing.scale, weighing.channels)
    there = marginal(windows_of(r, fit.A, fit.B, weighing.D, fit.offsets, *sizes), of.learnt.hyper)
    return belief_of(fit).best(there.Q.sum(0))[: len(of.model.fit.values)]


def _beside(of: Scored, base: int) -> Array:
    """Covariance `[base, base]` of the known parameters that rest at a bound: none of them is known without error."""
    return np.diag(of.found.beside[:base] ** 2)


def _own(of: Scored) -> tuple[Array, Array]:
    """(mean `[k]`, covariance) of the model's numbers; of those at a bound no spread."""
    posterior, free = of.found.posterior, np.flatnonzero(of.found.free)
    mean, covariance = np.asarray(of.fit.values + of.learnt.step), np.zeros((len(of.fit.values),) * 2)
    mean[free] = posterior.middle
    covariance[np.ix_(free, free)] = posterior.together()
    k = len(of.model.fit.values)
    return mean[:k], covariance[:k, :k]
