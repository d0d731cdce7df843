"""A spring across joints: cables and hoses that are bent, gravity compensators, return springs. Without hysteresis."""

import dataclasses
from typing import Any, ClassVar

import jax
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import add, native
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

_RK4, _HINGE = int(mujoco.mjtIntegrator.mjINT_RK4), int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclasses.dataclass(frozen=True)
class JointSpring(Effect):
    """F = -k1 (q - q0) - k3 (q - q0)^3.

    Parameters: `stiffness` k1, N m/rad (hinge) or N/m (slide), `cubic` k3, N m/rad^3 or N/m^3, neutral 0; `rest` q0,
    rad or m, without effect where k1 = k3 = 0.
    """

    name: ClassVar[str] = "joint_spring"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "spring"
    lacks: ClassVar[str] = "a spring"
    separates: ClassVar[str] = "slow sweeps of the whole range in two mount orientations"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("stiffness", 0.0, 0.0, 10.0, unit="N m/rad", per="force/travel", reach=(0.0, 1.0)),
        Quantity("cubic", 0.0, 0.0, 10.0, unit="N m/rad^3", per="force/travel^3", reach=(0.0, 1.0)),
        Quantity("rest", 0.0, -3.2, 3.2, unit="rad", per="travel", reach=(-2.0, 2.0), grid=(0.3, 0.5, 0.7), shape=True),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        stiffness, cubic, rest = at.values(theta).T
        bend = step.qpos[at.qadr] - rest
        if int(at.mj_model.opt.integrator) == _RK4:  # holds the force over the sub-step: take it from the middle
            bend = bend + 0.5 * step.dt * step.qvel[at.dadr]
        return memory, at.scatter(-(stiffness + cubic * bend * bend) * bend)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        joints = list(native(spec, values))
        if any(own["cubic"] for _, own in joints):
            return "MuJoCo has cubic joint springs from version 4 on, but MJX ignores them; use effects.yaml"
        taken = [joint.name for joint, _ in joints if np.any(joint.stiffness)]
        if taken:
            return f"joint {', '.join(taken)} has a spring already, and MuJoCo's joints have one; use effects.yaml"
        for joint, own in joints:
            degrees = int(joint.type) == _HINGE and joint.compiler.degree
            add(joint, "stiffness", own["stiffness"])
            joint.springref = np.degrees(own["rest"]) if degrees else own["rest"]
        return None
