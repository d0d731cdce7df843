"""What is predicted without any simulator: every joint keeps its speed. No law that does not beat that is a finding.

Windows begin anew at the measured state, so a short one is predicted well by whatever hardly accelerates. Where a
simulator's forces are far off, effects that only keep it from moving (a huge inertia, brakes everywhere) close almost
all of its gap. Measured beside this predictor they close nothing.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.selection.heldout import Prediction

Array = NDArray[np.float64]


def coasting(windows: Windows, model: mujoco.MjModel) -> Prediction:
    """Motion at constant speed, from start states that are estimated on each window as those of a simulation are."""
    moved, started = _displacements(windows, model)
    time = windows.dt * np.arange(1, windows.steps + 1)
    precise_q, precise_v = (_precision(s) for s in (windows.sigma_q, windows.sigma_v))
    loose_q, loose_v = np.split(_precision(windows.spread), 2)
    qvel = np.asarray(windows.batch.qvel, np.float64) - started[:, None]
    ahead = moved - started[:, None] * time[:, None]  # what the measured start state leaves

    # weighted least squares of (position, speed) at the start, each degree of freedom on its own
    a = windows.steps * precise_q + loose_q
    b = time.sum() * precise_q
    c = np.sum(time**2) * precise_q + windows.steps * precise_v + loose_v
    right_q = precise_q * ahead.sum(1)
    right_v = precise_q * np.einsum("whv,h->wv", ahead, time) + precise_v * qvel.sum(1)
    shared = a * c - b**2
    position, speed = (c * right_q - b * right_v) / shared, (a * right_v - b * right_q) / shared
    error = [ahead - position[:, None] - speed[:, None] * time[:, None], qvel - speed[:, None]]
    sigma = np.concatenate([windows.sigma_q, windows.sigma_v])
    used = np.isfinite(sigma)
    return Prediction(np.concatenate(error, 2)[..., used] / sigma[used], np.concatenate([position, speed], 1))


def _displacements(windows: Windows, model: mujoco.MjModel) -> tuple[Array, Array]:
    """(`[W, H, nv]` from each window's measured start, in its tangent; `[W, nv]`, measured speeds there)."""
    around = windows.batch.around
    begins, qpos = (np.asarray(x, np.float64) for x in (np.asarray(around.qpos)[:, around.start], windows.batch.qpos))
    out = np.zeros((*qpos.shape[:2], model.nv))
    for row, begin, there in zip(out, begins, qpos, strict=True):
        for one, position in zip(row, there, strict=True):
            mujoco.mj_differentiatePos(model, one, 1.0, begin, position)
    return out, np.asarray(around.qvel[:, around.start], np.float64)


def _precision(sigma: Array) -> Array:
    """1 / sigma^2; 0 where nothing is measured."""
    return np.where(np.isfinite(sigma), np.asarray(sigma, np.float64) ** -2, 0.0)
