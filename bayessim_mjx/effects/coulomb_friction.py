"""Coulomb (dry) friction of one joint, with real sticking.

The friction of a sub-step is the force that would bring the joint to rest at the end of the sub-step, limited to the
friction level: it holds a resting joint exactly and never reverses its motion. Unlike MuJoCo's frictionloss it is not
a soft constraint, needs no solver rows, and its level may be zero.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.effects.effect import Effect, index_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace

if TYPE_CHECKING:
    from mujoco import mjx

    from bayessim_mjx.physics import Physics


@dataclasses.dataclass(frozen=True)
class CoulombFriction(Effect):
    """Dry friction of the hinge or slide joint `where`.

    Parameters: `level`, N m (hinge) or N (slide), neutral 0.
    Constraint forces (contacts, limits) are not known when friction is computed: a joint that rests against a limit or
    is loaded through a contact may creep within one sub-step by what the contact alone would do.

    Attributes:
        high: upper limit of the level, N m or N, unless `parameters` has another range.
    """

    high: float = 1.0
    name: ClassVar[str] = "coulomb_friction"

    def __post_init__(self) -> None:
        if not 0 < self.high < math.inf:
            raise UserError(f"{self.name}: high = {self.high}, must be positive and finite")
        if (low := self.space().parameters[0].low) < 0:
            raise UserError(f"{self.where}.{self.name}.level: range begins at {low:g}; friction is never negative")

    def defaults(self) -> ParameterSpace:
        label = f"{self.where}.{self.name}.level"
        level = Parameter(label, 0.0, 0.0, self.high, unit="N m", attribute="level", target=self.where, kind="effect")
        return ParameterSpace([level])

    def init(self, physics: "Physics") -> Any:
        """The joint's velocity direction, `[nv]`, one-hot."""
        model = physics.mj_model
        names = [model.joint(i).name for i in range(model.njnt)]
        joint = index_of("joint", self.where, names, self.name)
        if int(model.jnt_type[joint]) not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
            raise ValueError(f"{self.name}: joint {self.where!r} is neither hinge nor slide")
        return (jnp.arange(model.nv) == model.jnt_dofadr[joint]).astype(jnp.float32)

    def on_force(self, memory: Any, model: "mjx.Model", data: "mjx.Data", theta: jax.Array) -> tuple[Any, jax.Array]:
        direction, dt = memory, model.opt.timestep
        smooth = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_applied
        # the integrator solves M' a = f; column M'^-1 e gives (M'^-1 f)_i and (M'^-1)_ii at once
        column = jnp.linalg.solve(_inertia(model, data), direction)
        speed = direction @ data.qvel + dt * (column @ smooth)  # at the end of the sub-step, without friction
        stop = -speed / (dt * (direction @ column))
        force = jnp.clip(stop, -theta[0], theta[0])
        return memory, jnp.where(theta[0] > 0, force, 0.0) * direction


def _inertia(model: "mjx.Model", data: "mjx.Data") -> jax.Array:
    """The matrix `[nv, nv]` the integrator inverts: M plus the implicit damping."""
    from mujoco import mjx

    inertia = mjx.full_m(model, data)
    implicit = int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    euler = int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_EULER)
    if euler and not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP):
        return inertia + model.opt.timestep * jnp.diag(model.dof_damping)
    derivative = mjx.deriv_smooth_vel(model, data) if implicit else None
    return inertia if derivative is None else inertia - model.opt.timestep * derivative
