"""Weighted least squares on sums of products: effort = scale (nominal + columns), with priors and signs.

Each joint has its own error variance, found with the fit. Below a hundredth of a joint's effort nothing is told: so
much the filters and derivatives are worth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.diagnosis.logcheck.regressor import FEWEST
from bayessim_mjx.diagnosis.statistics import times

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How a fit is made. Choices; that six rounds settle and a hundredth is the filters' error was not counted."""

    floor: float = 0.01  # of a joint's root mean square effort
    rounds: int = 6  # of a fit, in which variances, scales and places of loads settle
    least: float = 1e-9  # precision of what has no prior, in units of its own column


RULES = Rules()
Shape = Callable[[Array], Array]  # coefficients [k] of the last round (NaN: none yet) -> maps [nv, P, k]


@dataclass(frozen=True, eq=False)
class Term:
    """Something that may add to the nominal effort, or scale it.

    Attributes:
        effect, where: of the library, or a known parameter (`mass`, `armature`, `damping`).
        shape: its maps into the columns; a scale has none.
        scaled: `[nv]`, joints whose whole effort it scales (neutral 1); None: it adds (neutral 0).
        rest: `[nv, P]`, effort at these joints that it does not scale, y = rest + k (needed - rest); or None.
        sd: coefficients of the last round (NaN: none yet) -> `[k]` of the priors; inf: none.
        low, high: `[k]`, allowed coefficients; within: further limits.
        read: coefficients -> parameters of the effect.
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


def used(sums: Sums) -> NDArray[np.bool_]:
    """`[nv]`: joints whose effort is known and that moved."""
    known = np.array([s != "" for s in sums.source])
    return known & (sums.rows.sum(0) >= FEWEST) & (sums.size > 0)


def left(sums: Sums, gram: Array, model: Array) -> Array:
    """`[nv]`, sums of squares of what a model leaves."""
    rest = -model
    rest[:, sums.layout.effort] += 1.0
    return np.asarray(np.maximum(np.sum(rest * times(gram, rest), -1), 0.0))


def fit(sums: Sums, terms: Sequence[Term], without: int | None = None, start: Array | None = None) -> Fit:
    """Least squares of all terms together, on all parts but one.

    Args:
        start: variances `[nv]` to begin with; None: of the nominal model.
    """
    gram = sums.whole - (0 if without is None else sums.gram[without])
    rows = np.maximum(sums.rows.sum(0) - (0 if without is None else sums.rows[without]), 1e-9)
    on, lay = used(sums), sums.layout
    floor = (RULES.floor * np.maximum(sums.size, 1e-12)) ** 2
    spans, size = _spans(terms), sum(t.count for t in terms)
    values = np.concatenate([np.full(t.count, np.nan if t.scaled is None else 1.0) for t in terms] or [np.zeros(0)])
    nominal = np.zeros((lay.nv, lay.size))
    nominal[:, lay.known] = 1.0
    model, variance = nominal, left(sums, gram, nominal) / rows + floor if start is None else start
    covariance = np.zeros((size, size))
    neutral = np.concatenate([np.full(t.count, t.neutral) for t in terms] or [np.zeros(0)])
    for _ in range(RULES.rounds):
        design, target = _linearised(lay.effort, terms, spans, values, model, nominal)
        weight = np.where(on, 1.0 / variance, 0.0)
        rows_of = (lay.nv * lay.size, size)
        weighed = (weight[:, None, None] * design).reshape(rows_of).T
        H = weighed @ (gram @ design).reshape(rows_of)
        g = weighed @ times(gram, target).ravel()
        precision = _precision(np.diag(H), terms, spans, values)
        H, g = H + np.diag(precision), g + neutral * precision
        covariance = np.asarray(np.linalg.inv(H), np.float64)
        values = covariance @ g
        model = _model(terms, spans, values, nominal)
        variance = left(sums, gram, model) / rows + floor
    low, high = (np.concatenate([getattr(t, e) for t in terms] or [np.zeros(0)]) for e in ("low", "high"))
    feasible = bool(np.all(values >= low - 1e-9) and np.all(values <= high + 1e-9))
    feasible = feasible and all(t.within(values[own]) for t, own in zip(terms, spans, strict=True))
    sd = np.concatenate([t.sd(values[own]) for t, own in zip(terms, spans, strict=True)] or [np.zeros(0)])
    penalty = 0.5 * float(np.sum(((values - neutral) / sd) ** 2))
    return Fit(tuple(terms), values, covariance, model, variance, feasible, penalty)


def _scales(terms: Sequence[Term], spans: Sequence[slice], values: Array, nv: int) -> Array:
    """`[nv]`, by which the whole effort is multiplied."""
    out = np.ones(nv)
    for term, own in zip(terms, spans, strict=True):
        if term.scaled is not None:
            out[term.scaled] *= values[own][0]
    return out


def _model(terms: Sequence[Term], spans: Sequence[slice], values: Array, nominal: Array) -> Array:
    inner = nominal.copy()
    for term, own in zip(terms, spans, strict=True):
        if term.shape is not None:
            inner += term.shape(values[own]) @ values[own]
    scale = _scales(terms, spans, values, len(nominal))[:, None]
    return inner * scale + _rest(terms, spans, values, nominal)


def _rest(terms: Sequence[Term], spans: Sequence[slice], values: Array, nominal: Array) -> Array:
    """`[nv, P]`, what of the effort at the same joints comes beside what is scaled."""
    out = np.zeros_like(nominal)
    for term, own in zip(terms, spans, strict=True):
        if term.rest is not None:
            out += (1.0 - values[own][0]) * term.rest
    return out


def _linearised(
    effort: int, terms: Sequence[Term], spans: Sequence[slice], values: Array, model: Array, nominal: Array
) -> tuple[Array, Array]:
    """(columns `[nv, P, K]`, target `[nv, P]`) near the last round's values: scale times sum is not linear."""
    scale, rest = _scales(terms, spans, values, len(nominal)), _rest(terms, spans, values, nominal)
    design = np.zeros((*nominal.shape, len(values)))
    target = -nominal * scale[:, None] - rest
    target[:, effort] += 1.0
    for term, own in zip(terms, spans, strict=True):
        if term.shape is not None:
            design[:, :, own] = term.shape(values[own]) * scale[:, None, None]
        elif term.scaled is not None:
            # y = k m(p): y - k0 nominal + (k0 m0) = k0 M p + (k / k0) (k0 m0), of the part that this scale acts on
            design[term.scaled, :, own.start] = (model - rest)[term.scaled] / values[own][0]
            design[:, :, own.start] -= 0.0 if term.rest is None else term.rest
            target += values[own][0] * design[:, :, own.start]
    return design, target


