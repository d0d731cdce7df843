"""Fits on a subset of the windows: starts and candidates are ranked there, and the best continue on all windows.

All windows are needed to say how well a model predicts, fewer to see that it is far behind.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.journal import Remembering
from bayessim_mjx.diagnosis.selection.numbers import EFFORT

Array = NDArray[np.float64]


class WindowSubset:
    """A simulator of the windows `own` of another, for a fitter; both share one compiled program."""

    def __init__(self, simulator: Any, own: NDArray[np.int64]) -> None:
        self.simulator, self.own, self.physics = simulator, own, simulator.physics
        self.apart = getattr(simulator, "apart", False)
        all_of_it = simulator.windows  # its batch stays whole: the simulator has it
        parts = {name: getattr(all_of_it, name)[own] for name in ("log", "start", "group")}
        self.windows = replace(all_of_it, **parts)

    def run(self, thetas: Array, offsets: Array | None = None, windows: NDArray[np.int64] | None = None) -> Array:
        """As `Simulator.run`."""
        return np.asarray(self.simulator.run(thetas, offsets, self.own if windows is None else self.own[windows]))


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


def windows_of(fit: Fit) -> NDArray[np.int64] | None:
    """The windows on which extensions of a fit are ranked; None: all, as there are few."""
    return looked_at(fit, EFFORT.windows // 2) if len(fit.r) >= EFFORT.windows else None


def on(fitter: Fitter, own: NDArray[np.int64]) -> Fitter:
    """The fitter on some of its windows; it uses the same journal, but stores no columns there."""
    some: Any = WindowSubset(fitter.simulator, own)
    plain = Fitter(some, fitter.base, fitter.theta)
    journal = fitter.journal if isinstance(fitter, Remembering) else None
    return plain if journal is None else Remembering(plain, journal, bare=True)


def cut(fit: Fit, own: NDArray[np.int64]) -> Fit:
    """The start of a fit to some of the windows."""
    return replace(part(fit, own), cost=np.inf, history=(), reach=np.ones(1))


def cost(part: Fitter, fit: Fit, own: NDArray[np.int64]) -> float:
    """The cost on some windows of a fit to all windows."""
    some = cut(fit, own)
    return part.cost(some, some.r, some.offsets, some.values)


def back(fit: Fit, ranked: Fit, own: NDArray[np.int64]) -> Fit:
    """The start of a fit to all windows at the values of `ranked`, a fit to some; its first step gives residuals."""
    offsets = fit.offsets.copy()
    offsets[own] = ranked.offsets
    return replace(fit, values=ranked.values, offsets=offsets, cost=np.inf, history=(), reach=np.ones(1))


def close(costs: Array, least: float) -> NDArray[np.bool_]:
    """Which candidates go on: those whose cost is close to the least so far."""
    return np.asarray(costs <= EFFORT.close * least)
