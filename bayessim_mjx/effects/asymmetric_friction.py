"""Friction of joints that differs by direction: worn or preloaded gears, lip seals, belts, ball screws, cables."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax

from bayessim_mjx.effects.effect import Effect, Part, Quantity
from bayessim_mjx.effects.support.friction import add, lose, native, resist
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco


NUMBERS = ("level", "viscous")  # of each direction


@dataclasses.dataclass(frozen=True)
class AsymmetricFriction(Effect):
    """F = -(a+ + b+ w) where w > 0, a- - b- w where w < 0; at rest it holds against -a- .. a+ (see `friction.resist`).

    Parameters: `level_forward` a+, `level_backward` a-, N m (hinge) or N (slide); `viscous_forward` b+,
    `viscous_backward` b-, N m s/rad or N s/m; all neutral 0.
    """

    name: ClassVar[str] = "asymmetric_friction"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "direction-dependent friction"
    separates: ClassVar[str] = "symmetric strokes both ways, in two mount orientations"
    contains: ClassVar[tuple[str, ...]] = ("coulomb_friction", "viscous_friction")
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("level_forward", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0)),
        Quantity("level_backward", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0)),
        Quantity("viscous_forward", 0.0, 0.0, 1.0, unit="N m s/rad", per="force/speed", reach=(0.0, 1.0)),
        Quantity("viscous_backward", 0.0, 0.0, 1.0, unit="N m s/rad", per="force/speed", reach=(0.0, 1.0)),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        values = at.values(theta)
        return memory, resist(at, step, level=values[:, :2], damping=values[:, 2:])

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        """Write the mean of both directions, as frictionloss and damping."""
        mean = {w: {n: (own[f"{n}_forward"] + own[f"{n}_backward"]) / 2 for n in NUMBERS} for w, own in values.items()}
        lose(spec, mean)
        for joint, own in native(spec, mean):
            add(joint, "damping", own["viscous"])
        return Part("its dependence on the direction, which MuJoCo's joints do not have; use effects.yaml")
