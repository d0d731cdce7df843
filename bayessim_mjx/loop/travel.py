"""How far recorded channels move, which of them cannot say how noisy they are, and how many of their rows tell more."""

from __future__ import annotations

import jax
import mujoco
import numpy as np

from bayessim_mjx.logs.signals import LEVELS, values_shown
from bayessim_mjx.loop.noise import FINEST
from bayessim_mjx.physics.tangent import addresses, difference
from bayessim_mjx.tracking import Record

STILL = 1e-6  # rad, m, rad/s, m/s: what float32 and a simulator's rounding make of a joint that does not move
# Rows of one value that tell as much as if their errors were independent: with it root mean squares of z are .92 to .99
# where encoders show 2 to 52 rows a count, up to 3.5 without (benchmarks/inference/counts.py).
ROWS = 4
SAME = 0.1  # standard deviations of the sensor: what resampling between two equal rows makes of them is less


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
    shown = [values_shown(column) for column in _channels(record, model).reshape(-1, 2 * model.nv).T]
    return np.isfinite(sensor) & ~(np.asarray(sensor) > 0) & (np.array(shown) < LEVELS)


def repeated(record: Record, model: mujoco.MjModel, sensor: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[2 nv] factors on the sensors' standard deviations: of rows that repeat a value, ROWS tell and others do not.

    An encoder's error stays while its count does. Taken for white noise, a hundred rows of one count would be averaged
    to a tenth of it, and a posterior would be surer the more often a slow motion is sampled.
    """
    steps = np.abs(np.diff(_channels(record, model), axis=1))
    same = steps <= SAME * np.where(np.isfinite(sensor), sensor, 0.0)
    last = same.shape[1] - ROWS + 1
    if last < 1:
        return np.ones(len(sensor))
    more = np.all([same[:, k : k + last] for k in range(ROWS)], axis=0) & (valid[:, ROWS - 1 :, None] > 0)
    rows = len(valid) + float(np.sum(valid))
    return np.sqrt(rows / (rows - more.sum((0, 1))))


def _channels(record: Record, model: mujoco.MjModel) -> np.ndarray:
    """Position tangents from the first position, and velocities [N, T + 1, 2 nv]."""
    first = record.qpos[0, 0]
    away = jax.vmap(jax.vmap(lambda q: difference(model, q, first)))(record.qpos)
    return np.concatenate([np.asarray(away, float), np.asarray(record.qvel, float)], axis=2)


__all__ = ["repeated", "silent", "travel"]
