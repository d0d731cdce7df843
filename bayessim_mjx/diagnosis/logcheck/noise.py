"""Noise of the sensors, as far as the logs show it; runs of the same commands."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from bayessim_mjx.diagnosis.logcheck.single_log import ROWS
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.signals import LEVELS, noise_level, values_shown

Array = NDArray[np.float64]
# s, times a joint's speed: the least noise of a position, that of a simulation whose numbers are float32.
PRECISE = 4.0 * float(np.finfo(np.float32).eps)


def noise_known(log: Log, stream: str = "qpos") -> NDArray[np.bool_]:
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


def repeats(logs: Sequence[Log]) -> list[list[Log]]:
    """Group two or more runs of the same commands: declared by `repeat_of`, or found by equal command arrays.

    Raises:
        UserError: logs of different robots.
    """
    other = [log.name for log in logs if log.channels != logs[0].channels]
    if other:
        raise UserError(f"{other[0]!r} has other channels than {logs[0].name!r}; allowed: logs of one robot")
    names = {alias: i for i, log in enumerate(logs) for alias in log.aliases}
    same = np.zeros((len(logs), len(logs)), bool)
    for i, log in enumerate(logs):
        declared = names.get(str(log.metadata.get("repeat_of")))
        same[i, i if declared is None else declared] = True
    for (i, one), (j, other_one) in itertools.combinations(enumerate(logs), 2):
        same[i, j] |= _same(one, other_one)
    count, group = connected_components(same, directed=False) if logs else (0, [])
    found = [[log for log, own in zip(logs, group, strict=True) if own == k] for k in range(count)]
    return [runs for runs in found if len(runs) > 1]


def _same(a: Log, b: Log) -> bool:
    """Return the same commands at the same times from nearly the same state."""
    rows = min(len(a), len(b))
    if rows < 0.8 * max(len(a), len(b)) or not a.channels.actuators:
        return False
    clock = np.allclose(a.time[:rows] - a.time[0], b.time[:rows] - b.time[0], atol=0.1 * a.period)
    changing = np.ptp(a.ctrl, axis=0).any()
    if not (clock and changing and np.allclose(a.ctrl[:rows], b.ctrl[:rows], rtol=1e-6, atol=1e-9)):
        return False
    near = 6.0 * a.sigma_qpos + 0.01 * np.ptp(a.qpos, axis=0)
    return bool((np.abs(a.qpos[0] - b.qpos[0]) <= near).all())


def noise_free(logs: Sequence[Log], column: int) -> bool:
    """Whether a position shows no noise: of white noise all differences have the same level, smooth motion has none.

    Rows of rest say nothing: an encoder without dither shows one value there, and so does a simulation.
    """
    shares = [s for log in logs if (s := _smooth(log.qpos[:, column])) is not None]
    return bool(shares) and bool(np.median(shares) < 0.1)


def _smooth(x: Array) -> float | None:
    """Level of the eighth differences of x [T] in that of the fourth ones, where x moves; None: it hardly does."""
    if len(x) <= ROWS + 8:
        return None
    changing = np.asarray(np.lib.stride_tricks.sliding_window_view(np.diff(x) != 0, 8).any(1))
    if changing.sum() < ROWS:
        return None
    return _level(x, 8, changing) / max(_level(x, 4, changing), 1e-300)


def _level(x: Array, order: int, rows: NDArray[np.bool_]) -> float:
    """Return standard deviation of white noise in x [T] by differences of an order: Var = binomial(2 n, n) sigma^2."""
    return float(np.median(np.abs(np.diff(x, order)[: len(rows)][rows])) / np.sqrt(comb(2 * order, order)))


def noise_of(logs: Sequence[Log], raw: Sequence[Log], use_qvel: bool) -> tuple[Array, Array, Array]:
    """(sigma_q [nv], sigma_v [nv], spread of the start [2 nv]), pooled over logs; inf where nothing tells a noise.

    raw: the logs before they were resampled: a spline shows values that no sensor did.

    Raises:
        UserError: no channel's noise is known.
    """
    dofs = noise_of_positions(raw)
    rate, moved = _pooled([log.sigma_qvel for log in logs], [noise_known(log, "qvel") for log in raw])
    motion = np.sqrt(np.mean([np.mean(log.qvel**2, axis=0) for log in logs], axis=0))
    known, precise = np.isfinite(dofs), np.maximum(PRECISE * motion, 1e-14)
    if not (known | moved & use_qvel).any():
        text = f"{raw[0].name}: no position shows {LEVELS} values in any log, so the noise of the sensors is unknown"
        raise UserError(f"{text}; allowed: `quantum` or `sigma` in the logs' side YAML, or logs that move")
    seen, fast = (np.all([getattr(log, k) for log in logs], axis=0) for k in ("seen_dofs", "seen_speeds"))
    fast |= not any(log.absent for log in logs)
    kept = fast & moved & (use_qvel | ~seen)  # the only measurement of a joint is compared in any case
    sigma_q, sigma_v = np.maximum(dofs, precise), np.where(kept, np.maximum(rate, 1e-3 * motion), np.inf)
    # where nothing tells the noise, a start is as uncertain as the usual sensor of this robot leaves it
    usual = np.where(known, sigma_q, np.median(sigma_q[known]) if known.any() else 1.0)
    start_v = np.maximum(3 * rate, 0.1 * motion + 10 * usual)
    guess = np.sqrt(np.mean([log.sigma_dofs**2 for log in logs], axis=0))
    start_q = np.where(seen, usual, np.maximum(guess, precise))
    start_v = np.where(seen, start_v, 3 * rate + 0.1 * motion)  # what is guessed is not tied to its position's guess
    return np.where(seen, sigma_q, np.inf), sigma_v, np.concatenate([3 * start_q, start_v])


def noise_of_positions(logs: Sequence[Log]) -> Array:
    """`[nv]`, standard deviation of each position's noise, pooled over the logs that tell it; inf where none does.

    logs: as recorded.
    """
    pooled, known = _pooled([log.sigma_dofs for log in logs], [noise_known(log) for log in logs])
    return np.where(known, pooled, np.inf)


def _pooled(sigma: Sequence[Array], shown: Sequence[NDArray[np.bool_]]) -> tuple[Array, NDArray[np.bool_]]:
    """(root mean square `[n]` over the logs that tell a noise, of all where none does; whether one does)."""
    own, known = np.asarray(shown), np.any(shown, axis=0)
    counts = own | ~known
    return np.sqrt(np.sum(np.square(sigma) * counts, axis=0) / counts.sum(0)), known


def not_compared(logs: Sequence[Log]) -> list[str]:
    """In words, the positions that were measured but whose noise nothing tells."""
    unknown = ~np.isfinite(noise_of_positions(logs)) & np.all([log.seen_dofs for log in logs], axis=0)
    names = [f"qpos:{n}" for n, off in zip(logs[0].channels.qvel, unknown, strict=True) if off]
    if not names:
        return []
    text = f"{', '.join(names)}: fewer than {LEVELS} values in every log, so the noise is unknown there"
    return [f"{text}; `quantum` or `sigma` in the logs' side YAML states it"]
