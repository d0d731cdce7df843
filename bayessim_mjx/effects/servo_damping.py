"""Servo damping: the derivative gain kv of a position servo is a multiple of the modelled one."""

import dataclasses
from typing import ClassVar

import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import OfGains, servo
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT


@dataclasses.dataclass(frozen=True)
class ServoDamping(OfGains, Effect):
    """f' = kp (u - q) - factor kv q', within the modelled force limit; stiffness and limit stay what they are.

    Parameters: `factor`, no unit, neutral 1. Nothing to ten times: the gain of a hobby servo's firmware has no known
    relation to kv.
    """

    name: ClassVar[str] = "servo_damping"
    kind: ClassVar[str] = "actuator"
    relative: ClassVar[bool] = True
    columns: ClassVar[dict[str, int]] = {"actuator_biasprm": 2}
    noun: ClassVar[str] = "wrong servo damping (kv)"
    lacks: ClassVar[str] = "the true servo damping (kv)"
    separates: ClassVar[str] = "motion by hand with the drive off: what damps it then is the joint's, not the servo's"
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("factor", 1.0, 0.0, 10.0, grid=(0.02, 0.1)),)

    @classmethod
    def carries(cls, model: mujoco.MjModel, i: int) -> bool:
        return servo(model, i) and bool(model.actuator_biasprm[i, 2])
