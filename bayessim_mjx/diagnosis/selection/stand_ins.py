"""Known parameters far from the data sheet that stand for an effect: one law, two names, and no log tells them apart.

A joint's viscous friction is its damping, rotor inertia beside a slide is its mass, a drive's gain is all of the
robot's inertia, damping and friction together. The prior tells whether a data sheet is so wrong, or an effect missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import SURE
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.hidden import LIMITS
from bayessim_mjx.diagnosis.selection.laws import compatible
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Pool
from bayessim_mjx.diagnosis.selection.projection import Projection
from bayessim_mjx.diagnosis.selection.screen import part, room
from bayessim_mjx.diagnosis.selection.sets import ODDS, log_prior

Array = NDArray[np.float64]
AMOUNTS = np.linspace(0.0, 1.0, 101)[1:]  # of an effect, shares of the largest in its range


def of_parameters(pool: Pool, answer: Model) -> dict[str, tuple[str, ...]]:
    """{known parameter: labels of the effects that it may stand for}, without a simulation.

    An effect stands beside a parameter's deviation where known parameters do all its work (`hidden.LIMITS.hidden`), and
    where the data sheet speaks for it: without the effect's part the parameters are so much likelier that the odds
    against the effect, one of all candidates and in its best size, are below `ODDS.mention`.
    """
    known = pool.secants.columns
    others = [c for c in pool.candidates if known.get(c.label) and all(compatible(c, e) for e in answer.effects)]
    if not others:
        return {}
    fit = part(answer.fit, pool.secants.own)
    project, least = (
        Projection(pool.fitter, fit),
        -log_prior(frozenset("x"), len(pool.candidates)) - np.log(ODDS.strong),
    )
    out: dict[str, list[str]] = {}
    for c in others:
        neutral = np.array([x.neutral for x in c.coordinates])
        found = []
        for point, column in known[c.label]:
            way = np.where(c.shapes, 0.0, point - neutral)
            steps = project.taken(column, LIMITS.hidden)
            if steps is not None and way.any():
                found.append(_gain(fit, steps, room(c, way)))
        gain, parameter = max(found, default=(0.0, -1))
        if gain > least:
            out.setdefault(fit.names[parameter], []).append(c.label)
    return {name: tuple(labels) for name, labels in out.items()}


def _gain(fit: Fit, steps: Array, ends: tuple[float, float]) -> tuple[float, int]:
    """(Nats by which the data sheet is likelier with an effect in its best amount; the parameter that gains most).

    Args:
        steps: `[k]`, of the numbers, that one of it takes; ends: amounts of it that its range allows.
    """
    amounts = np.concatenate([end * AMOUNTS for end in ends if np.isfinite(end) and end])
    away = fit.values - np.array([c.neutral for c in fit.coordinates])
    before = _far(fit.coordinates, away)
    gains = [before.sum() - _far(fit.coordinates, away - t * steps).sum() for t in amounts]
    if not len(amounts) or max(gains) <= 0:
        return 0.0, -1
    after = away - amounts[int(np.argmax(gains))] * steps
    precision = np.array([c.precision if c.stated or c.kind else 0.0 for c in fit.coordinates])
    return float(max(gains)), int(np.argmax(precision * (away**2 - after**2)))


def _far(coordinates: Sequence[Coordinate], away: Array) -> Array:
    """Minus the log prior density of each kind of known parameter, so far from the data sheet, up to a constant.

    Of a kind whose accuracy nobody stated a multivariate Student t (`accuracy`), of stated ones a Gaussian.
    """
    squares = np.array([c.precision for c in coordinates]) * away**2
    kinds = np.array([c.kind for c in coordinates])
    stated = np.array([c.stated and not c.kind for c in coordinates])
    each = [0.5 * float(squares[stated].sum())]
    for kind in sorted({k for k in kinds if k}):
        own = squares[kinds == kind]
        each.append(0.5 * (SURE + len(own)) * float(np.log1p(own.sum() / SURE)))
    return np.array(each)
