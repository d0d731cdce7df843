"""Weighted least squares on sums of products: effort = scale (nominal + columns), with priors and signs.

Each joint has its own error variance, found with the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.equation_error.sums import Layout, Sums
from bayessim_mjx.diagnosis.logcheck.drives import FLOOR
from bayessim_mjx.diagnosis.selection.numbers import EFFORT
from bayessim_mjx.diagnosis.statistics import times

Array = NDArray[np.float64]


# Precision of what has no prior, in units of its own column: products of columns have half the digits of a float64.
LEAST = float(np.finfo(float).eps) ** 0.5
Shape = Callable[[Array], Array]  # coefficients [k] of the last round -> maps [nv, P, k]


@dataclass(frozen=True, eq=False)
class Term:
    """Something that may add to the nominal effort, or scale it.

    Attributes:
        effect, where: of the library, or a known parameter (`mass`, `armature`, `damping`).
        shape: its maps into the columns; a scale has none. bent: coefficients -> the sum of its columns `[nv, P]`, of
            which the maps are the derivative; None: the maps times the coefficients.
        scaled: `[nv]`, joints whose whole effort it scales (neutral 1); None: it adds (neutral 0).
        rest: `[nv, P]`, effort at these joints that it does not scale, y = rest + k (needed - rest); or None.
        sd: coefficients of the last round -> `[k]` of the priors; inf: none.
        low, high: `[k]`, allowed coefficients; within: further limits.
        read: coefficients -> parameters of the effect.
        modelled: {parameter: the model's own number that it multiplies}.
    """

    effect: str
    where: str
    shape: Shape | None
    count: int = 1
    scaled: NDArray[np.bool_] | None = None
    sd: Callable[[Array], Array] = lambda c: np.full(len(c), np.inf)
    low: Array = field(default_factory=lambda: np.array([-np.inf]))
    high: Array = field(default_factory=lambda: np.array([np.inf]))
    within: Callable[[Array], bool] = lambda c: True
    read: Callable[[Array], Mapping[str, float]] = lambda c: {}
    rest: Array | None = None
    bent: Shape | None = None
    modelled: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        return f"{self.effect}@{self.where}"

    @property
    def neutral(self) -> float:
        return 0.0 if self.scaled is None else 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
        values, covariance: `[K]`, `[K, K]`, of all terms' coefficients, in order.
        model: `[nv, P]`, the effort as a map of the columns; variance: `[nv]`, of what is left, floor included.
        feasible: whether all coefficients are where they may be.
    """

    terms: tuple[Term, ...]
    values: Array
    covariance: Array
    model: Array
    variance: Array
    feasible: bool
    penalty: float

    def at(self, term: Term) -> slice:
        """Where a term's coefficients stand."""
        return _spans(self.terms)[self.terms.index(term)]

    def of(self, term: Term) -> Array:
        """Its coefficients."""
        return self.values[self.at(term)]

    def deviation(self, term: Term) -> Array:
        """Their standard deviations."""
        return np.sqrt(np.diag(self.covariance))[self.at(term)]


def _spans(terms: Sequence[Term]) -> list[slice]:
    ends = np.cumsum([0, *(t.count for t in terms)])
    return [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]


def left(sums: Sums, model: Array) -> Array:
    """`[nv]`, mean squares of what a model leaves."""
    rest = -model
    rest[:, sums.layout.at("effort")] += 1.0
    return np.maximum(np.sum(rest * times(sums.gram, rest), -1), 0.0) / np.maximum(sums.rows, 1e-9)


def fit(sums: Sums, terms: Sequence[Term]) -> Fit:
    """Least squares of all terms together, by Gauss-Newton steps: a scale times a sum is not linear."""
    on, spans, size = sums.used, _spans(terms), sum(t.count for t in terms)
    floor = (FLOOR * np.maximum(sums.size, 1e-12)) ** 2
    neutral, low, high = (
        np.concatenate([np.broadcast_to(getattr(t, e), t.count) for t in terms] or [np.zeros(0)])
        for e in ("neutral", "low", "high")
    )
    values, covariance = neutral, np.zeros((size, size))
    model, design = _effort(sums.layout, terms, spans, values)
    for _ in range(EFFORT.rounds):
        rest = design @ values - model
        rest[:, sums.layout.at("effort")] += 1.0
        weight = np.where(on, 1.0 / (left(sums, model) + floor), 0.0)
        rows_of = (model.size, size)
        weighed = (weight[:, None, None] * design).reshape(rows_of).T
        H = weighed @ (sums.gram @ design).reshape(rows_of)
        known = np.concatenate([1.0 / t.sd(values[own]) ** 2 for t, own in zip(terms, spans, strict=True)] or [neutral])
        precision = known + LEAST * np.where(np.diag(H) > 0, np.diag(H), 1.0)
        covariance = np.asarray(np.linalg.inv(H + np.diag(precision)), np.float64)
        values = covariance @ (weighed @ times(sums.gram, rest).ravel() + neutral * precision)
        model, design = _effort(sums.layout, terms, spans, values)
    feasible = bool(np.all(values >= low - LEAST) and np.all(values <= high + LEAST))
    feasible = feasible and all(t.within(values[own]) for t, own in zip(terms, spans, strict=True))
    sd = np.concatenate([t.sd(values[own]) for t, own in zip(terms, spans, strict=True)] or [neutral])
    penalty = 0.5 * float(np.sum(((values - neutral) / sd) ** 2))
    return Fit(tuple(terms), values, covariance, model, left(sums, model) + floor, feasible, penalty)


def _effort(layout: Layout, terms: Sequence[Term], spans: Sequence[slice], values: Array) -> tuple[Array, Array]:
    """(effort `[nv, P]` as a map of the columns, its derivative `[nv, P, K]` by the coefficients)."""
    inner, scale, rest = np.zeros((3, layout.nv, layout.size))
    inner[:, layout.at("known")], scale[:] = 1.0, 1.0
    design = np.zeros((*inner.shape, len(values)))
    for term, own in zip(terms, spans, strict=True):
        if term.shape is not None:
            design[:, :, own] = term.shape(values[own])
            inner += design[:, :, own] @ values[own] if term.bent is None else term.bent(values[own])
        elif term.scaled is not None:
            scale[term.scaled] *= values[own][0]
            rest += 0.0 if term.rest is None else (1.0 - values[own][0]) * term.rest
    design *= scale[:, :, None]
    for term, own in zip(terms, spans, strict=True):
        if term.scaled is not None:
            design[term.scaled, :, own.start] = (inner * scale)[term.scaled] / values[own][0]
            design[:, :, own.start] -= 0.0 if term.rest is None else term.rest
    return inner * scale + rest, design


def contribution(sums: Sums, found: Fit, term: Term) -> Array:
    """`[nv]`, root mean square of what a term adds to the effort, as a share of it."""
    values = found.values.copy()
    values[found.at(term)] = term.neutral
    away = found.model - _effort(sums.layout, found.terms, _spans(found.terms), values)[0]
    power = np.sum(away * times(sums.gram, away), -1) / np.maximum(sums.rows, 1e-9)
    return np.where(sums.used, np.sqrt(np.maximum(power, 0.0)) / np.maximum(sums.size, 1e-300), 0.0)


def evidence(sums: Sums, found: Fit) -> float:
    """Log density of all efforts and priors at the fit, up to a constant."""
    return -0.5 * float(np.sum(np.where(sums.used, sums.rows * np.log(found.variance), 0.0))) - found.penalty
