"""Armature: inertia of the motor's rotor, seen through the gear (times the gear ratio squared), and of the gear."""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import add, native
from bayessim_mjx.effects.support.site import Site

if TYPE_CHECKING:
    import mujoco
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class Armature(Effect):
    """F = -J dw/dt: the joint's diagonal of the mass matrix grows by J, with what MuJoCo derives from it.

    Parameters: `inertia` J, kg m^2 (hinge) or kg (slide), on top of the model's own armature, neutral 0.

    Attributes:
        high: upper limit of J, unless `parameters` has another range.
    """

    high: float = 1.0
    name: ClassVar[str] = "armature"
    kind: ClassVar[str] = "joint"
    effort: ClassVar[str] = "acceleration"
    inertial: ClassVar[bool] = True
    noun: ClassVar[str] = "added rotor inertia"
    lacks: ClassVar[str] = "rotor inertia"
    separates: ClassVar[str] = (
        "fast chirps in two poses of the other joints, which change the link's inertia but not the rotor's"
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("inertia", 0.0, 0.0, 1.0, unit="kg m^2", per="inertia", reach=(0.0, 1.5)),
    )

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        return model.replace(dof_armature=model.dof_armature.at[at.dadr].add(at.values(theta)[:, 0]))

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        for joint, own in native(spec, values):
            add(joint, "armature", own["inertia"])
        return None
