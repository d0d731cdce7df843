"""Models in the race (the known parameters plus some effects), their held-out scores, and what makes one better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted model.

    Attributes:
        effects: its candidates; fit: of its parameters.
        cost: `[W]`, held-out cost of each window (leave one operating condition out), starts re-estimated.
        estimates: `[G, k]`, parameters without each condition.
        samples: effective number of independent residuals.
    """

    effects: tuple[Candidate, ...]
    fit: Fit
    cost: Array
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
    cost, moves = fitter.scores(fit)
    return Model(tuple(effects), fit, np.maximum(cost, 1e-9), fit.values + moves, effective_samples(fit, fitter))


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


@dataclass(frozen=True)
class Comparison:
    """How much better `new` predicts than `old`.

    Attributes:
        share: drop of the held-out cost, as a share of the old one above the noise.
        drop: as a share of the old cost itself.
        evidence: N_eff/2 log(cost ratio), nats.
        t: mean over windows of the robust log gain, over its standard error by conditions, as a normal deviate.
        worst: the smallest drop among the conditions, as a share of the condition's old cost.
    """

    share: float
    drop: float
    evidence: float
    t: float
    worst: float


def compare(old: Model, new: Model, group: NDArray[np.int64], noise: float) -> Comparison:
    """`noise`: expected cost of a perfect model per window."""
    gain = old.total - new.total
    log_gain = np.log(old.cost + noise) - np.log(new.cost + noise)
    return Comparison(
        share=statistics.share_of_gap(gain, old.total, noise * len(old.cost)),
        drop=gain / old.total,
        evidence=0.5 * new.samples * float(np.log(old.total / new.total)),
        t=statistics.normal_deviate(log_gain, group),
        worst=min(_drop(old.cost[group == g], new.cost[group == g], noise) for g in np.unique(group)),
    )


def _drop(old: Array, new: Array, noise: float) -> float:
    return float((old.sum() - new.sum()) / (old.sum() + noise * len(old)))
