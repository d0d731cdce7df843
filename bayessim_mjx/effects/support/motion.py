"""Recorded motion around a start, which effects with memory and sensors' effects look at."""

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.effects.support.site import Site

AROUND = 0.1  # s of recorded motion before and after a start that effects with memory may look at, at least
# s of it that lead up to a start, for effects that follow the motion: as long as a window, in which a flexible base
# swings on. With 0.1 s before windows of a base of 7 Hz, damped by 5 %, a spring in the joints was named for its swing
PAST = 0.5


class Motion(struct.PyTreeNode):
    """Recorded motion around a start, one row per control step; row `start` is the start itself.

    Attributes:
        qpos: `[rows, nq]`, qvel: `[rows, nv]`.
        command: `[rows, substeps, nu]`; row k acts from row k to row k + 1.
        time: s since the recording began, at the start row; None: it begins there.
        start: static int.
    """

    qpos: jax.Array
    qvel: jax.Array
    command: jax.Array
    start: int = struct.field(pytree_node=False)
    time: jax.Array | None = None

    def shifted(self, at: Site, steps: jax.Array) -> jax.Array:
        """Position and velocity of each joint of `at` read its own number of control steps later, `[rows, n, 2]`.

        Between two rows those of the nearest, carried there by its velocity and acceleration: as noisy as one row. A
        mean of two rows knows more than one, and a model whose windows begin there would seem likelier.

        Args: steps: `[n]`, in control steps, of any sign, with fractions; the recording's ends are held.
        """
        last, dt = self.qpos.shape[0] - 1, jnp.float32(at.dt)
        when = jnp.clip(jnp.arange(last + 1)[:, None] + steps, 0, last)
        near = jnp.round(when).astype(jnp.int32)
        part = when - near

        def row(x: jax.Array, ahead: int) -> jax.Array:
            return jnp.take_along_axis(x, jnp.clip(near + ahead, 0, last), axis=0)

        qpos, qvel = self.qpos[:, at.qadr], self.qvel[:, at.dadr]
        gained = part * (row(qvel, 1) - row(qvel, -1)) / 2
        held = jnp.where(part > 0, row(qpos, 1), row(qpos, -1)) == row(qpos, 0)  # even at speed
        way = jnp.where(held, 0.0, part * dt * (row(qvel, 0) + gained / 2))
        return jnp.stack([row(qpos, 0) + way, row(qvel, 0) + gained], axis=-1)


def between(one: jax.Array, two: jax.Array, gained: jax.Array, part: jax.Array, dt: float) -> jax.Array:
    """Position at constant acceleration gained / dt between two that are dt apart.

    Only the *difference* of the velocities bends the path: where an end is held it is a line, and the half sub-step by
    which semi-implicit Euler's velocities lag, the same at both ends, cancels (not so in a Hermite spline).

    Args:
        one, two: positions; gained: by how much the velocity grows from one to the other.
        part: of the way, from 0 to 1.
        dt: s.
    """
    return (1 - part) * one + part * two - 0.5 * jnp.float32(dt) * part * (1 - part) * gained


def bend(before: jax.Array, now: jax.Array, at: Site) -> jax.Array:
    """How far the velocity is from a line during a control step: c s (1 - s), s from 0 to 1; c `[n]`.

    Drag, gravity and springs change the acceleration within a step. The positions tell the mean velocity. A staggered
    integrator's velocities are `Site.early` late to them. What is held at the start of an episode is a line.

    Args:
        before, now: positions and velocities `[n, 2]`, one control step apart.
    """
    gained = now - before
    mean = (gained[:, 0] - jnp.float32(at.early) * gained[:, 1]) / jnp.float32(at.dt)
    return jnp.where(jnp.any(gained != 0, 1), 6.0 * mean - 3.0 * (before[:, 1] + now[:, 1]), 0.0)


def delayed(past: jax.Array, now: jax.Array, steps: jax.Array, at: Site) -> tuple[jax.Array, jax.Array]:
    """Positions and velocities `[n, 2]` as they were `steps` `[n]` control steps ago, and the past one step later.

    Args:
        past: `[lag, n, 2]`, after the control steps before, newest last; now: `[n, 2]`; steps: 0 to lag.
    """
    lag, signal = past.shape[0], jnp.concatenate([past, now[None]])  # row `lag` is now
    whole = jnp.minimum(jnp.floor(steps), lag - 1.0)
    row, joint = lag - whole.astype(jnp.int32), jnp.arange(len(now))
    newer, older = signal[row, joint], signal[row - 1, joint]
    part, gained = steps - whole, older[:, 1] - newer[:, 1]
    position = between(newer[:, 0], older[:, 0], -gained, part, at.dt)
    velocity = newer[:, 1] + part * gained + part * (1 - part) * bend(older, newer, at)
    return jnp.stack([position, velocity], axis=-1), signal[1:]
