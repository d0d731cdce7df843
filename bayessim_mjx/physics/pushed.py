"""Generalised forces of effects, in one timestep."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.substep import SubStep, springs
from bayessim_mjx.physics.controllers import Drive
from bayessim_mjx.physics.gates import chained
from bayessim_mjx.physics.model import IMPLICITFAST, Physics

Memory = tuple[tuple, tuple]  # (memories of the effects, last forces [nv] of those that exert any)


def apart(physics: Physics, forces: jax.Array) -> tuple[jax.Array, ...]:
    """`[effects, nv]` -> `[nv]` of each effect that exerts a force, as a control step's timesteps carry them.

    Together they would be taken apart in each timestep: a third of a small robot's on a CPU.
    """
    return tuple(forces[i] for i in physics.having("on_force"))


def together(physics: Physics, rows: tuple[jax.Array, ...]) -> jax.Array:
    """Return the inverse of `apart`."""
    nothing = jnp.zeros(physics.mj_model.nv)
    each = dict(zip(physics.having("on_force"), rows, strict=True))
    every = [each.get(i, nothing) for i in range(len(physics.effects))]
    return jnp.stack(every) if every else jnp.zeros((0, physics.mj_model.nv))


def felt(data: mjx.Data, beside: jax.Array) -> jax.Array:
    """Generalised force `[nv]` that effects see: passive, bias, actuators, equality constraints, and the one beside."""
    known = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + beside
    return known + springs(data)[1] if data._impl.ne else known


def pushed(
    physics: Physics, thetas: tuple[jax.Array, ...], drive: Drive, data: mjx.Data, carry: Memory, step: SubStep
) -> tuple[mjx.Data, Memory]:
    """Return the sum of the effects' own forces in qfrc_applied.

    Each effect sees the newest forces of the others (Gauss-Seidel). They start from those of the last sub-step, so that
    dry friction in several coupled joints settles to sticking.
    """
    if not physics.effects and drive.force is None:
        return data, carry
    memory, last = carry
    outside = jnp.zeros_like(data.qfrc_applied) if drive.force is None else drive.force
    known = felt(data, outside)
    forcing = physics.having("on_force")

    def hook(step: SubStep, i: int, of_effect: tuple, total: jax.Array) -> tuple[tuple, jax.Array]:
        remembered, last = of_effect
        others = total - last
        seen = step.seen_by(known + others, last)
        remembered, force = physics.effects[i].on_force(physics.sites[i], remembered, seen, thetas[i])
        return (remembered, force), others + force

    # a branch copies what it returns: only what may change goes through it
    each, total = tuple(zip((memory[i] for i in forcing), last, strict=True)), sum(last, jnp.zeros_like(known))
    if drive.active is None:
        each, total = chained(None, forcing, functools.partial(hook, step), each, total)
    elif forcing:
        if int(physics.mj_model.opt.integrator) == IMPLICITFAST:
            step.ready("solved")  # the integrator asks for it in any case

        def acting() -> tuple[tuple, jax.Array]:
            inside = step.within_a_branch().ready("asked", "response", "inverse")
            return chained(drive.active, forcing, functools.partial(hook, inside), each, total)

        each, total = jax.lax.cond(jnp.any(drive.active[np.asarray(forcing)]), acting, lambda: (each, total))
    after = dict(zip(forcing, each, strict=True))
    remembered = tuple(after[i][0] if i in after else own for i, own in enumerate(memory))
    return data.replace(qfrc_applied=total + outside), (remembered, tuple(force for _, force in each))


__all__ = ["Memory", "apart", "felt", "pushed", "together"]
