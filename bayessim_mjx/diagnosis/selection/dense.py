"""All effects at once: linear in every candidate's amplitude, a sparse solution path, pruned backward.

Two effects can hide each other (a weaker motor behind less friction), so that neither shows in a fit of its own. The
screening's secant columns tell what each would do; least squares on all of them, with a price on every amplitude, finds
sets that explain together (the lasso path, Tibshirani 1996; Efron et al., 2004).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection.laws import beside
from bayessim_mjx.diagnosis.selection.screen import Screened, residual

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Prices:
    """Prices of the sparse path."""

    path: float = 0.7  # from one price to the next
    least: float = 0.001  # of the first price: the last one
    sweeps: int = 200


PRICES = Prices()


def lasso(S: Array, g: Array, low: Array, high: Array, price: Array, t: Array) -> Array:
    """argmin t'St - 2 g't + 2 sum(price |t|) with low <= t <= high, from t, by coordinate descent."""
    t = t.copy()
    for _ in range(PRICES.sweeps):
        before = t.copy()
        for j in range(len(t)):
            rest = g[j] - S[j] @ t + S[j, j] * t[j]
            t[j] = np.clip(np.sign(rest) * max(abs(rest) - price[j], 0.0) / S[j, j], low[j], high[j])
        if np.max(np.abs(t - before)) < 1e-6:
            break
    return t


def path(S: Array, g: Array, low: Array, high: Array, most: int) -> list[int]:
    """Columns in the order in which they enter as their price falls, up to `most`."""
    scale = np.sqrt(np.diag(S))
    reach = np.abs(g) / scale
    order: list[int] = []
    price, t = float(reach.max(initial=0.0)), np.zeros(len(g))
    end = PRICES.least * price
    while price > end and len(order) < most:
        price *= PRICES.path
        t = lasso(S, g, low, high, price * scale, t)
        new = [j for j in np.argsort(-np.abs(t) * scale) if t[j] and j not in order]
        order += [int(j) for j in new]
    return order[:most]


def gain(S: Array, g: Array, low: Array, high: Array, own: Sequence[int]) -> tuple[float, Array]:
    """(predicted drop of the cost, amounts) of some columns, least squares within bounds."""
    i = np.asarray(own)
    t = lasso(S[np.ix_(i, i)], g[i], low[i], high[i], np.zeros(len(i)), np.zeros(len(i)))
    return float(2 * g[i] @ t - t @ S[np.ix_(i, i)] @ t), t


def best_sets(
    S: Array, g: Array, low: Array, high: Array, blocked: NDArray[np.bool_], most: int, count: int
) -> list[tuple[tuple[int, ...], Array]]:
    """Sets of two to `most` columns that promise most, `count` of each size, with their amounts.

    Args:
        blocked: `[C, C]`, columns that cannot be together.

    All pairs are tried; larger sets are grown from the best ones, and from the sparse path, pruned backward.
    """
    found: dict[tuple[int, ...], float] = {}

    def tried(own: tuple[int, ...]) -> None:
        if own not in found and not any(blocked[a, b] for a, b in itertools.combinations(own, 2)):
            found[own] = gain(S, g, low, high, own)[0]

    some = np.argsort(-_pairs(S, g), axis=None)
    for at in some[: 6 * count * 8]:
        a, b = sorted(divmod(int(at), len(g)))
        if a != b:
            tried((a, b))
    support = tuple(sorted(path(S, g, low, high, 3 * most)))
    for size in range(2, most + 1):
        if size <= 3:
            for own in itertools.combinations(support, size):
                tried(own)
        leading = sorted((s for s in found if len(s) == size - 1), key=lambda s: -found[s])[:count]
        for own in leading:
            for j in range(len(g)):
                if j not in own:
                    tried(tuple(sorted((*own, j))))
    out = []
    for size in range(2, most + 1):
        best = sorted((s for s in found if len(s) == size), key=lambda s: -found[s])[:count]
        out += [(s, gain(S, g, low, high, s)[1]) for s in best if found[s] > 0]
    return out


def _pairs(S: Array, g: Array) -> Array:
    """Drop of the cost `[C, C]` by all pairs of columns without bounds; -inf where a pair is one column twice."""
    d = np.diag(S)
    determinant = d[:, None] * d[None, :] - S**2
    top = d[None, :] * g[:, None] ** 2 + d[:, None] * g[None, :] ** 2 - 2 * S * np.outer(g, g)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(determinant > 1e-6 * np.outer(d, d), top / determinant, -np.inf)


def supports(fit: Fit, screened: Sequence[Screened], limit: int, most: int, count: int) -> list[list[Screened]]:
    """Sets of candidates that promise most on top of a fit, each with the values to start a fit from.

    Args:
        screened: on top of `fit`, on at most `limit` windows.
        most: candidates in a set; count: sets of each size.
    """
    left = residual(fit, limit)
    usable = [s for s in screened if s.absorbed < 1.0 and s.column.shape == left.shape and s.way.any()]
    if len(usable) < 2 or most < 2:
        return []
    columns = np.stack([s.column.ravel() for s in usable])
    S, g = columns @ columns.T, columns @ left.ravel()
    low, high = np.array([s.room for s in usable]).T
    blocked = np.array([[_clash(a, b) for b in usable] for a in usable]) & ~np.eye(len(usable), dtype=bool)
    sets = best_sets(S, g, low, high, blocked, most, count)
    return [[usable[j].at(float(t)) for j, t in zip(own, amounts, strict=True)] for own, amounts in sets]


def _clash(a: Screened, b: Screened) -> bool:
    """Whether two candidates cannot be in one model."""
    return not beside(a.candidate, b.candidate)
