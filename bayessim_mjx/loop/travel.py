"""How far recorded channels move, and which of them cannot say how noisy they are."""

from __future__ import annotations

import jax
import mujoco
import numpy as np

from bayessim_mjx.logs.signals import LEVELS, values_shown
from bayessim_mjx.loop.noise import FINEST
from bayessim_mjx.physics.tangent import addresses, difference
from bayessim_mjx.tracking import Record

STILL = 1e-6  # rad, m, rad/s, m/s: what float32 and a simulator's rounding make of a joint that does not move


def travel(record: Record, model: mujoco.MjModel) -> np.ndarray:
    """Range of motion [2 nv] of positions (angles at most pi) and velocities; of what rests, a share of the largest."""
    qpos, qvel = (np.asarray(x, float).reshape(-1, x.shape[-1]) for x in (record.qpos, record.qvel))
    places = addresses(model)
    moved = np.array([min(np.ptp(qpos[:, q]), np.pi) if q is not None else 1.0 for q in places])
    return np.concatenate([np.maximum(x, max(FINEST * x.max(), STILL)) for x in (moved, np.ptp(qvel, axis=0))])


def silent(record: Record, model: mujoco.MjModel, sensor: np.ndarray) -> np.ndarray:
    """[2 nv]: measured channels whose noise was not told (0) and cannot be seen, as they show fewer than LEVELS values.

    A held joint has no residual, hence no estimate of its noise. Whatever was assumed would be the simulator's own
    rounding, and each of its residuals millions of standard deviations.
    """
    first = record.qpos[0, 0]
    away = jax.vmap(jax.vmap(lambda q: difference(model, q, first)))(record.qpos)
    channels = np.concatenate([np.asarray(x, float).reshape(-1, model.nv) for x in (away, record.qvel)], axis=1)
    shown = [values_shown(column) for column in channels.T]
    return np.isfinite(sensor) & ~(np.asarray(sensor) > 0) & (np.array(shown) < LEVELS)


__all__ = ["silent", "travel"]
