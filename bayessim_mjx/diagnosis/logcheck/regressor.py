"""The regressor of generalised force on a log's motion: rigid bodies, springs, friction, zeros; all filtered alike.

The identification model of Gautier and Khalil (1990, IDIM-LS): positions are differentiated without phase, and effort
and columns pass the same zero-phase filter, so that a linear relation between them stays what it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.optimize import lsq_linear

from bayessim_mjx.diagnosis.logcheck import rigid_body
from bayessim_mjx.diagnosis.logcheck.drives import LEAST
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.velocities import bandwidth, lowpass

Mask = NDArray[np.bool_]
# Columns of a joint's own motion that the model of an effort has, without an upper bound.
LOOSE = ("one", "speed", "dry", "drag", "acceleration", "position")
# Independent rows, below which no effort is compared with a motion: fewer would be explained whatever they hold.
FEWEST = float(len(LOOSE))


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

    @property
    def share(self) -> float:
        """Independent rows that a row of this grid is, of what passed the filter (two a cycle of the cutoff)."""
        return min(1.0, 2.0 * self.cutoff * self.step)

    def smooth(self, x: Array) -> Array:
        """x `[T, ...]` on this grid, filtered as efforts are."""
        return lowpass(x, self.step, self.cutoff)

    def filtered(self, signal: Array, log: Log, lags: Array | None = None) -> Array:
        """Signal [T of the log] filtered alike, on this grid; [L, T] delayed by each of `lags` [L] s."""
        grid, (even,) = _even(log, (signal[:, None],))
        smooth = lowpass(even[:, 0], float(grid[1] - grid[0]), self.cutoff)
        times = self.time if lags is None else self.time - lags[:, None]
        return np.interp(times, grid, smooth)

    def moving(self, dof: int) -> Mask:
        """[T]: free, and faster than a twentieth of the top speed of this degree of freedom."""
        speed = np.abs(self.qvel[:, dof])
        return self.free & (speed > 0.05 * np.percentile(speed, 99))


def motion(log: Log, mj_model: mujoco.MjModel, cutoff: float | None = None) -> Motion:
    """Return the smoothed motion of a log, at 20 times the cutoff or at the log's own rate, whichever is slower."""
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


@dataclass(frozen=True, eq=False)
class Regressor:
    """Generalised forces that a motion needs, by cause, `[T, nv]` or `[T, nv, K]`, filtered as efforts are.

    Attributes:
        moved: the motion.
        columns: `[T, nv, K]`, per unit of inertial parameters or sets of them (`rigid_body.rigid`).
        known: all that the nominal model says, friction included; weight: gravity's part of it; spring: its springs'.
        tilt: `[T, nv, 2]`, per rad by which the world is turned about its x and y axis.
        own: {name: `[T, nv]`}, of each joint's own motion: acceleration, speed, dry (direction), drag (speed squared),
            position (of hinges and slides; of others the integral of speed), one, load (what the joint bears, with the
            direction).
        dry: `[T, nv]`, direction of motion, not filtered.
    """

    moved: Motion
    columns: Array
    known: Array
    weight: Array
    spring: Array
    tilt: Array
    own: dict[str, Array]
    dry: Array

    @classmethod
    def of(
        cls, model: mujoco.MjModel, moved: Motion, slow: Array | None = None, sets: Array | None = None, loads: int = 0
    ) -> Regressor:
        """Args: slow: `[nv]`, speeds at which dry friction turns over; None: by this motion's top speeds.

        sets, loads: see `rigid_body.rigid`.
        """
        v = moved.qvel
        slow = LEAST * np.percentile(np.abs(v), 95, axis=0) + 1e-12 if slow is None else slow
        dry = np.tanh(v / slow)
        rigid = rigid_body.rigid(model, moved.qpos, v, moved.qacc, sets, loads)
        known = rigid.nominal + rigid.spring + model.dof_damping * v + model.dof_armature * moved.qacc
        known += model.dof_frictionloss * dry
        position = np.zeros_like(v) + np.cumsum(v, 0) * moved.step
        for joint in np.flatnonzero(model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)):
            position[:, int(model.jnt_dofadr[joint])] = moved.qpos[:, int(model.jnt_qposadr[joint])]
        own = {
            "acceleration": moved.qacc, "speed": v, "dry": dry, "drag": v * np.abs(v), "position": position,
            "one": np.ones_like(v), "load": np.abs(rigid.bias + rigid.spring) * dry,
        }  # fmt: skip
        return cls(
            moved,
            columns=moved.smooth(rigid.columns),
            known=moved.smooth(known),
            weight=moved.smooth(rigid.weight),
            spring=moved.smooth(rigid.spring),
            tilt=moved.smooth(rigid.tilt),
            own={name: moved.smooth(x) for name, x in own.items()},
            dry=dry,
        )


@dataclass(frozen=True, eq=False)
class Bounded:
    """Linear model of one joint's effort, x [T, K] c with low <= c <= high."""

    x: Array
    low: Array
    high: Array
    rigid: slice  # the model's own bodies and springs, which have a scale

    def explained(self, efforts: Array, rows: Mask, scaled: bool = True) -> Array:
        """[L] share of the variance of efforts [L, T] over the rows [T] that the bounded model explains, or below zero.

        scaled: the effort's unit is the model's; otherwise every scale of the effort is tried.
        """
        y, x = efforts[:, rows], self.x[rows]
        size = np.linalg.norm(x, axis=0) + 1e-12
        # a bounded fit of R c = Q'y is that of X c = y
        q, r = np.linalg.qr(x / size)
        bounds = (self.low * size, self.high * size)
        body = float(np.linalg.norm(x[:, self.rigid].sum(1)))

        def one(signal: Array) -> float:
            target = q.T @ signal
            norm = max(float(np.linalg.norm(signal)), 1e-300)
            tried = np.ones(1) if scaled or body == 0 else body / norm * np.geomspace(0.1, 10.0, 9)
            fits = [2.0 * lsq_linear(r, s * target, bounds=bounds, method="bvls").cost / s**2 for s in tried]
            left = norm**2 - float(target @ target) + float(min(fits))
            return 1.0 - left / max(float(np.sum((signal - signal.mean()) ** 2)), 1e-300)

        return np.array([one(signal) for signal in y])
