"""Controller stiffness: the gain kp of a controller that the logs declare is a multiple of the declared one."""

import dataclasses
from typing import ClassVar

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import OfLoops
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT


@dataclasses.dataclass(frozen=True)
class ControllerStiffness(OfLoops, Effect):
    """kp' = factor kp in the law between command and actuator (docs/logs.md, `controller`).

    Without a declared controller it does nothing.

    Parameters: `factor`, no unit, neutral 1. A tenth to ten times: units of
    firmware gains are rarely known.
    """

    name: ClassVar[str] = "controller_stiffness"
    kind: ClassVar[str] = "actuator"
    relative: ClassVar[bool] = True
    loop: ClassVar[str] = "kp"
    noun: ClassVar[str] = "wrong controller gain kp"
    lacks: ClassVar[str] = "the true controller gain kp"
    separates: ClassVar[str] = "a known load on the joint at rest: the position error times kp is its torque"
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("factor", 1.0, 0.1, 10.0, grid=(0.02, 0.1)),)