def _precision(size: Array, terms: Sequence[Term], spans: Sequence[slice], values: Array) -> Array:
    """`[K]` of the priors; what has none gets one that only keeps the matrix regular."""
    out = RULES.least * np.where(size > 0, size, 1.0)
    for term, own in zip(terms, spans, strict=True):
        out[own] += 1.0 / term.sd(values[own]) ** 2
    return out


def contribution(sums: Sums, found: Fit, term: Term) -> Array:
    """`[nv]`, root mean square of what a term adds to the effort, as a share of it."""
    values = found.values.copy()
    values[found.at(term)] = term.neutral
    nominal = np.zeros_like(found.model)
    nominal[:, sums.layout.known] = 1.0
    away = found.model - _model(found.terms, _spans(found.terms), values, nominal)
    power = np.sum(away * times(sums.whole, away), -1) / np.maximum(sums.rows.sum(0), 1e-9)
    return np.where(used(sums), np.sqrt(np.maximum(power, 0.0)) / np.maximum(sums.size, 1e-300), 0.0)


def score(sums: Sums, terms: Sequence[Term], start: Array | None = None) -> Array:
    """`[F]`, log density of each part's effort as predicted by a fit to the others, up to a constant."""
    on, out = used(sums), np.zeros(len(sums.gram))
    for part in range(len(sums.gram)):
        own = fit(sums, terms, without=part, start=start)
        rest = left(sums, sums.gram[part], own.model)
        out[part] = -0.5 * float(
            np.sum(np.where(on, rest / own.variance + sums.rows[part] * np.log(own.variance), 0.0))
        )
        out[part] -= own.penalty / len(out)
    return out


def evidence(sums: Sums, found: Fit) -> float:
    """Log density of all efforts and priors at the fit: what ranks terms before any part is held out."""
    density = np.where(used(sums), sums.rows.sum(0) * np.log(found.variance), 0.0)
    return -0.5 * float(np.sum(density)) - found.penalty
