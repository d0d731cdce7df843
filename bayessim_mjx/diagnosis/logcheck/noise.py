"""Noise floors: what the sensors, chance in the process and the model's error each add, before anything is judged."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import nnls

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.resample import resample
from bayessim_mjx.logs.signals import LEVELS, noise_level, values_shown

_REST = 25  # rows of a window that is looked at for rest
_PROCESS, _BIAS = (1.0, 3.0), (2.0, 4.0)  # powers of the horizon: a random walk and its integral; a rate and a force


@dataclass(frozen=True, eq=False)
class Floors:
    """Noise of every channel, over all logs.

    Attributes:
        qpos, qvel: [nq], [nv] standard deviation of the sensors.
        horizons: [H] s since the start; None without repeats.
        repeat_qpos, repeat_qvel: [H, nq], [H, nv] standard deviation of one run among its repeats at each horizon:
            sensors and process together. No model can be closer to the logs. None without repeats.
        repeats: names of the logs that repeat each other.
        warnings: what could not be known.
    """

    qpos: Array
    qvel: Array
    horizons: Array | None = None
    repeat_qpos: Array | None = None
    repeat_qvel: Array | None = None
    repeats: tuple[tuple[str, ...], ...] = ()
    warnings: tuple[str, ...] = ()


def floors(logs: Sequence[Log], horizons: Sequence[float] = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)) -> Floors:
    """Sensor noise of all channels, and what differs between runs of the same commands where some were repeated.

    Sensor noise is max(quantum / sqrt 12, spread at rest, high-frequency residual); what metadata declare wins.

    Raises:
        UserError: no logs, logs of different robots, horizons out of order.
    """
    if not logs:
        raise UserError("floors: no logs; allowed: at least one")
    marks = np.asarray(horizons, float)
    if not len(marks) or (np.diff(marks, prepend=0.0) <= 0).any():
        raise UserError(f"floors: horizons = {list(horizons)}; allowed: increasing seconds > 0")
    other = [log.name for log in logs if log.channels != logs[0].channels]
    if other:
        raise UserError(f"floors: {other[0]!r} has other channels than {logs[0].name!r}; allowed: logs of one robot")
    qpos = _pooled([_sensor(log, "qpos") for log in logs])
    qvel = _pooled([_sensor(log, "qvel") for log in logs])
    groups = repeats(logs)
    if not groups:
        text = "no repeated runs: only the growth of the error separates chance from an error of the model"
        return Floors(qpos, qvel, warnings=(text,))
    rest = [_reproduced(group, marks) for group in groups]
    count = sum(r[2] for r in rest)
    squares = [np.sum([r[k] for r in rest], axis=0) / np.maximum(count, 1)[:, None] for k in (0, 1)]
    seen = count > 0
    return Floors(
        qpos,
        qvel,
        horizons=marks[seen],
        repeat_qpos=np.sqrt(squares[0][seen]),
        repeat_qvel=np.sqrt(squares[1][seen]),
        repeats=tuple(tuple(log.name for log in g) for g in groups),
    )


def _pooled(levels: list[Array]) -> Array:
    """The median: one set of sensors; what shakes in a few of the runs is motion, not noise."""
    return np.median(levels, axis=0)


def _sensor(log: Log, stream: str) -> Array:
    """[n]: the log's own estimate (quantum, residual, or declared) raised to its spread at rest."""
    names, values = getattr(log.channels, stream), getattr(log, stream)
    own = getattr(log, f"sigma_{stream}")
    declared = log.metadata.get("sigma") or {}
    known = [f"{stream}:{n}" in declared or (stream == "qpos" and n in declared) for n in names]
    if stream == "qvel" and not log.has_qvel:
        return own
    rest = [rest_spread(x) for x in values.T]
    return np.where(known, own, np.maximum(own, rest))


