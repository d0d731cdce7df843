"""The forces that a motion takes, joint by joint: by inertia, by speed, by position; and what common errors of them do.

The missing force of one window is independent of that of another. A law that is not quite right is wrong in all of them
alike, and parameters take it. It has the size of the missing force, and here the shape of each of these terms.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fitter

Array = NDArray[np.float64]


def covariance(fitter: Fitter, D: Array, size: Array, step: Callable[[Array], Array], r: Array) -> Array:
    """`[k, k]`, of numbers that take a force which is the same in all windows.

    Args:
        D: as in `forcing.columns`; size: `[nv]`, rms of the missing force, N m or N.
        step: most probable step of the numbers of residuals `[W, n]`; r: those of the fit.
    """
    here, nv = step(r), len(size)
    if not size.any():
        return np.zeros((len(here), len(here)))
    nodes, out = D.shape[2] // nv, []
    forces = of_motion(fitter, nodes)
    rms = np.sqrt(np.mean(forces**2, axis=(0, 3), keepdims=True))
    forces = forces / np.where(rms > 0, rms, np.inf) * size[:, None]
    for kind in range(forces.shape[1]):
        for joint in np.flatnonzero(size):
            own = D[:, :, joint * nodes : (joint + 1) * nodes] @ forces[:, kind, joint, :, None]
            out.append(step(r + own[..., 0]) - here)
    moves = np.array(out)
    return np.asarray(moves.T @ moves)


def of_motion(fitter: Fitter, nodes: int) -> Array:
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
    return np.stack([inertial, by_speed - drives @ moments(model, data), by_position])


def moments(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """`[nu, nv]`, the force on joints of one unit of each actuator's force."""
    out = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(out, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return out
