"""Actuator gain: the force is a constant multiple of the modelled one (torque constant, gear loss, supply voltage)."""

import dataclasses
from typing import Any, ClassVar

import jax
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import nonlinear, with_bias
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep


@dataclasses.dataclass(frozen=True)
class ActuatorGain(Effect):
    """f' = gain f, for all that the actuator exerts: a position servo's stiffness and damping, and its force limit.

    Parameters: `gain`, no unit, neutral 1.
    """

    name: ClassVar[str] = "actuator_gain"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "wrong actuator gain"
    lacks: ClassVar[str] = "the true actuator gain"
    separates: ClassVar[str] = (
        "a known added mass, or a force gauge: without a force reference only ratios to inertia show"
    )
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("gain", 1.0, 0.5, 1.5, grid=(0.1, 0.3, 0.6)),)

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        return memory, force.at[at.ids].set(force[at.ids] * at.values(theta)[:, 0])

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: gainprm, biasprm and forcerange, times gain."""
        if why := nonlinear(spec, values):
            return why
        for actuator, own in with_bias(spec, values):
            actuator.gainprm = own["gain"] * actuator.gainprm
            actuator.biasprm = own["gain"] * actuator.biasprm
            actuator.forcerange = own["gain"] * actuator.forcerange
        return None
