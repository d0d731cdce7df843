"""What a sampled channel tells about its own measurement: quantum, noise, and a zero-phase velocity estimate."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_coeffs, savgol_filter
from scipy.special import betainc

from bayessim_mjx.logs.log import Array, Channels

MAX_WINDOW = 0.25  # s, the longest smoothing window; rule of thumb, not measured
_POLYNOMIAL = 3  # the least order whose derivative is exact where the acceleration grows; Savitzky and Golay 1964
# Rules of thumb: what is off a smooth motion is so many steps of its encoder, and so many usual steps from row to row
# or standard deviations of the noise, away from it.
COUNTS = 20.0
STEPS = 8.0
# Values that a channel has to show before its noise can be estimated: of two, nothing says whether they are one count
# apart, so the noise may be anything. Source: that count.
LEVELS = 3
# Of folders of logs without motion, the share in which a channel counts as moving: a choice. Counted, in 6000 each of 8
# channels of noise (normal, rounded to its deviation, or Student's t of 3; 20 to 5000 rows): 0.9 %, 1.0 % and 1.3 %.
STILL = 0.01


def quantum(x: Array) -> float:
    """Step of which all values of x [T] are multiples (encoder resolution); 0 where there is none to be seen."""
    scale = max(float(np.ptp(x)), 1e-300)
    levels = np.unique(np.round((x - x.min()) / scale, 9)) * scale
    if len(levels) < LEVELS:
        return float(np.ptp(x)) if len(levels) == 2 else 0.0
    steps = np.diff(levels)
    step = float(steps.min())
    step = float(np.median(steps[steps < 1.5 * step]))
    multiples = steps[steps < 40 * step] / step
    regular = np.mean(np.abs(multiples - np.round(multiples)) < 0.1) > 0.95
    return step if regular and len(multiples) > 0.5 * len(steps) else 0.0


def values_shown(x: Array) -> int:
    """Different values in x [T], up to ten roundings of the single precision in which they are simulated."""
    span, grain = float(np.ptp(x)), 10.0 * float(np.finfo(np.float32).eps) * max(1.0, float(np.abs(x).max()))
    return len(np.unique(np.round((x - x.min()) / max(1e-9 * span, grain))))


def noise_level(x: Array, grain: float | None = None) -> float:
    """Return the standard deviation of the noise in x [T]: max(quantum / sqrt 12, robust high-frequency residual).

    `grain` is the quantum where it is known; otherwise it is estimated. The fourth difference of white noise has
    variance 70 sigma^2; its median is blind to rare jerks of the true motion.
    """
    fourth = np.diff(x, 4)
    residual = 1.4826 * float(np.median(np.abs(fourth))) / np.sqrt(70.0) if len(fourth) else 0.0
    return max((quantum(x) if grain is None else grain) / np.sqrt(12.0), residual)


def moves(x: Array, sigma: float, channels: int) -> bool:
    """Whether x [T] moves: its range is beyond its noise, and its values follow each other as those of no white noise.

    Bartels (J. Am. Stat. Assoc. 77, 1982): von Neumann's ratio of ranks, squared steps over squared deviations. It is
    about 2 of white noise of any distribution, and small where values stay near the one before.

    Args:
        sigma: standard deviation of the noise. channels: of all logs that are tested together (Bonferroni).
    """
    if np.ptp(x) <= 6.0 * sigma + 1e-12:
        return False
    _, at, count = np.unique(x, return_inverse=True, return_counts=True)
    rank, rows = (np.cumsum(count) - 0.5 * count)[at], float(len(x))
    ratio = float(np.sum(np.diff(rank) ** 2) / np.sum((rank - rank.mean()) ** 2))
    shape = 2.5 * rows * (rows + 1) * (rows - 1) ** 2 / ((rows - 2) * (5 * rows**2 - 2 * rows - 9)) - 0.5
    return bool(betainc(shape, shape, ratio / 4) < STILL / channels)


def smoothing_window(x: Array, period: float, sigma: float) -> int:
    """Longest odd Savitzky-Golay window (samples) whose residual the noise still explains (discrepancy principle).

    Both are judged where they are worst (95th percentile of their local rms): rest phases do not hide motion, and the
    noise may grow with speed (jitter of the time stamps).
    """
    longest = max(5, min(int(MAX_WINDOW / period), len(x) // 4))
    floor = max(sigma, _worst(np.diff(x, 4) / np.sqrt(70.0)) if len(x) > 4 else 0.0)
    chosen = 5
    for half in range(3, longest // 2 + 1):
        if _worst(x - savgol_filter(x, 2 * half + 1, _POLYNOMIAL)) > 1.25 * floor:
            break
        chosen = 2 * half + 1
    return chosen


def _worst(residual: Array) -> float:
    local = np.sqrt(np.maximum(uniform_filter1d(residual**2, 25, mode="nearest"), 0.0))
    return float(np.percentile(local, 95))


def derivative(time: Array, x: Array, sigma: float) -> tuple[Array, float]:
    """Zero-phase derivative of x [T] at the times [T], and the standard deviation that noise sigma of x gives it.

    Local cubic fits (Savitzky and Golay, 1964) on an even grid of the median period, read back at the logged times.
    """
    period = float(np.median(np.diff(time)))
    rows = max(7, int(round((time[-1] - time[0]) / period)) + 1)
    grid = np.linspace(time[0], time[-1], rows)
    step = float(grid[1] - grid[0])
    even = np.interp(grid, time, x) if quantum(x) > 0 else CubicSpline(time, x)(grid)
    window = smoothing_window(even, step, sigma)
    rate = savgol_filter(even, window, _POLYNOMIAL, deriv=1, delta=step)
    # Var[rate] = sigma^2 sum_k c_k^2, c = the filter's taps; no position is known better than its rounding
    sigma = max(sigma, 10.0 * float(np.finfo(np.float64).eps) * float(np.abs(x).max()))
    spread = sigma * float(np.linalg.norm(savgol_coeffs(window, _POLYNOMIAL, deriv=1, delta=step)))
    return CubicSpline(grid, rate)(time), spread


def estimate_velocity(time: Array, qpos: Array, channels: Channels, sigma: Array) -> tuple[Array, Array]:
    """Velocities [T, nv] and their standard deviations [nv] from positions.

    Quaternions: omega = 2 Im(conj(q) * dq/dt) in the body's frame, as MuJoCo stores it.

    Args:
        time: [T] seconds.
        qpos: [T, nq] rad, m and quaternions.
        channels: which column is what.
        sigma: [nq] standard deviations of the noise of qpos.
    """
    rates = [derivative(time, qpos[:, i], float(sigma[i])) for i in range(qpos.shape[1])]
    columns, spreads = [], []
    for joint, kind in zip(channels.joints, channels.kinds, strict=True):
        own = range(*channels.columns(joint).indices(qpos.shape[1]))
        linear = list(own)[:3] if kind == "free" else ([] if kind == "ball" else list(own))
        columns += [rates[i][0] for i in linear]
        spreads += [rates[i][1] for i in linear]
        if kind in ("free", "ball"):
            quat = list(own)[-4:]
            columns += list(_angular(qpos[:, quat], np.stack([rates[i][0] for i in quat], 1)).T)
            spreads += [2.0 * float(np.mean([rates[i][1] for i in quat]))] * 3
    return np.stack(columns, 1) if columns else np.zeros((len(time), 0)), np.array(spreads)


def _angular(q: Array, dq: Array) -> Array:
    """2 Im(conj(q) dq) for quaternions [T, 4] (w x y z) and their derivatives [T, 4]."""
    w, v, dw, dv = q[:, :1], q[:, 1:], dq[:, :1], dq[:, 1:]
    return 2.0 * (w * dv - dw * v - np.cross(v, dv))
