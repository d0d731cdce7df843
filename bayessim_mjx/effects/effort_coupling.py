"""Coupled drives: part of an actuator's effort arrives at a neighbouring joint too.

Causes: differentials of wrists, hips and ankles, tendons and belts that run over another joint's axle, a motor that is
fixed to the wrong side of a joint. Sign: a joint moves, or its drive has to hold, whenever its neighbour's is at work.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.site import Site, ranges
from bayessim_mjx.effects.support.substep import SubStep

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


@dataclasses.dataclass(frozen=True)
class EffortCoupling(Effect):
    """F_next = to_next tau, F_previous = to_previous tau; tau is what the actuator exerts on its own joint.

    Neighbours are the nearest hinge or slide towards the base (previous) and the first one behind the joint (next);
    where there is none, nothing arrives. tau comes after the effects on actuators. Where the joint's limit of force
    cuts the sum of what acts there, each actuator loses in proportion. Gravity compensation is the joint's, not tau's.

    Parameters: `to_next`, `to_previous`, N m/(N m) (from a slide to a hinge N m/N), neutral 0.
    """

    name: ClassVar[str] = "effort_coupling"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "coupling to a neighbouring joint"
    lacks: ClassVar[str] = "a coupling to a neighbouring joint"
    separates: ClassVar[str] = "one drive at work while its neighbour holds, then is off"
    witness: ClassVar[tuple[str, str] | None] = ("effort", "torque sensors on the link side of both joints")
    tied: ClassVar[bool] = False
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("to_next", 0.0, -1.0, 1.0, grid=(0.01, 0.05, 0.3)),
        Quantity("to_previous", 0.0, -1.0, 1.0, grid=(0.01, 0.05, 0.3)),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        driven, column = at.dadr >= 0, np.maximum(at.dadr, 0)
        own = step.actuator_force[at.ids] * step.data._impl.actuator_moment[at.ids, column]
        tau = jnp.where(driven, own * _passed(at.mj_model, step)[column], 0.0)
        near = neighbours(at.mj_model)[column]
        force = jnp.zeros_like(step.force)
        for side, share in zip(near.T, at.values(theta).T, strict=True):
            reached = jnp.asarray((side >= 0) & driven)
            force = force.at[np.maximum(side, 0)].add(jnp.where(reached, share * tau, 0.0))
        return memory, force

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's actuators at a joint act on that joint alone; use effects.yaml"


def _passed(model: mujoco.MjModel, step: SubStep) -> jax.Array:
    """`[nv]`, the share of what acts at a joint (actuators, gravity compensation) that its limit of force lets pass."""
    data = step.data
    if not np.any(model.jnt_actfrclimited):
        return jnp.ones(model.nv)
    acting = step.actuator_force @ data._impl.actuator_moment
    if step.model.flg_gravcomp:
        acting = acting + data.qfrc_gravcomp * model.jnt_actgravcomp[model.dof_jntid]
    low, high = ranges(step.model.jnt_actfrclimited, step.model.jnt_actfrcrange)
    low, high = low[model.dof_jntid], high[model.dof_jntid]
    cut = ((acting < low) | (acting > high)) & (acting != 0)
    return jnp.where(cut, jnp.clip(acting, low, high) / jnp.where(cut, acting, 1.0), 1.0)


def neighbours(model: mujoco.MjModel) -> np.ndarray:
    """`[nv, 2]`, columns in qvel of the next and the previous hinge or slide of each; -1: none, and of other joints."""
    found = np.full((model.nv, 2), -1)
    single = [j for j in range(model.njnt) if int(model.jnt_type[j]) in (_HINGE, _SLIDE)]
    for joint in single:
        dof, before = int(model.jnt_dofadr[joint]), _before(model, joint)
        if before in single:
            other = int(model.jnt_dofadr[before])
            found[dof, 1] = other
            found[other, 0] = dof if found[other, 0] < 0 else found[other, 0]
    return found


def _before(model: mujoco.MjModel, joint: int) -> int:
    """Find the joint before one on the way to the world, of whatever type; -1: none."""
    body = int(model.jnt_bodyid[joint])
    if joint > model.body_jntadr[body]:
        return joint - 1
    while body:
        body = int(model.body_parentid[body])
        if model.body_jntnum[body]:
            return int(model.body_jntadr[body] + model.body_jntnum[body] - 1)
    return -1
