"""Fits on some of the windows, to choose starts and candidates by; what is chosen goes on with all windows.

All windows are needed to say how well a model predicts, fewer to see that it is far behind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.journal import Remembering
from bayessim_mjx.diagnosis.selection.screen import looked_at

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """How many windows candidates are ranked on, and who goes on with all of them.

    Rules of thumb: on one case they cost half the simulations (131 360 windows in place of 239 872) and name the same
    (46e2ef7); error rates were not counted.

    Attributes:
        windows: ranked on; least: windows from which on some of them are enough.
        close: times the best candidate's cost on these windows; others make one step on all windows, for the table.
    """

    windows: int = 24
    least: int = 48
    close: float = 4.0


SIZES = Sizes()


class Some:
    """Some windows of a simulator, for a fitter: the same program, the windows in the order of `own`."""

    def __init__(self, simulator: Any, own: NDArray[np.int64]) -> None:
        self.simulator, self.own, self.physics = simulator, own, simulator.physics
        self.apart = getattr(simulator, "apart", False)
        all_of_it = simulator.windows  # its batch stays whole: the simulator has it
        parts = {name: getattr(all_of_it, name)[own] for name in ("log", "start", "group")}
        self.windows = replace(all_of_it, **parts)

    def run(self, thetas: Array, offsets: Array | None = None, windows: NDArray[np.int64] | None = None) -> Array:
        """As of the simulator."""
        return np.asarray(self.simulator.run(thetas, offsets, self.own if windows is None else self.own[windows]))


def windows_of(fit: Fit) -> NDArray[np.int64] | None:
    """The windows that candidates on top of a fit are ranked on; None: there are too few to choose from."""
    return looked_at(fit, SIZES.windows) if len(fit.r) >= SIZES.least else None


def on(fitter: Fitter, own: NDArray[np.int64]) -> Fitter:
    """The fitter on some of its windows; in the same journal, without the columns that nobody asks for."""
    some: Any = Some(fitter.simulator, own)
    part = Fitter(some, fitter.base, fitter.theta)
    journal = fitter.journal if isinstance(fitter, Remembering) else None
    return part if journal is None else Remembering(part, journal, bare=True)


def cut(fit: Fit, own: NDArray[np.int64]) -> Fit:
    """A fit on some of its windows, to be fitted there."""
    parts = {name: getattr(fit, name)[own] for name in ("offsets", "r", "A", "B", "weight")}
    return replace(fit, **parts, cost=np.inf, history=(), reach=np.ones(1))


def cost(part: Fitter, fit: Fit, own: NDArray[np.int64]) -> float:
    """Of a fit on all windows, on some of them."""
    some = cut(fit, own)
    return part.cost(some, some.r, some.offsets, some.values)


def back(fit: Fit, ranked: Fit, own: NDArray[np.int64]) -> Fit:
    """The fit with what was found on some of its windows; residuals and columns come with its first step."""
    offsets = fit.offsets.copy()
    offsets[own] = ranked.offsets
    return replace(fit, values=ranked.values, offsets=offsets, cost=np.inf, history=(), reach=np.ones(1))


def close(costs: Array, least: float) -> NDArray[np.bool_]:
    """Which candidates go on, by their costs and that of the best one so far."""
    return np.asarray(costs <= SIZES.close * least)
