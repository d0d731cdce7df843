"""The clock of the logs: what is late behind what, by how much and how surely.

Each lateness has one estimator, since each is another quantity:

- velocities behind the derivatives of their positions: `logs.velocities`, lags over all measured rows;
- motion behind the effort: `effort`, where the bounded inverse dynamics of a log explain most;
- measured efforts behind their commands: `links`, where the command explains most of the effort;
- commands behind (or before) their rows: `fitting.command_shift`, by simulation, beside all that forces can explain;
- jitter of the stamps themselves: `logs.stamps`;
- what no estimator is sure of, up to a part of a row: nuisance numbers of every fit, `evidence.doubts`, and in the
  inverse dynamics the term "lateness" of `equation_error.terms`.

`residual.frequency.delay` is no clock but the delay that the recalibrated model lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.logs.log import Array

LAGS = np.linspace(-0.5, 0.5, 201)  # s, odd: none is among them
# Standard errors from which on a lateness is believed. Rule of thumb: the errors are those of white residuals, and of
# logs with nothing hidden 90 % of the latenesses lie within four of them (benchmarks/records/log_checks.json).
SURE = 4.0


@dataclass(frozen=True)
class Late:
    """A lateness: seconds (negative: early), and its standard error in s (NaN: not known)."""

    seconds: float
    error: float = float("nan")

    @property
    def sure(self) -> float:
        """s; 0 where it lies within SURE standard errors of 0."""
        return 0.0 if abs(self.seconds) < SURE * self.error else self.seconds

    def beyond(self, row: float) -> float:
        """s; 0 where it may be within a row [s] of a held command, which acts half a row after its stamp on average."""
        return self.seconds if abs(self.seconds - row / 2) - row > SURE * self.error else 0.0


@dataclass(frozen=True)
class Timing:
    """When what the logs say happened.

    Attributes:
        velocities: {velocity channel: behind the derivative of its position}.
        motion: {joint: behind its effort, the measured one where there is one}; held commands alone make half a row.
        moved: s by which the logs' commands were moved since.
    """

    velocities: Mapping[str, Late] = field(default_factory=dict)
    motion: Mapping[str, Late] = field(default_factory=dict)
    moved: float = 0.0


def nearest(lags: Array, explained: Array, allowed: NDArray[np.bool_], count: float) -> Late:
    """Return the smallest lag that is about as good as the best of those allowed.

    Args:
        lags: `[L]` s, even; explained: `[L]`, share of the variance; allowed: `[L]`.
        count: independent rows n. Of residuals with the variance s(lag) the likelihood is s^(-n/2), whose curvature at
            the vertex of a parabola s = s0 + c (lag - lag0)^2 gives the error sqrt(s0 / (n c)).
    """
    best, now = float(explained[allowed].max()), float(np.interp(0.0, lags, explained))
    good = np.flatnonzero(allowed & (explained >= best - min(0.002, 0.1 * (best - now))))
    k = int(good[np.argmin(np.abs(lags[good]))])
    first, last = np.flatnonzero(allowed)[[0, -1]]
    while first < k < last and max(explained[k - 1], explained[k + 1]) > explained[k]:
        k += 1 if explained[k + 1] > explained[k - 1] else -1  # to the top of its hill
    if k in (0, len(lags) - 1) or max(explained[k - 1], explained[k + 1]) > explained[k]:
        return Late(float(lags[k]))  # no top lies among the lags
    left, top, right = explained[k - 1 : k + 2]  # the vertex of the parabola through them
    bend, step = max(2 * top - left - right, 1e-12), float(lags[1] - lags[0])
    error = step * float(np.sqrt(max(1.0 - top, 0.0) / (0.5 * bend * max(count, 1.0))))
    return Late(float(lags[k] + 0.5 * step * (right - left) / bend), error)
