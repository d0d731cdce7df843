"""Servo stiffness: the proportional gain kp of a position servo is a multiple of the modelled one."""

import dataclasses
from typing import Any, ClassVar

import jax
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import addressed, scaled, servo
from bayessim_mjx.effects.support.site import Site


@dataclasses.dataclass(frozen=True)
class ServoStiffness(Effect):
    """f' = factor kp (u - q) - kv q', within the modelled force limit; damping and limit stay what they are.

    Parameters: `factor`, no unit, neutral 1. A tenth to ten times: the gain of a hobby servo's firmware has no known
    relation to kp.
    """

    name: ClassVar[str] = "servo_stiffness"
    kind: ClassVar[str] = "actuator"
    relative: ClassVar[bool] = True
    noun: ClassVar[str] = "wrong servo stiffness (kp)"
    lacks: ClassVar[str] = "the true servo stiffness (kp)"
    separates: ClassVar[str] = "a known load on the servo at rest: the position error times kp is its torque"
    witness: ClassVar[tuple[str, str] | None] = (
        "effort",
        "the drive's measured effort or current (`effort:<actuator>`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("factor", 1.0, 0.1, 10.0, grid=(0.02, 0.1)),)

    @classmethod
    def carries(cls, model: mujoco.MjModel, i: int) -> bool:
        return servo(model, i)

    def on_model(self, at: Site, model: Any, theta: jax.Array) -> Any:
        factor = at.values(theta)[:, 0]
        gain, bias = (
            scaled(prm, at.ids, k, factor) for prm, k in ((model.actuator_gainprm, 0), (model.actuator_biasprm, 1))
        )
        return model.replace(actuator_gainprm=gain, actuator_biasprm=bias)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: gainprm[0] and biasprm[1], times factor."""
        compiled = spec.copy().compile()  # its biasprm has the damping that a dampratio stands for
        order = list(spec.actuators)
        for actuator, own in addressed(spec, values):
            actuator.biasprm = compiled.actuator_biasprm[order.index(actuator)]
            actuator.gainprm[0] *= own["factor"]
            actuator.biasprm[1] *= own["factor"]
        return None
