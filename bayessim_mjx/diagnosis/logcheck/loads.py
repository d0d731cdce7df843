"""What a robot can carry, and how far out: the scale of an unknown payload's mass and of its centre of mass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.logcheck.drives import dof_of, is_effort

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """How far out a robot may carry something. Rules of thumb, not counted."""

    # reach of a load: of the body's own size, of the robot's length
    beside: float = 1.2
    out: float = 0.3
    lever: float = 1e-06  # m: a shorter one carries nothing


LIMITS = Limits()


def carried(model: mujoco.MjModel, places: Array) -> Array:
    """kg that the drives hold at each body `[nbody]`, at rest in all of some places, at most what the robot weighs.

    At every joint m g lever <= force limit + own gravity torque, which the load may balance. Joints without a drive
    hold nothing and rule nothing out; nor do drives without a limit.

    Args:
        places: `[T, nq]`, positions that were logged.
    """
    limit = force_limits(model)
    out = np.array([weight(model, b) for b in range(model.nbody)])
    if not np.isfinite(limit).any():
        return out
    data, jacobian = mujoco.MjData(model), np.zeros((3, model.nv))
    for qpos in places:
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        room = limit + np.abs(data.qfrc_bias)
        for body in np.flatnonzero(model.body_weldid):
            mujoco.mj_jacBodyCom(model, data, jacobian, None, int(body))
            torque = np.abs(model.opt.gravity @ jacobian)  # N m per kg
            ruled = np.isfinite(room) & (torque > LIMITS.lever * 9.81)
            out[body] = np.min(room[ruled] / torque[ruled], initial=out[body])
    return out


def force_limits(model: mujoco.MjModel) -> Array:
    """Largest generalised force of the drives `[nv]`, N m or N; infinite where no limit is set or nothing drives."""
    limit = np.zeros(model.nv)
    for i in range(model.nu):
        dof = dof_of(model, i)
        if dof is not None:
            limit[dof] += abs(float(model.actuator_gear[i, 0])) * _largest(model, i)
    limit[limit == 0] = np.inf
    for j in np.flatnonzero(model.jnt_actfrclimited):
        v = int(model.jnt_dofadr[j])
        limit[v] = min(limit[v], float(np.abs(model.jnt_actfrcrange[j]).max()))
    return limit


def _largest(model: mujoco.MjModel, actuator: int) -> float:
    """Largest force of one actuator by its force range, or by its command's where the command is a force."""
    ends = []
    if model.actuator_forcelimited[actuator]:
        ends.append(float(np.abs(model.actuator_forcerange[actuator]).max()))
    if is_effort(model, actuator) and model.actuator_ctrllimited[actuator]:
        largest = float(np.abs(model.actuator_ctrlrange[actuator]).max())
        ends.append(largest * abs(float(model.actuator_gainprm[actuator, 0])))
    return min(ends, default=np.inf)


def weight(model: mujoco.MjModel, body: int) -> float:
    """kg of all that moves in the body's tree."""
    own = (model.body_rootid == model.body_rootid[body]) & (model.body_weldid != 0)
    return float(model.body_mass[own].sum())


def reach(model: mujoco.MjModel, body: int) -> float:
    """m from the body's centre of mass to that of what it may carry: beyond the body itself, a tool's length."""
    return max(LIMITS.beside * size(model, body), LIMITS.out * _length(model, body))


def at_the_ends(model: mujoco.MjModel) -> Iterator[tuple[int, Array, float]]:
    """(body, place `[3]` m in its frame, kg that may be there), at and around the last links' centres of mass."""
    jointed = np.flatnonzero(model.body_jntnum)
    above = {int(model.body_weldid[model.body_parentid[b]]) for b in jointed}
    for body in (int(b) for b in jointed if int(b) not in above):
        for side in np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]):
            yield body, model.body_ipos[body] + reach(model, body) * side, weight(model, body)


def _length(model: mujoco.MjModel, body: int) -> float:
    """m, the longest chain of the body's tree, stretched out."""
    length = np.zeros(model.nbody)
    for b in range(1, model.nbody):
        above = int(model.body_parentid[b])
        length[b] = length[above] + (np.linalg.norm(model.body_pos[b]) if above else 0.0)
    own = np.flatnonzero(model.body_rootid == model.body_rootid[body])
    return max((float(length[b]) + size(model, int(b)) for b in own if b), default=0.0)


def size(model: mujoco.MjModel, body: int) -> float:
    """m from the body's centre of mass to the farthest end of its geoms, or where a body joins."""
    centre = model.body_ipos[body]
    own = np.flatnonzero((model.geom_bodyid == body) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)))
    ends = [np.linalg.norm(model.geom_pos[g] - centre) + model.geom_rbound[g] for g in own]
    joined = np.flatnonzero(model.body_parentid == body)
    ends += [np.linalg.norm(model.body_pos[b] - centre) for b in joined if b != body]
    return max([float(r) for r in ends], default=0.0) or 0.1
