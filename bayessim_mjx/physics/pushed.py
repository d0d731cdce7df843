"""Generalised forces of effects, in one timestep."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.physics.drive import Drive
from bayessim_mjx.physics.gates import chained
from bayessim_mjx.physics.model import IMPLICITFAST, Physics

Memory = tuple[tuple, jax.Array]  # (memories of the effects, their last forces [effects, nv])


def pushed(
    physics: Physics, thetas: tuple[jax.Array, ...], drive: Drive, data: mjx.Data, carry: Memory, step: SubStep
) -> tuple[mjx.Data, Memory]:
    """The sum of the effects' own forces in qfrc_applied.

    Each effect sees the newest forces of the others (Gauss-Seidel). They start from those of the last sub-step, so that
    dry friction in several coupled joints settles to sticking.
    """
    if not physics.effects and drive.force is None:
        return data, carry
    memory, forces = carry
    outside = jnp.zeros_like(data.qfrc_applied) if drive.force is None else drive.force
    known = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + outside
    forcing = physics.having("on_force")

    def hook(step: SubStep, i: int, of_effect: tuple, total: jax.Array) -> tuple[tuple, jax.Array]:
        remembered, last = of_effect
        others = total - last
        seen = step.seen_by(known + others, last)
        remembered, force = physics.effects[i].on_force(physics.sites[i], remembered, seen, thetas[i])
        return (remembered, force), others + force

    # a branch copies what it returns: only what may change goes through it
    each, total = tuple((memory[i], forces[i]) for i in forcing), sum((forces[i] for i in forcing), jnp.zeros_like(known))
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
    if forcing:  # row by row: a scatter is a loop over the effects on a CPU, a third of a small robot's step
        forces = jnp.stack([after[i][1] if i in after else own for i, own in enumerate(forces)])
    return data.replace(qfrc_applied=total + outside), (remembered, forces)


__all__ = ["Memory", "pushed"]
