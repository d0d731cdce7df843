"""Actuator delay: commands arrive late by a fixed time.

The command is a staircase in time. Each sub-step applies the time average of the delayed staircase over that sub-step
(so: linear interpolation at sub-step resolution). The impulse is exact for every delay, not only for whole sub-steps,
and the motion depends continuously on the delay. Before the first command the first command is taken to have held for
ever.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.quantity import delay
from bayessim_mjx.effects.support.site import Site

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class ActuatorDelay(Effect):
    """u(t - delay) at one actuator or several.

    Parameters: `delay`, s, neutral 0.

    Attributes:
        high: largest delay, s, unless `parameters` has another range.
    """

    where: str | tuple[str, ...] = "all"
    high: float = 0.1
    name: ClassVar[str] = "actuator_delay"
    kind: ClassVar[str] = "actuator"
    late: ClassVar[bool] = True
    last: ClassVar[bool] = True
    noun: ClassVar[str] = "command delay"
    lacks: ClassVar[str] = "a command delay"
    separates: ClassVar[str] = "a wide-band chirp with the drive's measured effort in the log; the onset time of a step"
    witness: ClassVar[tuple[str, str] | None] = (
        "effort",
        "the drive's measured effort with its own time stamps (`effort:<actuator>`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (delay(0.1, grid=(0.05, 0.2, 0.5)),)

    def init(self, at: Site) -> Any:
        """{"history": `[lag, nu]` commands of past sub-steps, newest last; "fresh"}."""
        longest = max(p.high for p in self.space().parameters)
        lag = math.ceil(longest / at.timestep - 1e-6) + 1
        return {"history": jnp.zeros((lag, at.nu)), "fresh": jnp.ones((), bool)}

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        lag, steps = memory["history"].shape[0], command.shape[0]
        past = jnp.where(memory["fresh"], command[0], memory["history"])
        signal = jnp.concatenate([past, command])  # row lag + k is sub-step k of this control step
        own = signal[:, at.ids]
        delay = jnp.clip(at.values(theta)[:, 0] / jnp.float32(at.timestep), 0.0, lag - 1.0)
        whole = jnp.floor(delay)
        part = delay - whole
        row = lag + jnp.arange(steps)[:, None] - whole.astype(jnp.int32)
        # mean of the staircase over a sub-step that begins `delay` sub-steps earlier
        late = (1.0 - part) * jnp.take_along_axis(own, row, 0) + part * jnp.take_along_axis(own, row - 1, 0)
        shifted = command.at[:, at.ids].set(jnp.where(delay > 0, late, command[:, at.ids]))
        return {"history": signal[-lag:], "fresh": jnp.zeros((), bool)}, shifted

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's delay buffer holds whole timesteps and MJX has none; use effects.yaml"
