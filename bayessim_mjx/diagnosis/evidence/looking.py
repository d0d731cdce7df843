"""What to fit next: sets of effects around a fitted model, by what their columns promise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.columns import Column, Part, Promise, Promises, leading
from bayessim_mjx.diagnosis.evidence.gaussian import Belief
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.laws import beside
from bayessim_mjx.diagnosis.selection.screen import looked_at, simulated
from bayessim_mjx.diagnosis.selection.sets import Key, log_prior

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Breadth:
    """How far one look goes; more of each finds the same sets, later.

    Attributes:
        pairs: of columns that promise most; seeds: sets that larger ones grow from.
        most: effects in a set; more: effects that one look adds (each is then left out in turn).
        points: of a candidate that are looked at in sets; anew: candidates that are simulated on a model with effects.
    """

    pairs: int = 24
    seeds: int = 4
    most: int = 8
    more: int = 3
    points: int = 3
    anew: int = 16
    columns: int = 120


BREADTH = Breadth()


@dataclass(frozen=True)
class Plan:
    """A set that promises something, and how to begin its fit.

    Attributes:
        key: its effects; nats: of evidence and prior over the known parameters; parent: the fitted model it extends.
        columns, amounts: of the effects that it has more; points: further starting points of a single one.
        origin: the fitted model whose known parameters it begins at; None: its parent's.
        known: other values of these, at each of the `points`; (): the origin's.
    """

    key: Key
    nats: float
    parent: Key
    columns: tuple[Column, ...] = ()
    amounts: tuple[float, ...] = ()
    points: tuple[Array, ...] = ()
    origin: Key | None = None
    known: tuple[Array, ...] = ()


def around(weighing: Weighing, key: Key, say: Progress) -> list[Plan]:
    """Sets that have more effects than a fitted model, most promising first.

    On the known parameters by what was screened; on effects the most promising candidates are simulated there, as
    effects change what others do.
    """
    pool, model = weighing.pool, weighing.pool.models[key]
    fit = pool.begun(model.fit)
    others = [c for c in pool.candidates if all(beside(c, e) for e in model.effects)]
    known = pool.secants.columns
    columns = [Column(c, point, change) for c in others for point, change in known.get(c.label, ())]
    if not columns:
        return []
    (part, belief), hyper = _part(weighing, fit, pool.secants.own), weighing.scored[key].learnt.hyper
    columns = leading(part, belief, hyper, columns, BREADTH.points, BREADTH.columns)
    if key:
        labels = list(dict.fromkeys(c.candidate.label for c in columns))[: BREADTH.anew]
        some = [c for c in others if c.label in labels]
        plans = [(some.index(c.candidate), c.point) for c in columns if c.candidate.label in labels]
        own = looked_at(fit, pool.settings.screened)
        found = simulated(pool.fitter, fit, some, plans, own, lambda _, done, total: say("second look", done, total))
        columns = [Column(some[i], point, change) for i, point, change in found]
        part, belief = _part(weighing, fit, own)
    promises = Promises(part, belief, hyper, columns)
    return _plans(weighing, key, promises)


def _part(weighing: Weighing, fit: Fit, own: NDArray[np.int64]) -> tuple[Part, Belief]:
    """Some windows of a fit, and the prior of its parameters."""
    fit = weighing.doubted(fit)
    arrays = fit.r[own], fit.A[own], weighing.D[own], fit.B[own], fit.offsets[own]
    part = Part(*arrays, weighing.pool.fitter.spread, weighing.scale, weighing.channels, len(fit.r) / len(own))
    return part, belief_of(fit)


def _plans(weighing: Weighing, key: Key, promises: Promises) -> list[Plan]:
    columns, gains = promises.columns, promises.whole()
    price = -log_prior(frozenset("x"), len(weighing.pool.candidates))
    ranked = sorted(zip(gains, columns, strict=True), key=lambda pair: pair[0])
    whole = {c.candidate.label: c.point for _, c in ranked}
    out, total = [], weighing.total(key)
    for p in _sets(promises, price, min(BREADTH.most - len(key), BREADTH.more)):
        some = [columns[j] for j in p.own]
        own = key | {c.candidate.label for c in some}
        points = (some[0].point, whole[some[0].candidate.label]) if len(some) == 1 else ()
        nats = total + p.nats - price * len(some)
        out.append(Plan(own, nats, key, tuple(some), tuple(map(float, p.amounts)), points))
    return sorted(out, key=lambda p: -p.nats)


def _sets(promises: Promises, price: float, most: int) -> list[Promise]:
    """Single columns, pairs, and larger sets that grow from the best of these as long as each more pays its price."""
    columns, usable = promises.columns, range(len(promises.columns))
    blocked = np.array([[not beside(a.candidate, b.candidate) for b in columns] for a in columns])
    found = {p.own: p for p in promises.of([(j,) for j in usable])}
    if most > 1:
        found |= {p.own: p for p in promises.pairs(blocked, BREADTH.pairs)}
    for seed in sorted(found.values(), key=lambda p: price * len(p.own) - p.nats)[: BREADTH.seeds]:
        grown = seed
        while len(grown.own) < most:
            more = [tuple(sorted((*grown.own, j))) for j in usable if not blocked[j, list(grown.own)].any()]
            top = max(promises.of(more), key=lambda p: p.nats, default=None)
            if top is None or top.nats < grown.nats + price:
                break
            grown = found[top.own] = top
    return list(found.values())
