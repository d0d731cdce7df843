"""Logs at the control period, with the mean of their commands, and windows of them ready for replay in simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import TIMING, Array, Log


def is_even(log: Log, dt: float) -> bool:
    """Whether every sample lies within dt/1000 of an even grid of period dt."""
    grid = log.time[0] + dt * np.arange(len(log))
    return bool(np.max(np.abs(log.time - grid)) < 1e-3 * dt)


def resample(log: Log, dt: float, kind: Literal["cubic", "linear"] = "cubic") -> Log:
    """Return the log on the grid time[0] + k dt. Command k is held over [t_k, t_k + dt).

    Positions and velocities are interpolated. A logged command is held until the next row; the command of a step is
    the *mean* of that held signal over the step (its impulse is kept, no sample is skipped and no delay added).
    `enabled:` streams are 1 only where the drive was on throughout the step. A log that is already even is returned as
    it is. Where commands run linearly (`Log.linear`) or act later than their rows (`Log.late`), theirs is the mean of
    that, also on an even log, and the result is held and on time.

    Raises:
        UserError: dt or kind out of range, a log shorter than two steps, a rate so low that steps would be invented.
    """
    if not (np.isfinite(dt) and dt > 0):
        raise UserError(f"resample: dt = {dt!r}; allowed: seconds > 0")
    if kind not in ("cubic", "linear"):
        raise UserError(f"resample: kind = {kind!r}; allowed: cubic, linear")
    if is_even(log, dt):
        return _held(replace(log, time=log.time[0] + dt * np.arange(len(log))), dt)
    if log.period > 20 * dt:
        text = f"log {log.name!r}: one row per {log.period:.4g} s against a control period of {dt:.4g} s"
        raise UserError(f"{text}; allowed: up to 20 control periods per row")
    rows = int(np.floor(log.duration / dt + 1e-6)) + 1
    if rows < 3:
        raise UserError(
            f"log {log.name!r}: {log.duration:.4g} s long; allowed: at least two control periods of {dt:.4g} s"
        )
    grid = log.time[0] + dt * np.arange(rows)
    inside = np.minimum(grid, log.time[-1])
    return replace(
        log,
        time=grid,
        ctrl=_mean(log.time + log.late, log.ctrl, grid, dt, log.linear),
        metadata=_on_time(log),
        qpos=_normalised(log, _interpolate(log.time, log.qpos, inside, kind)),
        qvel=_interpolate(log.time, log.qvel, inside, kind),
        streams={k: _stream(log.time, k, s, grid, dt) for k, s in log.streams.items()},
    )


def _interpolate(time: Array, x: Array, grid: Array, kind: str) -> Array:
    if kind == "cubic" and len(time) > 3:
        return np.asarray(CubicSpline(time, x)(grid)) if x.shape[1] else np.zeros((len(grid), 0))
    return np.stack([np.interp(grid, time, c) for c in x.T], 1) if x.shape[1] else np.zeros((len(grid), 0))


def _mean(time: Array, x: Array, grid: Array, dt: float, linear: bool = False) -> Array:
    """Mean of x over each [t_k, t_k + dt), held or linear from row to row; the last row is held for ever."""
    return means(time, x, np.append(grid, grid[-1] + dt), dt, (0.0, dt), linear)


def _held(even: Log, dt: float) -> Log:
    """Put the means of the commands of an even log in their place, where these are linear or late."""
    if not even.linear and not even.late:
        return even
    ctrl = _mean(even.time + even.late, even.ctrl, even.time, dt, even.linear)
    return replace(even, ctrl=ctrl, metadata=_on_time(even))


def _on_time(log: Log) -> dict[str, Any]:
    return {key: value for key, value in log.metadata.items() if key not in TIMING}


def _stream(time: Array, name: str, x: Array, grid: Array, dt: float) -> Array:
    if name.startswith("enabled"):
        on = np.nan_to_num(x, nan=1.0)[:, None] > 0.5
        return (_mean(time, on.astype(float), grid, dt)[:, 0] > 1.0 - 1e-6).astype(float)
    seen = np.isfinite(x)
    return np.interp(grid, time[seen], x[seen]) if seen.any() else np.full(len(grid), np.nan)


def _normalised(log: Log, qpos: Array) -> Array:
    """Interpolated quaternions back to norm 1."""
    out = np.array(qpos)
    for joint, kind in zip(log.joints, log.channels.kinds, strict=True):
        if kind in ("hinge", "slide"):
            continue
        quat = list(range(*log.channels.columns(joint).indices(out.shape[1])))[-4:]
        out[:, quat] /= np.linalg.norm(out[:, quat], axis=1, keepdims=True)
    return out


def around(log: Log, start: int, rows: int) -> NDArray[np.int64]:
    """Return indices of the log's rows `start - rows .. start + rows`; beyond its ends the end is held."""
    return np.clip(np.arange(start - rows, start + rows + 1), 0, len(log) - 1)


