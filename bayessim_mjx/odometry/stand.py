"""Inertial measurement units of a robot whose base does not float: how the stand leans and shakes."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.odometry import feet, imu
from bayessim_mjx.odometry.feet import Feet
from bayessim_mjx.odometry.smoother import Noise

HOLDS = 1e-4  # m and rad, of a weld to the world: below every sensor's noise; a rule of thumb
WELD = int(mujoco.mjtEq.mjEQ_WELD)


@dataclass(frozen=True, eq=False)
class Stand:
    """What the units of one log say of a fixed base.

    Attributes:
        sensors: their names, of those on the fixed base; others: of those on moving bodies.
        unplaced: why columns belong to no sensor of the model; "": they do.
        lean: rad, angle between the model's vertical and the accelerometer's mean; NaN: there is none.
        sd_lean: rad, by the bias that is usual of accelerometers (`Noise.accel_bias`).
        shake: rad/s, root mean square of the gyroscope beside its mean and its noise; NaN: there is none.
    """

    sensors: tuple[str, ...]
    others: tuple[str, ...]
    lean: float
    sd_lean: float
    shake: float
    unplaced: str = ""


def measure(log: Log, model: mujoco.MjModel) -> Stand | None:
    """Return what the log's units say of a fixed base, and which are on other bodies; None: it has none."""
    if not any((found := imu.column(name)) is not None and found[0] != "touch" for name in log.streams):
        return None
    try:
        every = [s for s in imu.sensors(log, model) if s.kind != "touch"]
    except UserError as error:
        return Stand((), (), np.nan, np.nan, np.nan, str(error))
    fixed = [s for s in every if s.body == 0]
    others = tuple(s.label for s in every if s.body != 0)
    lean, sd, shake = np.nan, np.nan, np.nan
    for sensor in fixed:
        mean = np.nanmean(sensor.values(log), axis=0) @ sensor.turn.T
        if sensor.kind == "accel":
            up = -np.asarray(model.opt.gravity, float)
            lean = float(np.arctan2(np.linalg.norm(np.cross(mean, up)), mean @ up))
            sd = Noise.accel_bias / max(float(np.linalg.norm(up)), 1e-9)
        if sensor.kind == "gyro":
            spread, noise = np.nanvar(sensor.values(log), axis=0), sensor.noise(log) ** 2
            shake = float(np.sqrt(max(np.sum(spread - noise), 0.0)))
    return Stand(tuple(s.label for s in fixed), others, lean, sd, shake)


def welded(model: mujoco.MjModel, body: int) -> Array | None:
    """Return the pose `[7]` in which a weld to the world holds a body; None: no weld does."""
    for i in np.flatnonzero((model.eq_type == WELD) & (model.eq_active0 > 0)):
        pair = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_BODY) and sorted(pair) == [0, body]:
            data = model.eq_data[i]
            place, turn = np.array(data[3:6]), np.array(data[6:10])
            if pair[0] == body:  # of the world from the body
                mujoco.mju_negPose(place, turn, data[3:6].copy(), data[6:10].copy())
            return np.concatenate([place, turn])
    return None


# A floating base moved to where the simulator's own contacts hold it: where its simulation begins


SECONDS = 1.0  # of falling until a robot with locked joints rests; contacts settle in hundredths. A rule of thumb
LOCKED = 1e6  # times its own inertia, of a joint that does not move meanwhile; a rule of thumb
# By which depths differ as the load moves: m, and share of the depth at rest. Rules of thumb.
EVEN, VARIES = 1e-4, 0.3


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
