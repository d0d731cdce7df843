"""Effects' parameters that end at a bound: their ranges grow as long as held-out evidence gains from it."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate, shrink
from bayessim_mjx.diagnosis.fitting.quadratic import solve
from bayessim_mjx.diagnosis.selection.models import Model, nats, scored
from bayessim_mjx.diagnosis.selection.numbers import LEAVING_OUT, ODDS, PRIORS, Progress
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.selection.successive_halving import AFRESH
from bayessim_mjx.physics import Physics

SINGLE = float(np.finfo(np.float32).eps)  # values are written into the model in single precision
Change = Callable[[Physics, Coordinate, float], Coordinate]  # (physics, its range, its value) -> its new range


@dataclass(frozen=True)
class Bound:
    """How a parameter ends at a bound.

    Attributes:
        kind: "at least", "at most" (nothing larger or smaller was tried), "end" (physics ends there, or a wider range
            explains no more), "off" (it has no part in the effect).
        at: the bound, in the parameter's unit; physical: physics ends there.
    """

    kind: str
    at: float
    physical: bool = False


def widened(state: SearchState, model: Model, say: Progress) -> Model:
    """Return the model with ranges as wide as it takes for its effects' parameters to lie within, refitted.

    A range doubles as long as a still wider one promises strong held-out evidence (`Odds.strong`), up to as many times
    as the smallest usual size is below it (`Priors.sizes`). What has brought it is kept. A range stays where its end
    means that the effect is off, where physics ends, and where it sizes an effect's memory.
    """
    last = model
    while not state.settings.budget.over(LEAVING_OUT) and _held(state, last):
        left = max(last.total - promise(state, last), 1e-9)
        if 0.5 * last.samples * math.log(last.total / left) <= math.log(ODDS.strong):
            break
        say("wider ranges", 0, 1)
        last = _refitted(state, last, _moved(state, last, _grown))
        if nats(model, last) >= math.log(ODDS.strong):
            _adopt(state, last)
            model = last
    return model


def promise(state: SearchState, model: Model) -> float:
    """By how much the cost would fall in ranges as wide as they may get, if the model were linear."""
    fit = model.fit
    q, _ = fit.quadratic()
    g, S = q.weighted(fit.weight)
    precision, pull, low, high = fit.prior()
    S, g = S + np.diag(precision), g + pull
    far = {c.name: c for e in _moved(state, model, functools.partial(_grown, whole=True)) for c in e.coordinates}
    wide = [far.get(c.name, c) for c in fit.coordinates]
    ends = [np.array([getattr(c, end) for c in wide]) - fit.values for end in ("low", "high")]
    near, free = solve(S, g, low, high), solve(S, g, *ends)
    return max(float((2 * g - S @ free) @ free - (2 * g - S @ near) @ near), 0.0)


def of(physics: Physics, coordinate: Coordinate, value: float) -> Bound | None:
    """How a parameter ends at a bound; None where it does not."""
    end = _end(coordinate, value)
    if not end:
        return None
    quantity = physics.quantity(coordinate.index[0])
    at = getattr(coordinate, end)
    if at == quantity.neutral and (quantity.optional or not quantity.shape):
        return Bound("off", at)
    least, most = quantity.ends()
    if at == (most if end == "high" else least):
        return Bound("end", at, physical=True)
    if at == _farthest(physics, coordinate, end):
        return Bound("at least" if end == "high" else "at most", at)
    return Bound("end", at)


def _end(c: Coordinate, value: float) -> str:
    room = SINGLE * (c.high - c.low)
    return "high" if c.high - value <= room else "low" if value - c.low <= room else ""


def _farthest(physics: Physics, coordinate: Coordinate, end: str) -> float:
    """Where a range may end at most."""
    own = [physics.space.parameters[i] for i in coordinate.index]
    low, high = min(p.low for p in own), max(p.high for p in own)
    quantity = physics.quantity(coordinate.index[0])
    least, most = quantity.ends()
    times = 1 / PRIORS.sizes[-1]
    if quantity.remembered:
        return high if end == "high" else low
    if end == "high":
        return high if high >= most else min(most, coordinate.neutral + times * (high - coordinate.neutral))
    if low <= least:
        return low
    return low / times if low > 0 else coordinate.neutral + times * (low - coordinate.neutral)


def _moved(state: SearchState, model: Model, change: Change) -> list[Candidate]:
    """Return the model's effects with their ranges changed; the same objects where nothing is."""
    physics, out = state.fitter.simulator.physics, []
    for effect in model.effects:
        pairs = zip(effect.coordinates, model.values_of(effect), strict=True)
        new = tuple(change(physics, c, float(v)) for c, v in pairs)
        out.append(effect if new == effect.coordinates else replace(effect, coordinates=new))
    return out


def _held(state: SearchState, model: Model) -> bool:
    """Whether a parameter ends at a bound that may move."""
    return any(new is not old for new, old in zip(_moved(state, model, _grown), model.effects, strict=True))


def _grown(physics: Physics, c: Coordinate, value: float, whole: bool = False) -> Coordinate:
    """Twice as wide, or as wide as it may get (`whole`), where the value is at an end that may move."""
    end = _end(c, value)
    if not end or getattr(c, end) == (far := _farthest(physics, c, end)):
        return c
    if c.neutral == getattr(c, end) and not physics.quantity(c.index[0]).shape:
        return c
    if whole:
        return replace(c, high=far) if end == "high" else replace(c, low=far)
    if end == "high":
        wider = replace(c, high=min(far, c.neutral + 2 * (c.high - c.neutral)))
    else:
        low = c.low / 2 if c.low > 0 else c.neutral + 2 * (c.low - c.neutral)
        wider = replace(c, low=max(far, low))
    return wider if c.stated else replace(wider, precision=shrink(wider))


def _refitted(state: SearchState, model: Model, effects: Sequence[Candidate]) -> Model:
    fitter, base = state.fitter, len(state.fitter.base)
    own = {c.name: c for e in effects for c in e.coordinates}
    coordinates = tuple(c if i < base else own[c.name] for i, c in enumerate(model.fit.coordinates))
    start = fitter.refresh(replace(model.fit, coordinates=coordinates, **AFRESH))
    (fit,) = fitter.iterate([start], state.settings.iterations, state.fresh)
    return scored(fitter, fitter.refresh(fit), tuple(effects))


def _adopt(state: SearchState, new: Model) -> None:
    """Return the state with a model's effects in their new ranges; what was fitted with the old ones stays as it is."""
    own = {e.label: e for e in new.effects}
    state.models[frozenset(own)] = new
    state.candidates = [own.get(c.label, c) for c in state.candidates]
    state.screened = [replace(s, candidate=own.get(s.candidate.label, s.candidate)) for s in state.screened]


def spread_out(covariance: np.ndarray, away: np.ndarray, at: Sequence[int]) -> np.ndarray:
    """Return a covariance `[k, k]` that says of the parameters `at` a bound no more than that they are not neutral.

    away: `[k]`, their distance from neutral.
    """
    out = covariance.copy()
    for i in at:
        out[i, :] = out[:, i] = 0.0
        out[i, i] = (0.5 * away[i]) ** 2
    return out
