"""The mean of a logged command over any steps: held from row to row, or running linearly between rows."""

from __future__ import annotations

import numpy as np

from bayessim_mjx.logs.log import Array


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
    return _linear(time, x, edges, before) if linear else _held(time, x, edges, before, after)


def _held(time: Array, x: Array, edges: Array, before: float, after: float) -> Array:
    """Integrals of each column from `before` to the edges."""
    times = np.concatenate([[before], time[1:], [after]])
    area = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x * np.diff(times)[:, None], axis=0)])
    return np.stack([np.interp(edges, times, a) for a in area.T], 1)


def _linear(time: Array, x: Array, edges: Array, before: float) -> Array:
    """The same of the trapezoids between rows: within a row the integral is a parabola."""
    times, values = np.append(before, time), np.concatenate([x[:1], x])
    steps = np.diff(times)
    area = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]) * steps[:, None], 0)])
    rise = np.append(np.where(steps > 0, 1 / np.maximum(steps, 1e-300), 0.0), 0.0)[:, None]
    slope = rise * np.concatenate([np.diff(values, axis=0), np.zeros((1, x.shape[1]))])
    at = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, len(times) - 1)
    since = (edges - times[at])[:, None]
    return np.asarray(area[at] + values[at] * since + 0.5 * slope[at] * since**2)
