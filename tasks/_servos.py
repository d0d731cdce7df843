"""Position drives, and the commands at which they rest: MuJoCo compares a command with gear times a joint's place."""

from typing import TypeVar

import jax
import mujoco
import numpy as np

from bayessim_mjx.errors import UserError

_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_RATES = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
Lengths = TypeVar("Lengths", np.ndarray, jax.Array)


def servos(model: mujoco.MjModel, task: str) -> np.ndarray:
    """`[nu]` bool, actuators that pull towards a place.

    Raises:
        UserError: one of them has no command that is a place.
    """
    found = (model.actuator_biastype == _AFFINE) & (model.actuator_biasprm[:, 1] != 0)
    for i in np.flatnonzero(found):
        name = model.actuator(i).name or f"#{i}"
        if model.actuator_dyntype[i] == _RATES:
            raise UserError(f"{task}: the command of actuator {name} is a rate; allowed: <position> and <motor>")
        if model.actuator_gaintype[i] not in _GAINS or model.actuator_gainprm[i, 0] == 0:
            raise UserError(f"{task}: actuator {name} pulls to a place whatever its command; allowed: <position>")
    return found


def resting(model: mujoco.MjModel, length: Lengths) -> Lengths:
    """Commands `[nu]` at which servos exert no force at rest: 0 = (k0 + k1 l) u + b0 + b1 l.

    Args:
        model: its other actuators get nothing of use.
        length: `[nu]` l, MuJoCo's `actuator_length`: on a hinge or slide, gear times its place.
    """
    (k0, k1), (b0, b1) = model.actuator_gainprm[:, :2].T, model.actuator_biasprm[:, :2].T
    k0, k1 = np.where(k0 == 0, 1, k0), np.where(model.actuator_gaintype == _GAINS[1], k1, 0)
    k0, k1, b0, b1 = (x.astype(length.dtype) for x in (k0, k1, b0, b1))
    gain = k0 + k1 * length
    return -b0 / gain + (-b1 / gain) * length
