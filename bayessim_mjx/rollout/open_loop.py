"""Logged commands in simulation, open loop, from measured states."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.compat import brief
from bayessim_mjx.effects.support.motion import AROUND, PAST, Motion
from bayessim_mjx.physics import Drive, Physics, control_step, retraced
from bayessim_mjx.physics.controllers import Law


def replay(
    physics: Physics,
    qpos0: jax.Array,
    qvel0: jax.Array,
    command: jax.Array,
    thetas: jax.Array,
    around: Motion | None = None,
    law: Law | None = None,
) -> dict[str, jax.Array]:
    """Open loop: the commands [N, T, nu] from measured states [N, nq], [N, nv] in the worlds thetas [N, d].

    It begins as `physics.retraced`: in the true state behind the measured one, with memories filled by what was
    recorded before.

    Args:
        around: the recording around the starts (leaves [N, rows, ...]), moved as a whole so that it goes through them;
            None: nothing is known but the start.
        law: controllers between commands and actuators (leaves [N, nu]); None: there are none.

    Returns:
        the measurements {"qpos": [N, T+1, nq], "qvel": [N, T+1, nv]}, row 0 at the start.
    """
    arrays = [jnp.asarray(x, jnp.float32) for x in (qpos0, qvel0, command, thetas)]
    shapes = [x.shape for x in arrays]
    if [len(s) for s in shapes] != [2, 2, 3, 2] or len({s[0] for s in shapes}) != 1:
        raise ValueError(
            f"qpos0 {shapes[0]}, qvel0 {shapes[1]}, command {shapes[2]}, thetas {shapes[3]}: "
            "expected [N, nq], [N, nv], [N, T, nu], [N, d] with the same N"
        )
    return _replay(physics)(*arrays, around, law)


@lru_cache(maxsize=32)
def _replay(physics: Physics) -> Callable[..., dict[str, jax.Array]]:
    def one(
        qpos: jax.Array, qvel: jax.Array, command: jax.Array, theta: jax.Array, around: Motion | None, law: Law | None
    ) -> dict[str, jax.Array]:
        drive = Drive(law=law)
        world = started(physics, theta, qpos, qvel, command, around, drive)

        def step(world: Any, command: jax.Array) -> tuple[Any, dict]:
            world, _ = control_step(physics, world, command, drive)
            return world, world.measurement

        _, after = jax.lax.scan(step, world, command)
        return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), world.measurement, after)

    return brief(jax.vmap(one), level=None)  # an effect at neutral changes no bit


def started(
    physics: Physics,
    theta: jax.Array,
    qpos: jax.Array,
    qvel: jax.Array,
    command: jax.Array,
    around: Motion | None,
    drive: Drive = Drive(),  # noqa: B008  # immutable
) -> Any:
    """Start the world theta [d] before the commands [T, nu], in the true state behind measured qpos [nq], qvel [nv].

    around: as in `replay`, of one start; None: the first command was held.
    """
    if around is None:
        around = Motion(qpos[None], qvel[None], _throughout(physics, command[:1]), start=0)
    moved = [x + (own - x[around.start]) for x, own in ((around.qpos, qpos), (around.qvel, qvel))]
    return retraced(physics, theta, around.replace(qpos=moved[0], qvel=moved[1]), drive)


def _throughout(physics: Physics, command: jax.Array) -> jax.Array:
    """Commands [..., nu] as held over the sub-steps of their control steps, [..., substeps, nu]."""
    held = (*command.shape[:-1], physics.substeps, command.shape[-1])
    return jnp.broadcast_to(command[..., None, :], held)


def recording(physics: Physics, qpos: jax.Array, qvel: jax.Array, command: jax.Array) -> Motion:
    """Cut the recording around starts, as `replay` takes it.

    Args:
        physics: its sub-steps are what a command is held over.
        qpos, qvel: [N, 2 L + 1, nq] and [N, 2 L + 1, nv], `around_*` of `logs.segments`; the start is row L.
        command: [N, 2 L + 1, nu].
    """
    qpos, qvel, command = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, command))
    return Motion(qpos, qvel, _throughout(physics, command), start=(qpos.shape[-2] - 1) // 2)


def remembered(physics: Physics) -> int:
    """Control steps of a recording around a start that the effects look at: three of their longest times."""
    times = [p.high for effect in physics.effects for p in effect.space().parameters if p.unit == "s"]
    least = PAST if any(effect.follows for effect in physics.effects) else AROUND
    return max(2, math.ceil(max([least, *(3 * t for t in times)]) / physics.dt - 1e-6)) if physics.effects else 0
