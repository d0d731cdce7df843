"""What adding effects promises before any of them is fitted: linear, from one simulation of each.

In the same unit as what they then close: mean squares of the windows, as a share of the gap above the noise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, eliminate, solve
from bayessim_mjx.diagnosis.gap import Gap
from bayessim_mjx.diagnosis.selection.tried import Tried

Array = NDArray[np.float64]
FURTHEST = 2.0  # times the screened start: further a secant is not trusted


def promised(tried: Tried, effects: Sequence[Candidate]) -> tuple[float, dict[str, float]]:
    """Shares of the recalibrated simulator's squared gap above the noise: of all, and of each (Shapley, 1953)."""
    q, precision, high = _linear(tried, effects)
    base = len(tried.fitter.base)

    _, pull, low, top = tried.base.fit.prior()
    even = np.ones(len(tried.base.fit.r))  # all windows count alike, as in what is realised

    def left(some: frozenset[int]) -> float:
        """Mean square with some of the effects, the known parameters refitted."""
        columns = np.array([*range(base), *(base + i for i in sorted(some))], dtype=np.int64)
        more = np.zeros(len(some))
        own = q.subset(columns)
        g, S = own.weighted(even)
        limits = np.concatenate([low, more]), np.concatenate([top, high[sorted(some)]])
        p = solve(S + np.diag(precision[columns]), g + np.concatenate([pull, more]), *limits)
        return float(own.at(p).mean()) / tried.noise

    before = left(frozenset())
    every = frozenset(range(len(effects)))

    def share(some: frozenset[int]) -> float:
        return max(Gap(before, left(some)).closed, 0.0)  # what promises harm is not added

    each, total = shapley(len(effects), share), share(every)
    return total, {e.label: share for e, share in zip(effects, each, strict=True)}


def _linear(tried: Tried, effects: Sequence[Candidate]) -> tuple[Quadratic, Array, Array]:
    """(quadratic in the known parameters' steps and the amounts of the effects, precisions, largest amounts).

    An amount of 1 is the start that the screening chose.
    """
    fitter, fit = tried.fitter, tried.base.fit
    starts = [next(s.start for s in tried.screened if s.candidate.label == e.label) for e in effects]
    pairs = list(zip(effects, starts, strict=True))
    thetas = [fitter.vector((*fit.coordinates, *e.coordinates), np.concatenate([fit.values, s])) for e, s in pairs]
    moved = fitter.whiten(fitter.simulator.run(np.stack(thetas), np.repeat(fit.offsets[None], len(thetas), 0)))
    A = np.concatenate([fit.A, np.moveaxis(fit.r[None] - moved, 0, -1)], axis=2)
    q, _ = eliminate(fit.r, A, fit.B, fit.offsets, fitter.spread)
    known = fit.belief()
    return q, np.array([*known, *(_precision(e, s) for e, s in pairs)]), np.array([_furthest(e, s) for e, s in pairs])


def _precision(effect: Candidate, start: Array) -> float:
    return float(sum(c.precision * (s - c.neutral) ** 2 for c, s in zip(effect.coordinates, start, strict=True)))


def _furthest(effect: Candidate, start: Array) -> float:
    """The amount at which a coordinate reaches its bound."""
    ends = [FURTHEST]
    for c, s, shape in zip(effect.coordinates, start, effect.shapes, strict=True):
        way = s - c.neutral
        if way and not shape:
            ends.append(((c.high if way > 0 else c.low) - c.neutral) / way)
    return max(min(ends), 0.0)


def shapley(count: int, value: Callable[[frozenset[int]], Any]) -> Array:
    """`[count, ...]`, each one's contribution to `value`, averaged over all orders of adding them."""
    every = [frozenset(some) for k in range(count + 1) for some in itertools.combinations(range(count), k)]
    known = {some: np.asarray(value(some), float) for some in every}
    out = np.zeros((count, *known[frozenset()].shape))
    for some, worth in known.items():
        orders = math.factorial(len(some)) * math.factorial(max(count - len(some) - 1, 0)) / math.factorial(count)
        for i in set(range(count)) - some:
            out[i] += orders * (known[some | {i}] - worth)
    return out
