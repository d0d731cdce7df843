"""The gap between a simulator and the logs, above the noise; uncertainty from few operating conditions.

Whatever says in numbers or words which share of a gap is closed or left reads it here, so that no sentence contradicts
the numbers beside it.

Uncertainty: a jackknife over conditions, with Student's t. Windows of one condition err alike, as the model errs there
alike. So conditions are what is independent, however few they are; of one condition alone nothing can be said. Coverage
of the intervals: benchmarks/diagnosis/intervals.py.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.optimize import nnls
from scipy.special import ndtr, ndtri, ndtri_exp

Array = NDArray[np.float64]


Z90 = float(ndtri(0.95))  # half the width of a Gaussian's 90 % interval, in standard deviations
RULED = 0.5  # degrees of freedom where one condition rules a mean of squares; coverage as measured, see above
NOTHING = (float("nan"), float("nan"))  # the interval of one condition


# Root mean square residual, in noise standard deviations, up to which a model is at the noise. It decides words, and
# whether the gap is located; verdicts rest on `selection.numbers.FLOOR` and on the force that is left. Counted:
# docs/decisions/at_noise.md
AT_NOISE = 1.15


@dataclass(frozen=True)
class Gap:
    """Squared residuals of one set of windows, under two models and under the noise alone; all in the same unit.

        closed = (E0 - max(E1, N)) / (E0 - N),  left = max(E1 - N, 0) / (E0 - N) = 1 - closed

    Attributes:
        before, after: E0 and E1, of the worse and of the better model, sums or means of squares.
        noise: N, what a perfect model leaves; 1 where residuals are in noise standard deviations.
    """

    before: float
    after: float
    noise: float = 1.0

    def share(self, part: float) -> float:
        """Return a part of E0 as a share of the squared gap above the noise, E0 - N; NaN where nothing is above it."""
        above = self.before - self.noise
        return part / above if above > 0.0 else math.nan

    @property
    def closed(self) -> float:
        """Share of the squared gap above the noise that is closed: at most 1, below 0 where it grows, NaN of none.

        Nothing undercuts the noise: the best of many models is below its own expected error by selection.
        """
        return self.share(self.before - max(self.after, self.noise))

    @property
    def left(self) -> float:
        """Share of the squared gap above the noise that is left, at least 0; NaN of none."""
        return self.share(max(self.after - self.noise, 0.0))

    @property
    def rms(self) -> float:
        """Root mean square residual of the better model, in noise standard deviations."""
        return math.sqrt(self.after / self.noise)

    @property
    def at_noise(self) -> bool:
        """Whether what the better model leaves counts as noise alone."""
        return self.rms <= AT_NOISE


def of_rms(before: float, after: float, noise: float = 1.0) -> Gap:
    """Return the gap between two root mean square residuals, by default in noise standard deviations."""
    return Gap(before**2, after**2, noise**2)


def of_one(squared: float, noise: float = 1.0) -> Gap:
    """Return the gap that one model leaves."""
    return Gap(squared, squared, noise)


def above_noise(rms: ArrayLike, noise: ArrayLike) -> NDArray[np.float64]:
    """Root mean square errors without the noise's part; all in one unit."""
    return np.asarray(np.sqrt(np.maximum(np.square(rms) - np.square(noise), 0.0)))


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
