"""Gravity tilt: the robot stands or hangs a little askew, so that gravity points elsewhere in its frame.

Causes: a sloping floor or table, a mount that is not levelled, a mounting angle that was measured by eye.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import tilted
from bayessim_mjx.effects.support.site import Site

if TYPE_CHECKING:
    import mujoco
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class GravityTilt(Effect):
    """g' = Rx(-roll) Ry(-pitch) g: gravity as seen from a robot tilted by two angles.

    Parameters: `roll`, `pitch`, rad, about the world's x and y axes, neutral 0. On a floor: the floor slopes along.
    """

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "gravity_tilt"
    kind: ClassVar[str] = "world"
    noun: ClassVar[str] = "tilted base"
    lacks: ClassVar[str] = "the tilt of the base"
    separates: ClassVar[str] = "two mount orientations; a spirit level or an IMU on the base"
    witness: ClassVar[tuple[str, str] | None] = ("imu", "an IMU at rest on the base (`imu:...`)")
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("roll", 0.0, -0.1, 0.1, unit="rad"),
        Quantity("pitch", 0.0, -0.1, 0.1, unit="rad"),
    )

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        roll, pitch = at.values(theta)[0]
        return model.tree_replace({"opt.gravity": tilted(model.opt.gravity, roll, pitch)})

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        for own in values.values():
            spec.option.gravity = tilted(jnp.asarray(spec.option.gravity), own["roll"], own["pitch"])
        return None
