"""Successive halving: which of many fits in lockstep go on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit


class Heats:
    """Starts far behind their candidate's best stop first, then candidates that are far behind the best candidate.

    They keep the cost they reached, and their place far down the table. What still falls fast goes on, and what was
    refused a step that would have brought much. over: whether the time is.
    """

    STARTS = {1: 4.0, 2: 2.0, 3: 1.3, 5: 1.03}  # steps made -> cost over the best start's
    CANDIDATES = {2: 8.0, 3: 5.0, 5: 3.0}  # and over the best candidate's
    FAST = 0.7  # cost after over cost before a step

    def __init__(self, over: Callable[[], bool]) -> None:
        self.over = over
        self.pace: dict[int, float] = {}  # steps made -> cost of the best candidate, of all batches
        self.least = np.inf  # cost of the best candidate in the end

    def among(self, starts: Sequence[int]) -> Callable[[int, Sequence[Fit], Sequence[int]], list[int]]:
        """Which fits of a batch go on, of candidates with so many starts each."""
        owner = np.repeat(np.arange(len(starts)), starts)

        def going(made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
            if self.over():
                return []
            cost = np.array([fit.cost for fit in fits])
            best = np.array([float(np.min(cost[owner == i])) for i in range(len(starts))])
            self.pace[made] = min(self.pace.get(made, np.inf), float(best.min()))
            limits = self.STARTS.get(made, np.inf) * best
            if made in self.CANDIDATES:
                limits[best > self.CANDIDATES[made] * self.pace[made]] = 0.0
            return [i for i in running if cost[i] <= limits[owner[i]] or self._falls(fits[i])]

        return going

    def learn(self, fits: Sequence[Fit]) -> None:
        """The pace of fits that are made, also of those that a search which goes on has from the disk."""
        for made in self.CANDIDATES:
            costs = [fit.history[min(made, len(fit.history) - 1)] for fit in fits if fit.history]
            self.pace[made] = min([self.pace.get(made, np.inf), *costs])

    def finals(self, close: NDArray[np.bool_]) -> Callable[[int, Sequence[Fit], Sequence[int]], list[int]]:
        """Which fits go on with all windows: one step tells their place in the table, those that are close go on."""

        def going(made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
            return [] if self.over() else [i for i in running if made < 1 or close[i]]

        return going

    def _falls(self, fit: Fit) -> bool:
        refused = len(fit.history) > 1 and fit.history[-1] == fit.history[-2]
        fell = len(fit.history) > 1 and fit.history[-1] < self.FAST * fit.history[-2]
        return fell or (refused and fit.promise > (1 - self.FAST) * fit.cost)
