"""The evidence that sets of effects promise, without a simulation: from what each does to the residual of a fit.

A candidate's column is a secant: the change of the residual from neutral to a starting point. With force and start
states integrated out (`gaussian`), the evidence of every set is algebra on one matrix of inner products, so all singles
and pairs are looked at, and larger sets grow from the best. The force's amplitude is not known before a set is fitted:
the best of the amplitude without it and parts of it (`Priors.sizes`) counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.gaussian import Belief, Hyper, correlation
from bayessim_mjx.diagnosis.evidence.laws import beside
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.budget import Progress
from bayessim_mjx.diagnosis.selection.models import Key
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, PRIORS
from bayessim_mjx.diagnosis.selection.screen import looked_at, room, simulated

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Column:
    """What one candidate does at one point.

    Attributes:
        candidate; point: `[k]`, where it was simulated; change: `[w, n]` of the residual.
    """

    candidate: Candidate
    point: Array
    change: Array

    @property
    def way(self) -> Array:
        """`[k]` from neutral to the point; 0 for shapes."""
        neutral = np.array([c.neutral for c in self.candidate.coordinates])
        return np.where(self.candidate.shapes, 0.0, self.point - neutral)

    @property
    def room(self) -> tuple[float, float]:
        return room(self.candidate, self.way)

    @property
    def precision(self) -> float:
        """Of the multiple of the way, by the priors of the candidate's numbers."""
        return float(sum(c.precision * w**2 for c, w in zip(self.candidate.coordinates, self.way, strict=True)))

    def at(self, amount: float) -> Array:
        """The point so many ways from neutral, within the ranges, and not at neutral, where many laws have no slope."""
        low, high = (np.array([getattr(c, e) for c in self.candidate.coordinates]) for e in ("low", "high"))
        neutral = np.array([c.neutral for c in self.candidate.coordinates])
        amount = amount if abs(amount) > 0.02 else 0.02
        moved = np.where(self.candidate.shapes, self.point, neutral + amount * self.way)
        return np.clip(moved, low, high)


@dataclass(frozen=True, eq=False)
class Part:
    """Some windows of a fit: `r [w, n]`, `A`, `D`, `B`, offsets as in `gaussian.windows_of`; share: of all windows."""

    r: Array
    A: Array
    D: Array
    B: Array
    offsets: Array
    spread: Array
    scale: Array
    channels: int
    share: float


@dataclass(frozen=True, eq=False)
class Promise:
    """One set: columns by their index, the evidence that they add to the fit, and the amounts of them."""

    own: tuple[int, ...]
    nats: float
    amounts: Array


class Promises:
    """Evidence of sets of columns on a fit, for several amplitudes of the force."""

    def __init__(self, part: Part, belief: Belief, hyper: Hyper, columns: Sequence[Column]) -> None:
        self.columns = list(columns)
        self.levels = [_level(part, belief, _scaled(hyper, f), self.columns) for f in PRIORS.sizes]
        self.base = max(level.base for level in self.levels)

    def pairs(self, blocked: NDArray[np.bool_], count: int) -> list[Promise]:
        """The best pairs of columns that may be together."""
        gain = np.max([level.base + level.pairs() for level in self.levels], 0) - self.base
        gain[blocked] = -np.inf
        gain[np.tril_indices(len(gain))] = -np.inf
        best = np.argsort(-gain, axis=None)[:count]
        return self.of([divmod(int(i), len(gain)) for i in best if np.isfinite(gain.flat[i])])

    def whole(self) -> Array:
        """`[P]`: log likelihood that each column gains at its point itself: of a limit a smaller part shows nothing."""
        level = self.levels[0]
        return level.g - 0.5 * np.diag(level.S)

    def of(self, sets: Sequence[tuple[int, ...]]) -> list[Promise]:
        return self._best([[level.of(own) for own in sets] for level in self.levels])

    def _best(self, each: Sequence[Sequence[Promise]]) -> list[Promise]:
        """Of each set, the level at which its evidence is greatest."""
        out = []
        for some in zip(*each, strict=True):
            total = [level.base + p.nats for level, p in zip(self.levels, some, strict=True)]
            i = int(np.argmax(total))
            out.append(replace(some[i], nats=total[i] - self.base))
        return out


