"""Dry friction with real sticking, shared by the friction effects."""

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.site import Site, SubStep

SWEEPS = 2


def dry(at: Site, step: SubStep, level: jax.Array) -> jax.Array:
    """Generalised force `[nv]` of dry friction up to `level` `[n]` (>= 0) at the joints of the site.

    The force of a sub-step is the one that would bring the joints to rest at its end, limited to the level: it holds a
    resting joint exactly and never reverses its motion. Coupled joints: projected Gauss-Seidel from the forces of the
    last sub-step. Constraint forces are not known yet: a joint that rests against a stop may creep within one sub-step.
    """
    inverse, dt = step.inverse, step.dt
    force = step.last[at.dadr]
    pull = step.force + at.scatter(force)
    speed = step.qvel + dt * (inverse * pull).sum(-1)  # at the end of the sub-step
    for _ in range(SWEEPS if len(at) > 1 else 1):
        for i, dof in enumerate(at.dadr):
            new = jnp.clip(force[i] - speed[dof] / (dt * inverse[dof, dof]), -level[i], level[i])
            speed = speed + dt * inverse[:, dof] * (new - force[i])
            force = force.at[i].set(new)
    return at.scatter(jnp.where(level > 0, force, 0.0))

