"""Measured velocities against the derivatives of their positions: which of them can be believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import butter, filtfilt, welch

from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.signals import estimate_velocity


def lowpass(x: Array, step: float, cutoff: float) -> Array:
    """Zero-phase Butterworth filter of x [T, ...] sampled every `step` s; x itself where the rate is too low for it."""
    if 2.0 * cutoff * step > 0.9:
        return x
    b, a = butter(2, 2.0 * cutoff * step)
    return np.asarray(filtfilt(b, a, x, axis=0, padlen=min(len(x) - 1, int(1.0 / (cutoff * step)))))


def bandwidth(log: Log) -> float:
    """Cutoff [Hz]: twice the frequency below which 95 % of the velocities' power lies; 3 to 12 Hz, a fifth of the rate.

    Only where the positions' spectrum stands ten times above its own floor: differentiated noise is no motion.
    """
    top = min(12.0, 0.2 / log.period)
    frequency, power = welch(log.qpos, 1.0 / log.period, nperseg=min(len(log), 1024), axis=0)
    floor = np.median(power[len(power) // 2 :], axis=0)
    speed = np.where(power > 10.0 * floor, power, 0.0) * frequency[:, None] ** 2
    share = np.cumsum(speed, axis=0) / np.maximum(np.sum(speed, axis=0), 1e-300)
    reached = [float(frequency[np.searchsorted(s, 0.95)]) for s in share.T if s[-1] > 0.5]
    return float(min(max(3.0, 2.0 * max(reached, default=0.0)), top))


@dataclass(frozen=True)
class Velocity:
    """A measured velocity against the derivative of its position: v(t) ~ slope dq/dt(t - lag)."""

    channel: str
    slope: float
    lag: float  # s by which the measured velocity is late
    correlation: float

    def usable(self, step: float) -> bool:
        """Within 10 % and late by no more than half a step [s]."""
        return abs(self.slope - 1.0) < 0.1 and abs(self.lag) <= 0.6 * step and self.correlation > 0.95

    def sentence(self) -> str:
        """How it differs from the derivative."""
        return (
            f"qvel:{self.channel} is {self.slope:.3g} times the derivative of its position, {self.lag * 1e3:+.0f} ms "
            f"late (correlation {self.correlation:.3f}): positions are used instead"
        )


def velocities(log: Log) -> list[Velocity]:
    """One comparison per measured velocity whose joint moves well above the noise, in logs long enough."""
    if not log.has_qvel:
        return []
    cutoff = bandwidth(log)
    rows = slice(None, None, max(1, int(1.0 / (20.0 * cutoff * log.period))))
    time = log.time[rows]
    rates, spread = estimate_velocity(time, log.qpos[rows], log.channels, log.sigma_qpos)
    grid = np.linspace(time[0], time[-1], len(time))
    step = float(grid[1] - grid[0])
    if grid[-1] - grid[0] < 2.0 / cutoff:
        return []  # all of it is edge
    out = []
    both = log.seen_dofs & log.seen_speeds
    for i in np.flatnonzero(both):
        name, v, w, noise = log.channels.qvel[i], log.qvel[rows, i], rates[:, i], spread[i]
        even = [lowpass(np.interp(grid, time, x), step, cutoff) for x in (v, w)]
        if float(np.std(even[1])) > 2.0 * float(noise) and np.ptp(v) > 0:
            out.append(_compare(name, grid, even[0], even[1], 0.5 / cutoff))
    return out


def _compare(name: str, grid: Array, v: Array, w: Array, edge: float) -> Velocity:
    jerk = np.abs(np.gradient(w))
    # samples on either side of an impact say nothing about the velocity between them
    rows = (grid > grid[0] + edge) & (grid < grid[-1] - edge) & (jerk <= np.percentile(jerk, 90))
    # odd count: a lag of exactly 0 is among them
    lags = np.linspace(-0.1, 0.1, 201) if grid[-1] - grid[0] > 1.0 else np.zeros(1)
    late = [np.interp(grid - lag, grid, w)[rows] for lag in lags]
    v = v[rows]
    errors = [float(np.sum((v - (v @ x) / (x @ x) * x) ** 2)) for x in late]
    best, now = int(np.argmin(errors)), len(lags) // 2
    if errors[best] > 0.5 * errors[now] or best in (0, len(lags) - 1):
        best = now  # a lag has to explain something
    x = late[best]
    correlation = float(v @ x) / float(np.linalg.norm(v) * np.linalg.norm(x))
    return Velocity(name, float(v @ x) / float(x @ x), float(lags[best]), correlation)


def agreeing(seen: Sequence[Velocity], step: float) -> dict[str, bool]:
    """Per channel, whether it is `usable` in most logs: a joint that hardly moves in one of them proves nothing."""
    channels = dict.fromkeys(v.channel for v in seen)
    return {c: bool(np.median([v.usable(step) for v in seen if v.channel == c]) > 0.5) for c in channels}


def trusted(logs: Sequence[Log], step: float) -> tuple[list[Log], list[str]]:
    """Return logs with their positions' derivatives in the place of velocities that do not agree; and a note on each.

    A filter takes each measurement as on time, with a noise of its own. A late velocity then passes for forces that
    nobody modelled, and a posterior leans by more than it says.

    Args:
        logs: those velocities are afterwards among their `absent` channels.
        step: s by which a velocity may be late, see `Velocity.usable`.
    """
    seen = [velocities(log) for log in logs]
    bad = [channel for channel, good in agreeing([v for each in seen for v in each], step).items() if not good]
    notes = []
    for channel in bad:
        worst = [v for each in seen for v in each if v.channel == channel and not v.usable(step)]
        shown = sorted(worst, key=lambda v: v.lag)[len(worst) // 2]
        notes.append(f"{shown.sentence()} ({len(worst)} of {len(logs)} logs, the one of median delay)")
    return [_without(log, bad) for log in logs] if bad else list(logs), notes


def _without(log: Log, channels: Sequence[str]) -> Log:
    if not log.has_qvel:
        return log
    rates, spread = estimate_velocity(log.time, log.qpos, log.channels, log.sigma_qpos)
    left_out = np.array([name in channels for name in log.channels.qvel])
    absent = dict.fromkeys((*log.absent, *(f"qvel:{name}" for name in channels)))
    qvel, sigma = np.where(left_out, rates, log.qvel), np.where(left_out, spread, log.sigma_qvel)
    changed = replace(log, qvel=qvel, sigma_qvel=sigma, absent=tuple(absent))
    if changed.seen_speeds.any():
        return changed
    kept = tuple(name for name in absent if not name.startswith("qvel:"))
    return replace(changed, has_qvel=False, absent=kept)


__all__ = ["Velocity", "agreeing", "bandwidth", "lowpass", "trusted", "velocities"]
