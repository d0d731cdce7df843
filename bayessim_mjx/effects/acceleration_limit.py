"""Motion profile of a drive: its set-point runs after the command with limited speed and acceleration.

Causes: the trapezoidal profile generator of smart servos and motion controllers. Sign: large steps arrive late by a
time that grows with the root of the step, small ones are smoothed.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.profile import trapezoid
from bayessim_mjx.effects.support.site import Site


@dataclasses.dataclass(frozen=True)
class AccelerationLimit(Effect):
    """|u'| <= 1 / slowness and |u''| <= 1 / inertness: u goes to the command c in the least time, and brakes for it.

    Exact for the command that is held over a sub-step, planned anew in each: it may speed up, cruise, brake and arrive
    within one. The actuator obeys the mean of u over the sub-step. A command nearer than u can stop is passed.

    Parameters: `slowness`, s per unit of the command, and `inertness`, s^2 per unit of the command; neutral 0.
    """

    name: ClassVar[str] = "acceleration_limit"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "motion profile of the drive"
    lacks: ClassVar[str] = "the drive's motion profile"
    separates: ClassVar[str] = "steps of several sizes, small ones among them"
    contains: ClassVar[tuple[str, ...]] = ("rate_limit",)
    witness: ClassVar[tuple[str, str] | None] = (
        "effort",
        "the drive's own set-point, or its measured effort (`effort:<actuator>`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("slowness", 0.0, 0.0, 2.0, unit="s/ctrl", per="1/command", reach=(0.0, 2.0), grid=(0.0, 0.05)),
        # a unit of the command takes 2 sqrt(inertness) s
        Quantity(
            "inertness", 0.0, 0.0, 0.5, unit="s^2/ctrl", per="1/command", reach=(0.0, 0.5),
            grid=(0.0005, 0.002, 0.01, 0.05, 0.2),
        ),
    )  # fmt: skip

    def init(self, at: Site) -> Any:
        return {"state": jnp.zeros(len(at)), "rate": jnp.zeros(len(at)), "fresh": jnp.ones((), bool)}

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        own = command[:, at.ids]
        h = jnp.float32(at.timestep)
        slowness, inertness = at.values(theta)[:, 0] / h, at.values(theta)[:, 1] / h**2

        def advance(state: tuple, c: jax.Array) -> tuple[tuple, jax.Array]:
            u, rate = state
            left, rate, mean = trapezoid(c - u, rate, slowness, inertness)
            return (c - left, rate), c - mean

        start = jnp.where(memory["fresh"], own[0], memory["state"])
        (state, rate), means = jax.lax.scan(advance, (start, jnp.where(memory["fresh"], 0.0, memory["rate"])), own)
        kept = {"state": state, "rate": rate, "fresh": jnp.zeros((), bool)}
        return kept, command.at[:, at.ids].set(means)