def told(log: Log, stream: str = "qpos") -> NDArray[np.bool_]:
    """`[nv]`: whether a log tells the noise of its positions, or of its velocities (`stream` qvel).

    A channel that shows fewer than `LEVELS` values tells none: it may have any resolution. What is stated wins: `sigma`
    or `quantum` of the metadata, or a standard deviation above what the values themselves show. Of several columns
    (an orientation) one is enough. A velocity that was not measured is not judged.
    """
    if stream == "qvel" and not log.has_qvel:
        return np.ones(len(log.channels.qvel), bool)
    given = {**(log.metadata.get("sigma") or {}), **(log.metadata.get("quantum") or {})}
    names, sigma = getattr(log.channels, stream), getattr(log, f"sigma_{stream}")
    stated = [f"{stream}:{n}" in given or (stream == "qpos" and n in given) for n in names]
    rows = zip(stated, getattr(log, stream).T, sigma, strict=True)
    own = [known or values_shown(x) >= LEVELS or s > 1.01 * noise_level(x) for known, x, s in rows]
    if stream == "qvel":
        return np.array(own, bool)
    out: list[bool] = []
    for joint, kind in zip(log.joints, log.channels.kinds, strict=True):
        of = own[log.channels.columns(joint)]
        moved = of[: {"free": 3, "ball": 0}.get(kind, 1)]
        out += [*moved, *[any(of[-4:])] * (3 if kind in ("free", "ball") else 0)]
    return np.array(out, bool)


def rest_spread(x: Array) -> float:
    """Standard deviation of x [T] where it rests: its slow part stays within 1 % of its range; 0 where it never does.

    Parabolas are taken out first: creep and turning points are motion.
    """
    count = len(x) // _REST
    if count < 4:
        return 0.0
    cut = x[: count * _REST].reshape(count, _REST)
    slow = uniform_filter1d(x, _REST, mode="nearest")[: count * _REST].reshape(count, _REST)
    resting = np.ptp(slow, axis=1) < 0.01 * np.ptp(x)
    if resting.sum() < max(3, 0.05 * count):
        return 0.0
    slow_basis, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, _REST), 3))
    left = cut[resting] - cut[resting] @ slow_basis @ slow_basis.T
    return float(np.median(np.sqrt(np.sum(left**2, axis=1) / (_REST - 3))))


def repeats(logs: Sequence[Log]) -> list[list[Log]]:
    """Groups of two or more runs of the same commands: declared by `repeat_of`, or found by equal command arrays."""
    parent = list(range(len(logs)))

    def root(i: int) -> int:
        while parent[i] != i:
            i = parent[i]
        return i

    names = {alias: i for i, log in enumerate(logs) for alias in log.aliases}
    for i, log in enumerate(logs):
        target = log.metadata.get("repeat_of")
        if target is None:
            continue
        if str(target) not in names:
            text = f"{log.name}: repeat_of = {target!r} is none of the logs; allowed: a file's name; it is left alone"
            warnings.warn(text, stacklevel=2)
        else:
            parent[root(i)] = root(names[str(target)])
    for (i, a), (j, b) in itertools.combinations(enumerate(logs), 2):
        if root(i) != root(j) and _same(a, b):
            parent[root(i)] = root(j)
    groups: dict[int, list[Log]] = {}
    for i, log in enumerate(logs):
        groups.setdefault(root(i), []).append(log)
    return [g for g in groups.values() if len(g) > 1]


def _same(a: Log, b: Log) -> bool:
    """The same commands at the same times from nearly the same state."""
    rows = min(len(a), len(b))
    if rows < 0.8 * max(len(a), len(b)) or not a.channels.actuators:
        return False
    clock = np.allclose(a.time[:rows] - a.time[0], b.time[:rows] - b.time[0], atol=0.1 * a.period)
    changing = np.ptp(a.ctrl, axis=0).any()
    if not (clock and changing and np.allclose(a.ctrl[:rows], b.ctrl[:rows], rtol=1e-6, atol=1e-9)):
        return False
    near = 6.0 * a.sigma_qpos + 0.01 * np.ptp(a.qpos, axis=0)
    return bool((np.abs(a.qpos[0] - b.qpos[0]) <= near).all())


