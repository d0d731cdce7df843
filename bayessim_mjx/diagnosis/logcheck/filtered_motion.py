"""A log's motion on an even grid, differentiated and filtered without phase: what inverse dynamics needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.velocities import bandwidth, lowpass

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Motion:
    """A log's motion on an even grid, zero-phase low-pass filtered; everything linear is filtered at `cutoff`.

    Attributes:
        time: [T] s.
        qpos, qvel, qacc: [T, nq], [T, nv], [T, nv]; filtered at four times the cutoff.
        free: [T]; no contact, equality or joint limit acts, the drives are on, and it is not the first or last moment.
        cutoff: Hz.
    """

    time: Array
    qpos: Array
    qvel: Array
    qacc: Array
    free: Mask
    cutoff: float

    @property
    def step(self) -> float:
        return float(self.time[1] - self.time[0])

    def moving(self, dof: int) -> Mask:
        """[T]: free, and faster than a twentieth of the top speed of this degree of freedom."""
        speed = np.abs(self.qvel[:, dof])
        return self.free & (speed > 0.05 * np.percentile(speed, 99))


def motion(log: Log, mj_model: mujoco.MjModel, cutoff: float | None = None) -> Motion:
    """The smoothed motion of a log, at 20 times the cutoff or at the log's own rate, whichever is slower."""
    cutoff = bandwidth(log) if cutoff is None else cutoff
    grid, (qpos, qvel) = _even(log, (log.qpos, log.qvel))
    fine = float(grid[1] - grid[0])
    axial = [(log.channels.columns(j).start, log.channels.columns(j, "qvel").start)
             for j, k in zip(log.joints, log.channels.kinds, strict=True) if k in ("hinge", "slide")]  # fmt: skip
    smooth = lowpass(qpos, fine, 4.0 * cutoff)
    for q, v in axial:
        qvel[:, v] = np.gradient(smooth[:, q], fine)
        qpos[:, q] = smooth[:, q]
    qvel = lowpass(qvel, fine, 4.0 * cutoff)
    qacc = np.gradient(qvel, fine, axis=0)
    every = max(1, int(1.0 / (20.0 * cutoff * fine)))
    rows = slice(None, None, every)
    edge = (grid > grid[0] + 0.5 / cutoff) & (grid < grid[-1] - 0.5 / cutoff)
    on = np.interp(grid, log.time, lowpass(log.enabled.astype(float), log.period, cutoff)) > 0.99
    out = Motion(grid[rows], qpos[rows], qvel[rows], qacc[rows], (edge & on)[rows], cutoff)
    near = max(1, round(0.5 / (cutoff * out.step)))  # rows that the filter blends what is free with
    touched = binary_dilation(_constrained(mj_model, out.qpos), iterations=near)
    return replace(out, free=out.free & ~touched)


def _even(log: Log, arrays: tuple[Array, ...]) -> tuple[Array, list[Array]]:
    grid = np.linspace(log.time[0], log.time[-1], max(8, int(round(log.duration / log.period)) + 1))
    return grid, [np.stack([np.interp(grid, log.time, c) for c in x.T], 1) for x in arrays]


def _constrained(mj_model: mujoco.MjModel, qpos: Array) -> Mask:
    """[T]: a contact, an equality or a limit acts."""
    data = mujoco.MjData(mj_model)
    out = np.zeros(len(qpos), bool)
    for k, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_fwdPosition(mj_model, data)
        out[k] = data.ncon + data.ne + data.nl > 0
    return out


def filtered(signal: Array, log: Log, moved: Motion, lags: Array | None = None) -> Array:
    """signal [T of the log] filtered as the motion is, on the motion's grid; [L, T] delayed by each of `lags` [L] s."""
    grid, (even,) = _even(log, (signal[:, None],))
    smooth = lowpass(even[:, 0], float(grid[1] - grid[0]), moved.cutoff)
    times = moved.time if lags is None else moved.time - lags[:, None]
    return np.interp(times, grid, smooth)
