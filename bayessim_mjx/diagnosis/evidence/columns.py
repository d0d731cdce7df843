"""The evidence that sets of effects promise, without a simulation: from what each does to the residual of a fit.

A candidate's column is a secant: the change of the residual from neutral to a starting point. With force and start
states integrated out (`gaussian`), the evidence of every set is algebra on one matrix of inner products, so all singles
and pairs are looked at, and larger sets grow from the best. The force's amplitude is not known before a set is fitted:
the best of a few shares of the amplitude without it counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.gaussian import PRIORS, Belief, Hyper, correlation
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.selection.screen import _room

Array = NDArray[np.float64]
SHARES = (1.0, 0.3, 0.1, 0.03)  # of the amplitude on the fit itself, that a set may leave


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
        return _room(self.candidate, self.way)

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
        self.levels = [_level(part, belief, _scaled(hyper, f), self.columns) for f in SHARES]
        self.base = max(level.base for level in self.levels)

    def singles(self) -> list[Promise]:
        return self._best([level.singles() for level in self.levels])

    def pairs(self, blocked: NDArray[np.bool_], count: int) -> list[Promise]:
        """The best pairs of columns that may be together."""
        gain = np.max([level.base + level.pairs() for level in self.levels], 0) - self.base
        gain[blocked] = -np.inf
        gain[np.tril_indices(len(gain))] = -np.inf
        best = np.argsort(-gain, axis=None)[:count]
        return self.of([divmod(int(i), len(gain)) for i in best if np.isfinite(gain.flat[i])])

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

    def singles(self) -> list[Promise]:
        return [self.of((j,)) for j in range(len(self.g))]

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


def _level(part: Part, belief: Belief, hyper: Hyper, columns: Sequence[Column]) -> _Level:
    k, nodes = part.A.shape[2], part.D.shape[2] // len(part.scale)
    root = np.kron(np.diag(hyper.amplitude * part.scale), correlation(nodes, hyper.memory))
    noise = np.tile(hyper.noise**2, part.r.shape[1] // part.channels)
    Q, logdet = np.zeros((1 + k + len(columns),) * 2), 0.0
    for w in range(len(part.r)):
        B = part.B[w] * part.spread
        V = np.concatenate([part.D[w] @ root, B], 1)
        L = np.linalg.cholesky(V @ V.T + np.diag(noise))
        start = part.r[w] + part.B[w] @ part.offsets[w]
        Y = np.concatenate([start[:, None], part.A[w], np.stack([c.change[w] for c in columns], 1)], 1)
        Z = np.linalg.solve(L, Y)
        Q += Z.T @ Z
        logdet += 2 * float(np.sum(np.log(np.diag(L))))
    Q, logdet = Q * part.share, logdet * part.share
    p = belief.best(Q[: 1 + k, : 1 + k])
    free = np.flatnonzero((p > belief.low) & (p < belief.high))
    own = 1 + np.arange(k)
    H = Q[np.ix_(own[free], own[free])] + np.diag(belief.precision[free])
    take = np.linalg.solve(H, Q[np.ix_(own[free], np.arange(1 + k, len(Q)))]) if len(free) else np.zeros((0, len(columns)))
    S = Q[1 + k :, 1 + k :] - Q[np.ix_(np.arange(1 + k, len(Q)), own[free])] @ take
    g = Q[1 + k :, 0] - Q[1 + k :, own] @ p
    base = -0.5 * belief.cost(Q[: 1 + k, : 1 + k], p) - 0.5 * logdet
    if len(free):
        base -= 0.5 * float(np.linalg.slogdet(H)[1])
    amplitude = (np.log(hyper.amplitude) - np.log(PRIORS.usual)) / PRIORS.spread
    base -= 0.5 * float(np.sum(amplitude**2))
    precision = np.maximum([c.precision for c in columns], 1e-12)
    return _Level(S, g, precision, np.array([c.room for c in columns]), base)