def _reproduced(group: Sequence[Log], marks: Array) -> tuple[Array, Array, Array]:
    """Sums over rows and degrees of freedom of the runs' variance in bins that end at `marks`: qpos, qvel, count."""
    dt = max(log.period for log in group)
    even = [resample(log, dt) for log in group]
    rows = min(len(log) for log in even)
    since = dt * np.arange(rows)
    index = np.searchsorted(marks, since - 1e-9)
    spread = [np.var([getattr(log, k)[:rows] for log in even], axis=0, ddof=1) for k in ("qpos", "qvel")]
    weight = len(group) - 1
    inside = [index == k for k in range(len(marks))]
    qpos, qvel = (np.array([weight * s[m].sum(0) for m in inside]) for s in spread)
    return qpos, qvel, np.array([weight * m.sum() for m in inside])


def tau_int(x: Array, window: float = 5.0) -> float:
    """Integrated autocorrelation time of x [T] in rows: 1/2 + sum of the autocorrelation; 1/2 for white noise.

    Summed up to the first M >= `window` tau(M) (Sokal 1996, section 3).
    """
    centred = np.asarray(x, float) - np.mean(x)
    size = 1 << (2 * len(centred) - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size)) ** 2
    rho = np.fft.irfft(power, size)[: len(centred)]
    if rho[0] <= 0:
        return 0.5  # a constant has no memory
    tau = 0.5 + np.cumsum(rho[1:] / rho[0])
    enough = np.flatnonzero(np.arange(1, len(tau) + 1) >= window * tau)
    return float(max(0.5, tau[enough[0]] if len(enough) else tau[-1]))


def ess(x: Array) -> float:
    """Effective sample size of x [T]: T / (2 tau_int), between 1 and T."""
    return float(min(len(x), max(1.0, len(x) / (2.0 * tau_int(x)))))


@dataclass(frozen=True)
class Growth:
    """E^2(h) = sensor + process h^process_power + bias h^bias_power, h in s; squares of the unit of the error."""

    sensor: float
    process: float
    bias: float
    process_power: float
    bias_power: float
    misfit: float  # relative rms

    def parts(self, horizon: float) -> dict[str, float]:
        """The three squares at one horizon [s]."""
        return {
            "sensor": self.sensor,
            "process": self.process * horizon**self.process_power,
            "bias": self.bias * horizon**self.bias_power,
        }


def error_growth(horizons: Array, mse: Array) -> Growth:
    """Split the mean square error [H] of windows at horizons [H] s into sensor, chance and bias.

    A sensor's error does not grow; chance grows more slowly than bias. Non-negative least squares of relative errors.
    The powers are those of a random walk (1) or its integral (3), and of
    a wrong rate (2) or a wrong force (4); the pair that fits best is taken. Bias in short windows only: where motion
    saturates, the split means nothing.

    Raises:
        UserError: fewer than four horizons, or errors that are not positive.
    """
    h, e = np.asarray(horizons, float), np.asarray(mse, float)
    if h.shape != e.shape or h.ndim != 1 or len(h) < 4:
        raise UserError(f"error_growth: shapes {h.shape} and {e.shape}; allowed: [H] and [H], at least four horizons")
    if not ((h > 0).all() and (e > 0).all() and np.isfinite(e).all()):
        raise UserError("error_growth: horizons and mse have to be positive and finite")
    unit = float(h.max())  # scaled: powers of small times are tiny
    best: Growth | None = None
    for p, q in itertools.product(_PROCESS, _BIAS):
        x = np.stack([np.ones_like(h), (h / unit) ** p, (h / unit) ** q], 1)
        c, left = nnls(x / e[:, None], np.ones_like(e))
        grown = Growth(float(c[0]), float(c[1] / unit**p), float(c[2] / unit**q), p, q, left / float(np.sqrt(len(h))))
        if best is None or grown.misfit < best.misfit - 1e-9:
            best = grown
    assert best is not None
    return best
