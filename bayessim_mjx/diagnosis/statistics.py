"""Uncertainty from few operating conditions: a jackknife over conditions, with Student's t.

Windows of one condition err alike, as the model errs there alike. So conditions are what is independent, however few
they are; of one condition alone nothing can be said. Coverage of the intervals: benchmarks/diagnosis/intervals.py.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import nnls
from scipy.special import ndtr, ndtri, ndtri_exp

Array = NDArray[np.float64]


Z90 = float(ndtri(0.95))  # half the width of a Gaussian's 90 % interval, in standard deviations
RULED = 0.5  # degrees of freedom where one condition rules a mean of squares; coverage as measured, see above
NOTHING = (float("nan"), float("nan"))  # the interval of one condition


def leave_one_out(group: NDArray[np.int64]) -> Array:
    """`[G, W]`, 1 for the windows of all conditions but one; `[0, W]` of a single condition."""
    names = np.unique(group)
    return (group != names[:, None]).astype(np.float64)[: len(names) if len(names) > 1 else 0]


def freedom(weight: Array, least: float = 1.0) -> Array:
    """Degrees of freedom of weights `[G, ...]` of conditions -> `[...]`, at least `least`.

    One less than the conditions that count: as many equal ones as have the same spread of weights (Carter, Schnepel and
    Steigerwald, 2017).
    """
    count = weight.sum(0) ** 2 / np.maximum((weight**2).sum(0), 1e-300)
    return np.asarray(np.maximum(count - 1.0, least))


def covariance(replicates: Array) -> Array:
    """`[k, k]` of estimates from replicates `[G, k]`, each without one condition (Tukey, 1958)."""
    g = len(replicates)
    moves = replicates - replicates.mean(0)
    return np.asarray((g - 1) / g * moves.T @ moves)


def error(replicates: Array) -> Array:
    """Return standard errors `[...]` from replicates `[G, ...]`, each without one condition."""
    g = len(replicates)
    return np.asarray(np.sqrt((g - 1) / g * np.sum((replicates - replicates.mean(0)) ** 2, axis=0)))


def quantile(freedom: Array | float) -> Array:
    """Student's t that 90 % intervals reach to on either side."""
    return np.asarray(stats.t.ppf(0.95, freedom))


def interval(value: float, replicates: Array) -> tuple[float, float]:
    """90 % interval of an estimate from replicates `[G]`, each without one condition."""
    if len(replicates) < 2:
        return NOTHING
    half = float(quantile(len(replicates) - 1.0) * error(replicates))
    return value - half, value + half


def mixture_quantiles(weight: Array, mean: Array, sd: Array, ends: Sequence[float]) -> Array:
    """Return `[ends, k]`, of mixtures of Gaussians, by bisection of their distribution functions.

    Args:
        weight: `[m]`, adding up to 1; mean, sd: `[m, k]`; ends: probabilities below.
    """
    low = np.tile(np.min(mean - 10 * sd, 0), (len(ends), 1))
    high = np.tile(np.max(mean + 10 * sd, 0), (len(ends), 1))
    for _ in range(60):
        middle = (low + high) / 2
        below = np.einsum("m,mek->ek", weight, ndtr((middle - mean[:, None]) / sd[:, None]))
        under = below < np.asarray(ends)[:, None]
        low, high = np.where(under, middle, low), np.where(under, high, middle)
    return np.asarray((low + high) / 2)


def interval_of_rms(cost: Array, group: NDArray[np.int64]) -> tuple[float, float]:
    """90 % interval of the root mean of positive costs `[W]`; on a log scale, since few large errors rule a mean."""
    rows = leave_one_out(group)
    if len(rows) < 2:
        return NOTHING
    own = np.sum(cost) - rows @ cost
    replicates = np.log(np.maximum(rows @ cost, 1e-300) / rows.sum(1))
    half = float(quantile(freedom(own, RULED)) * error(replicates))
    centre = np.log(max(float(np.mean(cost)), 1e-300))
    # squares of numbers beyond 1e100 are of no use to anybody
    low, high = np.exp(np.clip([0.5 * (centre - half), 0.5 * (centre + half)], -230.0, 230.0))
    return float(low), float(high)


def interval_of_shares(each: Array, group: NDArray[np.int64]) -> list[tuple[float, float]]:
    """90 % intervals of the shares of k parts `[W, k]` in their sum; parts that are negative in sum count as 0."""

    def shares(total: Array) -> Array:
        kept = np.maximum(total, 0.0)
        return np.asarray(kept / np.maximum(kept.sum(-1, keepdims=True), 1e-300))

    ends = [interval(v, r) for v, r in zip(shares(each.sum(0)), shares(leave_one_out(group) @ each).T, strict=True)]
    return [(float(np.clip(low, 0.0, 1.0)), float(np.clip(high, 0.0, 1.0))) for low, high in ends]


def normal_deviate(x: Array, group: NDArray[np.int64]) -> float:
    """How far the mean of x `[W]` lies from 0: the normal deviate of as small a probability as that of its t.

    So a threshold has one error rate for any number of conditions. 0 where there is one condition only.
    """
    rows = leave_one_out(group)
    if len(rows) < 2:
        return 0.0
    t = float(np.mean(x)) / (float(error(rows @ x / rows.sum(1))) + 1e-12)
    beyond = float(stats.t.logsf(abs(t), freedom(len(x) - rows.sum(1))))
    return float(np.copysign(-ndtri_exp(min(beyond, np.log(0.5))), t))


def variance_parts(squares: Array, kinds: Array, rounds: int = 4) -> tuple[Array, Array]:
    """How much of each kind of variance is in Gaussian squares, by least squares reweighted so many times.

    Args:
        squares: `[n]`; kinds: `[n, k]`, by how much each kind adds to each.

    Returns:
        (`[k]` parts, none negative; `[n]` variances, no less than a thousandth of their mean).
    """
    mean = np.mean(squares)
    level = np.full(len(squares), mean + 1e-300)
    for _ in range(rounds):
        parts, _ = nnls(kinds / level[:, None], squares / level)
        level = kinds @ parts + 1e-3 * mean + 1e-300
    return np.asarray(parts), level


def times(M: Array, v: Array) -> Array:
    """Matrices `[..., i, j]` times vectors `[..., j]`; as a product of matrices, several times as fast as einsum."""
    return np.asarray((M @ v[..., None])[..., 0])


def root(covariance: Array) -> Array:
    """`[k, k]`, R with R R^T = covariance, also where it is singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


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
