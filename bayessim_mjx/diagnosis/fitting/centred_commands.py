"""Commands centred on the integrator's force evaluations, after the effects of the drive have acted on them.

A rate limit or a dead band acts on the command that is sent, not on its mean over two sub-steps: centring comes last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.physics import Physics, staggered


@dataclasses.dataclass(frozen=True)
class Centred(Effect):
    """The command half a sub-step early (see `windows._fine_commands`); it has no parameters and is no candidate."""

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "centred"
    kind: ClassVar[str] = "world"
    quantities: ClassVar[tuple[Quantity, ...]] = ()

    def init(self, at: Site) -> Any:
        return {"last": jnp.zeros(at.nu), "fresh": jnp.ones((), bool)}

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        if not staggered(at.mj_model):
            return memory, command
        last = jnp.where(memory["fresh"], command[0], memory["last"])
        early = jnp.concatenate([last[None], command[:-1]])
        return {"last": command[-1], "fresh": jnp.zeros((), bool)}, 0.5 * (early + command)


def physics_of(robot: Robot, dt: float, effects: Sequence[Effect]) -> Physics:
    """The robot with these effects, for windows cut with `centred=False`."""
    return robot.physics(dt, (*effects, Centred()))
