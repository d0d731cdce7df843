"""Drag of a floating body in air or water that moves: wind, a draught, a current."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import DRAG, resisted
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class Wind(Effect):
    """f = -(k + c |v - u|) (v - u), moment = -r w: `body_drag` in a medium of constant velocity u (world).

    Parameters: `linear` k, N s/m; `quadratic` c, N s^2/m^2; `turning` r, N m s/rad; all neutral 0; `wind_x`, `wind_y`,
    `wind_z`, m/s, without effect where the others are 0.
    """

    name: ClassVar[str] = "wind"
    kind: ClassVar[str] = "body"
    floats: ClassVar[bool] = True
    contains: ClassVar[tuple[str, ...]] = ("body_drag",)
    star: ClassVar[bool] = True
    noun: ClassVar[str] = "wind or current"
    lacks: ClassVar[str] = "wind or a current"
    separates: ClassVar[str] = "straight runs at three constant speeds, to and fro, along two directions"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        *DRAG,
        *(
            Quantity(
                f"wind_{a}",
                0.0,
                -5.0,
                5.0,
                unit="m/s",
                per="speed",
                reach=(-5.0, 5.0),
                grid=(0.3, 0.5, 0.7),
                shape=True,
            )
            for a in "xyz"
        ),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        values = at.values(theta)
        return memory, resisted(at, step, values[:, :3], values[:, 3:])

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's wind acts by drag that follows from the inertia of bodies, not from numbers; use effects.yaml"
