"""Secant screening: how much would each candidate gain, from one simulation per starting point, base refitted linearly.

Tangents at neutral mislead where laws have kinks (dry friction, play): the columns are secants to finite values.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, Progress
from bayessim_mjx.diagnosis.statistics import times

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Screened:
    """One candidate's best starting point on top of a fitted model.

    Attributes:
        candidate; start: `[k]`, values to start a fit from.
        gain: predicted drop of the cost; absorbed: share of the effect that refitting the model hides.
        whole: drop of the cost at the starting point itself, as it was simulated.
        column: `[W, n]`, the projected change of the residual per unit of the way to the start (for isolability).
        others: further starting points `[m, k]`, in other places of its range.
    """

    candidate: Candidate
    start: Array
    gain: float
    absorbed: float
    column: Array
    others: tuple[Array, ...] = ()
    whole: float = 0.0


def looked_at(fit: Fit, limit: int) -> NDArray[np.int64]:
    """At most `limit` windows: half with the largest residuals (a limit acts in few), the others spread evenly."""
    count = len(fit.r)
    if count <= limit:
        return np.arange(count)
    worst = np.argsort(-np.sum(fit.r**2, 1), kind="stable")[: limit // 2]
    others = np.setdiff1d(np.arange(count), worst)
    spread = others[np.linspace(0, len(others) - 1, limit - len(worst)).round().astype(int)]
    return np.sort(np.concatenate([worst, spread]))


def part(fit: Fit, own: NDArray[np.int64]) -> Fit:
    """Return the fit on some of its windows."""
    return replace(fit, offsets=fit.offsets[own], r=fit.r[own], A=fit.A[own], B=fit.B[own], weight=fit.weight[own])


class Projection:
    """The fit's own parameters and start states, projected out of columns and residuals."""

    def __init__(self, fit: Fit) -> None:
        precision, pull, low, high = fit.prior()
        q, starts = fit.quadratic()
        g, S = q.weighted(fit.weight)
        slope = g + pull
        pinned = ((low >= -1e-12) & (slope < 0)) | ((high <= 1e-12) & (slope > 0))
        self.free = np.flatnonzero(~pinned)
        self.fit, self.starts, self.root = fit, starts, np.sqrt(fit.weight)[:, None]
        H = (S + np.diag(precision))[np.ix_(self.free, self.free)]
        self.inverse = np.linalg.pinv(H) if len(self.free) else H
        self.slope = slope[self.free]
        self.A = fit.A[:, :, self.free]
        self.Bt, self.BA = starts.B.mT, starts.B.mT @ self.A
        # columns by the parameters as one matrix, weighted, and less what the start states take
        rows = self.A.shape[0] * self.A.shape[1]  # there may be no parameter that is free
        self.away = (self.A - starts.B @ (starts.M @ self.BA)).reshape(rows, len(self.free))
        self.weighted = np.repeat(fit.weight, self.A.shape[1])[:, None] * self.away

    def moments(self, a: Array) -> tuple[float, float, float, Array]:
        """(s, g, full norm, projected column) of a column `[W, n]`."""
        w, starts = self.fit.weight, self.starts
        Ba = times(self.Bt, a)
        MBa = times(starts.M, Ba)
        s_aa = float(w @ (np.sum(a * a, 1) - np.sum(Ba * MBa, 1)))
        g_a = float(w @ (np.sum(a * self.fit.r, 1) - np.sum(MBa * starts.b, 1)))
        s_ab = self.weighted.T @ a.ravel()
        along = self.inverse @ s_ab
        projected = a - times(starts.B, MBa) - (self.away @ along).reshape(a.shape)
        return s_aa - float(s_ab @ along), g_a - float(s_ab @ (self.inverse @ self.slope)), s_aa, projected * self.root

    def taken(self, a: Array, share: float) -> Array | None:
        """Return steps `[k]` of the fit's numbers that do the work of a column `[W, n]`; None where they do less."""
        s, _, s_aa, _ = self.moments(a)
        if s_aa <= 0 or s_aa - s <= share * s_aa:
            return None
        steps = np.zeros(self.fit.A.shape[2])
        steps[self.free] = self.inverse @ (self.weighted.T @ a.ravel())
        return steps


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
        return np.where(self.candidate.shapes, 0.0, self.point - self._ends()[2])

    @property
    def room(self) -> tuple[float, float]:
        """Least and greatest multiple of the way within the ranges."""
        low, high, neutral = self._ends()
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([low - neutral, high - neutral]) / self.way
        ends[:, self.way == 0] = [[-np.inf], [np.inf]]
        return float(np.max(np.min(ends, 0))), float(np.min(np.max(ends, 0)))

    @property
    def precision(self) -> float:
        """Of the multiple of the way, by the priors of the candidate's numbers."""
        return float(sum(c.precision * w**2 for c, w in zip(self.candidate.coordinates, self.way, strict=True)))

    def at(self, amount: float) -> Array:
        """Move a point so many ways from neutral, within the ranges and off neutral, where many laws have no slope."""
        low, high, neutral = self._ends()
        amount = amount if abs(amount) > 0.02 else 0.02
        return np.clip(np.where(self.candidate.shapes, self.point, neutral + amount * self.way), low, high)

    def _ends(self) -> Array:
        """`[3, k]`: low, high, neutral of the candidate's numbers."""
        return np.array([[c.low, c.high, c.neutral] for c in self.candidate.coordinates]).T


