"""Actuator saturation: the force has a limit (current limit of the drive, full supply voltage, a slipping clutch)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import addressed, limits
from bayessim_mjx.effects.support.quantity import EFFORT_OR_CURRENT
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep


@dataclasses.dataclass(frozen=True)
class ActuatorSaturation(Effect):
    """|f| <= 1 / inverse_limit, in units of the actuator's force; the inverse, so that "no limit" is a number.

    f' = f / max(1, inverse_limit |f|)

    Parameters: `inverse_limit`, 1/(N m) (hinge) or 1/N (slide), neutral 0. Data below the limit do not see it: the
    first starting value of a fit lies just below the largest effort.

    Attributes:
        high: largest inverse limit, unless `parameters` has another range.
    """

    high: float = 10.0
    name: ClassVar[str] = "actuator_saturation"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "effort saturation"
    lacks: ClassVar[str] = "an effort limit"
    separates: ClassVar[str] = "the same motion at several amplitudes, up to the limit"
    witness = EFFORT_OR_CURRENT
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "inverse_limit",
            0.0,
            0.0,
            10.0,
            unit="1/(N m)",
            per="1/force",
            reach=(0.0, 5.0),
            grid=(0.08, 0.12, 0.16, 0.22, 0.3, 0.5),
        ),
    )

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        own = force[at.ids]
        return memory, force.at[at.ids].set(own / jnp.maximum(1.0, at.values(theta)[:, 0] * jnp.abs(own)))

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: forcerange, inside the one that there is."""
        for actuator, own in addressed(spec, values):
            if own["inverse_limit"] > 0:
                limit = 1.0 / own["inverse_limit"]
                before = limits(actuator)
                actuator.forcerange = np.clip([-limit, limit] if before is None else before, -limit, limit)
                actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        return None
