"""What a simulator with right laws and right numbers still differs by: numbers of their own, and so in the evidence.

Positions and velocities are rows of two sensors. Each lies in time as exactly as its sensor reads, and a robot's clock
is not the simulator's: half a sub-step lies between the positions and the velocities of one semi-implicit step. Without
these lags known parameters would take such errors, and pretend to know them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.fitting.fitter import Fitter

Array = NDArray[np.float64]
# Of the period between rows: as exactly as rows and commands lie in time (.07 of a time step of half a period, by which
# delays differ between simulators: single effects in MuJoCo C at a tenth of the step).
TIMING = 0.03
FREE = 100.0  # standard deviations, as good as no bound


def columns(fitter: Fitter) -> Array:
    """`[W, n, T]`, what one prior standard deviation does to what is measured: a lag of positions, and of velocities."""
    rate, nv = fitter.rate(), fitter.simulator.nv
    channels = np.arange(rate.shape[1]) % int(fitter.used.sum())
    positions = channels < int(fitter.used[:nv].sum())
    lag = -TIMING * float(fitter.simulator.windows.dt) * rate
    every = np.stack([lag * positions, lag * ~positions], 2)
    return every[:, :, np.abs(every).max((0, 1)) > 0]


def doubted(fit: Fit, columns: Array) -> Fit:
    """The fit with these numbers behind its own, in units of their priors."""
    more = tuple(Coordinate(f"doubt{i}", (), 0.0, -FREE, FREE, 1.0, "", stated=True) for i in range(columns.shape[2]))
    values = np.concatenate([fit.values, np.zeros(len(more))])
    return replace(fit, coordinates=(*fit.coordinates, *more), values=values, A=np.concatenate([fit.A, columns], 2))
