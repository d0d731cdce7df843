"""Models (the known parameters plus some effects), their held-out scores, and the errors that no data show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import Rest, predictive
from bayessim_mjx.diagnosis.selection.numbers import PRIORS

Array = NDArray[np.float64]
Key = frozenset[str]  # labels of a model's effects
BASE: Key = frozenset()  # the known parameters alone


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted model.

    Attributes:
        effects: its candidates; fit: of its parameters.
        cost: `[W]`, held-out cost of each window (leave one operating condition out), starts re-estimated, with the
            uncertainty of the parameters (`_innovations`); plain: without it.
        estimates: `[G, k]`, parameters without each condition.
        samples: effective number of independent residuals.
    """

    effects: tuple[Candidate, ...]
    fit: Fit
    cost: Array
    plain: Array
    estimates: Array
    samples: float

    @property
    def total(self) -> float:
        return float(self.cost.sum())

    @property
    def label(self) -> str:
        return " + ".join(c.label for c in self.effects) or "known parameters"

    @property
    def size(self) -> int:
        return len(self.fit.coordinates)

    def values_of(self, candidate: Candidate) -> Array:
        """Return the candidate's parameters in this model, `[k]`."""
        own = [self.fit.names.index(c.name) for c in candidate.coordinates]
        return self.fit.values[own]


def scored(fitter: Fitter, fit: Fit, effects: Sequence[Candidate]) -> Model:
    """Return the held-out score of a fit."""
    plain, moves = fitter.scores(fit)
    cost = _innovations(fitter, fit, moves, plain)
    costs = np.maximum(cost, 1e-9), np.maximum(plain, 1e-9)
    return Model(tuple(effects), fit, *costs, fit.values + moves, effective_samples(fit, fitter))


def _innovations(fitter: Fitter, fit: Fit, moves: Array, plain: Array) -> Array:
    """Held-out costs `[W]` with the uncertainty of the estimates that they were predicted with.

    Conditions that alone tell a parameter count as they were predicted: without them nothing is known of it.

    Args:
        moves: `[G, k]`, from the fit to the estimates without a condition; plain: `[W]`, costs of the predictions
            themselves.
    """
    rest, costs, group = _rest(fitter, fit), plain.copy(), fitter.simulator.windows.group
    for name, move, alone in zip(np.unique(group), moves, told_alone(fitter, fit, rest), strict=True):
        if not alone:
            own = group == name
            H = rest.curvature(own)[1]
            costs[own] = predictive(rest.q, own, fit.weight, move, H, rest.low, rest.high)
    return costs


def told_alone(fitter: Fitter, fit: Fit, rest: Rest | None = None) -> list[bool]:
    """Of each condition, whether it alone tells a parameter of an effect (a limit that is reached there only).

    rest: `_rest` of the fit, where it is known.
    """
    tells = (rest or _rest(fitter, fit)).told_by(np.arange(len(fitter.base), len(fit.coordinates)))
    group = fitter.simulator.windows.group
    return [tells(group == name) for name in np.unique(group)]


def _rest(fitter: Fitter, fit: Fit) -> Rest:
    """Fits without some of the windows."""
    return Rest(fit.quadratic()[0], fit.weight, *fit.prior())


def effective_samples(fit: Fit, fitter: Fitter) -> float:
    """N / (2 tau), tau the integrated autocorrelation time of the residuals within windows, pooled over channels."""
    windows, channels = len(fit.r), int(fitter.used.sum())
    r = fit.r.reshape(windows, -1, channels)
    variance = float(np.mean(r**2)) + 1e-300
    tau = 0.5
    for lag in range(1, r.shape[1] // 2):
        rho = float(np.mean(r[:, lag:] * r[:, :-lag])) / variance
        if rho <= 0.0:
            break
        tau += rho
    return max(r.size / (2 * tau), 2.0 * windows**0.5)


def nats(old: Model, new: Model) -> float:
    """Held-out log predictive density that `new` has more, of Gaussian residuals of unknown scale."""
    return 0.5 * new.samples * math.log(old.total / new.total)


def of_noise(fitter: Fitter, model: Model) -> Array:
    """`[k, k]`, Laplace covariance of the fit if its law were right: of the noise and of what was known before."""
    q, _ = model.fit.quadratic()
    _, S = q.weighted(model.fit.weight)
    precision, base = model.fit.belief(), len(fitter.base)
    ranges = np.array([c.high - c.low for c in model.fit.coordinates[:base]])
    precision[:base] = np.maximum(precision[:base], 12.0 / ranges**2)  # of a uniform density
    return np.asarray(np.linalg.pinv(S + np.diag(precision)))


def systematic(model: Model, period: float, known: bool = False) -> Array:
    """Return standard deviations `[k]` of the differences between simulators, whatever the data: of effects' numbers.

    That of known parameters is in their posterior (`evidence`).

    Args:
        period: s between rows; known: whether known parameters too differ from one simulator to the next.
    """
    own = {c.name for effect in model.effects for c in effect.coordinates}

    def one(c: Coordinate, value: float) -> float:
        if c.name not in own:
            return PRIORS.laws * abs(value) * known
        return PRIORS.times * period if c.unit == "s" else PRIORS.laws * abs(value - c.neutral)

    return np.array([one(c, value) for c, value in zip(model.fit.coordinates, model.fit.values, strict=True)])