def _scaled(hyper: Hyper, share: float) -> Hyper:
    return replace(hyper, amplitude=np.maximum(share * hyper.amplitude, PRIORS.least))


@dataclass(frozen=True, eq=False)
class _Level:
    """Products with everything else integrated out: S `[P, P]`, g `[P]`, priors; base: evidence without columns."""

    S: Array
    g: Array
    precision: Array
    room: Array
    base: float

    def of(self, own: tuple[int, ...]) -> Promise:
        i = np.asarray(own)
        H, g, P = self.S[np.ix_(i, i)] + np.diag(self.precision[i]), self.g[i], self.precision[i]
        t = np.clip(np.linalg.lstsq(H, g, rcond=None)[0], *self.room[i].T)
        nats = float(g @ t - 0.5 * t @ H @ t + 0.5 * np.sum(np.log(P)) - 0.5 * np.linalg.slogdet(H)[1])
        return Promise(own, nats, t)

    def pairs(self) -> Array:
        """`[P, P]`: of all pairs without bounds."""
        d = np.diag(self.S) + self.precision
        determinant = d[:, None] * d - self.S**2
        top = d * self.g[:, None] ** 2 + d[:, None] * self.g**2 - 2 * self.S * np.outer(self.g, self.g)
        logs = np.log(self.precision)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = 0.5 * top / determinant - 0.5 * np.log(determinant) + 0.5 * (logs + logs[:, None])
        return np.where(determinant > 1e-6 * np.outer(d, d), found, -np.inf)


def leading(part: Part, belief: Belief, hyper: Hyper, columns: Sequence[Column]) -> list[Column]:
    """The columns that promise most by themselves, so many of each candidate (`Effort.points`); few products tell."""
    g, s = _Rest(part, belief, _scaled(hyper, PRIORS.sizes[1]), columns, diagonal=True).projected()
    precision = np.maximum([c.precision for c in columns], 1e-12)
    t = np.clip(g / (s + precision), *np.array([c.room for c in columns]).T)
    nats = g * t - 0.5 * t**2 * (s + precision) + 0.5 * np.log(precision / (s + precision))
    count: dict[str, int] = {}
    out = []
    for j in np.argsort(-nats):
        label = columns[j].candidate.label
        count[label] = count.get(label, 0) + 1
        out += [columns[j]] if count[label] <= EFFORT.points else []
    return out


