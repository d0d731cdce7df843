"""Dry and viscous friction with real sticking, shared by the friction effects; and the joints they are written into."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    from collections.abc import Iterator

SWEEPS = 2
DMIN, DMAX = 0.9, 0.95  # MuJoCo's default solimp
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def resist(at: Site, step: SubStep, level: jax.Array, damping: jax.Array, soft: "Soft | None" = None) -> jax.Array:
    """Generalised force `[nv]` of friction that opposes the motion and never reverses it.

    F = -(level + damping |w|) sgn(w), w at the *end* of the sub-step (implicit: stable for any damping). At rest F is
    whatever holds the joint, up to the level. Coupled joints: projected Gauss-Seidel from the forces of the last
    sub-step. Forces of limits and contacts are not known yet: a joint that rests against a stop may creep within one
    sub-step.

    Args:
        level: `[n, 2]` >= 0, dry friction against forward (w > 0) and against backward motion, N m (hinge) or N.
        damping: `[n, 2]` >= 0, likewise, N m s/rad or N s/m.
        soft: how dry friction yields below its level; None: it holds at once and for good.
    """
    inverse, dt = step.inverse, step.dt
    force = step.last[at.dadr]
    pull = step.force + at.scatter(force)
    speed = step.qvel + dt * (inverse * pull).sum(-1)  # at the end of the sub-step
    for _ in range(SWEEPS if len(at) > 1 else 1):
        for i, dof in enumerate(at.dadr):
            gain = dt * inverse[dof, dof]  # dw/dF
            stop = force[i] - speed[dof] / gain  # the force that would bring the joint to rest
            asked = stop if soft is None else soft(i, stop, gain)
            # no clip: at level 0 its derivative in the level would be lost
            held = jnp.where(asked < -level[i, 0], -level[i, 0], jnp.where(asked > level[i, 1], level[i, 1], asked))
            left = gain * (held - stop)  # the speed that dry friction leaves; 0 where it holds
            slope = jnp.where(left > 0, damping[i, 0], damping[i, 1])
            new = held - slope * left / (1.0 + gain * slope)
            speed = speed + dt * inverse[:, dof] * (new - force[i])
            force = force.at[i].set(new)
    return at.scatter(force)


class Soft:
    """MuJoCo's friction as a soft constraint: below its level F = -(dw/dt + b w) / R.

    So a joint that it holds gives way to a load slowly, and comes to rest within some 1 / b = dmax T / 2, T the time
    constant in its solref. R = (1 - dmin) / dmin times the joint's inverse inertia in the model's rest pose. MuJoCo's
    documentation, "Computation", constraint model. Here w is the speed at the end of the sub-step, so as T goes to 0 it
    is rigid.

    Args:
        constant: `[n]` T, s; dmin, dmax: of its solimp, numbers or `[n]`.
    """

    def __init__(
        self, at: Site, step: SubStep, constant: jax.Array, dmin: ArrayLike = DMIN, dmax: ArrayLike = DMAX
    ) -> None:
        self.speed, self.dt = step.qvel[at.dadr], step.dt
        self.weak = (1 - dmin) / dmin * step.model.dof_invweight0[at.dadr]
        time = dmax / 2 * constant
        self.time = time * (time + step.dt / 2) / (time + step.dt)  # an implicit sub-step lags by half of it

    def __call__(self, i: int, stop: jax.Array, gain: jax.Array) -> jax.Array:
        """Force below the level, where `stop` would bring the joint to rest and gain is dw/dF."""
        stiff, time = gain * (self.time[i] + self.dt), self.time[i]
        return (stiff * stop + time * self.speed[i]) / (stiff + self.weak[i] * self.dt * time)


def dry(at: Site, step: SubStep, level: jax.Array, soft: Soft | None = None) -> jax.Array:
    """Generalised force `[nv]` of dry friction up to `level` `[n]` (>= 0) in both directions; see `resist`."""
    both = jnp.stack([level, level], axis=-1)
    return resist(at, step, both, jnp.zeros_like(both), soft)


def viscous(at: Site, step: SubStep, damping: jax.Array) -> jax.Array:
    """Generalised force `[nv]` of viscous friction `damping` `[n]` (>= 0), implicit; see `resist`."""
    both = jnp.stack([damping, damping], axis=-1)
    return resist(at, step, jnp.zeros_like(both), both)


def native(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> "Iterator[tuple[Any, dict[str, float]]]":
    """(joint of the spec, its values) for every place of an effect on joints; "all": every hinge and slide."""
    for place, own in values.items():
        for joint in spec.joints:
            everywhere = place == "all" and int(joint.type) in _SINGLE
            if everywhere or place in (joint.name, f"joint{joint.id}"):
                yield joint, own


def lose(spec: mujoco.MjSpec, levels: dict[str, dict[str, float]]) -> None:
    """Write dry friction, `levels[place]["level"]`, with its relaxation: MuJoCo allows two timesteps at the least."""
    for joint, own in native(spec, levels):
        if own["level"]:
            add(joint, "frictionloss", own["level"])
            joint.solref_friction = [max(own.get("relaxation", 0.0), 2.0 * spec.option.timestep), 1.0]


def add(joint: Any, field: str, value: float) -> None:
    """Add to a number of a spec's joint; in MuJoCo 4 some are polynomials, and the first number is the linear one."""
    number = np.array(getattr(joint, field), float)
    number.flat[0] += value
    setattr(joint, field, number if number.ndim else float(number))
