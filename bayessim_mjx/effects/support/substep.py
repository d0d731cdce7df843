"""What an effect sees of a sub-step; traced."""

import copy
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.support.site import ranges
from bayessim_mjx.linalg import inverse, product

if TYPE_CHECKING:
    from collections.abc import Callable

    from mujoco import mjx

_CONSTANT = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtGain.mjGAIN_FIXED))
_AFFINE = (int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtGain.mjGAIN_AFFINE))


class SubStep:
    """What is known of one sub-step before its acceleration. Made while tracing; derived values are computed once.

    Attributes:
        model, data: data holds this sub-step's poses, mass matrix, qfrc_bias, qfrc_passive, actuator_force and moments.
        force: `[nv]`, passive - bias + actuators + all other effects, and what equality constraints exert where nothing
            accelerates; no other constraint forces (they are not known yet).
        actuator_force: `[nu]`, after the effects on actuators.
        ctrl: `[nu]`, the command as it reached the actuators.
        dt: s, the sub-step.
        last: `[nv]`, this effect's own force in the last sub-step.
        measurement: what the sensors showed after the last control step.
    """

    def __init__(
        self,
        model: "mjx.Model",
        data: "mjx.Data",
        measurement: dict[str, jax.Array],
        dt: float | jax.Array,
        asked: jax.Array | None = None,
        response: "Callable[[], jax.Array | None] | None" = None,
    ) -> None:
        self.model, self.data, self.measurement, self.dt = model, data, measurement, dt
        self.force = self.last = data.qfrc_applied
        self.actuator_force = data.actuator_force
        self._responding = response
        self._cache: dict[str, Any] = {} if asked is None else {"asked": asked}

    def seen_by(self, force: jax.Array, last: jax.Array) -> "SubStep":
        """Return the same sub-step with the forces that one effect sees."""
        other = copy.copy(self)
        other.force, other.last = force, last
        return other

    def ready(self, *names: str) -> "SubStep":
        """Itself, with these derived values computed: before a branch, which could not share what it computes."""
        for name in names:
            getattr(self, name)
        return self

    def within_a_branch(self) -> "SubStep":
        """Return the same sub-step, whose derived values stay in the branch; those known already are shared."""
        other = copy.copy(self)
        other._cache = dict(self._cache)
        return other

    def _once(self, name: str, compute: "Callable[[], Any]") -> Any:
        if name not in self._cache:
            self._cache[name] = compute()
        return self._cache[name]

    @property
    def ctrl(self) -> jax.Array:
        return self.data.ctrl

    @property
    def qpos(self) -> jax.Array:
        return self.data.qpos

    @property
    def qvel(self) -> jax.Array:
        return self.data.qvel

    @property
    def signal(self) -> jax.Array:
        """`[nu]`, what the actuators act on: the command within its range, or the activation where there is one."""
        model, data = self.model, self.data
        signal = jnp.clip(data.ctrl, *ranges(model.actuator_ctrllimited, model.actuator_ctrlrange))
        if not model.na:
            return signal
        last = np.clip(model.actuator_actadr + model.actuator_actnum - 1, 0, model.na - 1)
        return jnp.where(model.actuator_actadr < 0, signal, data.act[last])

    @property
    def asked(self) -> jax.Array:
        """`[nu]`, force before any limit: (k0 + k1 l + k2 l') u + b0 + b1 l + b2 l'; of muscles, as it is."""
        return self._once("asked", self._asked)

    def _asked(self) -> jax.Array:
        model, data = self.model, self.data
        terms = jnp.stack([jnp.ones(model.nu), data.actuator_length, data._impl.actuator_velocity])
        gain, bias = (jnp.sum(prm[:, :3].T * terms, 0) for prm in (model.actuator_gainprm, model.actuator_biasprm))
        fixed, none = model.actuator_gaintype == _CONSTANT[1], model.actuator_biastype == _CONSTANT[0]
        linear = (fixed | (model.actuator_gaintype == _AFFINE[1])) & (none | (model.actuator_biastype == _AFFINE[0]))
        gain, bias = jnp.where(fixed, model.actuator_gainprm[:, 0], gain), jnp.where(none, 0.0, bias)
        return jnp.where(linear, gain * self.signal + bias, data.actuator_force)

    @property
    def response(self) -> jax.Array:
        """`[nu]`, how much of a change of its damping force an actuator passes on: 1; 0 at a limit or switched off."""
        found = self._response
        return jnp.ones(self.model.nu) if found is None else found

    @property
    def _response(self) -> jax.Array | None:
        return self._once("response", self._responding or (lambda: None))

    @property
    def solved(self) -> "mjx.Model":
        """The model that an implicit integrator differentiates: actuators damp as far as they respond."""
        model = self.model
        shifted, affine = model.actuator_biastype == _AFFINE[0], model.actuator_gaintype == _AFFINE[1]
        if not np.any(shifted | affine) or self._response is None:
            return model
        gain, bias = (
            p.at[:, 2].set(p[:, 2] * self._response) for p in (model.actuator_gainprm, model.actuator_biasprm)
        )
        return model.replace(actuator_gainprm=gain, actuator_biasprm=bias)

    @property
    def inverse(self) -> jax.Array:
        """`[nv, nv]`, accelerations by forces, as integrated: inverse of M with implicit damping, in closed loops."""

        def compute() -> jax.Array:
            from mujoco import mjx

            inertia = mjx.full_m(self.model, self.data)
            free = self._damped(inertia)
            if not self.data._impl.ne:
                return inverse(free)
            # the integrator adds damping once constraints are solved without it
            within = inverse(inertia + springs(self.data)[0])
            return within if free is inertia else product(inverse(free), product(inertia, within))

        return self._once("inverse", compute)

    def _damped(self, inertia: jax.Array) -> jax.Array:
        from mujoco import mjx

        model = self.model
        integrator = int(model.opt.integrator)
        euler = integrator == int(mujoco.mjtIntegrator.mjINT_EULER)
        if euler and not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP):
            return inertia + model.opt.timestep * jnp.diag(model.dof_damping)
        implicit = integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        derivative = mjx.deriv_smooth_vel(self.solved, self.data) if implicit else None
        return inertia if derivative is None else inertia - model.opt.timestep * derivative


def springs(data: "mjx.Data") -> tuple[jax.Array, jax.Array]:
    """(J'DJ `[nv, nv]`, J'D a `[nv]`) of the equality constraints: their force on the joints is J'D (a - J qacc).

    That is MuJoCo's soft constraint without an inequality: with them M becomes M + J'DJ, whatever else acts.
    """
    ne, own = data._impl.ne, data._impl  # they are the first rows
    weighted = own.efc_J[:ne] * own.efc_D[:ne, None]
    return product(weighted.T, own.efc_J[:ne]), product(weighted.T, own.efc_aref[:ne])
