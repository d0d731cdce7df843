"""Sensor filter: a first-order low pass on what is measured, in the drive's firmware, an RC input or a driver."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Measurement, Quantity
from bayessim_mjx.effects.support.motion import Motion, bend
from bayessim_mjx.effects.support.site import Site, columns, written

if TYPE_CHECKING:
    import mujoco

_SHORTEST = 1e-3  # of a control step: below it the exponential is 0 in float32 anyway


@dataclasses.dataclass(frozen=True)
class SensorFilter(Effect):
    """T y' = q - y, shown is y; likewise the velocity. Exact for an acceleration that changes linearly in each control
    step (the angle: for a constant one).

    An episode begins settled (y = q). One that starts in the middle of a log has y = measured, q = y + T y'.

    Parameters: `time_constant` T, s, neutral 0.

    Attributes:
        high: largest time constant, s, unless `parameters` has another range.
    """

    high: float = 0.05
    name: ClassVar[str] = "sensor_filter"
    kind: ClassVar[str] = "joint"
    late: ClassVar[bool] = True
    noun: ClassVar[str] = "measurement filter"
    lacks: ClassVar[str] = "a measurement filter"
    separates: ClassVar[str] = "a second sensor of the same joint; steps"
    witness: ClassVar[tuple[str, str] | None] = ("imu", "a second, unfiltered sensor (`link:<joint>` or `imu:...`)")
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("time_constant", 0.0, 0.0, 0.05, unit="s", grid=(0.1, 0.3, 0.6)),
    )

    def init(self, at: Site) -> Any:
        """{"input", "output": `[n, 2]` position and velocity after the last control step; "fresh"}."""
        rest = jnp.zeros((len(at), 2))
        return {"input": rest, "output": rest, "fresh": jnp.ones((), bool)}

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        shown = columns(at, motion.qpos, motion.qvel)  # [rows, n, 2]
        speed = shown[..., 1]  # a filtered velocity is the filtered angle's rate
        rate = jnp.stack([speed, _slope(speed) / jnp.float32(at.dt)], axis=-1)
        true = shown + at.values(theta) * rate
        filled = {"input": true[motion.start], "output": shown[motion.start], "fresh": jnp.zeros((), bool)}
        return filled, motion.replace(**written(at, motion.qpos, motion.qvel, true))

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        now = columns(at, **measurement)
        before = jnp.where(memory["fresh"], now, memory["input"])
        output = jnp.where(memory["fresh"], now, memory["output"])
        ratio = at.values(theta) / jnp.float32(at.dt)  # T / dt, [n, 1]
        passed = -jnp.expm1(-1.0 / jnp.maximum(ratio, _SHORTEST))  # 1 - exp(-dt / T)
        # y(t + dt) = q1 - T/dt (1 - a) (q1 - q0) + a (y - q0), a = exp(-dt / T), q from q0 to q1 in a line
        line = now - ratio * passed * (now - before) + (1.0 - passed) * (output - before)
        # and the parabola's part: (w1 - w0) T (T/dt (1 - a) - (1 + a) / 2)
        parabola = at.values(theta) * (ratio * passed - 1.0 + 0.5 * passed) * (now - before)[:, 1:]
        # and of velocities c s (1 - s): c (T/dt (1 + a) - 2 (T/dt)^2 (1 - a))
        faster = ratio * (2.0 - passed) - 2.0 * ratio**2 * passed
        shown = line + jnp.concatenate([parabola, faster * bend(before, now, at)[:, None]], 1)
        memory = {"input": now, "output": shown, "fresh": jnp.zeros((), bool)}
        return memory, written(at, **measurement, values=shown)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's sensors have no low pass; use effects.yaml"


def _slope(x: jax.Array) -> jax.Array:
    """Change per row of `[rows, n]` from two rows on either side, fourth order; the ends are held."""
    held = jnp.pad(x, ((2, 2), (0, 0)), mode="edge")
    return (8.0 * (held[3:-1] - held[1:-3]) - (held[4:] - held[:-4])) / 12.0
