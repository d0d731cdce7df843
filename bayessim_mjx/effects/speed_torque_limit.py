"""Speed-torque limit of an electric motor: the faster it turns, the less of its stall torque is left."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.quantity import BUS
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

_TINY = 1e-20


@dataclasses.dataclass(frozen=True)
class SpeedTorqueLimit(Effect):
    """|f| <= f0 (1 - |w| / w0) while f drives the motion (f w > 0), |f| <= f0 while it brakes: four quadrants.

    Back-EMF takes w / w0 of the supply voltage when driving; when braking it helps, and only the current limit remains.
    Beyond w0 the motor cannot drive at all. f and w are the actuator's own (at the joint: force times gear, speed over
    gear).

    Parameters, inverse so that "no limit" is a number:
        inverse_stall: 1 / f0, 1/(N m) (hinge) or 1/N (slide), neutral 0: any force below the no-load speed.
        inverse_speed: 1 / w0, s/rad or s/m, neutral 0: the limit is f0 at all speeds (`actuator_saturation`).
    """

    name: ClassVar[str] = "speed_torque_limit"
    kind: ClassVar[str] = "actuator"
    contains: ClassVar[tuple[str, ...]] = ("actuator_saturation",)
    noun: ClassVar[str] = "speed-torque limit"
    lacks: ClassVar[str] = "a speed-torque limit"
    separates: ClassVar[str] = "fast driving and braking"
    witness = BUS
    joint: ClassVar[bool] = True
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "inverse_stall", 0.0, 0.0, 10.0, unit="1/(N m)", per="1/force", reach=(0.0, 3.0), grid=(0.1, 0.2, 0.35, 0.6)
        ),
        Quantity(
            "inverse_speed", 0.0, 0.0, 5.0, unit="s/rad", per="1/speed", reach=(0.0, 1.5), grid=(0.2, 0.4, 0.6, 0.9)
        ),
    )

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        inverse_stall, inverse_speed = at.values(theta).T
        own, speed = force[at.ids], step.data._impl.actuator_velocity[at.ids]
        used = inverse_stall * jnp.abs(own)
        left = 1.0 - inverse_speed * jnp.maximum(jnp.sign(own) * speed, 0.0)
        over = used > left
        # f' = f (1 - w / w0) f0 / |f|; the inner `where` keeps derivatives finite
        share = jnp.where(over, jnp.maximum(left, 0.0) / jnp.where(over, jnp.maximum(used, _TINY), 1.0), 1.0)
        return memory, force.at[at.ids].set(own * share)
