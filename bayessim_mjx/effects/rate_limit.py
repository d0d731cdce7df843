"""Rate limit of the command: a drive's profile generator, a slew limit, a valve or rudder of fixed speed."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import at_rest, follow
from bayessim_mjx.effects.support.quantity import SET_POINT
from bayessim_mjx.effects.support.site import Site


@dataclasses.dataclass(frozen=True)
class RateLimit(Effect):
    """|du/dt| <= 1 / slowness: the actuator obeys u, which runs after the command c and starts at the first one.

    Exact for the command that is held over a sub-step; continuous and differentiable at slowness 0.

    Parameters: `slowness`, s per unit of the command, neutral 0.

    Attributes:
        high: largest slowness, unless `parameters` has another range.
    """

    high: float = 2.0
    name: ClassVar[str] = "rate_limit"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "command rate limit"
    lacks: ClassVar[str] = "a command rate limit"
    separates: ClassVar[str] = "steps of several sizes"
    witness = SET_POINT
    quantities: ClassVar[tuple[Quantity, ...]] = (
        # per the largest command: seconds from 0 to it
        Quantity(
            "slowness",
            0.0,
            0.0,
            2.0,
            unit="s/ctrl",
            per="1/command",
            reach=(0.0, 2.0),
            grid=(0.005, 0.01, 0.02, 0.05, 0.12, 0.3),
        ),
    )

    def init(self, at: Site) -> Any:
        return at_rest(at)

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        slowness = at.values(theta)[:, 0] / jnp.float32(at.timestep)

        def advance(u: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
            way = c - u
            time = slowness * jnp.abs(way)  # to arrive, in sub-steps
            reached = 1.0 / jnp.maximum(time, 1.0)  # share of the way after one sub-step
            # a triangle is missing from the mean where it arrives, all but half of its way where not
            missing = jnp.where(time <= 1.0, 0.5 * time, 1.0 - 0.5 * reached)
            return c - way * (1.0 - reached), c - way * missing

        return follow(at, memory, command, advance)
