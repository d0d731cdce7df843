"""Points of a floating robot that may touch level ground: where they are from the base, and which of them rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.odometry.imu import Sensor

ABOVE = 100.0  # m, base height at which nearest points are looked for: no robot is as tall; a rule of thumb
# Rules of thumb, not counted: the height in m above the lowest point up to which a point rests, without a sensor of
# contact; of such a sensor the share of its large values from which it is on; and of gravity the specific force below
# which the robot falls freely.
NEAR, ON, FALLS = 0.01, 0.1, 0.3
LARGE = 95.0  # percentile of a contact sensor's values that counts as large; a rule of thumb


@dataclass(frozen=True, eq=False)
class Feet:
    """K points of geoms that may touch the ground, in each of T rows.

    Attributes:
        names: of the geoms.
        point: `[T, K, 3]` m, in the base's frame, the lowest one of each geom.
        spread: `[T, K, 3, 3]` m^2, its covariance by the noise of the encoders.
        rolled: `[T, K, 3]` m, in the base's frame, how far the point moved over the geom since the row before.
        rests: `[T, K]`, whether it touches the ground.
        ground: m, its height.
    """

    names: tuple[str, ...]
    point: Array
    spread: Array
    rolled: Array
    rests: NDArray[np.bool_]
    ground: float


def base_joint(model: mujoco.MjModel) -> int:
    """Return the only free joint; -1: there is none, or there are several."""
    free = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
    return int(free[0]) if len(free) == 1 else -1


def lost_base(log: Log, model: mujoco.MjModel) -> str:
    """Return the name of the free joint whose position was not measured; "" if there is none."""
    joint = base_joint(model)
    if joint < 0:
        return ""
    name = log.joints[joint]
    return name if set(log.lost) & {f"qpos:{n}" for n in log.channels.of_joint(name)} else ""


def ground(model: mujoco.MjModel) -> int:
    """Return the plane that the robot can stand on.

    Raises:
        UserError: the model has no plane, several, or a tilted one.
    """
    planes = [g for g in range(model.ngeom) if model.geom_type[g] == int(mujoco.mjtGeom.mjGEOM_PLANE)]
    planes = [g for g in planes if model.body_weldid[model.geom_bodyid[g]] == 0 and touching(model, g)]
    if len(planes) != 1:
        raise UserError(
            f"the model has {len(planes) or 'no'} planes that the floating robot can touch; allowed: one level plane, "
            "or logs with the base's pose (qpos of the free joint)"
        )
    data = _placed(model)
    up = data.geom_xmat[planes[0]].reshape(3, 3)[:, 2]
    gravity = np.asarray(model.opt.gravity, float)
    if up @ -gravity < (1 - 1e-6) * np.linalg.norm(gravity):
        name = model.geom(planes[0]).name or f"geom{planes[0]}"
        raise UserError(f"plane {name!r} is not level; allowed: level ground, or logs with the base's pose")
    return planes[0]


def _placed(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def touching(model: mujoco.MjModel, plane: int) -> list[int]:
    """Geoms of moving bodies that may touch it."""
    kind, kin = model.geom_contype, model.geom_conaffinity
    pairs = {(int(a), int(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] != 0]
    both = [bool((kind[g] & kin[plane]) | (kin[g] & kind[plane])) for g in moving]
    named = [(g, plane) in pairs or (plane, g) in pairs for g in moving]
    return [g for g, one, two in zip(moving, both, named, strict=True) if one or two]


def measured(
    model: mujoco.MjModel, log: Log, attitude: Array, force: Array, sensors: Sequence[Sensor], height: Array | None
) -> Feet:
    """Return the points along a log.

    Args:
        attitude: `[T, 4]`, quaternions of the base, as far as they are known; its heading plays no part.
        force: `[T, 3]` m/s^2, specific force at the base.
        sensors: of the log, for those of contact.
        height: `[T]` m, of the base, as far as it is known; None: the lowest point rests, unless the robot falls.
    """
    plane = ground(model)
    geoms = touching(model, plane)
    level = float(_placed(model).geom_xpos[plane][2])
    point, spread, rolled = _kinematics(model, log, attitude, geoms, plane)
    up = np.stack([_up(q) for q in attitude])
    heights = np.einsum("tki,ti->tk", point, up)
    lowest = heights.min(axis=1) if height is None else level - height
    falls = np.linalg.norm(force, axis=1) < FALLS * np.linalg.norm(model.opt.gravity)
    rests = (heights < lowest[:, None] + NEAR) & ~falls[:, None]
    for sensor in (s for s in sensors if s.kind == "touch"):
        own = [i for i, g in enumerate(geoms) if model.body_weldid[model.geom_bodyid[g]] == sensor.body]
        values = np.nan_to_num(sensor.values(log)[:, 0])
        rests[:, own] = (values > ON * np.percentile(values, LARGE))[:, None] & (
            heights[:, own] < heights.min(1)[:, None] + 3 * NEAR
        )
    names = tuple(model.geom(g).name or f"geom{g}" for g in geoms)
    return Feet(names, point, spread, rolled, rests, level)


def _up(quat: Array) -> Array:
    """Return the direction against gravity `[3]`, in the base's frame."""
    out = np.empty(3)
    mujoco.mju_rotVecQuat(out, np.array([0.0, 0.0, 1.0]), quat * np.array([1.0, -1.0, -1.0, -1.0]))
    return out


def _kinematics(
    model: mujoco.MjModel, log: Log, attitude: Array, geoms: Sequence[int], plane: int
) -> tuple[Array, Array, Array]:
    """(points `[T, K, 3]`, covariances `[T, K, 3, 3]`, ways over the geoms `[T, K, 3]`), see `Feet`."""
    data, root = mujoco.MjData(model), base_joint(model)
    q, v = int(model.jnt_qposadr[root]), int(model.jnt_dofadr[root])
    body = int(model.jnt_bodyid[root])
    noise = np.delete(log.sigma_dofs, np.arange(v, v + 6)) ** 2
    count = len(log), len(geoms)
    point, rolled, spread = np.zeros((*count, 3)), np.zeros((*count, 3)), np.zeros((*count, 3, 3))
    last = np.zeros((len(geoms), 3))
    jacobian, near = np.zeros((3, model.nv)), np.zeros(6)
    for k in range(len(log)):
        data.qpos[:] = log.qpos[k]
        data.qpos[q : q + 3], data.qpos[q + 3 : q + 7] = (0.0, 0.0, ABOVE), attitude[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        turn = data.xmat[body].reshape(3, 3)
        for i, geom in enumerate(geoms):
            mujoco.mj_geomDistance(model, data, plane, geom, 2 * ABOVE, near)
            here = near[3:]
            own = data.geom_xmat[geom].reshape(3, 3)
            place = own.T @ (here - data.geom_xpos[geom])
            mujoco.mj_jac(model, data, jacobian, None, here, int(model.geom_bodyid[geom]))
            by = turn.T @ np.delete(jacobian, np.arange(v, v + 6), axis=1)
            point[k, i], spread[k, i] = turn.T @ (here - data.xpos[body]), (by * noise) @ by.T
            rolled[k, i] = turn.T @ own @ (place - last[i]) if k else 0.0
            last[i] = place
    return point, spread, rolled
