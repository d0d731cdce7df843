"""The evidence that sets of effects promise, without a simulation: from what each does to the residual of a fit.

A candidate's column is a secant: the change of the residual from neutral to a starting point. With force and start
states integrated out (`gaussian`), the evidence of every set is algebra on one matrix of inner products, so all singles
and pairs are looked at, and larger sets grow from the best. The force's amplitude is not known before a set is fitted:
the best of the amplitude without it and parts of it (`Priors.sizes`) counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.gaussian import Hyper
from bayessim_mjx.diagnosis.evidence.laws import beside
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.models import Key
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, PRIORS, Progress
from bayessim_mjx.diagnosis.selection.screen import Column, looked_at, simulated

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Promise:
    """One set: columns by their index, the evidence that they add to the fit, and the amounts of them."""

    own: tuple[int, ...]
    nats: float
    amounts: Array


class Promises:
    """Evidence of sets of columns on a fit in some windows `own`, for several amplitudes of the force."""

    def __init__(
        self, weighing: Weighing, fit: Fit, own: NDArray[np.int64], hyper: Hyper, columns: Sequence[Column]
    ) -> None:
        self.columns = list(columns)
        self.levels = [x for f in PRIORS.sizes for x in _levels(weighing, fit, own, _scaled(hyper, f), self.columns)]
        self.base = max(level.base for level in self.levels)

    def pairs(self, blocked: NDArray[np.bool_], count: int) -> list[Promise]:
        """Return the best pairs of columns that may be together."""
        gain = np.max([level.base + level.pairs() for level in self.levels], 0) - self.base
        gain[blocked] = -np.inf
        gain[np.tril_indices(len(gain))] = -np.inf
        best = np.argsort(-gain, axis=None)[:count]
        return [self.of(divmod(int(i), len(gain))) for i in best if np.isfinite(gain.flat[i])]

    def whole(self) -> Array:
        """`[P]`: log likelihood that each column gains at its point itself: of a limit a smaller part shows nothing."""
        level = self.levels[0]
        return level.g - 0.5 * np.diag(level.S)

    def of(self, own: tuple[int, ...]) -> Promise:
        """Return a set at the level at which its evidence is greatest."""
        total, best = max(((level.base + (p := level.of(own)).nats, p) for level in self.levels), key=lambda x: x[0])
        return replace(best, nats=total - self.base)


def _scaled(hyper: Hyper, share: float) -> Hyper:
    return replace(hyper, amplitude=np.maximum(share * hyper.amplitude, PRIORS.least))


@dataclass(frozen=True, eq=False)
class _Level:
    """Columns with all else integrated out: a fit's parameters, force and start states.

    Attributes:
        S, g: `[P, P]`, `[P]`, products with each other and with the residual; precision: `[P]`, of priors.
        room: `[P, 2]`; base: evidence without columns.
        inward: `[h, 1 + P]`, where parameters that rest at an end of their range go if that end is not held, without
            columns and by an amount of each; sets that move one beyond its end promise nothing here. bonus: evidence
            that the first of these steps pretends to add.
    """

    S: Array
    g: Array
    precision: Array
    room: Array
    base: float
    inward: Array
    bonus: float = 0.0

    def of(self, own: tuple[int, ...]) -> Promise:
        i = np.asarray(own)
        H, g, P = self.S[np.ix_(i, i)] + np.diag(self.precision[i]), self.g[i], self.precision[i]
        t = np.clip(np.linalg.lstsq(H, g, rcond=None)[0], *self.room[i].T)
        if np.any(self.inward[:, 0] + self.inward[:, 1 + i] @ t < 0):
            return Promise(own, -np.inf, t)
        nats = self.bonus + float(g @ t - 0.5 * t @ H @ t + 0.5 * np.sum(np.log(P)) - 0.5 * np.linalg.slogdet(H)[1])
        return Promise(own, nats, t)

    def singles(self) -> Array:
        """`[P]`: of each column alone, within its bounds."""
        d = np.diag(self.S) + self.precision
        t = np.clip(self.g / d, *self.room.T)
        found = self.bonus + self.g * t - 0.5 * t**2 * d + 0.5 * np.log(self.precision / d)
        return np.where(np.all(self.inward[:, :1] + self.inward[:, 1:] * t >= 0, axis=0), found, -np.inf)

    def pairs(self) -> Array:
        """`[P, P]`: of all pairs without bounds."""
        d = np.diag(self.S) + self.precision
        determinant = d[:, None] * d - self.S**2
        top = d * self.g[:, None] ** 2 + d[:, None] * self.g**2 - 2 * self.S * np.outer(self.g, self.g)
        logs = np.log(self.precision)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = 0.5 * top / determinant - 0.5 * np.log(determinant) + 0.5 * (logs + logs[:, None])
            first = (d * self.g[:, None] - self.S * self.g) / determinant  # amount of i in the pair (i, j)
        good = determinant > 1e-6 * np.outer(d, d)
        for start, *each in self.inward:
            moved = np.array(each)[:, None] * first
            good &= start + moved + moved.T >= 0
        return np.where(good, self.bonus + found, -np.inf)


def _levels(
    weighing: Weighing, fit: Fit, own: NDArray[np.int64], hyper: Hyper, columns: Sequence[Column]
) -> list[_Level]:
    """Return the products in some windows `own`, as if those were typical of all.

    Where parameters rest at an end of their range: with them held there, and free to come back. An effect whose work
    they do promises nothing while they are held.
    """
    belief, k = belief_of(fit), 1 + len(fit.values)
    Q, logdet = weighing.products(fit, hyper, np.stack([c.change for c in columns], 2), own)
    share = len(fit.r) / len(own)
    Q *= share
    p = belief.best(Q[:k, :k])
    held = (p <= belief.low) | (p >= belief.high)
    free = np.flatnonzero(~held)
    H = Q[1:k, 1:k] + np.diag(belief.precision)
    amplitude = (np.log(hyper.amplitude) - np.log(PRIORS.usual)) / PRIORS.spread
    base = belief.cost(Q[:k, :k], p) + share * logdet + float(np.sum(amplitude**2))
    base = -0.5 * (base + float(np.linalg.slogdet(H[np.ix_(free, free)])[1]))
    g, S, across = Q[0, k:] - p @ Q[1:k, k:], Q[k:, k:], Q[1:k, k:]
    believed = np.maximum([c.precision for c in columns], 1e-12), np.array([c.room for c in columns])
    own_free = across[free].T @ np.linalg.solve(H[np.ix_(free, free)], across[free])
    out = [_Level(S - own_free, g, *believed, base, np.zeros((0, 1 + len(g))))]
    if held.any():
        pull = Q[1:k, 0] - Q[1:k, 1:k] @ p + belief.precision * (belief.mean - p)
        step, moved = np.linalg.solve(H, pull), np.linalg.solve(H, across)
        sign = np.where(p <= belief.low, 1.0, -1.0)[held, None]
        inward = sign * np.column_stack([step[held], -moved[held]])
        out.append(_Level(S - across.T @ moved, g - across.T @ step, *believed, base, inward, 0.5 * float(pull @ step)))
    return out


def leading(
    weighing: Weighing, fit: Fit, own: NDArray[np.int64], hyper: Hyper, columns: Sequence[Column]
) -> list[Column]:
    """Return the columns that promise most by themselves, so many of each candidate (`Effort.points`)."""
    hyper, count, nats = _scaled(hyper, PRIORS.sizes[1]), Counter[str](), list[float]()
    for first in range(0, len(columns), EFFORT.windows):  # some at a time: products of all are large
        some = _levels(weighing, fit, own, hyper, columns[first : first + EFFORT.windows])
        nats += np.max([level.singles() for level in some], axis=0).tolist()
    out = []
    for j in np.argsort(-np.array(nats)):
        count[columns[j].candidate.label] += 1
        out += [columns[j]] if count[columns[j].candidate.label] <= EFFORT.points else []
    return out


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
    """Return sets that have more effects than a fitted model, most promising first.

    On the known parameters by what was screened; on effects the most promising candidates are simulated there, as
    effects change what others do.
    """
    state, model = weighing.state, weighing.state.models[key]
    fit = state.begun(model.fit)
    others = [c for c in state.candidates if all(beside(c, e) for e in model.effects)]
    columns = state.secants.of(others)
    if not columns:
        return []
    own, hyper = state.secants.own, weighing.scored[key].learnt.hyper
    whole = weighing.doubts.beside(fit)
    columns = leading(weighing, whole, own, hyper, columns)
    if key:
        labels = list(dict.fromkeys(c.candidate.label for c in columns))[: EFFORT.batch]
        again = (c for c in columns if c.candidate.label in labels)
        plans = [(c.candidate, point) for c in again for point in state.secants.points(c)]
        own = looked_at(fit, state.settings.screened)
        columns = [
            *simulated(state.fitter, fit, plans, own, lambda _, done, total: say("screening again", done, total))
        ]
    return _plans(weighing, key, Promises(weighing, whole, own, hyper, columns))


def _plans(weighing: Weighing, key: Key, promises: Promises) -> list[Plan]:
    columns, gains = promises.columns, promises.whole()
    price = -weighing.state.log_prior(frozenset("x"))
    ranked = sorted(zip(gains, columns, strict=True), key=lambda pair: pair[0])
    whole = {c.candidate.label: c.point for _, c in ranked}
    out, total = [], weighing.total(key)
    for p in _sets(promises, price):
        some = [columns[j] for j in p.own]
        own = key | {c.candidate.label for c in some}
        points = (some[0].point, whole[some[0].candidate.label]) if len(some) == 1 else ()
        nats = total + p.nats - price * len(some)
        out.append(Plan(own, nats, key, tuple(some), tuple(map(float, p.amounts)), points))
    return sorted(out, key=lambda p: -p.nats)


def _sets(promises: Promises, price: float) -> list[Promise]:
    """Single columns, pairs, and larger sets that grow from the best of these as long as each more pays its price."""
    columns, usable = promises.columns, range(len(promises.columns))
    blocked = np.array([[not beside(a.candidate, b.candidate) for b in columns] for a in columns])
    found = {p.own: p for p in map(promises.of, ((j,) for j in usable))}
    found |= {p.own: p for p in promises.pairs(blocked, 2 * EFFORT.batch)}
    for seed in sorted(found.values(), key=lambda p: price * len(p.own) - p.nats)[: EFFORT.sets[1]]:
        grown = seed
        while len(grown.own) < len(EFFORT.sets):
            more = [tuple(sorted((*grown.own, j))) for j in usable if not blocked[j, list(grown.own)].any()]
            top = max(map(promises.of, more), key=lambda p: p.nats, default=None)
            if top is None or top.nats < grown.nats + price:
                break
            grown = found[top.own] = top
    return list(found.values())
