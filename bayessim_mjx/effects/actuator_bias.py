"""Actuator bias: a constant force on top of the modelled one (amplifier or current-sensor offset, a taut cable)."""

import dataclasses
from typing import Any, ClassVar

import jax
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import addressed, limits, nonlinear
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep


@dataclasses.dataclass(frozen=True)
class ActuatorBias(Effect):
    """f' = f + bias, in units of the actuator's force (at the joint: times the gear); not where the drive is off.

    Parameters: `bias`, N m (hinge) or N (slide), neutral 0.
    """

    name: ClassVar[str] = "actuator_bias"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "effort bias"
    lacks: ClassVar[str] = "an effort bias"
    separates: ClassVar[str] = "two mount orientations, or the drive switched off"
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("bias", 0.0, -1.0, 1.0, unit="N m", per="force", reach=(-0.5, 0.5)),
    )

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        return memory, force.at[at.ids].add(at.values(theta)[:, 0])

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: biasprm[0]; a force range moves with it, since the bias comes after the limit."""
        if why := nonlinear(spec, values):
            return why
        for actuator, own in addressed(spec, values):
            if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
                actuator.biastype, actuator.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, 0.0 * actuator.biasprm
            actuator.biasprm[0] += own["bias"]
            if limits(actuator) is not None:
                actuator.forcerange = actuator.forcerange + own["bias"]
        return None
