"""Commands that actions move at a rate, as Isaac Gym's arms, legs and rotors have them."""

from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.env import Task
from bayessim_mjx.physics import World


class RateControlled(Task):
    """A task in which command += dt * rate * action, kept inside the actuators' ctrlrange, in `world.task["command"]`.

    The commands are no part of the observation unless the task shows them.
    """

    rates: ClassVar[Sequence[float]]  # of each actuator's command at the action 1, per second

    def at_rest(self, qpos: jax.Array) -> jax.Array:
        """Commands `[nu]` at the start of an episode that begins at qpos `[nq]`."""
        return jnp.zeros(self.mj_model.nu)

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        return {"command": self.at_rest(world.qpos)}

    def actuate(self, world: World, action: jax.Array) -> tuple[World, jax.Array]:
        step = self.dt * np.asarray(self.rates, np.float32) * action
        low, high = self.mj_model.actuator_ctrlrange.T.astype(np.float32)
        command = jnp.clip(world.task["command"] + step, low, high)
        return world.replace(task=world.task | {"command": command}), command
