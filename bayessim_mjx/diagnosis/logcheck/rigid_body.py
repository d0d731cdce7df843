"""Inverse dynamics as a linear function of inertial parameters: ten columns of every moving body.

The regressor of Atkeson, An and Hollerbach (1986): a body's mass, mass times centre of mass (3) and inertia about its
frame (xx, yy, zz, xy, xz, yz), all in the body's own frame. Bodies welded together move as one.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
SHIFT = float(np.finfo(float).eps) ** (1 / 3)  # rad or m, of a central difference: rounding and curvature cost as much
INERTIAL = 1 + 3 + len(_PAIRS)  # parameters of a body: mass, first moments and inertia


def moving_bodies(model: mujoco.MjModel) -> list[int]:
    """Bodies that move on their own, one of each set that is welded together."""
    return [b for b in range(1, model.nbody) if model.body_weldid[b] == b]


def gravity(model: mujoco.MjModel) -> Array:
    """m/s^2, `[3]`; nothing where the model has it disabled."""
    off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return np.zeros(3) if off else np.array(model.opt.gravity)


@dataclass(frozen=True, eq=False)
class Frames:
    """Where the moving bodies are, and how they move, along a motion; and what the model does without its drives.

    Attributes:
        bodies: `[B]`; linear, angular: `[T, B, 3, nv]`, Jacobians of their frames' origins, in the bodies' own axes.
        spin, turning, felt: `[T, B, 3]`, angular velocity and acceleration, and acceleration less gravity of the
            origin, in the bodies' own axes.
        rotation: `[T, B, 3, 3]`, body to world; bias: `[T, nv]`, M 0 + c of the nominal model (no acceleration).
        spring, held: `[T, nv]`, generalised forces of the model's springs and of its compensation of gravity.
    """

    bodies: tuple[int, ...]
    linear: Array
    angular: Array
    spin: Array
    turning: Array
    felt: Array
    rotation: Array
    bias: Array
    spring: Array
    held: Array

    @classmethod
    def of(cls, model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array) -> Frames:
        """Along a motion `[T, nq]`, `[T, nv]`, `[T, nv]`."""
        bodies, data = moving_bodies(model), mujoco.MjData(model)
        rows, count, nv = len(qpos), len(bodies), model.nv
        jp, jr, dp, dr = (np.zeros((rows, count, 3, nv)) for _ in range(4))
        rotation, (bias, spring, held) = np.zeros((rows, count, 3, 3)), np.zeros((3, rows, nv))
        for k in range(rows):
            data.qpos[:], data.qvel[:] = qpos[k], qvel[k]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            bias[k], spring[k], held[k] = data.qfrc_bias, data.qfrc_spring, data.qfrc_gravcomp
            for i, body in enumerate(bodies):
                point = data.xpos[body]
                mujoco.mj_jac(model, data, jp[k, i], jr[k, i], point, body)
                mujoco.mj_jacDot(model, data, dp[k, i], dr[k, i], point, body)
                rotation[k, i] = data.xmat[body].reshape(3, 3)
        origin = _times(jp, qacc) + _times(dp, qvel)
        turned = _times(jr, qacc) + _times(dr, qvel)
        own = np.swapaxes(rotation, -1, -2)  # world to body
        put = lambda x: np.einsum("tbij,tbj->tbi", own, x)  # noqa: E731
        felt = put(origin - gravity(model))
        return cls(
            tuple(bodies), own @ jp, own @ jr, put(_times(jr, qvel)), put(turned), felt, rotation, bias, spring, held
        )

    def columns(self) -> Array:
        """`[T, B, nv, 10]`, the generalised force that a unit of each inertial parameter asks for."""
        return self._columns(self.felt, self.turning, self.spin)

    def weight(self, direction: Array) -> Array:
        """`[T, B, nv, 10]` of gravity alone, along a direction `[3]` of the world with its length."""
        own = np.einsum("tbji,j->tbi", self.rotation, direction)
        return self._columns(-own, np.zeros_like(own), np.zeros_like(own))

    def _columns(self, felt: Array, turning: Array, spin: Array) -> Array:
        skew = _skew(turning) + _skew(spin) @ _skew(spin)
        force = np.zeros((*felt.shape, INERTIAL))  # [T, B, 3, 10]
        moment = np.zeros_like(force)
        force[..., 0], force[..., 1:4] = felt, skew
        moment[..., 1:4] = -_skew(felt)
        moment[..., 4:] = _of_inertia(turning) + _skew(spin) @ _of_inertia(spin)
        both = np.swapaxes(self.linear, -1, -2) @ force + np.swapaxes(self.angular, -1, -2) @ moment
        return np.asarray(both)


def _times(jacobian: Array, speed: Array) -> Array:
    """`[T, B, 3, nv]` times `[T, nv]`."""
    return np.einsum("tbiv,tv->tbi", jacobian, speed)


def _skew(v: Array) -> Array:
    """`[..., 3, 3]` of the cross product with v."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def _of_inertia(w: Array) -> Array:
    """`[..., 3, 6]`: inertia times w as a function of the six moments."""
    out = np.zeros((*w.shape, 6))
    for k, (i, j) in enumerate(_PAIRS):
        out[..., i, k] = w[..., j]
        if i != j:
            out[..., j, k] = w[..., i]
    return out


