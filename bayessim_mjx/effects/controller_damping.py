"""Controller damping: the gain kd of a controller that the logs declare is a multiple of the declared one."""

import dataclasses
from typing import ClassVar

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import OfLoops
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT


@dataclasses.dataclass(frozen=True)
class ControllerDamping(OfLoops, Effect):
    """kd' = factor kd in the law between command and actuator (docs/logs.md, `controller`).

    Without a declared controller it does nothing.

    Parameters: `factor`, no unit, neutral 1. Nothing to ten times: units of
    firmware gains are rarely known.
    """

    name: ClassVar[str] = "controller_damping"
    kind: ClassVar[str] = "actuator"
    relative: ClassVar[bool] = True
    loop: ClassVar[str] = "kd"
    noun: ClassVar[str] = "wrong controller gain kd"
    lacks: ClassVar[str] = "the true controller gain kd"
    separates: ClassVar[str] = (
        "motion by hand with the drive off: what damps it then is the joint's, not the controller's"
    )
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("factor", 1.0, 0.0, 10.0, grid=(0.02, 0.1)),)
