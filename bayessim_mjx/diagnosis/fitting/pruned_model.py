"""What a robot's simulation does without where nothing can touch: limits far from the motion, rounds of the solver."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.fitting.discretisation import contacts
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.fitting.simulable import AXIAL
from bayessim_mjx.logs.log import Log

# Of a joint's travel in the logs and of its range, the larger: as near as the motion has to come
# (docs/decisions/unreached_limits.md).
NEAR_TRAVEL, NEAR_RANGE = 0.25, 0.05
# Iterations of Newton's solver and of its line search. Dry friction alone is solved to single precision by 4 and 6 (six
# joints, half a second: the same to 1e-7 rad as by 100 and 50, at half the time); worlds in one call wait for the last.
ROUNDS = 8


def pruned(robot: Robot, logs: Sequence[Log], dt: float) -> Robot:
    """The robot as it is simulated beside these logs at control steps of `dt` s."""
    robot = dataclasses.replace(robot, unlimited=unreached(robot.mj_model, logs))
    alone = not robot.mj_model.neq and not contacts(robot.physics(dt))
    return dataclasses.replace(robot, rounds=ROUNDS) if alone else robot


def unreached(model: mujoco.MjModel, logs: Sequence[Log]) -> tuple[int, ...]:
    """Joints with limits whose motion in the logs stays away from them; none that is not measured in all logs."""
    return tuple(j for j in range(model.njnt) if model.jnt_limited[j] and _away(model, j, logs))


def _away(model: mujoco.MjModel, j: int, logs: Sequence[Log]) -> bool:
    if model.jnt_type[j] not in AXIAL or not all(log.seen_dofs[model.jnt_dofadr[j]] for log in logs):
        return False
    q = np.concatenate([log.qpos[:, model.jnt_qposadr[j]] for log in logs])
    low, high = model.jnt_range[j]
    room = max(NEAR_TRAVEL * np.ptp(q), NEAR_RANGE * (high - low))
    return bool(low + room < q.min() and q.max() < high - room)
