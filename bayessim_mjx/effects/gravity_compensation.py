"""Gravity compensation inside the drives or their controller, which the logged commands do not contain.

Causes: a feed-forward of gravity in the firmware, springs or counterweights that carry the arm. Signs: the arm hangs
more lightly than it is, while its inertia is the modelled one; more than all of it: it is pushed up.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    from mujoco import mjx

_DRIVEN = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclasses.dataclass(frozen=True)
class GravityCompensation(Effect):
    """f = share g(q) at hinges and slides; g(q) is what holds the bodies beyond the joint against gravity.

    Parameters: `share`, no unit, neutral 0; 1: all weight is carried.
    """

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "gravity_compensation"
    kind: ClassVar[str] = "world"
    noun: ClassVar[str] = "gravity compensation"
    separates: ClassVar[str] = "holding still in several poses, and fast motion about them"
    witness: ClassVar[tuple[str, str] | None] = (
        "effort",
        "the drives' measured effort (`effort:<actuator>`), which contains the firmware's share",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("share", 0.0, -0.5, 1.5, grid=(0.05, 0.2, 0.5)),)

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        return memory, at.values(theta)[0, 0] * holding(at.mj_model, step.model, step.data)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: gravcomp of all bodies (also of those that a free joint moves, which have no drive)."""
        if any(j.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE) for j in spec.joints):
            return "MuJoCo's gravcomp carries a free base too; use effects.yaml"
        if any(own["share"] < 0 for own in values.values()):
            return "MuJoCo leaves out a negative gravcomp; use effects.yaml"
        for own in values.values():
            for body in spec.bodies[1:]:
                body.gravcomp += own["share"]
        return None


def holding(model: mujoco.MjModel, traced: "mjx.Model", data: "mjx.Data") -> jax.Array:
    """`[nv]`, force at hinges and slides that holds all bodies against gravity; 0 at other joints."""
    moved = np.array([_moves(model, body) for body in range(model.nbody)])
    arm = data.xipos - data.subtree_com[model.body_rootid]
    turn, shift = data.cdof[:, :3], data.cdof[:, 3:]
    velocity = moved[:, :, None] * (shift + jnp.cross(turn, arm[:, None]))  # of centres of mass, per unit of qvel
    weight = -traced.body_mass[:, None] * traced.opt.gravity
    return jnp.sum(velocity * weight[:, None], axis=(0, 2))


def _moves(model: mujoco.MjModel, body: int) -> np.ndarray:
    """`[nv]` bool: hinges and slides between the world and a body."""
    out = np.zeros(model.nv, bool)
    while body:
        for v in range(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body]):
            out[v] = model.jnt_type[model.dof_jntid[v]] in _DRIVEN
        body = int(model.body_parentid[body])
    return out
