"""Standard deviations of what simulators differ by, and of the noise, beside the evidence's posterior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection.models import Model

Array = NDArray[np.float64]
UNIFORM = 0.289  # standard deviation of a uniform distribution, of its range


@dataclass(frozen=True)
class Systematic:
    """What simulators differ by, whatever the data; that of known parameters is in their posterior (`evidence`)."""

    # of a time step; measured on single effects in MuJoCo C at a tenth of the step
    times: float = 0.07
    laws: float = 0.01  # of the distance from neutral
    # of it, for a law that leaves all of the gap's root mean square; measured likewise
    misfit: float = 0.15


SYSTEMATIC = Systematic()
KNOWN = 0.005  # of a known parameter's value, over whole logs: as 186 of 33 development cases agree between simulators


def of_noise(fitter: Fitter, model: Model) -> Array:
    """`[k, k]`, Laplace covariance of the fit if its law were right: of the noise and of what was known before."""
    q, _ = model.fit.quadratic(fitter.spread)
    _, S = q.weighted(model.fit.weight)
    precision, base = model.fit.belief(), len(fitter.base)
    ranges = np.array([UNIFORM * (c.high - c.low) for c in model.fit.coordinates[:base]])
    precision[:base] = np.maximum(precision[:base], 1.0 / ranges**2)
    return np.asarray(np.linalg.pinv(S + np.diag(precision)))


def systematic(model: Model, timestep: float, left: float = 0.0, known: float = 0.0) -> Array:
    """Standard deviations `[k]` of what simulators differ by, whatever the data; `known`: of known parameters, a share.

    Two simulators with the same effect agree on its times (delays, time constants) to a part of a time step, on its
    other numbers to about a percent; to less where the law leaves a share `left` of the squared gap unexplained (NaN:
    there is none).
    """
    laws = SYSTEMATIC.laws + SYSTEMATIC.misfit * float(np.sqrt(np.clip(np.nan_to_num(left), 0.0, 1.0)))
    own = {c.name for effect in model.effects for c in effect.coordinates}

    def one(c: Coordinate, value: float) -> float:
        if c.name not in own:
            return known * abs(value)
        return SYSTEMATIC.times * timestep if c.unit == "s" else laws * abs(value - c.neutral)

    return np.array([one(c, value) for c, value in zip(model.fit.coordinates, model.fit.values, strict=True)])
