"""What a posterior says of each parameter, for tables, titles, curves, rankings and JSON: one place computes it.

A posterior keeps a small share of the prior, so that no training excludes the truth. That share is no finding: .01 % of
a prior that is 50 times as wide as the posterior would be half of the standard deviation. It is reported beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayessim_mjx.quantities import percent, spread

PRIOR_ITSELF = 0.5  # share of the prior from which on a posterior counts as the prior: most of its draws are
TAIL = 0.15865525393145707  # of a Gaussian beyond one standard deviation: between both tails lie 68 %


@dataclass(frozen=True, eq=False)
class Estimates:
    """Numbers of each parameter in theta units, without the share of the prior that is kept.

    Attributes:
        median, low, high: `[d]`; low to high is the central 68 % interval.
        mean, sd: `[d]`.
        correlation: `[d, d]`; 0 where a parameter does not vary.
        width: `[d]` sd over the prior's sd: 1 nothing was learnt, 0 known exactly.
        prior_share: of the prior, kept in the posterior; 1 where the posterior is the prior.
    """

    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    correlation: np.ndarray
    width: np.ndarray
    prior_share: float = 0.0

    @property
    def contraction(self) -> np.ndarray:
        """[d]: 1 - posterior variance / prior variance."""
        return 1.0 - self.width**2

    def apart(self, other: Estimates) -> float:
        """Find the largest distance of medians, of ends of intervals, in the prior's sd, and of the prior's shares."""
        unit = self.sd / self.width
        ends = [np.abs(getattr(self, end) - getattr(other, end)) / unit for end in ("low", "median", "high")]
        return float(max(np.max(ends, initial=0.0), abs(self.prior_share - other.prior_share)))

    def sentence(self) -> str:
        """State in words how much of the prior is kept; "" where nothing is."""
        if self.prior_share >= PRIOR_ITSELF:
            return f"these are numbers of the prior: {percent(self.prior_share)} of the posterior is the prior"
        kept = f"training also draws {percent(self.prior_share)} of its physics from the prior: it excludes no truth"
        return kept if self.prior_share > 0 else ""

    def lines(self, names: Sequence[str], units: Sequence[str]) -> str:
        """Write `mass  1.04 ± 0.06 kg  posterior/prior sd 0.1` for each parameter."""
        rows = zip(self.median, self.low, self.high, self.sd, units, strict=True)
        found = [f"{spread(*row[:4])} {row[4]}".rstrip() for row in rows]
        wide, long = max(map(len, names), default=0), max(map(len, found), default=0)
        each = zip(names, found, self.width, strict=True)
        return "\n".join(f"{n:<{wide}}  {text:<{long}}  posterior/prior sd {w:.2g}" for n, text, w in each)

    def pick(self, index: Sequence[int] | np.ndarray) -> Estimates:
        """Those of some parameters, in the order of `index`."""
        i = np.asarray(index, int)
        both = self.correlation[np.ix_(i, i)]
        numbers = self.median[i], self.low[i], self.high[i], self.mean[i], self.sd[i]
        return Estimates(*numbers, both, self.width[i], self.prior_share)


def estimates(
    values: np.ndarray, prior_sd: np.ndarray, weights: np.ndarray | None = None, prior_share: float = 0.0
) -> Estimates:
    """Of weighted points [n, d] of a posterior.

    Args:
        values: in theta units.
        prior_sd: `[d]` of the prior.
        weights: `[n]`; None: all alike.
        prior_share: kept in the posterior, and left out of the points.
    """
    x = np.asarray(values, np.float64)
    w = np.full(len(x), 1.0 / len(x)) if weights is None else np.asarray(weights, np.float64)
    w = w / w.sum()
    mean = w @ x
    gap = x - mean
    covariance = (gap * w[:, None]).T @ gap
    sd = np.sqrt(np.diagonal(covariance))
    unit = np.where(sd > 0, sd, np.inf)
    correlation = covariance / np.outer(unit, unit)
    np.fill_diagonal(correlation, 1.0)
    low, median, high = np.stack([_quantiles(column, w) for column in x.T], 1) if x.shape[1] else np.zeros((3, 0))
    return Estimates(median, low, high, mean, sd, correlation, sd / np.asarray(prior_sd, float), float(prior_share))


def _quantiles(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Lower end of the 68 % interval, median and upper end of weighted points [n]; each point's mass lies about it."""
    order = np.argsort(x, kind="stable")
    mass = np.cumsum(weights[order]) - 0.5 * weights[order]
    return np.interp([TAIL, 0.5, 1 - TAIL], mass, x[order])


__all__ = ["PRIOR_ITSELF", "Estimates", "estimates"]