def inertial(mass: float, centre: Array, about_centre: Array) -> Array:
    """`[10]` of a mass with its centre and its inertia `[3, 3]` about it, both in the body's axes."""
    moment = about_centre + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.array([mass, *(mass * centre), *(moment[i, j] for i, j in _PAIRS)])


def nominal(model: mujoco.MjModel) -> Array:
    """`[B, 10]`, inertial parameters of the moving bodies with what is welded to them."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    bodies = moving_bodies(model)
    out = np.zeros((len(bodies), INERTIAL))
    for i, body in enumerate(bodies):
        frame = data.xmat[body].reshape(3, 3)
        for part in np.flatnonzero(model.body_weldid == body):
            own = frame.T @ data.ximat[part].reshape(3, 3)
            centre = frame.T @ (data.xipos[part] - data.xpos[body])
            moment = own @ np.diag(model.body_inertia[part]) @ own.T
            out[i] += inertial(float(model.body_mass[part]), centre, moment)
    return out


@dataclass(frozen=True, eq=False)
class Rigid:
    """Generalised forces that rigid bodies need for a motion, beside what compensates their weight (`gravcomp`).

    Attributes:
        columns: `[T, nv, K]`, per unit of each (set of) inertial parameters.
        nominal: `[T, nv]`, of the model's own; weight: the part of it that is gravity; bias: without acceleration.
        tilt: `[T, nv, 2]`, per rad by which the world is turned about its x and y axis.
        spring: `[T, nv]`, that the model's own springs need.
    """

    columns: Array
    nominal: Array
    weight: Array
    bias: Array
    tilt: Array
    spring: Array


def rigid(
    model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array, sets: Array | None = None, loads: int = 0
) -> Rigid:
    """Of a motion `[T, nq]`, `[T, nv]`, `[T, nv]`.

    Args:
        sets: `[K, B, 10]`, inertial parameters of which each column is made; None: one column each, of body after body.
        loads: how many sets, the last, are loads that `gravcomp` does not carry.
    """
    own, parts = nominal(model), []
    acts = 1.0 - model.body_gravcomp[moving_bodies(model), None, None]  # share of gravity that the drives feel
    falls = [-np.cross(axis, gravity(model)) for axis in np.eye(3)[:2]]
    for rows in np.array_split(np.arange(len(qpos)), max(1, min(model.nv, len(qpos)))):  # all would fill the memory
        frames = Frames.of(model, qpos[rows], qvel[rows], qacc[rows])
        whole, down = frames.columns(), frames.weight(gravity(model))
        each = whole - (1.0 - acts) * down
        columns = np.moveaxis(each, 1, 2) if sets is None else np.einsum("tbvk,cbk->tvc", each, sets)
        if loads and sets is not None:
            columns[..., -loads:] = np.einsum("tbvk,cbk->tvc", whole, sets[-loads:])
        needed, weight = (np.einsum("tbvk,bk->tv", x, own) - frames.held for x in (whole, down))
        tilt = np.stack([np.einsum("tbvk,bk->tv", acts * frames.weight(x), own) for x in falls], -1)
        columns = columns.reshape(*needed.shape, -1)
        parts.append((columns, needed, weight, frames.bias - frames.held, tilt, -frames.spring))
    return Rigid(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def recursive(model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array) -> Array:
    """`Rigid.nominal` alone, by MuJoCo's recursive Newton-Euler."""
    data, out = mujoco.MjData(model), np.zeros_like(qvel)
    for k, row in enumerate(out):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[k], qvel[k], qacc[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 1, row)
        if model.ngravcomp:
            mujoco.mj_passive(model, data)
            row -= data.qfrc_gravcomp
    return out


def by_zeros(model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array) -> dict[int, Array]:
    """{dof: `[T, nv]`}, derivative of `Rigid.nominal` by the zero of a hinge or slide."""
    out = {}
    for joint in np.flatnonzero(model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)):
        ends = []
        for sign in (1, -1):
            there = qpos.copy()
            there[:, int(model.jnt_qposadr[joint])] += sign * SHIFT
            ends.append(recursive(model, there, qvel, qacc))
        out[int(model.jnt_dofadr[joint])] = (ends[0] - ends[1]) / (2 * SHIFT)
    return out
