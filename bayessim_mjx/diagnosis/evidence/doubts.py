"""What a simulator with right laws and right numbers still differs by: numbers of their own, and so in the evidence.

Positions and velocities are rows of two sensors. Each lies in time as exactly as its sensor reads, and a robot's clock
is not the simulator's: half a sub-step lies between the positions and the velocities of one semi-implicit step. Without
these lags known parameters would take such errors, and pretend to know them. A stiff servo that sees its joint late
damps it less, by the stiffness times the lag, which is as much as a joint's own damping.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
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


def columns(fitter: Fitter, D: Array) -> Array:
    """`[W, n, T]`, what one prior standard deviation of each does to the residuals; D: as in `forcing.columns`.

    A lag of measured positions, of measured velocities, and of what servos see of their joints.
    """
    rate, nv = fitter.rate(), fitter.simulator.nv
    channels = np.arange(rate.shape[1]) % int(fitter.used.sum())
    positions = channels < int(fitter.used[:nv].sum())
    lag = TIMING * float(fitter.simulator.windows.dt)
    servos = lag * np.einsum("wnf,wf->wn", D, _pulled(fitter, D.shape[2] // nv))
    every = np.stack([-lag * rate * positions, -lag * rate * ~positions, servos], 2)
    return every[:, :, np.abs(every).max((0, 1)) > 0]


def _pulled(fitter: Fitter, nodes: int) -> Array:
    """`[W, nv m]`, N m/s or N/s, by how much the force of servos on their joints changes with the logged motion."""
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    data, moment = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    stiffness = moment.T @ (np.where(affine, -model.actuator_biasprm[:, 1], 0.0)[:, None] * moment)
    rows = windows.start[:, None] + ((np.arange(nodes) + 0.5) * windows.steps / nodes).round().astype(int)
    speed = np.stack([windows.logs[log].qvel[own] for log, own in zip(windows.log, rows, strict=True)])
    return np.nan_to_num(np.moveaxis(speed @ stiffness, 1, 2).reshape(len(speed), -1))


def doubted(fit: Fit, columns: Array) -> Fit:
    """The fit with these numbers behind its own, in units of their priors."""
    more = tuple(Coordinate(f"doubt{i}", (), 0.0, -FREE, FREE, 1.0, "", stated=True) for i in range(columns.shape[2]))
    values = np.concatenate([fit.values, np.zeros(len(more))])
    return replace(fit, coordinates=(*fit.coordinates, *more), values=values, A=np.concatenate([fit.A, columns], 2))
