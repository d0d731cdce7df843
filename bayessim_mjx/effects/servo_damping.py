"""Servo damping: the derivative gain kv of a position servo is a multiple of the modelled one."""

import dataclasses
from typing import Any, ClassVar

import jax
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import addressed, scaled, servo
from bayessim_mjx.effects.support.site import Site


@dataclasses.dataclass(frozen=True)
class ServoDamping(Effect):
    """f' = kp (u - q) - factor kv q', within the modelled force limit; stiffness and limit stay what they are.

    Parameters: `factor`, no unit, neutral 1. Nothing to ten times: the gain of a hobby servo's firmware has no known
    relation to kv.
    """

    name: ClassVar[str] = "servo_damping"
    kind: ClassVar[str] = "actuator"
    relative: ClassVar[bool] = True
    noun: ClassVar[str] = "wrong servo damping (kv)"
    lacks: ClassVar[str] = "the true servo damping (kv)"
    separates: ClassVar[str] = "motion by hand with the drive off: what damps it then is the joint's, not the servo's"
    witness: ClassVar[tuple[str, str] | None] = (
        "effort",
        "the drive's measured effort or current (`effort:<actuator>`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("factor", 1.0, 0.0, 10.0, grid=(0.02, 0.1)),)

    @classmethod
    def carries(cls, model: mujoco.MjModel, i: int) -> bool:
        return servo(model, i) and model.actuator_biasprm[i, 2] != 0

    def on_model(self, at: Site, model: Any, theta: jax.Array) -> Any:
        factor = at.values(theta)[:, 0]
        return model.replace(actuator_biasprm=scaled(model.actuator_biasprm, at.ids, 2, factor))

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: biasprm[2], times factor."""
        compiled = spec.copy().compile()  # its biasprm has the damping that a dampratio stands for
        order = list(spec.actuators)
        for actuator, own in addressed(spec, values):
            actuator.biasprm = compiled.actuator_biasprm[order.index(actuator)]
            actuator.biasprm[2] *= own["factor"]
        return None
