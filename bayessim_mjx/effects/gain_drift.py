"""Gain that drifts over a recording: drives that fade as they warm up, a battery that runs down.

Sign: the same motion takes more and more command; nothing else changes. Without a recording's clock (in training) the
time is that of the episode.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep


@dataclasses.dataclass(frozen=True)
class GainDrift(Effect):
    """f' = (1 + drift t) f, not below 0; t is the time since the recording began, in minutes.

    Parameters: `drift`, 1/min, neutral 0; negative: it fades.
    """

    name: ClassVar[str] = "gain_drift"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "drift of the actuator gain"
    separates: ClassVar[str] = "the same motion at the beginning and at the end of a long run"
    witness: ClassVar[tuple[str, str] | None] = (
        "temperature",
        "the drive's temperature or the supply voltage (`temperature`, `voltage`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("drift", 0.0, -1.0, 1.0, unit="1/min", grid=(0.02, 0.1, 0.5)),
    )

    def init(self, at: Site) -> Any:
        """Time, s."""
        return jnp.zeros(())

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        return memory if motion.time is None else jnp.asarray(motion.time, jnp.float32), motion

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        factor = jnp.maximum(1.0 + at.values(theta)[:, 0] * memory / 60.0, 0.0)
        return memory + jnp.float32(step.dt), force.at[at.ids].set(force[at.ids] * factor)
