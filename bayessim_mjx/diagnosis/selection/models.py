"""Models (the known parameters plus some effects) and their held-out scores."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted model.

    Attributes:
        effects: its candidates; fit: of its parameters.
        cost: `[W]`, held-out cost of each window (leave one operating condition out), starts re-estimated, with the
            uncertainty of the parameters (`Fitter.innovations`); plain: without it.
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
        """The candidate's parameters in this model, `[k]`."""
        own = [self.fit.names.index(c.name) for c in candidate.coordinates]
        return self.fit.values[own]


def scored(fitter: Fitter, fit: Fit, effects: Sequence[Candidate]) -> Model:
    """The held-out score of a fit."""
    plain, moves = fitter.scores(fit)
    cost = fitter.innovations(fit, moves, fit.values + moves, plain)
    costs = np.maximum(cost, 1e-9), np.maximum(plain, 1e-9)
    return Model(tuple(effects), fit, *costs, fit.values + moves, effective_samples(fit, fitter))


def effective_samples(fit: Fit, fitter: Fitter) -> float:
    """N / (2 tau), tau the integrated autocorrelation time of the residuals within windows, pooled over channels."""
    windows, channels = len(fit.r), int(fitter.used.sum())
    r = fit.r.reshape(windows, -1, channels)
    variance = float(np.mean(r**2)) + 1e-300
    tau = 0.5
    for lag in range(1, r.shape[1] // 2):
        rho = float(np.mean(r[:, lag:] * r[:, :-lag])) / variance
        if rho < 0.05:
            break
        tau += rho
    return max(r.size / (2 * tau), 2.0 * windows**0.5)


def nats(old: Model, new: Model) -> float:
    """Held-out log predictive density that `new` has more, of Gaussian residuals of unknown scale."""
    return 0.5 * new.samples * math.log(old.total / new.total)