def segments(
    logs: Log | Sequence[Log], length: int, stride: int | None = None, dt: float | None = None, rows: int = 0
) -> dict[str, NDArray[Any]]:
    """M windows of `length` = T control steps, one every `stride` steps (default T), ready for `rollout.replay`.

    Args:
        logs: sampled evenly at one period, or at any rates if `dt` is given: they are resampled first.
        dt: control period [s].
        rows: L, control steps of the recording before and after each start that are given too.

    Returns:
        qpos0 [M, nq], qvel0 [M, nv], command [M, T, nu], qpos [M, T+1, nq], qvel [M, T+1, nv] (float32): apply
        command[k] from row k to row k + 1. And run [M], start [M]: index of the log and first row of the window in it;
        around_qpos [M, 2 L + 1, nq], around_qvel, around_command: the recording around the start, which is row L.
        Windows in which a drive was switched off (`enabled:` streams) are left out: no command is no command of zero.

    Raises:
        UserError: no logs, uneven or different periods, length or stride out of range, no window left.
    """
    runs = [logs] if isinstance(logs, Log) else list(logs)
    step = length if stride is None else stride
    if not runs:
        raise UserError("segments: no logs; allowed: at least one")
    for key, value in (("length", length), ("stride", step)):
        if value < 1:
            raise UserError(f"segments: {key} = {value}; allowed: at least 1 control step")
    runs = runs if dt is None else [resample(log, dt) for log in runs]
    period = runs[0].period
    for log in runs:
        if not is_even(log, period):
            text = f"log {log.name!r} is not sampled evenly every {period:.6g} s"
            raise UserError(f"{text}; allowed: logs that went through resample(log, dt), or segments(..., dt=...)")
    windows = [(r, a) for r, log in enumerate(runs) for a in _starts(log, length, step)]
    if not windows:
        raise UserError(_no_window(runs, length, period))

    def cut(key: str, count: int) -> NDArray[np.float32]:
        return np.stack([getattr(runs[r], key)[a : a + count] for r, a in windows]).astype(np.float32)

    near = [around(runs[r], a, rows) for r, a in windows]
    motion = {
        f"around_{name}": np.stack([getattr(runs[r], key)[i] for (r, _), i in zip(windows, near, strict=True)])
        for name, key in (("qpos", "qpos"), ("qvel", "qvel"), ("command", "ctrl"))
    }
    motion = {name: x.astype(np.float32) for name, x in motion.items()}
    qpos, qvel = cut("qpos", length + 1), cut("qvel", length + 1)
    run, start = (np.array(c, dtype=np.int64) for c in zip(*windows, strict=True))
    motion |= {"qpos0": qpos[:, 0], "qvel0": qvel[:, 0], "command": cut("ctrl", length), "qpos": qpos, "qvel": qvel}
    return motion | {"run": run, "start": start}


def _no_window(runs: Sequence[Log], length: int, period: float) -> str:
    longest = max(runs, key=len)
    off = " (partly with the drive switched off)" if any(not log.enabled.all() for log in runs) else ""
    text = f"no log holds {length} control steps ({length * period:.4g} s); the longest is {longest.name!r} with"
    return f"{text} {len(longest) - 1}{off}; allowed: shorter segments (bayessim.trainTrajLen) or longer logs"


def _starts(log: Log, length: int, stride: int) -> list[int]:
    on = log.enabled
    return [a for a in range(0, len(log) - length, stride) if on[a : a + length].all()]


def noise(logs: Log | Sequence[Log]) -> dict[str, Array]:
    """Measurement noise of every channel: {"qpos": [nq], "qvel": [nv]} standard deviations.

    Pooled (rms) over the logs that show any: one in which a channel stands still tells none. 0: no log does.
    """
    runs = [logs] if isinstance(logs, Log) else list(logs)
    if not runs:
        raise UserError("noise: no logs; allowed: at least one")

    def pooled(sigmas: list[Array]) -> Array:
        square = np.square(sigmas)
        return np.sqrt(square.sum(0) / np.maximum((square > 0).sum(0), 1))

    return {"qpos": pooled([log.sigma_qpos for log in runs]), "qvel": pooled([log.sigma_qvel for log in runs])}


def means(time: Array, x: Array, edges: Array, step: float, beyond: tuple[float, float], linear: bool = False) -> Array:
    """Mean of x over each interval between two edges; x rests at its ends before its first and after its last row.

    Args:
        time: [T], s.
        x: [T, n], x[k] from time[k] to time[k+1], or at time[k] where `linear`.
        edges: [K + 1], s, one every `step` s.
        beyond: s, more than what the edges need, by which the ends are held before and after.
        linear: x runs linearly from row to row.

    Returns:
        [K, n].
    """
    return np.diff(integrals(time, x, edges, beyond, linear), axis=0) / step


def integrals(time: Array, x: Array, edges: Array, beyond: tuple[float, float], linear: bool = False) -> Array:
    """Integrals of x [K + 1, n] from the same beginning to each edge; arguments as of `means`."""
    if not x.shape[1]:
        return np.zeros((len(edges), 0))
    before = min(edges[0], time[0]) - beyond[0]
    after = max(edges[-1], time[-1]) + beyond[1]
    return _ramps(time, x, edges, before) if linear else _steps(time, x, edges, before, after)


def _steps(time: Array, x: Array, edges: Array, before: float, after: float) -> Array:
    """Integrals of each column from `before` to the edges."""
    times = np.concatenate([[before], time[1:], [after]])
    area = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x * np.diff(times)[:, None], axis=0)])
    return np.stack([np.interp(edges, times, a) for a in area.T], 1)


def _ramps(time: Array, x: Array, edges: Array, before: float) -> Array:
    """Integrate the trapezoids between rows: within a row the integral is a parabola."""
    times, values = np.append(before, time), np.concatenate([x[:1], x])
    steps = np.diff(times)
    area = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]) * steps[:, None], 0)])
    rise = np.append(np.where(steps > 0, 1 / np.maximum(steps, 1e-300), 0.0), 0.0)[:, None]
    slope = rise * np.concatenate([np.diff(values, axis=0), np.zeros((1, x.shape[1]))])
    at = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, len(times) - 1)
    since = (edges - times[at])[:, None]
    return np.asarray(area[at] + values[at] * since + 0.5 * slope[at] * since**2)