class _Rest:
    """Columns with all else integrated out: a fit's parameters, force and start states, in some windows."""

    def __init__(
        self, part: Part, belief: Belief, hyper: Hyper, columns: Sequence[Column], diagonal: bool = False
    ) -> None:
        self.part = part
        nodes = part.D.shape[2] // len(part.scale)
        self.root = np.kron(np.diag(hyper.amplitude * part.scale), correlation(nodes, hyper.memory))
        self.noise = np.tile(hyper.noise, part.r.shape[1] // part.channels)
        self.own = 1 + part.A.shape[2]
        self.few, self.among = self.products(columns, diagonal)
        few = self.few[:, : self.own]
        self.p = belief.best(few)
        self.free = np.flatnonzero((self.p > belief.low) & (self.p < belief.high))
        self.H = few[1:, 1:][np.ix_(self.free, self.free)] + np.diag(belief.precision[self.free])
        amplitude = (np.log(hyper.amplitude) - np.log(PRIORS.usual)) / PRIORS.spread
        self.base = -0.5 * (belief.cost(few, self.p) + self.logdet + float(np.sum(amplitude**2)))
        self.base -= 0.5 * float(np.linalg.slogdet(self.H)[1]) if len(self.free) else 0.0

    def products(self, columns: Sequence[Column], diagonal: bool) -> tuple[Array, Array]:
        """Inner products with force and start states integrated out, summed over the windows.

        Returns:
            Of (residual, parameters) with (residual, parameters, columns) `[1 + k, 1 + k + P]`, and of the columns with
            each other `[P, P]`, or with themselves `[P]`.
        """
        part, own, logdet = self.part, self.own, 0.0
        few = np.zeros((own, own + len(columns)))
        among = np.zeros(len(columns) if diagonal else (len(columns), len(columns)))
        for w in range(len(part.r)):
            V = np.concatenate([part.D[w] @ self.root, part.B[w] * part.spread], 1) / self.noise[:, None]
            L = np.linalg.cholesky(V.T @ V + np.eye(V.shape[1]))
            start = part.r[w] + part.B[w] @ part.offsets[w]
            Y = np.stack([start, *part.A[w].T, *(c.change[w] for c in columns)], 1) / self.noise[:, None]
            T = np.linalg.solve(L, V.T @ Y)
            few += Y[:, :own].T @ Y - T[:, :own].T @ T
            Y, T = Y[:, own:], T[:, own:]
            among += np.sum(Y**2, 0) - np.sum(T**2, 0) if diagonal else Y.T @ Y - T.T @ T
            logdet += 2 * float(np.sum(np.log(np.diag(L))) + np.sum(np.log(self.noise)))
        self.logdet = logdet * part.share
        return few * part.share, among * part.share

    def projected(self) -> tuple[Array, Array]:
        """(gradients `[P]`, products `[P, P]` or `[P]`) with the parameters at their best for each amount."""
        own, few, among = self.own, self.few, self.among
        across = few[1:, own:][self.free]
        take = np.linalg.solve(self.H, across) if len(self.free) else across
        g = few[0, own:] - self.p @ few[1:, own:]
        less = np.sum(across * take, 0) if among.ndim == 1 else across.T @ take
        return g, among - less


def _level(part: Part, belief: Belief, hyper: Hyper, columns: Sequence[Column]) -> _Level:
    rest = _Rest(part, belief, hyper, columns)
    g, S = rest.projected()
    precision = np.maximum([c.precision for c in columns], 1e-12)
    return _Level(S, g, precision, np.array([c.room for c in columns]), rest.base)


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
    state, model = weighing.state, weighing.state.models[key]
    fit = state.begun(model.fit)
    others = [c for c in state.candidates if all(beside(c, e) for e in model.effects)]
    known = state.secants.columns
    columns = [Column(c, point, change) for c in others for point, change in known.get(c.label, ())]
    if not columns:
        return []
    (part, belief), hyper = _part(weighing, fit, state.secants.own), weighing.scored[key].learnt.hyper
    columns = leading(part, belief, hyper, columns)
    if key:
        labels = list(dict.fromkeys(c.candidate.label for c in columns))[: EFFORT.candidates]
        some = [c for c in others if c.label in labels]
        plans = [(some.index(c.candidate), c.point) for c in columns if c.candidate.label in labels]
        own = looked_at(fit, state.settings.screened)
        found = simulated(state.fitter, fit, some, plans, own, lambda _, done, total: say("second look", done, total))
        columns = [Column(some[i], point, change) for i, point, change in found]
        part, belief = _part(weighing, fit, own)
    promises = Promises(part, belief, hyper, columns)
    return _plans(weighing, key, promises)


def _part(weighing: Weighing, fit: Fit, own: NDArray[np.int64]) -> tuple[Part, Belief]:
    """Some windows of a fit, and the prior of its parameters."""
    fit = weighing.doubted(fit)
    arrays = fit.r[own], fit.A[own], weighing.D[own], fit.B[own], fit.offsets[own]
    part = Part(*arrays, weighing.state.fitter.spread, weighing.scale, weighing.channels, len(fit.r) / len(own))
    return part, belief_of(fit)


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
    found = {p.own: p for p in promises.of([(j,) for j in usable])}
    found |= {p.own: p for p in promises.pairs(blocked, 2 * EFFORT.batch)}
    for seed in sorted(found.values(), key=lambda p: price * len(p.own) - p.nats)[: EFFORT.sets[1]]:
        grown = seed
        while len(grown.own) < len(EFFORT.sets):
            more = [tuple(sorted((*grown.own, j))) for j in usable if not blocked[j, list(grown.own)].any()]
            top = max(promises.of(more), key=lambda p: p.nats, default=None)
            if top is None or top.nats < grown.nats + price:
                break
            grown = found[top.own] = top
    return list(found.values())
