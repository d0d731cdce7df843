"""Secant screening: how much would each candidate gain, from one simulation per starting point, base refitted linearly.

Tangents at neutral mislead where laws have kinks (dry friction, play): the columns are secants to finite values.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.budget import Progress
from bayessim_mjx.diagnosis.selection.numbers import EFFORT
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
    """The fit on some of its windows."""
    return replace(fit, offsets=fit.offsets[own], r=fit.r[own], A=fit.A[own], B=fit.B[own], weight=fit.weight[own])


class Projection:
    """The fit's own parameters and start states, projected out of columns and residuals."""

    def __init__(self, fitter: Fitter, fit: Fit) -> None:
        precision, pull, low, high = fit.prior()
        q, starts = fit.quadratic(fitter.spread)
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
        """Steps `[k]` of the fit's numbers that do the work of a column `[W, n]`; None where they do less of it."""
        w = self.fit.weight
        MBa = times(self.starts.M, times(self.Bt, a))
        s_ab = self.weighted.T @ a.ravel()
        along = self.inverse @ s_ab
        s_aa = float(w @ (np.sum(a * a, 1) - np.sum(times(self.Bt, a) * MBa, 1)))
        if s_aa <= 0 or float(s_ab @ along) <= share * s_aa:
            return None
        steps = np.zeros(self.fit.A.shape[2])
        steps[self.free] = along
        return steps


def room(candidate: Candidate, way: Array) -> tuple[float, float]:
    neutral = np.array([c.neutral for c in candidate.coordinates])
    low, high = (np.array([getattr(c, e) for c in candidate.coordinates]) for e in ("low", "high"))
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(way > 0, (high - neutral) / way, np.where(way < 0, (low - neutral) / way, np.inf))
        behind = np.where(way > 0, (neutral - low) / way, np.where(way < 0, (neutral - high) / way, np.inf))
    return -float(np.min(behind)), float(np.min(ahead))


Plan = tuple[int, Array]  # candidate, starting point


@dataclass(eq=False)
class Secants:
    """What each candidate's starting points do to some windows, as it was simulated on one fit.

    On another fit they are projected anew, without a simulation: rough where effects change what others do, so the
    evidence simulates the best there. Of 26 recorded cases with one effect it led the screening in 22, and was among
    the first three in all; each of two effects was among the first eight.

    Attributes:
        own: `[w]` the windows; columns: {candidate's label: [(point `[k]`, change of the residual `[w, n]`)]}.
    """

    own: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, int))
    columns: dict[str, list[tuple[Array, Array]]] = field(default_factory=dict)


def screen(
    fitter: Fitter,
    fit: Fit,
    candidates: Sequence[Candidate],
    limit: int = EFFORT.windows,
    say: Progress = lambda text, done, total: None,
    secants: Secants | None = None,
    over: Callable[[], bool] | None = None,
) -> list[Screened]:
    """All candidates on top of `fit`, best first, on at most `limit` windows.

    Gains are scaled to all windows as if those looked at were typical: good for ranking, too high as an estimate.

    Args:
        secants: what was simulated before; if empty, it is filled.
        over: whether the time is; None: there is no limit. What was not simulated by then is not among them.
    """
    secants = Secants() if secants is None else secants
    if not secants.columns:
        _fill(secants, fitter, fit, candidates, limit, say, over)
    return _ordered(projected(fitter, fit, candidates, secants))


def _fill(
    secants: Secants,
    fitter: Fitter,
    fit: Fit,
    candidates: Sequence[Candidate],
    windows: int,
    say: Progress,
    over: Callable[[], bool] | None,
) -> None:
    secants.own = looked_at(fit, windows)
    plans = [(i, point) for i, candidate in enumerate(candidates) for point in candidate.probes]
    if over is not None:
        plans = [plan for turn in itertools.zip_longest(*map(_spread, _each(plans))) for plan in turn if plan]
    for i, point, column in simulated(fitter, fit, candidates, plans, secants.own, say, over):
        secants.columns.setdefault(candidates[i].label, []).append((point, column))


