"""Joints that equality constraints bind to measured ones (closed loops, coupled joints): geometry tells their way."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]
# rad or m, rad/s or m/s, of finite differences in doubles: the cube root of their precision balances the rounding of
# central ones with their third order. No state is known better
NUDGE = float(np.finfo(float).eps ** (1 / 3))


@dataclass(frozen=True, eq=False)
class Way:
    """A motion, as far as measurements tell it.

    Attributes:
        qpos: `[T, nq]`; qvel: `[T, nv]`; sd: `[T, 2 nv]`, of positions and velocities.
        known: `[2 nv]`, variance that was taken away, in what is left.
    """

    qpos: Array
    qvel: Array
    sd: Array
    known: Array


def equality(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array) -> tuple[Array, Array]:
    """Return (derivatives `[m, nv]` of the active equality constraints by the position, their values `[m]`)."""
    if not model.neq:
        return np.zeros((0, model.nv)), np.zeros(0)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    own = np.flatnonzero(data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
    J = np.zeros((data.nefc, model.nv))
    if mujoco.mj_isSparse(model):
        mujoco.mju_sparse2dense(J, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        J = data.efc_J.reshape(data.nefc, model.nv)
    return J[own].copy(), data.efc_pos[own].copy()


def followers(model: mujoco.MjModel, poses: Array, first: NDArray[np.bool_]) -> dict[int, int]:
    """{dof: another that it moves with at a ratio that is the same in all poses `[n, nq]`}, one of `first` if there is.

    A gear, a belt, a finger's second joint: a force at one of both moves the robot as one at the other does.
    """
    if not model.neq:
        return {}
    data, out = mujoco.MjData(model), dict[int, int]()
    ways = np.array([_free(equality(model, data, pose)[0]) for pose in poses])  # [n, nv, nv]
    order = np.argsort(~first, kind="stable").tolist()
    for k, lead in enumerate(order):
        own = ways[:, lead]
        size = np.sum(own**2, axis=1)
        if lead in out or size.min() < NUDGE:
            continue
        for other in order[k + 1 :]:
            ratio = np.median(np.sum(ways[:, other] * own, axis=1) / size)
            if abs(ratio) > NUDGE and np.abs(ways[:, other] - ratio * own).max() < NUDGE:
                out[other] = lead
    return out


def _free(J: Array) -> Array:
    """Projection `[nv, nv]` onto velocities that constraints with these derivatives allow."""
    return np.asarray(np.eye(J.shape[1]) - np.linalg.pinv(J) @ J)


def closed(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array, fixed: NDArray[np.bool_]) -> Array:
    """Return a position with its equality constraints met by the joints that are not `fixed` `[nv]`; data: scratch."""
    if not model.neq or fixed.all():
        return np.array(qpos, float)

    def at(change: Array) -> tuple[Array, Array, Array]:
        there = _moved(model, qpos, change, ~fixed)
        return there, *equality(model, data, there)

    none = np.zeros(int((~fixed).sum()))
    best = least_squares(lambda x: at(x)[2], none, jac=lambda x: at(x)[1][:, ~fixed]) if len(at(none)[2]) else None
    return at(none if best is None else best.x)[0]


def followed(model: mujoco.MjModel, log: Log, prior: Array) -> Way | None:
    """Return the motion by the constraints alone; None where they do not tell it at every row: dynamics have to.

    Row by row, each from the one before, so that a loop stays the way round in which it was assembled.

    Args:
        prior: `[2 nv]`, standard deviations of what is not measured.
    """
    seen, nv = log.seen_dofs, model.nv
    if not model.neq or not seen.any():
        return None
    data, there = mujoco.MjData(model), log.qpos[0]
    measured = [j for j, dof in zip(log.joints, model.jnt_dofadr, strict=True) if seen[dof]]
    columns = np.r_[tuple(log.channels.columns(j) for j in measured)]
    noise = np.concatenate([np.where(seen, log.sigma_dofs, 0.0), np.where(seen, log.sigma_qvel, 0.0)])
    qpos, qvel, sd = [], [], []
    there = closed(model, data, there, seen)
    for row, speed in zip(log.qpos, np.where(seen, log.qvel, 0.0), strict=True):
        there = there.copy()
        there[columns] = row[columns]
        found = _solved(model, data, there, seen)
        if found is None:
            return None
        there, by_measured = found
        qpos.append(there)
        qvel.append(speed + by_measured @ speed)
        sd.append(np.concatenate([np.hypot(own, np.abs(by_measured) @ own) for own in (noise[:nv], noise[nv:])]))
    spread = np.array(sd)
    known = (prior / np.maximum(spread.max(0), NUDGE)) ** 2 - 1
    return Way(np.array(qpos), np.array(qvel), spread, known) if (known > 1).all() else None


def _solved(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: Array, seen: NDArray[np.bool_]
) -> tuple[Array, Array] | None:
    """Return (the position that closes the loops, derivatives `[nv, nv]` of the other joints by the seen ones).

    By Newton's method, from nearby; None where that does not converge, or joints stay free.
    """
    last = np.inf
    while True:
        J, off = equality(model, data, qpos)
        if np.linalg.matrix_rank(J[:, ~seen]) < (~seen).sum():
            return None
        inverse = np.linalg.pinv(J[:, ~seen])
        step = -inverse @ off
        size = float(np.abs(step).max())
        if size >= last:
            return None
        qpos, last = _moved(model, qpos, step, ~seen), size
        if size < NUDGE:
            break
    out = np.zeros_like(J, shape=(model.nv, model.nv))
    out[np.ix_(~seen, seen)] = -inverse @ J[:, seen]
    return qpos, out


def _moved(model: mujoco.MjModel, qpos: Array, change: Array, which: NDArray[np.bool_]) -> Array:
    """Return a position moved along some degrees of freedom."""
    there, whole = np.array(qpos, float), np.zeros(model.nv)
    whole[which] = change
    mujoco.mj_integratePos(model, there, whole, 1.0)
    return there
