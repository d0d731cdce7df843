"""Tension of a cable or hose across joints: it hangs slack up to an angle, and is stretched beyond.

Causes: cables that are too short, hoses, straps, springs that only pull. Sign: a force on one side of an angle that
grows with the way beyond it, whatever the speed; none on the other side.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import add, native
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_FAR = 1e10  # rad or m, a length that is never reached


@dataclasses.dataclass(frozen=True)
class CableTension(Effect):
    """F = -kf max(q - q0, 0) + kb max(q0 - q, 0).

    With kf = kb it is a `joint_spring` without its cubic part; with one of them 0 a single cable.

    Parameters: `forward` kf and `backward` kb, N m/rad (hinge) or N/m (slide), not below 0, neutral 0; `taut` q0, rad
    or m, where the cable is straight, without effect where kf = kb = 0.
    """

    name: ClassVar[str] = "cable_tension"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "cable tension"
    lacks: ClassVar[str] = "the tension of a cable"
    separates: ClassVar[str] = "slow sweeps of the whole range, well to both sides of the angle where the cable is taut"
    # logs that stay on one side of the angle cannot tell it from a spring, those near it hardly from a payload
    offered: ClassVar[bool] = False
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("forward", 0.0, 0.0, 10.0, unit="N m/rad", per="force/travel", reach=(0.0, 5.0), grid=(0.05,)),
        Quantity("backward", 0.0, 0.0, 10.0, unit="N m/rad", per="force/travel", reach=(0.0, 5.0), grid=(0.05,)),
        Quantity(
            "taut", 0.0, -3.2, 3.2, unit="rad", per="travel", reach=(-2.0, 2.0), grid=(0.35, 0.5, 0.65), shape=True
        ),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        forward, backward, taut = at.values(theta).T
        beyond = step.qpos[at.qadr] - taut
        if int(at.mj_model.opt.integrator) == _RK4:  # holds the force over the sub-step: take it from the middle
            beyond = beyond + 0.5 * step.dt * step.qvel[at.dadr]
        return memory, at.scatter(-jnp.where(beyond > 0, forward, backward) * beyond)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: tendons along the joint, whose springs have no force within a range of lengths."""
        for joint, own in native(spec, values):
            for name, slack in (("forward", (-_FAR, own["taut"])), ("backward", (own["taut"], _FAR))):
                if own[name]:
                    tendon = spec.add_tendon(name=f"{joint.name}.cable_tension.{name}", springlength=slack)
                    tendon.wrap_joint(joint.name, 1.0)
                    add(tendon, "stiffness", own[name])
        return None
