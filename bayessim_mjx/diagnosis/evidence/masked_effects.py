"""Masked effects: the parameters of named effects, or known parameters, can reproduce them in these logs.

A bias beside a spring moves the spring's angle of rest; viscous friction beside friction by direction is part of it.
Such logs do not tell whether both are there: the named law stands for both (`by_effects`).

A joint's viscous friction is its damping, rotor inertia beside a slide is its mass, a drive's gain is all of the
robot's inertia, damping and friction together. The prior decides whether the data sheet is wrong or an effect is
missing (`by_parameters`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import SURE
from bayessim_mjx.diagnosis.evidence.laws import compatible
from bayessim_mjx.diagnosis.evidence.promises import Column
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.budget import Progress
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, HIDDEN, ODDS
from bayessim_mjx.diagnosis.selection.screen import Projection, judged, looked_at, part, projected, simulated
from bayessim_mjx.diagnosis.selection.search_state import SearchState

Array = NDArray[np.float64]
AMOUNTS = np.linspace(0.0, 1.0, 101)[1:]  # of an effect, shares of the largest in its range


def by_effects(state: SearchState, answer: Model, say: Progress = lambda text, done, total: None) -> tuple[str, ...]:
    """Labels of candidates that the answer's effects hide, and that show without these effects."""
    if not answer.effects or not state.secants.columns:
        return ()
    others = [c for c in state.candidates if c.label in state.secants.columns]
    others = [c for c in others if all(compatible(c, e) for e in answer.effects)]
    alone, likely = _shown(state, state.base, others), _shown(state, answer, others)
    shown = 1.0 - (1.0 - HIDDEN) ** 0.5  # halfway, on a log scale, between what is hidden and what shows wholly
    some = [c for c in others if alone[c.label][0][0] < shown < likely[c.label][0][0]]
    some = sorted(some, key=lambda c: -likely[c.label][0][0])[: EFFORT.candidates]
    plans = [(i, point) for i, c in enumerate(some) for _, point in likely[c.label][: EFFORT.points]]
    own = looked_at(answer.fit, state.settings.screened)
    columns = simulated(state.fitter, answer.fit, some, plans, own, lambda _, done, all_: say("hidden", done, all_))
    found = judged(state.fitter, answer.fit, some, columns, own)
    return tuple(some[i].label for i, each in found.items() if min(s.absorbed for s, _ in each) > HIDDEN)


def _shown(state: SearchState, model: Model, candidates: Sequence[Candidate]) -> dict[str, list[tuple[float, Array]]]:
    """{label: (share that is hidden, starting point)}, what shows most first, without a simulation."""
    found = projected(state.fitter, model.fit, candidates, state.secants)
    each = {candidates[i].label: [(s.absorbed, point) for s, point in several] for i, several in found.items()}
    return {label: sorted(several, key=lambda pair: pair[0]) for label, several in each.items()}


@dataclass(frozen=True, eq=False)
class StandIn:
    """An effect that may do the work of a known parameter's deviation from the data sheet.

    Attributes:
        candidate, column: of the effect, at one of its points; point: `[k]`, its numbers in the best amount.
        known: `[base]`, the known parameters beside it; parameter: which of them gains most.
        nats: by which the known parameters are likelier.
    """

    candidate: Candidate
    column: Column
    point: Array
    known: Array
    parameter: str
    nats: float


def by_parameters(state: SearchState, answer: Model) -> dict[str, tuple[str, ...]]:
    """{known parameter: labels of the effects that it may stand for}, without a simulation (`stand_ins`)."""
    out: dict[str, list[str]] = {}
    for found in stand_ins(state, answer):
        out.setdefault(found.parameter, []).append(found.candidate.label)
    return {name: tuple(labels) for name, labels in out.items()}


def stand_ins(state: SearchState, answer: Model) -> list[StandIn]:
    """Effects that known parameters may stand for.

    An effect stands beside a parameter's deviation where known parameters do all its work (`HIDDEN`), and
    where the data sheet speaks for it: without the effect's part the parameters are so much likelier that the odds
    against the effect, one of all candidates and in its best size, are below `ODDS.strong`, and by `ODDS.mention` at
    least. Beside the best one stand those that the data sheet does not speak strongly against; then what it leaves is
    looked at in the same way.
    """
    fit = part(answer.fit, state.secants.own) if state.secants.columns else answer.fit
    every = _works(state, answer, fit)
    least = max(-state.log_prior(frozenset("x")) - np.log(ODDS.strong), np.log(ODDS.mention))
    away = fit.values - np.array([c.neutral for c in fit.coordinates])
    base, out = len(state.fitter.base), list[StandIn]()
    while every:
        gains = {label: max(_gain(fit, away, own) for own in works) for label, works in every.items()}
        best = max(gains.values())
        if best.nats <= least:
            break
        for label, gain in gains.items():
            if gain.nats > max(least, best.nats - np.log(ODDS.strong)):
                column = gain.of.column
                known = fit.values[:base] - gain.steps[:base]
                at = fit.names[gain.parameter], gain.nats
                out.append(StandIn(column.candidate, column, column.at(gain.amount), known, *at))
                del every[label]
        away = away - best.steps
    return out


@dataclass(frozen=True, eq=False)
class _Work:
    """Of an effect at one point: its column, and the steps `[k]` of the fit's numbers that do it."""

    column: Column
    steps: Array


@dataclass(frozen=True, order=True)
class _Gain:
    """Nats by which the data sheet is likelier, the parameter that gains most, and the steps taken back `[k]`."""

    nats: float
    parameter: int
    steps: Array = field(compare=False)
    amount: float = field(compare=False)
    of: _Work = field(compare=False)


def _works(state: SearchState, answer: Model, fit: Fit) -> dict[str, list[_Work]]:
    """Of each effect whose work the fit's numbers can do."""
    known = state.secants.columns
    out: dict[str, list[_Work]] = {}
    others = [c for c in state.candidates if known.get(c.label) and all(compatible(c, e) for e in answer.effects)]
    project = Projection(state.fitter, fit) if others else None
    for c in others:
        found = []
        for point, change in known[c.label]:
            column = Column(c, point, change)
            steps = project.taken(change, HIDDEN) if project and column.way.any() else None
            found += [] if steps is None else [_Work(column, steps)]
        out |= {c.label: found} if found else {}
    return out


def _gain(fit: Fit, away: Array, of: _Work) -> _Gain:
    """In its best amount, of parameters so far from the data sheet `[k]`."""
    before = _far(fit.coordinates, away)
    amounts = [float(end * share) for end in of.column.room if np.isfinite(end) and end for share in AMOUNTS]
    gains = [before - _far(fit.coordinates, away - t * of.steps) for t in amounts]
    if not gains or max(gains) <= 0:
        return _Gain(0.0, -1, np.zeros_like(away), 0.0, of)
    amount = amounts[int(np.argmax(gains))]
    steps = amount * of.steps
    precision = np.array([c.precision if c.stated or c.kind else 0.0 for c in fit.coordinates])
    return _Gain(max(gains), int(np.argmax(precision * (away**2 - (away - steps) ** 2))), steps, amount, of)


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
