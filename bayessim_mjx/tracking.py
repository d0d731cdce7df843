"""How likely recorded motion is in the worlds theta: one-step prediction errors of a filter that follows the record.

A simulation of the logged commands from the logged start drifts off by every small force that is not modelled, and in
contact it may end anywhere. So the simulated state is drawn to the measured one by a Kalman gain: x <- x + K (y - x).
The gains come from linear error dynamics along the record (an extended Kalman filter with the gains of one reference
theta for all): without process noise they vanish, and what is left is the free simulation from an estimated start.
A force that is not modelled and lasts is followed too: otherwise whatever it moves with would be taken for its cause.
Ljung (1999), System Identification, 7.4; Sarkka (2013), Bayesian Filtering and Smoothing, 5.2.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from bayessim_mjx.compat import brief, program
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.kalman import Gains, push
from bayessim_mjx.physics import Drive, Physics, control_step
from bayessim_mjx.physics.controllers import Law
from bayessim_mjx.physics.tangent import difference, integrate
from bayessim_mjx.rollout import started

STEP = 1e-3  # of the perturbed states, relative to `scale`
BLOCKS = 8  # stretches of time


class Record(struct.PyTreeNode):
    """N recorded trajectories of T control steps, as measured.

    Attributes:
        qpos: `[N, T+1, nq]`; qvel: `[N, T+1, nv]`; command: `[N, T, nu]`.
        around: the recording around the starts, as for `rollout.replay`; None: nothing is known but the start.
        law: controllers between commands and actuators, leaves `[N, nu]`, or None.
    """

    qpos: Array
    qvel: Array
    command: Array
    around: Motion | None = None
    law: Law | None = None


def errors(physics: Physics, thetas: ArrayLike, record: Record, gains: Gains) -> Array:
    """Whitened one-step prediction errors of every record in every world; compiled once for each (physics, shapes).

    Args:
        thetas: `[M, d]`.

    Returns:
        Sums of squares `[M, N, B]` of each world and record in B = BLOCKS equal stretches of time.
    """
    return _errors(physics)(jnp.asarray(thetas, jnp.float32), record, gains)


@lru_cache(maxsize=16)
def _errors(physics: Physics) -> Callable[..., Any]:
    def one(theta: Array, record: Record, gains: Gains) -> Array:
        drive = Drive(law=record.law)
        world = started(physics, theta, record.qpos[0], record.qvel[0], record.command, record.around, drive)

        def step(carry: tuple, row: tuple) -> tuple[tuple, Array]:
            world, force = carry
            command, qpos, qvel, gain, whitener = row
            world, _ = control_step(physics, world, command, drive)
            world, force, gap = _followed(physics, world, force, gains.lasting, gain, qpos, qvel)
            return (world, force), jnp.sum((whitener @ gap) ** 2)

        rows = record.command, record.qpos[1:], record.qvel[1:], gains.gain, gains.whitener
        return jax.lax.scan(step, (world, jnp.zeros(physics.mj_model.nv)), rows)[1]

    def run(thetas: Array, record: Record, gains: Gains) -> Array:
        def of(at: tuple[Record, Gains]) -> Array:
            squares = jax.vmap(one, in_axes=(0, None, None))(thetas, *at)
            return jnp.stack([part.sum(-1) for part in jnp.array_split(squares, BLOCKS, axis=-1)], axis=-1)

        return jnp.moveaxis(jax.lax.map(of, (record, gains)), 0, 1)

    return program(run, physics)


def _followed(
    physics: Physics, world: Any, force: Array, lasting: Array, gain: Array, qpos: Array, qvel: Array
) -> tuple[Any, Array, Array]:
    """(world, force) drawn to what was measured, and the prediction error [2 nv]."""
    size = 2 * physics.mj_model.nv
    pushed = jnp.asarray(push(size // 2, physics.dt), jnp.float32) @ force
    gap = _gap(physics, world, qpos, qvel) - pushed
    by = gain @ gap
    return _drawn(physics, world, pushed + by[:size]), lasting * force + by[size:], gap


def _gap(physics: Physics, world: Any, qpos: Array, qvel: Array) -> Array:
    shown = world.measurement
    return jnp.concatenate([difference(physics.mj_model, qpos, shown["qpos"]), qvel - shown["qvel"]])


def _drawn(physics: Physics, world: Any, by: Array) -> Any:
    """Move the world by [2 nv] in position and velocity."""
    nv = physics.mj_model.nv
    return world.replace(qpos=integrate(physics.mj_model, world.qpos, by[:nv]), qvel=world.qvel + by[nv:])


@lru_cache(maxsize=16)
def _transitions(physics: Physics) -> Callable[..., Any]:
    nv = physics.mj_model.nv

    def one(theta: Array, record: Record, gains: Gains, scale: Array) -> tuple[Array, Array]:
        drive = Drive(law=record.law)
        world = started(physics, theta, record.qpos[0], record.qvel[0], record.command, record.around, drive)

        def step(carry: tuple, row: tuple) -> tuple[tuple, tuple[Array, Array]]:
            world, force = carry
            command, qpos, qvel, gain = row

            def ahead(by: Array) -> Any:
                return control_step(physics, _drawn(physics, world, by), command, drive)[0]

            way = STEP * scale
            pushed = jnp.concatenate([jnp.zeros((1, 2 * nv)), jnp.diag(way), -jnp.diag(way)])
            after = jax.vmap(ahead)(pushed)
            first = jax.tree.map(lambda x: x[0], after)

            def state(w: Any) -> Array:
                return jnp.concatenate([difference(physics.mj_model, w.qpos, first.qpos), w.qvel - first.qvel])

            states = jax.vmap(state)(after)
            columns = (states[1 : 1 + 2 * nv] - states[1 + 2 * nv :]) / (2 * way[:, None])
            world, force, gap = _followed(physics, first, force, gains.lasting, gain, qpos, qvel)
            return (world, force), (columns.T, gap)

        rows = record.command, record.qpos[1:], record.qvel[1:], gains.gain
        return jax.lax.scan(step, (world, jnp.zeros(nv)), rows)[1]

    return brief(jax.vmap(one, in_axes=(None, 0, 0, None)))


def transitions(
    physics: Physics, theta: ArrayLike, record: Record, gains: Gains, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Linear error dynamics [N, T, 2 nv, 2 nv] along the records at theta [d], and prediction errors [N, T, 2 nv].

    scale [2 nv]: how large a position's and a velocity's motion is; columns are central differences of 1e-3 of it.
    """
    found = _transitions(physics)(jnp.asarray(theta, jnp.float32), record, gains, jnp.asarray(scale, jnp.float32))
    return tuple(np.asarray(x, np.float64) for x in found)  # type: ignore[return-value]


def free(record: Record, nv: int) -> Gains:
    """Gains that never correct: a free simulation from the measured start, unit weights."""
    n, t = record.command.shape[:2]
    zero = jnp.zeros((n, t, 3 * nv, 2 * nv))
    return Gains(zero, zero[:, :, : 2 * nv] + jnp.eye(2 * nv), jnp.zeros((n, t)), jnp.zeros(n))


def close(record: Record, nv: int) -> Gains:
    """Gains that correct at once: every step begins where it was measured."""
    gains = free(record, nv)
    return gains.replace(gain=gains.gain + jnp.eye(3 * nv, 2 * nv))