Plan = tuple[Candidate, Array]  # and a starting point


@dataclass(eq=False)
class Secants:
    """What each candidate's starting points do to some windows, as it was simulated on one fit.

    On another fit they are projected anew, without a simulation: rough where effects change what others do, so the
    evidence simulates the best there. Of 26 recorded cases with one effect it led the screening in 22, and was among
    the first three in all; each of two effects was among the first eight.

    Attributes:
        own: `[w]` the windows; columns: {candidate's label: those of its points}.
    """

    own: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, int))
    columns: dict[str, list[Column]] = field(default_factory=dict)

    def add(self, columns: Iterable[Column]) -> None:
        """Keep some more columns."""
        for column in columns:
            self.columns.setdefault(column.candidate.label, []).append(column)

    def points(self, column: Column) -> list[Array]:
        """Return where to simulate a candidate again: where it was, or also elsewhere if that was its middle alone."""
        c = column.candidate
        return [column.point] if len(self.columns[c.label]) > 1 else _spread(list(c.probes))[: EFFORT.points]

    def of(self, candidates: Iterable[Candidate]) -> list[Column]:
        """Return the columns of some candidates, in ranges as wide as they are by now."""
        return [replace(own, candidate=c) for c in candidates for own in self.columns.get(c.label, ())]


def screen(
    fitter: Fitter,
    fit: Fit,
    candidates: Sequence[Candidate],
    limit: int = EFFORT.windows,
    say: Progress = lambda text, done, total: None,
    secants: Secants | None = None,
    over: Callable[[], bool] | None = None,
) -> list[Screened]:
    """Rank all candidates on top of `fit`, best first, on at most `limit` windows.

    Each is simulated at the middle one of its starting points. At the `Effort.batch` places where these gain most, all
    candidates are simulated at all of them: something missing shows at its place in more than one law. Gains are
    scaled to all windows as if those looked at were typical: good for ranking, too high as an estimate.

    Args:
        secants: what was simulated before; if empty, it is filled.
        over: whether the time is; None: there is no limit. What was not simulated by then is not among them.
    """
    secants = Secants() if secants is None else secants
    if not secants.columns:
        secants.own = looked_at(fit, limit)
        turns = list(itertools.zip_longest(*(_spread([(c, point) for point in c.probes]) for c in candidates)))
        first = [plan for plan in turns[0] if plan] if turns else []
        secants.add(simulated(fitter, fit, first, secants.own, say, over))
        middle = [s for ((s, _),) in judged(fit, secants.of(candidates), secants.own).values()]
        deep = list(dict.fromkeys(s.candidate.where for s in sorted(middle, key=lambda s: -s.gain)))[: EFFORT.batch]
        more = [plan for turn in turns[1:] for plan in turn if plan and plan[0].where in deep]
        secants.add(simulated(fitter, fit, more, secants.own, say, over, len(first)))
    found = judged(fit, secants.of(candidates), secants.own)
    return sorted(map(_with_others, found.values()), key=lambda s: -s.gain)