def _each(plans: Sequence[Plan]) -> list[list[Plan]]:
    """Those of each candidate."""
    return [list(own) for _, own in itertools.groupby(plans, lambda plan: plan[0])]


def _spread(plans: Sequence[Plan]) -> list[Plan]:
    """The middle one first, then those halfway between, and so on: however many are simulated, they lie apart."""
    bits = len(plans).bit_length()

    def place(i: int) -> int:
        return int(f"{(i - len(plans) // 2) % len(plans):0{bits}b}"[::-1], 2)

    return [plans[i] for i in sorted(range(len(plans)), key=place)]


def projected(
    fitter: Fitter, fit: Fit, candidates: Sequence[Candidate], secants: Secants
) -> dict[int, list[tuple[Screened, Array]]]:
    known = ((i, *pair) for i, c in enumerate(candidates) for pair in secants.columns.get(c.label, ()))
    return judged(fitter, fit, candidates, known, secants.own)


def simulated(
    fitter: Fitter,
    fit: Fit,
    candidates: Sequence[Candidate],
    plans: Sequence[Plan],
    own: NDArray[np.int64],
    say: Progress,
    over: Callable[[], bool] | None = None,
) -> Iterator[tuple[int, Array, Array]]:
    """(candidate, starting point, what it changes of the residual `[w, n]`) for plans of (candidate, point)."""
    some = part(fit, own)
    at_once = max(EFFORT.batch * fitter.simulator.lanes // len(own), 1)  # whole calls of the compiled program
    for first in range(0, len(plans), at_once):
        if first and over is not None and over():
            return
        say("screening", first, len(plans))
        now = plans[first : first + at_once]
        thetas = [
            fitter.vector((*fit.coordinates, *candidates[i].coordinates), np.concatenate([fit.values, point]))
            for i, point in now
        ]
        shifted = fitter.simulator.run(np.stack(thetas), np.repeat(some.offsets[None], len(thetas), 0), own)
        columns = some.r[None] - fitter.whiten(shifted)
        yield from ((i, point, column) for (i, point), column in zip(now, columns, strict=True))


def judged(
    fitter: Fitter,
    fit: Fit,
    candidates: Sequence[Candidate],
    columns: Iterable[tuple[int, Array, Array]],
    own: NDArray[np.int64],
) -> dict[int, list[tuple[Screened, Array]]]:
    """{candidate: [(what its starting point gains, the point)]} for (candidate, point, column)."""
    project, share = Projection(fitter, part(fit, own)), len(fit.r) / max(len(own), 1)
    each: dict[int, list[tuple[Screened, Array]]] = {}
    for i, point, column in columns:
        one = _one(project, candidates[i], point, column)
        each.setdefault(i, []).append((replace(one, gain=one.gain * share), point))
    return each


def _ordered(each: dict[int, list[tuple[Screened, Array]]]) -> list[Screened]:
    return sorted((_with_others(found) for found in each.values()), key=lambda s: -s.gain)


def _with_others(found: list[tuple[Screened, Array]]) -> Screened:
    """The best start, with the best that differs in what it moves or in its shape, and the best at other levels.

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


def _one(project: Projection, candidate: Candidate, point: Array, column: Array) -> Screened:
    s, g, norm, projected = project.moments(column)
    neutral = np.array([c.neutral for c in candidate.coordinates])
    low, high = (np.array([getattr(c, e) for c in candidate.coordinates]) for e in ("low", "high"))
    if norm < 1e-9 or s <= 1e-9 * norm:
        return Screened(candidate, point, 0.0, 1.0, projected)
    way = np.where(candidate.shapes, 0.0, point - neutral)
    t = float(np.clip(g / s, *room(candidate, way)))
    gain = 2 * t * g - t * t * s
    start = np.where(candidate.shapes, point, neutral + (t if abs(t) > 0.02 else 0.02) * (point - neutral))
    return Screened(candidate, np.clip(start, low, high), max(gain, 0.0), 1.0 - s / norm, projected, whole=2 * g - s)
