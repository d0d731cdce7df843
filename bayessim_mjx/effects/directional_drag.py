"""Drag of a floating body that differs by its axes: a flat hull, a long body, rotors that brake a climb."""

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
class DirectionalDrag(Effect):
    """f = -(k + c |v|) (v_x, s v_y, u v_z) in the body's axes, moment = -r w: `body_drag` with a factor for two axes.

    Parameters: `linear` k, N s/m; `quadratic` c, N s^2/m^2; `turning` r, N m s/rad; all neutral 0; `side` s and `up` u,
    no unit, drag along y and z as a multiple of that along x, without effect where the others are 0.
    """

    name: ClassVar[str] = "directional_drag"
    kind: ClassVar[str] = "body"
    floats: ClassVar[bool] = True
    contains: ClassVar[tuple[str, ...]] = ("body_drag",)
    star: ClassVar[bool] = True
    noun: ClassVar[str] = "drag that differs by direction"
    separates: ClassVar[str] = "straight runs along each axis of the body at two constant speeds"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        *DRAG,
        Quantity("side", 1.0, 0.2, 3.4, grid=(0.0, 0.25, 0.6), shape=True),
        Quantity("up", 1.0, 0.2, 3.4, grid=(0.0, 0.25, 0.6), shape=True),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        values = at.values(theta)
        axes = jnp.concatenate([jnp.ones((len(at), 1)), values[:, 3:]], axis=1)
        return memory, resisted(at, step, values[:, :3], jnp.zeros(3), axes)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return (
            "MuJoCo's drag follows from the inertia of bodies (density, viscosity), not from numbers; use effects.yaml"
        )
