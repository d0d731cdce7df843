"""First-order lag of the command: current loops, drive filters, hydraulic and pneumatic valves, a servo's smoothing."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.actuators import addressed, at_rest, follow
from bayessim_mjx.effects.support.quantity import EFFORT
from bayessim_mjx.effects.support.site import Site

if TYPE_CHECKING:
    from mujoco import MjSpec


@dataclasses.dataclass(frozen=True)
class ActuatorLag(Effect):
    """T du/dt = c - u: the actuator obeys u, not the command c; u starts at the first command.

    Solved exactly for the command that is held over a sub-step, so every T >= 0 is allowed and T -> 0 is continuous.

    Parameters: `time_constant`, s, neutral 0.

    Attributes:
        high: largest time constant, s, unless `parameters` has another range.
    """

    high: float = 0.2
    name: ClassVar[str] = "actuator_lag"
    kind: ClassVar[str] = "actuator"
    late: ClassVar[bool] = True
    noun: ClassVar[str] = "actuator lag"
    lacks: ClassVar[str] = "an actuator lag"
    separates: ClassVar[str] = "steps and a chirp: a lag is the slope after a step, a delay its dead time"
    witness = EFFORT
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("time_constant", 0.0, 0.0, 0.2, unit="s", grid=(0.02, 0.1, 0.3)),
    )

    def init(self, at: Site) -> Any:
        return at_rest(at)

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        lag = at.values(theta)[:, 0] / jnp.float32(at.timestep)
        # u(t) = c + (u - c) exp(-t / T); exp(-1000) is 0 in float32
        gone = -jnp.expm1(-1.0 / jnp.maximum(lag, 1e-3))

        def advance(u: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
            return c + (u - c) * (1.0 - gone), c + (u - c) * (lag * gone)

        return follow(at, memory, command, advance)

    def edit(self, spec: "MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        """Native: dyntype filterexact. It starts at activation 0 and is read at the start of each timestep."""
        lagging = [(a, own["time_constant"]) for a, own in addressed(spec, values) if own["time_constant"] > 0]
        for actuator, _ in lagging:
            if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
                return f"actuator {actuator.name} has an activation of its own already"
        for actuator, time in lagging:
            actuator.dyntype, actuator.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, time
        return None
