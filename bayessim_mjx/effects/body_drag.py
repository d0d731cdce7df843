"""Drag of a floating body in air or water: hulls, frames, rotors and housings that push the medium aside."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import DRAG, resisted
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class BodyDrag(Effect):
    """f = -(k + c |v|) v at the centre of mass, moment = -r w: still air or water, the same in all directions.

    v, w: velocity and angular velocity of a body with a free joint, half-way through the sub-step: stable for any
    coefficient. It adds to MuJoCo's own fluid forces (density, viscosity), which follow from the bodies' inertia.

    Parameters: `linear` k, N s/m; `quadratic` c, N s^2/m^2; `turning` r, N m s/rad; all neutral 0.
    """

    name: ClassVar[str] = "body_drag"
    kind: ClassVar[str] = "body"
    floats: ClassVar[bool] = True
    noun: ClassVar[str] = "drag of the body"
    separates: ClassVar[str] = (
        "straight runs at three constant speeds, to and fro: wind adds a force that keeps its sign"
    )
    quantities: ClassVar[tuple[Quantity, ...]] = DRAG

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        return memory, resisted(at, step, at.values(theta), jnp.zeros(3))

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return (
            "MuJoCo's drag follows from the inertia of bodies (density, viscosity), not from numbers; use effects.yaml"
        )
