"""Effects' parameters that end at a bound: ranges grow as long as the logs ask for it, and what stays there is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate, shrink
from bayessim_mjx.diagnosis.selection.models import Model, nats, scored
from bayessim_mjx.diagnosis.selection.pool import Pool, Progress, fresh
from bayessim_mjx.diagnosis.selection.tried import ranked
from bayessim_mjx.physics import Physics


@dataclass(frozen=True)
class Widening:
    """How ranges grow, and when an estimate is at the end of one."""

    near: float = 0.001  # of a range: at its end
    # a range grows by this factor, up to so many times what it was at first
    twice: float = 2.0
    farthest: float = 8.0
    nats: float = 2.0  # of held-out evidence that a wider range has to bring
    leading: int = 3  # single effects whose ranges grow before further ones are added
    steps: int = 8  # of a fit in a wider range


WIDENING = Widening()


@dataclass(frozen=True)
class Bound:
    """How a parameter ends at a bound.

    Attributes:
        kind: "at least", "at most" (nothing larger or smaller was tried), "end" (physics ends there, or a wider range
            explains no more), "off" (it has no part in the effect).
        why: a clause for people, after the parameter's name.
    """

    kind: str
    why: str


def widened(pool: Pool, model: Model, say: Progress) -> Model:
    """The model with ranges as wide as it takes for its effects' parameters to lie within, refitted.

    A range doubles as long as that brings held-out evidence, up to `farthest` times what it was. It stays where its end
    means that the effect is off, where physics ends, and where it sizes an effect's memory.
    """
    while True:
        effects = tuple(_wider(pool, model, e) for e in model.effects)
        if all(new is old for new, old in zip(effects, model.effects, strict=True)):
            return model
        say("wider ranges", 0, 1)
        new = _refitted(pool, model, effects)
        if nats(model, new) < WIDENING.nats:
            return model
        _adopt(pool, new)
        model = new


def widen_leading(pool: Pool, say: Progress) -> None:
    """Wider ranges for the leading single effects: one that is held back at a bound must not lose for that."""
    for model in ranked(pool, 1)[: WIDENING.leading]:
        widened(pool, model, say)


def of(physics: Physics, coordinate: Coordinate, value: float) -> Bound | None:
    """How a parameter ends at a bound; None where it does not."""
    end = _end(coordinate, value)
    if not end:
        return None
    quantity = physics.quantity(coordinate.index[0])
    at = getattr(coordinate, end)
    if at == quantity.neutral and not quantity.shape:
        return Bound("off", phrases.off(at))
    least, most = quantity.ends()
    unit = f" {coordinate.unit}" if coordinate.unit else ""
    if at == (most if end == "high" else least):
        return Bound("end", phrases.physical_end(at, unit))
    if at == _farthest(physics, coordinate, end):
        kind = "at least" if end == "high" else "at most"
        return Bound(kind, phrases.farthest_tried(at, unit, kind))
    return Bound("end", phrases.bound(at, unit))


def _end(c: Coordinate, value: float) -> str:
    room = WIDENING.near * (c.high - c.low)
    return "high" if c.high - value < room else "low" if value - c.low < room else ""


def _farthest(physics: Physics, coordinate: Coordinate, end: str) -> float:
    """Where a range may end at most."""
    own = [physics.space.parameters[i] for i in coordinate.index]
    low, high = min(p.low for p in own), max(p.high for p in own)
    quantity = physics.quantity(coordinate.index[0])
    least, most = quantity.ends()
    if quantity.remembered:
        return high if end == "high" else low
    if end == "high":
        return high if high >= most else min(most, coordinate.neutral + WIDENING.farthest * (high - coordinate.neutral))
    if low <= least:
        return low
    return low / WIDENING.farthest if low > 0 else coordinate.neutral + WIDENING.farthest * (low - coordinate.neutral)


def _wider(pool: Pool, model: Model, effect: Candidate) -> Candidate:
    """The effect with twice the range where one of its parameters ends at a bound that may move."""
    physics = pool.fitter.simulator.physics
    values = model.values_of(effect)
    coordinates = tuple(_grown(physics, c, float(v)) for c, v in zip(effect.coordinates, values, strict=True))
    return effect if coordinates == effect.coordinates else replace(effect, coordinates=coordinates)


def _grown(physics: Physics, c: Coordinate, value: float) -> Coordinate:
    end = _end(c, value)
    if not end or getattr(c, end) == _farthest(physics, c, end):
        return c
    if c.neutral == getattr(c, end) and not physics.quantity(c.index[0]).shape:
        return c
    far = _farthest(physics, c, end)
    if end == "high":
        wider = replace(c, high=min(far, c.neutral + WIDENING.twice * (c.high - c.neutral)))
    else:
        low = c.low / WIDENING.twice if c.low > 0 else c.neutral + WIDENING.twice * (c.low - c.neutral)
        wider = replace(c, low=max(far, low))
    return replace(wider, precision=shrink(wider))


def _refitted(pool: Pool, model: Model, effects: Sequence[Candidate]) -> Model:
    fitter, base = pool.fitter, len(pool.fitter.base)
    own = {c.name: c for e in effects for c in e.coordinates}
    coordinates = tuple(c if i < base else own[c.name] for i, c in enumerate(model.fit.coordinates))
    start = fitter.refresh(replace(model.fit, coordinates=coordinates, history=(), damping=1e-3))
    (fit,) = fitter.iterate([start], WIDENING.steps, lambda f: fresh(pool, f))
    return scored(fitter, fitter.refresh(fit), tuple(effects))


def _adopt(pool: Pool, new: Model) -> None:
    """The pool with a model's effects in their new ranges; what was fitted with the old ones stays as it is."""
    own = {e.label: e for e in new.effects}
    pool.models[frozenset(own)] = new
    pool.candidates = [own.get(c.label, c) for c in pool.candidates]
    pool.screened = [replace(s, candidate=own.get(s.candidate.label, s.candidate)) for s in pool.screened]


def spread_out(covariance: np.ndarray, values: np.ndarray, neutral: np.ndarray, at: Sequence[int]) -> np.ndarray:
    """A covariance `[k, k]` that says of the parameters `at` a bound no more than that they are not neutral."""
    out = covariance.copy()
    for i in at:
        out[i, :] = out[:, i] = 0.0
        out[i, i] = (0.5 * (values[i] - neutral[i])) ** 2
    return out
