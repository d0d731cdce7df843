"""Joint elasticity: a spring between motor and link (harmonic drives, belts, long shafts, series elastic actuators)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support import transmission
from bayessim_mjx.effects.support.quantity import LINK_ENCODER
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep


@dataclasses.dataclass(frozen=True)
class JointElasticity(transmission.OfTransmission, Effect):
    """J w_m' = tau - d_j w_m - s, link moved by s = k (q_m - q) + d (w_m - w), d = 2 zeta sqrt(k J_s).

    The actuators turn the motor, whose inertia J is the joint's armature (taken off the link), or a fifth of what is
    felt at the joint where the model has none; J_s is the inertia of motor against link. The sensors show the link,
    or the motor; position servos see the motor. The joint's damping d_j is the motor's; its friction stays with the
    link. At the start the spring is wound up by the torque that a rigid joint would pass on, or as the recording before
    it says.

    Parameters: `compliance` 1/k, rad/(N m) (hinge) or m/N (slide), neutral 0; `damping` zeta and the optional `encoder`
    (0 on the link, 1 on the motor), without effect where the compliance is 0.
    """

    name: ClassVar[str] = "joint_elasticity"
    kind: ClassVar[str] = "joint"
    mark: ClassVar[float] = 2.0**-20
    noun: ClassVar[str] = "elastic transmission"
    lacks: ClassVar[str] = "an elastic transmission"
    separates: ClassVar[str] = "a chirp beyond the suspected resonance; known static loads with the motor held"
    witness = LINK_ENCODER
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "compliance", 0.0, 0.0, 0.05, unit="rad/(N m)", per="1/force", reach=(0.0, 0.3), grid=(0.01, 0.03, 0.1, 0.3)
        ),
        Quantity("damping", 0.1, 0.02, 1.5, grid=(0.05,), shape=True),
        transmission.ENCODER,
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        on = self.on(at, theta)
        both = transmission.sides(at, memory, step, on, self.mark)
        compliance, ratio, *_ = at.values(theta).T
        soft = jnp.where(on & ~memory["fresh"], compliance, 0.0)
        spring = transmission.sprung(at, both, step.dt, soft, ratio)
        passed = transmission.transmit(both, step.dt, spring, jnp.zeros(len(at)), on)
        twist = jnp.where(memory["fresh"], compliance * passed.torque, both.twist)
        return transmission.finish(at, memory, step, both, passed, twist, spring.share, self.encoder(at, theta))
