"""Viscous friction of joints: grease, bearings, seals, and the eddy currents or back-EMF of a short-circuited motor."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support import friction
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class ViscousFriction(Effect):
    """F = -b w.

    Where the integrator treats joint damping implicitly (Euler, implicitfast) it is MuJoCo's own damping; elsewhere
    (RK4) a force with the speed at the end of the sub-step, `friction.viscous`. Either way stable for any b dt / M.

    Parameters: `damping` b, N m s/rad (hinge) or N s/m (slide), neutral 0.

    Attributes:
        high: upper limit of b, unless `parameters` has another range.
    """

    high: float = 1.0
    name: ClassVar[str] = "viscous_friction"
    kind: ClassVar[str] = "joint"
    effort: ClassVar[str] = "speed"
    noun: ClassVar[str] = "viscous friction"
    separates: ClassVar[str] = "a staircase of constant speeds; swings with the drive off separate it from back-EMF"
    witness: ClassVar[tuple[str, str] | None] = (
        "temperature",
        "temperature of motor or gearbox (`temperature`): grease thins as it warms",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("damping", 0.0, 0.0, 1.0, unit="N m s/rad", per="force/speed", reach=(0.0, 1.0)),
    )

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        if not _implicit(at.mj_model):
            return model
        return model.replace(dof_damping=model.dof_damping.at[at.dadr].add(at.values(theta)[:, 0]))

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        if _implicit(at.mj_model):
            return memory, jnp.zeros_like(step.force)
        return memory, friction.viscous(at, step, at.values(theta)[:, 0])

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        for joint, own in friction.native(spec, values):
            friction.add(joint, "damping", own["damping"])
        return None


def _implicit(model: mujoco.MjModel) -> bool:
    """Whether the integrator solves joint damping implicitly."""
    flags, integrator = int(model.opt.disableflags), int(model.opt.integrator)
    if flags & int(mujoco.mjtDisableBit.mjDSBL_DAMPER):
        return False
    if integrator == int(mujoco.mjtIntegrator.mjINT_EULER):
        return not flags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    return integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
