"""Actuator delay: commands arrive late by a fixed time.

The command is a staircase in time (zero-order hold over each control step). Each sub-step applies the time average of
the delayed staircase over that sub-step (so: linear interpolation at sub-step resolution). The impulse is exact for
every delay, not only for whole sub-steps, and the motion depends continuously on the delay. Before the first command
the first command is taken to have held for ever.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, index_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace

if TYPE_CHECKING:
    from bayessim_mjx.physics import Physics


@dataclasses.dataclass(frozen=True)
class ActuatorDelay(Effect):
    """Delay of one actuator's command, or of all (`where="all"`).

    Parameters: `delay`, s, neutral 0.

    Attributes:
        high: largest delay, s, unless `parameters` has another range.
    """

    where: str = "all"
    high: float = 0.1
    name: ClassVar[str] = "actuator_delay"

    def __post_init__(self) -> None:
        if not 0 < self.high < math.inf:
            raise UserError(f"{self.name}: high = {self.high} s, must be positive and finite")
        if (low := self.space().parameters[0].low) < 0:
            raise UserError(f"{self.where}.{self.name}.delay: range begins at {low:g} s; a delay is never negative")

    def defaults(self) -> ParameterSpace:
        label = f"{self.where}.{self.name}.delay"
        delay = Parameter(label, 0.0, 0.0, self.high, unit="s", attribute="delay", target=self.where, kind="effect")
        return ParameterSpace([delay])

    def init(self, physics: "Physics") -> Any:
        """{"history": `[lag, nu]` commands of past sub-steps, newest last; "mask": `[nu]`; "fresh"; "timestep": []}."""
        nu = physics.mj_model.nu
        mask = jnp.ones(nu, bool)
        if self.where != "all":
            names = [physics.mj_model.actuator(i).name for i in range(nu)]
            mask = jnp.arange(nu) == index_of("actuator", self.where, [*names, "all"], self.name)
        timestep = physics.mj_model.opt.timestep
        lag = math.ceil(self.space().parameters[0].high / timestep - 1e-6) + 1
        return {
            "history": jnp.zeros((lag, nu)),
            "mask": mask,
            "fresh": jnp.ones((), bool),
            "timestep": jnp.float32(timestep),
        }

    def on_command(self, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        lag, steps = memory["history"].shape[0], command.shape[0]
        past = jnp.where(memory["fresh"], command[0], memory["history"])
        signal = jnp.concatenate([past, command])  # row lag + k is sub-step k of this control step
        delay = jnp.clip(theta[0] / memory["timestep"], 0.0, lag - 1.0)
        whole = jnp.floor(delay)
        part = delay - whole
        row = lag + jnp.arange(steps) - whole.astype(jnp.int32)
        # mean of the staircase over a sub-step that begins `delay` sub-steps earlier
        late = (1.0 - part) * signal[row] + part * signal[row - 1]
        shifted = jnp.where((delay > 0) & memory["mask"], late, command)
        return memory | {"history": signal[-lag:], "fresh": jnp.zeros((), bool)}, shifted
