"""Known parameters far from the data sheet that stand for an effect: one law, two names, and no log tells them apart.

A joint's viscous friction is its damping, rotor inertia beside a slide is its mass, a drive's gain is all of the
robot's inertia, damping and friction together. The prior tells whether a data sheet is so wrong, or an effect missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

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
    against the effect, one of all candidates and in its best size, are below `ODDS.strong`, and by `ODDS.mention` at
    least. Beside the best one stand those that the data sheet does not speak strongly against; then what it leaves is
    looked at in the same way.
    """
    fit = part(answer.fit, pool.secants.own) if pool.secants.columns else answer.fit
    every = _works(pool, answer, fit)
    least = max(-log_prior(frozenset("x"), len(pool.candidates)) - np.log(ODDS.strong), np.log(ODDS.mention))
    away = fit.values - np.array([c.neutral for c in fit.coordinates])
    out: dict[str, list[str]] = {}
    while every:
        gains = {label: max(_gain(fit, away, own) for own in works) for label, works in every.items()}
        best = max(gains.values())
        if best.nats <= least:
            break
        for label, gain in gains.items():
            if gain.nats > max(least, best.nats - np.log(ODDS.strong)):
                out.setdefault(fit.names[gain.parameter], []).append(label)
                del every[label]
        away = away - best.steps
    return {name: tuple(labels) for name, labels in out.items()}


@dataclass(frozen=True, eq=False)
class _Work:
    """Of an effect at one point: the steps `[k]` of the fit's numbers that do it, and what its range allows of it."""

    steps: Array
    room: tuple[float, float]


@dataclass(frozen=True, order=True)
class _Gain:
    """Nats by which the data sheet is likelier, the parameter that gains most, and the steps taken back `[k]`."""

    nats: float
    parameter: int
    steps: Array = field(compare=False)


def _works(pool: Pool, answer: Model, fit: Fit) -> dict[str, list[_Work]]:
    """Of each effect whose work the fit's numbers can do."""
    known = pool.secants.columns
    out: dict[str, list[_Work]] = {}
    others = [c for c in pool.candidates if known.get(c.label) and all(compatible(c, e) for e in answer.effects)]
    project = Projection(pool.fitter, fit) if others else None
    for c in others:
        neutral, found = np.array([x.neutral for x in c.coordinates]), []
        for point, column in known[c.label]:
            way = np.where(c.shapes, 0.0, point - neutral)
            steps = project.taken(column, LIMITS.hidden) if project and way.any() else None
            found += [] if steps is None else [_Work(steps, room(c, way))]
        out |= {c.label: found} if found else {}
    return out


def _gain(fit: Fit, away: Array, of: _Work) -> _Gain:
    """In its best amount, of parameters so far from the data sheet `[k]`."""
    before = _far(fit.coordinates, away)
    amounts = [float(end * share) for end in of.room if np.isfinite(end) and end for share in AMOUNTS]
    gains = [before - _far(fit.coordinates, away - t * of.steps) for t in amounts]
    if not gains or max(gains) <= 0:
        return _Gain(0.0, -1, np.zeros_like(away))
    steps = amounts[int(np.argmax(gains))] * of.steps
    precision = np.array([c.precision if c.stated or c.kind else 0.0 for c in fit.coordinates])
    return _Gain(max(gains), int(np.argmax(precision * (away**2 - (away - steps) ** 2))), steps)


def _far(coordinates: Sequence[Coordinate], away: Array) -> float:
    """Minus the log prior density of known parameters so far from the data sheet, up to a constant.

    Of a kind whose accuracy nobody stated a multivariate Student t (`accuracy`), of stated ones a Gaussian.
    """
    squares = np.array([c.precision for c in coordinates]) * away**2
    kinds = np.array([c.kind for c in coordinates])
    total = 0.5 * float(squares[[c.stated and not c.kind for c in coordinates]].sum())
    for kind in {k for k in kinds if k}:
        own = squares[kinds == kind]
        total += 0.5 * (SURE + len(own)) * float(np.log1p(own.sum() / SURE))
    return total
