"""What two right simulators of one robot differ by: shares of each joint's terms of force, and the time of rows.

They are numbers of every model, with narrow priors, so they are in every interval: the error of a sum is an error of
the parameter that is part of it. Half a percent of a joint's inertia is 4 % of an armature that is an eighth of it. A
quarter of a millisecond times the stiffness of a servo is a fifth of its joint's damping.
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
# Of each joint's inertial force, force by speed, and force by position: as exactly as known parameters agree between
# simulators (186 parameters of 33 development cases: 90 % intervals held 77 % without half a percent, 93 % with it).
TERMS = 0.005
# Of the period between rows: as exactly as rows and commands lie in time (.07 of a time step of half a period, by which
# delays differ between simulators: single effects in MuJoCo C at a tenth of the step).
TIMING = 0.03
FREE = 100.0  # standard deviations, as good as no bound


def columns(fitter: Fitter, D: Array) -> Array:
    """`[W, n, T]`, what one prior standard deviation of each does to the residuals; D: as in `forcing.columns`."""
    windows, nv = fitter.simulator.windows, fitter.simulator.nv
    nodes = D.shape[2] // nv
    forces = TERMS * _terms(fitter, nodes)  # [W, kinds, nv, m]
    D = D.reshape(*D.shape[:2], nv, nodes)
    each = np.einsum("wnvm,wkvm->wnkv", D, forces).reshape(*D.shape[:2], -1)
    lag = TIMING * float(windows.dt) * fitter.rate()[..., None]
    every = np.concatenate([each, lag], 2)
    return every[:, :, np.abs(every).max((0, 1)) > 0]


def doubted(fit: Fit, columns: Array) -> Fit:
    """The fit with these numbers behind its own, in units of their priors."""
    more = tuple(Coordinate(f"doubt{i}", (), 0.0, -FREE, FREE, 1.0, "", stated=True) for i in range(columns.shape[2]))
    values = np.concatenate([fit.values, np.zeros(len(more))])
    return replace(fit, coordinates=(*fit.coordinates, *more), values=values, A=np.concatenate([fit.A, columns], 2))


def _terms(fitter: Fitter, nodes: int) -> Array:
    """`[W, 3, nv, m]`, N m or N: M a, forces by speed, forces by position, along the logged motion at the nodes."""
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    data, count = mujoco.MjData(model), windows.steps
    at = (np.arange(nodes) + 0.5) * count / nodes
    out = np.zeros((len(windows), 3, model.nv, nodes))
    for w, (log, start) in enumerate(zip(windows.log, windows.start, strict=True)):
        rows = start + np.arange(count + 1)
        qpos, qvel = windows.logs[log].qpos[rows], windows.logs[log].qvel[rows]
        qacc = np.gradient(qvel, windows.dt, axis=0)
        for m, row in enumerate(np.clip(at.round().astype(int), 0, count)):
            out[w, :, :, m] = _at(model, data, qpos[row], qvel[row], qacc[row])
    return np.nan_to_num(out)


def _at(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array, qvel: Array, qacc: Array) -> Array:
    """`[3, nv]` at one state."""
    data.qpos[:], data.qvel[:] = qpos, 0.0
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    by_position = data.qfrc_bias - data.qfrc_passive
    inertial = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, inertial, np.ascontiguousarray(qacc))
    data.qvel[:] = qvel
    mujoco.mj_fwdVelocity(model, data)
    by_speed = data.qfrc_bias - data.qfrc_passive - by_position
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    drives = np.where(affine, model.actuator_biasprm[:, 2], 0.0) * data.actuator_velocity
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return np.stack([inertial, by_speed - drives @ moment, by_position])
