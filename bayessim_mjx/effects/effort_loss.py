"""Effort loss: the larger the effort that an actuator shall give, the smaller the share that arrives.

One form of several causes, which a log of motion alone cannot tell apart: supply voltage sagging under load, winding
resistance growing with current, a nonlinear duty cycle, magnetic saturation of the iron.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.quantity import BUS
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep


@dataclasses.dataclass(frozen=True)
class EffortLoss(Effect):
    """f' = f / (1 + loss |f|), in units of the actuator's force; odd, monotone, slope 1 at f = 0.

    At |f| = 1 / loss half of the force arrives.

    Parameters: `loss`, 1/(N m) (hinge) or 1/N (slide), neutral 0.

    Attributes:
        high: largest loss, unless `parameters` has another range.
    """

    high: float = 10.0
    name: ClassVar[str] = "effort_loss"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "effort loss at high load"
    lacks: ClassVar[str] = "an effort loss at high load"
    separates: ClassVar[str] = "the same motion on a full and on an empty battery (or two supply voltages)"
    witness = BUS
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("loss", 0.0, 0.0, 10.0, unit="1/(N m)", per="1/force", reach=(0.0, 1.5), grid=(0.05, 0.2, 0.4, 0.7)),
    )

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        own = force[at.ids]
        return memory, force.at[at.ids].set(own / (1.0 + at.values(theta)[:, 0] * jnp.abs(own)))