def _spread(plans: Sequence[Any]) -> list[Any]:
    """Order: the middle one first, then those halfway between, and so on: any number of them lies apart."""
    bits = len(plans).bit_length()

    def place(i: int) -> int:
        return int(f"{(i - len(plans) // 2) % len(plans):0{bits}b}"[::-1], 2)

    return [plans[i] for i in sorted(range(len(plans)), key=place)]


def simulated(
    fitter: Fitter,
    fit: Fit,
    plans: Sequence[Plan],
    own: NDArray[np.int64],
    say: Progress,
    over: Callable[[], bool] | None = None,
    done: int = 0,
) -> Iterator[Column]:
    """Return the changes by candidates at starting points of the residual of some windows `own`.

    Args:
        done: points that were simulated before, for what is said.
    """
    some = part(fit, own)
    at_once = max(EFFORT.batch * fitter.simulator.lanes // len(own), 1)  # whole calls of the compiled program
    for first in range(0, len(plans), at_once):
        if done + first and over is not None and over():
            return
        say("more starting points" if done else "screening", first, len(plans))
        now = plans[first : first + at_once]
        thetas = [
            fitter.vector((*fit.coordinates, *c.coordinates), np.concatenate([fit.values, point])) for c, point in now
        ]
        shifted = fitter.simulator.run(np.stack(thetas), np.repeat(some.offsets[None], len(thetas), 0), own)
        changes = some.r[None] - fitter.whiten(shifted)
        yield from (Column(*plan, change) for plan, change in zip(now, changes, strict=True))


def judged(fit: Fit, columns: Iterable[Column], own: NDArray[np.int64]) -> dict[str, list[tuple[Screened, Array]]]:
    """{candidate's label: [(what its starting point gains, the point)]}; on another fit without a simulation."""
    project, share = Projection(part(fit, own)), len(fit.r) / max(len(own), 1)
    each: dict[str, list[tuple[Screened, Array]]] = {}
    for column in columns:
        one = _one(project, column)
        each.setdefault(column.candidate.label, []).append((replace(one, gain=one.gain * share), column.point))
    return each


def _with_others(found: list[tuple[Screened, Array]]) -> Screened:
    """Return the best start, with the best that differs in what it moves or in its shape, and the best at other levels.

    The point that leaves least as it was simulated comes too: a secant says little of laws that act beyond a threshold.
    """
    found = sorted(found, key=lambda f: -f[0].gain)
    first, point = found[0]
    neutral = np.array([c.neutral for c in first.candidate.coordinates])
    shapes = np.array(first.candidate.shapes)

    def sort_of(p: Array) -> tuple:
        return tuple(np.sign(p - neutral)[~shapes]) + tuple(p[shapes])

    useful = [(s, p) for s, p in found[1:] if s.gain > 0]
    others = [s.start for s, p in useful if sort_of(p) != sort_of(point)][:1]
    levels = [p for _, p in useful if sort_of(p) == sort_of(point)][:2]
    least, seen = max(found, key=lambda f: f[0].whole)
    whole = [seen] if least.whole > 0 and not any(np.array_equal(seen, p) for p in (point, *levels)) else []
    return replace(first, others=(point, *others, *levels, *whole))


def _one(project: Projection, column: Column) -> Screened:
    s, g, norm, projected = project.moments(column.change)
    if norm < 1e-9 or s <= 1e-9 * norm:
        return Screened(column.candidate, column.point, 0.0, 1.0, projected)
    t = float(np.clip(g / s, *column.room))
    gain = max(2 * t * g - t * t * s, 0.0)
    return Screened(column.candidate, column.at(t), gain, 1.0 - s / norm, projected, whole=2 * g - s)
