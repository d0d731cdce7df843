"""Standard deviations of identified numbers, by operating conditions, and weights among rivals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic
from bayessim_mjx.diagnosis.selection import accuracy, weak_directions
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.weak_directions import Ridges

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Spread:
    """What limits a fit's parameters.

    Attributes:
        formal: `[k, k]`, inflated by the misfit and by the residuals' correlation, with what is not known of the data
            sheet's accuracy: where no accuracy is inferred, the Laplace covariance.
        between: `[k, k]`, jackknife over operating conditions; of one log's blocks, of a single one of them.
        freedom: `[k]`, degrees of freedom of `between`: conditions that tell the parameter, less one.
    """

    formal: Array
    between: Array
    freedom: Array


def spread(fitter: Fitter, model: Model, along: Ridges | None = None) -> Spread:
    """The uncertainty of the model's parameters at its fit; `along`: what was simulated along its ridges."""
    q, S = _informed(fitter, model, along)
    less = weak_directions.inflation(model)
    covariance = np.linalg.pinv(S / less + np.diag(weak_directions.beliefs(model.fit, len(fitter.base))))
    formal = accuracy.posterior(model.fit, S / less).together() if accuracy.kinds(model.fit) else covariance
    group = fitter.simulator.windows.group
    told = [covariance @ q.weighted(model.fit.weight * (group == n))[1] @ covariance for n in np.unique(group)]
    share = np.diagonal(told, axis1=1, axis2=2)  # of the parameter's variance, by the condition it comes from
    between, freedom = statistics.covariance(model.estimates), statistics.freedom(share)
    if fitter.simulator.windows.blocks:  # blocks of one log err alike: they are no more than one block tells
        alike = np.sqrt(freedom + 1.0)
        between = between * alike[:, None] * alike
    return Spread(np.asarray(formal), between, freedom)


def accuracies(fitter: Fitter, model: Model, along: Ridges | None = None) -> accuracy.Posterior | None:
    """Of the data sheet's accuracies, by kind of parameter; None where all were stated."""
    if not accuracy.kinds(model.fit):
        return None
    return accuracy.posterior(model.fit, _informed(fitter, model, along)[1] / weak_directions.inflation(model))


def of_noise(fitter: Fitter, model: Model, along: Ridges | None = None) -> Array:
    """`[k, k]`, Laplace covariance of the fit if its law were right: of the noise and of what was known before."""
    _, S = _informed(fitter, model, along)
    return np.asarray(np.linalg.pinv(S + np.diag(weak_directions.beliefs(model.fit, len(fitter.base)))))


def _informed(fitter: Fitter, model: Model, along: Ridges | None) -> tuple[Quadratic, Array]:
    """(The fit's quadratic form, the data's curvature in the parameters `[k, k]`)."""
    q, _ = model.fit.quadratic(fitter.spread)
    _, S = q.weighted(model.fit.weight)
    S = S if along is None else along.corrected(S, weak_directions.scales(model.fit))
    return q, S


@dataclass(frozen=True)
class Systematic:
    """What simulators differ by, whatever the data."""

    # of a time step; measured on single effects in MuJoCo C at a tenth of the step
    times: float = 0.07
    laws: float = 0.01  # of the distance from neutral
    # of a known parameter's value: of 186 in 33 development cases with data sheets 5 % off, 90 % intervals held 77 %
    # without it, 93 % with it
    known: float = 0.005
    # of it, for a law that leaves all of the gap's root mean square; measured likewise
    misfit: float = 0.15


SYSTEMATIC = Systematic()


def deviations(fitter: Fitter, model: Model) -> Array:
    """Standard deviations `[k]` of the model's parameters: the larger of the formal and the jackknife's."""
    found = spread(fitter, model)
    return np.sqrt(np.maximum(np.diag(found.formal), np.diag(found.between)))


def covariance(fitter: Fitter, model: Model, along: Ridges | None = None) -> Array:
    """`[k, k]`, of a Gaussian with the 90 % intervals of the parameters and their correlations.

    Few conditions: Student's quantile in the normal's place, where what differs between conditions decides.
    """
    found = spread(fitter, model, along)
    formal, between = np.diag(found.formal), np.diag(found.between)
    wide = statistics.quantile(found.freedom) / statistics.quantile(np.inf)
    sd = np.sqrt(np.where(between > formal, between * wide**2, formal))
    base = len(fitter.base)
    before = 1.0 / np.sqrt(weak_directions.beliefs(model.fit, base)[:base])
    sd[:base] = np.minimum(sd[:base], np.maximum(before, np.sqrt(formal[:base])))  # data take nothing away
    both = found.formal + found.between
    scale = sd / np.sqrt(np.maximum(np.diag(both), 1e-300))
    return np.asarray(both * scale[:, None] * scale[None, :])


def systematic(model: Model, timestep: float, left: float = 0.0, known: float = SYSTEMATIC.known) -> Array:
    """Standard deviations `[k]` of what simulators differ by, whatever the data; `known`: of known parameters, a share.

    Two simulators with the same effect agree on its times (delays, time constants) to a part of a time step, on its
    other numbers to about a percent; to less where the law leaves a share `left` of the squared gap unexplained. On
    the known parameters they agree to half a percent.
    """
    laws = SYSTEMATIC.laws + SYSTEMATIC.misfit * float(np.sqrt(np.clip(left, 0.0, 1.0)))
    own = {c.name for effect in model.effects for c in effect.coordinates}

    def one(c: Coordinate, value: float) -> float:
        if c.name not in own:
            return known * abs(value)
        return SYSTEMATIC.times * timestep if c.unit == "s" else laws * abs(value - c.neutral)

    return np.array([one(c, value) for c, value in zip(model.fit.coordinates, model.fit.values, strict=True)])


def win_share(
    models: list[Model], group: NDArray[np.int64], noise: float, rng: np.random.Generator, numbers: float = np.inf
) -> Array:
    """Pseudo-BMA+ weights (Yao et al., 2018, arXiv:1704.02030): held-out log scores under a Bayesian bootstrap.

    Of conditions; of the windows where there is one condition only. Rivals differ by smooth errors of their laws,
    however white the noise is: no more residuals count as independent than `numbers` (`Fitter.numbers`).
    """
    names, index = np.unique(group, return_inverse=True)
    index = index if len(names) > 1 else np.arange(len(group))
    draws = (rng.dirichlet(np.ones(index.max() + 1), size=500) * (index.max() + 1))[:, index]
    totals = np.stack([draws @ m.cost for m in models], 1) + 1e-9  # [draws, models]
    samples = min(*(m.samples for m in models), numbers)
    score = -0.5 * samples * np.log(totals) + np.array([m.belief for m in models])
    weight = np.exp(score - score.max(1, keepdims=True))
    return np.asarray((weight / weight.sum(1, keepdims=True)).mean(0))
