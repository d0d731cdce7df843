"""Servo stiffness: the proportional gain kp of a position servo is a multiple of the modelled one."""

import dataclasses
from typing import ClassVar

import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import OfGains, servo
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT


@dataclasses.dataclass(frozen=True)
class ServoStiffness(OfGains, Effect):
    """f' = factor kp (u - q) - kv q', within the modelled force limit; damping and limit stay what they are.

    Parameters: `factor`, no unit, neutral 1. A tenth to ten times: the gain of a hobby servo's firmware has no known
    relation to kp.
    """

    name: ClassVar[str] = "servo_stiffness"
    kind: ClassVar[str] = "actuator"
    relative: ClassVar[bool] = True
    columns: ClassVar[dict[str, int]] = {"actuator_gainprm": 0, "actuator_biasprm": 1}  # of the model, that it scales
    noun: ClassVar[str] = "wrong servo stiffness (kp)"
    lacks: ClassVar[str] = "the true servo stiffness (kp)"
    separates: ClassVar[str] = "a known load on the servo at rest: the position error times kp is its torque"
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("factor", 1.0, 0.1, 10.0, grid=(0.02, 0.1)),)

    @classmethod
    def carries(cls, model: mujoco.MjModel, i: int) -> bool:
        return servo(model, i)
