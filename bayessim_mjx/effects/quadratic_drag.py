"""Quadratic drag of joints: air, water or oil that is pushed aside, fans and propellers on the shaft."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import viscous
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class QuadraticDrag(Effect):
    """F = -c w |w|, as -c |w at the start| (w at the end) of a sub-step: never reverses the motion, stable for any c.

    For a coasting body of constant inertia this is exact: 1 / w grows by c dt / M.

    Parameters: `coefficient` c, N m s^2/rad^2 (hinge) or N s^2/m^2 (slide), neutral 0.

    Attributes:
        high: upper limit of c, unless `parameters` has another range.
    """

    high: float = 1.0
    name: ClassVar[str] = "quadratic_drag"
    kind: ClassVar[str] = "joint"
    effort: ClassVar[str] = "drag"
    noun: ClassVar[str] = "quadratic drag"
    separates: ClassVar[str] = "a range of speeds of five to one or more"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("coefficient", 0.0, 0.0, 1.0, unit="N m s^2/rad^2", per="force/speed^2", reach=(0.0, 1.0)),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        return memory, viscous(at, step, at.values(theta)[:, 0] * jnp.abs(step.qvel[at.dadr]))

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo has quadratic joint damping from version 4 on, but MJX ignores it; use effects.yaml"
