"""A floating base moved to where the simulator's own contacts hold it: where its simulation begins.

Contacts are stiff: a base that begins a millimetre too low is thrown up, one too high falls. Within a few hundredths of
a second the simulated base lies where its contacts hold it, wherever it began. So where feet rest it begins there.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from bayessim_mjx.logs.log import Array
from bayessim_mjx.odometry import feet, imu
from bayessim_mjx.odometry.feet import Feet

SECONDS = 1.0  # of falling until a robot with locked joints rests; contacts settle in hundredths. A rule of thumb
LOCKED = 1e6  # times its own inertia, of a joint that does not move meanwhile; a rule of thumb
EVEN = 1e-4  # m, and of the depth at rest the share VARIES, by which depths differ as the load moves; rules of thumb
VARIES = 0.3


def depth(model: mujoco.MjModel, qpos: Array) -> float:
    """Return how deep the robot's lowest points stand in soft ground, m, in the posture `qpos` `[nq]`; 0: it falls."""
    locked, root, plane = copy.copy(model), feet.base_joint(model), feet.ground(model)
    v, q = int(model.jnt_dofadr[root]), int(model.jnt_qposadr[root])
    others = np.delete(np.arange(model.nv), np.arange(v, v + 6))
    locked.dof_armature[others] = LOCKED * np.maximum(model.dof_M0[others], 1e-6)
    locked.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    data = mujoco.MjData(locked)
    data.qpos[:] = qpos
    mujoco.mj_forward(locked, data)
    data.qpos[q + 2] -= _lowest(locked, data, plane)
    for _ in range(round(SECONDS / locked.opt.timestep)):
        mujoco.mj_step(locked, data)
    mujoco.mj_forward(locked, data)
    deep = [-c.dist for c in data.contact[: data.ncon] if plane in (c.geom1, c.geom2)]
    return float(np.clip(np.mean(deep), 0.0, None)) if deep else 0.0


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, plane: int) -> float:
    """Distance of the nearest geom from the ground, m."""
    near = np.zeros(6)
    far = 2 * feet.ABOVE
    return min(mujoco.mj_geomDistance(model, data, plane, g, far, near) for g in feet.touching(model, plane))


def settled(pose: Array, covariance: Array, points: Feet, deep: float) -> tuple[Array, Array]:
    """Return poses `[T, 7]` and covariances `[T, 6, 6]` (position, orientation) with resting points at their depth.

    Args:
        pose: `[T, 7]`; covariance: `[T, 6, 6]`; deep: m, of a resting point in the ground.
    """
    poses, covariances = np.array(pose), np.array(covariance)
    noise = (EVEN + VARIES * deep) ** 2
    for k in range(len(pose)):
        own = points.point[k][points.rests[k]]
        if not len(own):
            continue
        turn = imu.rotation(pose[k, 3:])
        heights = pose[k, 2] + (own @ turn.T)[:, 2]
        seen = np.zeros((len(own), 6))
        seen[:, 2], seen[:, 3:] = 1.0, np.cross(own, turn[2])  # of turns in the base's frame: up . (turn x point)
        noisy = noise * np.eye(len(own))
        wide = covariance[k]
        gain = np.linalg.solve(seen @ wide @ seen.T + noisy, seen @ wide).T
        change = gain @ (points.ground - deep - heights)
        poses[k, :3] += change[:3]
        mujoco.mju_quatIntegrate(poses[k, 3:], change[3:], 1.0)
        covariances[k] = wide - gain @ seen @ wide
    return poses, covariances
