"""Noise of what the windows compare, pooled over logs; a channel whose noise no log tells has no say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.logcheck.noise import told
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.signals import LEVELS

Array = NDArray[np.float64]
PRECISE = 5e-7  # s: times a joint's speed, as precise as positions are taken to be that show no noise (a simulation's)


def noise_of(logs: Sequence[Log], raw: Sequence[Log], use_qvel: bool) -> tuple[Array, Array, Array]:
    """(sigma_q [nv], sigma_v [nv], spread of the start [2 nv]), pooled over logs; inf where nothing tells a noise.

    raw: the logs before they were resampled: a spline shows values that no sensor did.

    Raises:
        UserError: no channel's noise is told.
    """
    dofs = noise_of_positions(raw)
    rate, moved = _pooled([log.sigma_qvel for log in logs], [told(log, "qvel") for log in raw])
    motion = np.sqrt(np.mean([np.mean(log.qvel**2, axis=0) for log in logs], axis=0))
    known, precise = np.isfinite(dofs), np.maximum(PRECISE * motion, 1e-14)
    sigma_q = np.maximum(dofs, precise)
    sigma_v = np.where(moved & use_qvel, np.maximum(rate, 1e-3 * motion), np.inf)
    # where nothing tells the noise, a start is as uncertain as the usual sensor of this robot leaves it
    start_q = np.where(known, sigma_q, np.median(sigma_q[known]) if known.any() else 1.0)
    start_v = np.maximum(3 * rate, 0.1 * motion + 10 * start_q)
    if not (np.isfinite(sigma_q) | np.isfinite(sigma_v)).any():
        text = f"{raw[0].name}: no position shows {LEVELS} values in any log, so nothing tells the noise of the sensors"
        raise UserError(f"{text}; allowed: `quantum` or `sigma` in the logs' side YAML, or logs that move")
    if not any(log.absent for log in logs):
        return sigma_q, sigma_v, np.concatenate([3 * start_q, start_v])
    seen, fast = (np.all([getattr(log, k) for log in logs], axis=0) for k in ("seen_dofs", "seen_speeds"))
    kept = fast & moved & (use_qvel | ~seen)  # the only measurement of a joint is compared in any case
    sigma_v = np.where(kept, np.maximum(rate, 1e-3 * motion), np.inf)
    guess = np.sqrt(np.mean([log.sigma_dofs**2 for log in logs], axis=0))
    start_q = np.where(seen, start_q, np.maximum(guess, precise))
    start_v = np.where(seen, start_v, 3 * rate + 0.1 * motion)  # what is guessed is not tied to its position's guess
    return np.where(seen, sigma_q, np.inf), sigma_v, np.concatenate([3 * start_q, start_v])


def noise_of_positions(logs: Sequence[Log]) -> Array:
    """`[nv]`, standard deviation of each position's noise, pooled over the logs that tell it; inf where none does.

    logs: as recorded.
    """
    pooled, known = _pooled([log.sigma_dofs for log in logs], [told(log) for log in logs])
    return np.where(known, pooled, np.inf)


def _pooled(sigma: Sequence[Array], told: Sequence[NDArray[np.bool_]]) -> tuple[Array, NDArray[np.bool_]]:
    """(root mean square `[n]` over the logs that tell a noise, of all where none does; whether one does)."""
    own, known = np.asarray(told), np.any(told, axis=0)
    counts = own | ~known
    return np.sqrt(np.sum(np.square(sigma) * counts, axis=0) / counts.sum(0)), known


def not_compared(logs: Sequence[Log]) -> list[str]:
    """In words, the positions that were measured but whose noise nothing tells."""
    unknown = ~np.isfinite(noise_of_positions(logs)) & np.all([log.seen_dofs for log in logs], axis=0)
    names = [f"qpos:{n}" for n, off in zip(logs[0].channels.qvel, unknown, strict=True) if off]
    if not names:
        return []
    text = f"{', '.join(names)}: fewer than {LEVELS} values in every log tell no noise, so nothing is compared there"
    return [f"{text}; `quantum` or `sigma` in the logs' side YAML would tell it"]
