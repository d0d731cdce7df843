"""Sensor delay: measurements that arrive late, by bus cycles, conversion and transport."""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Measurement, Quantity
from bayessim_mjx.effects.support.motion import Motion, delayed
from bayessim_mjx.effects.support.quantity import delay
from bayessim_mjx.effects.support.site import Site, columns, written

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class SensorDelay(Effect):
    """measured(t) = q(t - d), w(t - d); between control steps the velocity is a parabola (`motion.bend`).

    Before the first measurement of an episode the first one is taken to have held for ever; an episode that starts in
    the middle of a log takes its past from there.

    Parameters: `delay` d, s, neutral 0.

    Attributes:
        high: largest delay, s, unless `parameters` has another range.
    """

    high: float = 0.05
    name: ClassVar[str] = "sensor_delay"
    kind: ClassVar[str] = "joint"
    late: ClassVar[bool] = True
    noun: ClassVar[str] = "measurement delay"
    lacks: ClassVar[str] = "a measurement delay"
    separates: ClassVar[str] = "the loop closed in the drive against the loop closed outside; an independent clock"
    witness: ClassVar[tuple[str, str] | None] = (
        "imu",
        "an IMU or a second sensor with its own time stamps (`imu:...`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (delay(0.05, grid=(0.1, 0.3, 0.6)),)

    def init(self, at: Site) -> Any:
        """{"history": `[lag, n, 2]` positions and velocities after past control steps, newest last; "fresh"}."""
        longest = max(p.high for p in self.space().parameters)
        lag = max(2, math.ceil(longest / at.dt - 1e-6))
        return {"history": jnp.zeros((lag, len(at), 2)), "fresh": jnp.ones((), bool)}

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        true = motion.shifted(at, at.values(theta)[:, 0] / jnp.float32(at.dt))
        lag = memory["history"].shape[0]
        past = jnp.clip(jnp.arange(motion.start - lag + 1, motion.start + 1), 0, None)
        filled = {"history": true[past], "fresh": jnp.zeros((), bool)}
        return filled, motion.replace(**written(at, motion.qpos, motion.qvel, true))

    def echoes(self, at: Site, theta: jax.Array) -> jax.Array:
        return jnp.zeros(at.nv).at[at.dadr].set(at.values(theta)[:, 0] / jnp.float32(at.dt))

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        now, lag = columns(at, **measurement), memory["history"].shape[0]
        past = jnp.where(memory["fresh"], now, memory["history"])
        steps = jnp.clip(at.values(theta)[:, 0] / jnp.float32(at.dt), 0.0, lag)
        shown, history = delayed(past, now, steps, at)
        memory = {"history": history, "fresh": jnp.zeros((), bool)}
        return memory, written(at, **measurement, values=shown)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo delays sensors, not qpos and qvel, and MJX does not know these delays; use effects.yaml"
