"""Backlash: play between motor and link (gear teeth, splines, keys, worn couplings)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support import transmission
from bayessim_mjx.effects.support.quantity import LINK_ENCODER
from bayessim_mjx.effects.support.site import Site, staggered
from bayessim_mjx.effects.support.substep import SubStep

RATIO = 0.7  # damping of the teeth, of critical: "teeth do not bounce"; not counted
TEETH = Quantity(
    "compliance", 0.0, 0.0, 0.01, unit="rad/(N m)", per="1/force", reach=(0.0, 0.03), grid=(0.0, 0.1), shape=True,
    optional=True,
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Backlash(transmission.OfTransmission, Effect):
    """The motor turns freely within +-gap around the link; at its ends the teeth push, never pull.

    J w_m' = tau - d w_m - s, link moved by s, |q_m - q| <= gap, s = 0 inside. The motor is that of `joint_elasticity`:
    its inertia J is the joint's armature, or a fifth of what is felt at the joint, d the joint's damping. The sensors
    show the link, or the motor; position servos see the motor. Teeth do not bounce. At the start the load has pushed
    the motor to one end of the gap; where a recording leads up to the start, it is where this brought it.

    Parameters: `gap`, half of the play, rad (hinge) or m (slide), neutral 0; the optional `compliance` of the teeth,
    rad/(N m) or m/N, and `encoder` (0 on the link, 1 on the motor), without effect where the gap is 0.
    """

    name: ClassVar[str] = "backlash"
    kind: ClassVar[str] = "joint"
    mark: ClassVar[float] = 2.0**-40
    noun: ClassVar[str] = "backlash"
    separates: ClassVar[str] = "slow triangles with and without gravity's pre-load, a link-side encoder"
    witness = LINK_ENCODER
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("gap", 0.0, 0.0, 0.05, unit="rad", per="travel", reach=(0.0, 0.1), grid=(0.03, 0.1, 0.4), half="play"),
        TEETH,
        transmission.ENCODER,
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        on, gap, fresh = self.on(at, theta), at.values(theta)[:, 0], memory["fresh"]
        both = transmission.sides(at, memory, step, on, self.mark)
        none = jnp.zeros(len(at))
        soft = at.values(theta)[:, 1] if TEETH in self.quantities else none
        teeth = transmission.sprung(at, both, step.dt, jnp.where(fresh, 0.0, soft), RATIO)

        def solve(side: jax.Array) -> transmission.Passed:
            rest = jnp.where(fresh, 0.0, gap * side)
            return transmission.transmit(both, step.dt, teeth, rest, on & (fresh | (side != 0)))

        free = none + (1.0 if staggered(at.mj_model) else 0.5)
        way = (1.0 - free) * both.slip + free * solve(none).slip
        twist = both.twist + step.dt * way  # if nothing touched
        side = jnp.where(jnp.abs(twist) > gap, jnp.sign(twist), 0.0)
        side = jnp.where(solve(side).torque * side > 0, side, 0.0)
        passed, share = solve(side), jnp.where(fresh | (side != 0), teeth.share, free)
        twist = jnp.where(fresh, gap * jnp.sign(passed.torque) + soft * passed.torque, both.twist)
        return transmission.finish(at, memory, step, both, passed, twist, share, self.encoder(at, theta))
