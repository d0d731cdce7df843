"""How actuators are commanded: torque, position or velocity, in which units, and gains to close a loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.logs.log import Array, Channels

BANDWIDTH = 12.0  # rad/s, of the loop around a torque-driven joint
KINDS = ("torque", "position", "velocity", "none")


@dataclass(frozen=True, eq=False)
class Drives:
    """How each actuator is commanded: u = unit * target, or for torque unit * (feed-forward + kp e + kd de/dt).

    Attributes:
        kind: `[nu]`, one of KINDS; joint: `[nu]` names ("" where it drives no hinge or slide).
        q, v: `[nu]`, columns in qpos and qvel; unit: `[nu]`, ctrl per joint unit; kp, kd: `[nu]`, in ctrl units.
    """

    kind: tuple[str, ...]
    joint: tuple[str, ...]
    q: NDArray[np.int64]
    v: NDArray[np.int64]
    unit: Array
    kp: Array
    kd: Array

    def joints(self) -> dict[str, int]:
        """{joint: dof} that can be moved."""
        return {n: int(v) for n, v, kind in zip(self.joint, self.v, self.kind, strict=True) if n and kind != "none"}


def drives_of(model: mujoco.MjModel, law: Any, inertia: Array, dt: float) -> Drives:
    """law: of the logs, leading axis windows, or None; inertia: `[nv]`; dt: s, control period."""
    names = Channels.of(model).joints
    own = None if law is None else jax.tree.map(lambda x: np.asarray(x[0]), law)
    rows = [_drive(model, i, own) for i in range(model.nu)]
    joints = [j for _, j, _ in rows]
    v = np.array([model.jnt_dofadr[max(j, 0)] for j in joints], np.int64)
    sharing = np.array([sum(j == other for other in joints) for j in joints], float)
    unit = np.array([u for _, _, u in rows]) / np.where([k == "torque" for k, _, _ in rows], sharing, 1.0)
    omega = min(BANDWIDTH, 0.25 / dt)
    torque = np.array([k == "torque" for k, _, _ in rows])
    speed = np.array([k == "velocity" for k, _, _ in rows])
    return Drives(
        kind=tuple(k for k, _, _ in rows),
        joint=tuple(names[j] if j >= 0 else "" for j in joints),
        q=np.array([model.jnt_qposadr[max(j, 0)] for j in joints], np.int64),
        v=v,
        unit=unit,
        kp=unit * np.where(torque, inertia[v] * omega**2, np.where(speed, 2.0, 0.0)),
        kd=unit * np.where(torque, 1.6 * omega * inertia[v], 0.0),
    )


def _drive(model: mujoco.MjModel, i: int, law: Any) -> tuple[str, int, float]:
    """(kind, joint, ctrl per joint unit) of one actuator."""
    j, gear = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0])
    gain = float(model.actuator_gainprm[i, 0])
    axial = int(model.actuator_trntype[i]) <= 1 and int(model.jnt_type[j]) >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    if not axial:
        return "none", -1, 0.0
    if law is not None and law.on_position[i] > 0:
        return "position", j, 1.0
    if law is not None and law.on_velocity[i] > 0:
        return "velocity", j, 1.0
    scale = 1.0 if law is None else float(law.scale[i])
    if int(model.actuator_gaintype[i]) != int(mujoco.mjtGain.mjGAIN_FIXED) or gain * gear * scale == 0:
        return "none", j, 0.0
    b = model.actuator_biasprm[i]
    if b[1]:
        return "position", j, float(-b[1] * gear / gain / scale)
    if b[2]:
        return "velocity", j, float(-b[2] * gear / gain / scale)
    return "torque", j, 1.0 / (gain * gear * scale)
