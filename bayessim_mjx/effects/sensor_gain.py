"""Sensor gain: an encoder or potentiometer of the wrong scale, or a gear ratio that is not what the driver believes."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax

from bayessim_mjx.effects.effect import Effect, Measurement, Quantity
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site, columns, written
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class SensorGain(Effect):
    """measured = g q, g w. Only what is shown: a servo's own loop runs on the true angle.

    Parameters: `gain` g, > 0, dimensionless, neutral 1.
    """

    name: ClassVar[str] = "sensor_gain"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "wrong sensor gain"
    lacks: ClassVar[str] = "the true sensor gain"
    separates: ClassVar[str] = "two positions known from outside (stops, a gauge)"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("gain", 1.0, 0.8, 1.2),)

    def check(self) -> None:
        super().check()
        for p in self.space().parameters:
            if p.low <= 0:
                raise UserError(f"{p.name}: range begins at {p.low:g}; allowed: above 0")

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        true = columns(at, motion.qpos, motion.qvel) / at.values(theta)
        return memory, motion.replace(**written(at, motion.qpos, motion.qvel, true))

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        shown = columns(at, **measurement) * at.values(theta)
        return memory, written(at, **measurement, values=shown)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's joint sensors have no scale; use effects.yaml"
