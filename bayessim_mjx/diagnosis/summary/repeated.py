"""What runs of the same commands differ by: no model can be nearer to the logs than they are to each other."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.logcheck import noise
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """When runs count as repeated."""

    fewest: int = 3  # windows with a repeat: with fewer nothing is said
    same: float = 0.001  # of a command's range: commands that are the same


LIMITS = Limits()


def floor(fitter: Fitter, fit: Fit, logs: Sequence[Log]) -> tuple[Prediction, NDArray[np.int64]] | None:
    """The error of a perfect model of what repeats, window by window, and the windows' conditions `[P]`.

    Two runs of the same commands differ by twice the variance of what is not reproducible. What comes of their
    different start states is taken out as it is from a model's errors, by the fit's derivatives.

    Args:
        logs: as recorded, in the order of the windows' logs.

    Returns:
        None where nothing was repeated.
    """
    cut = fitter.simulator.windows
    errors, group = [], []
    for w, partner in _pairs(fitter, logs):
        a, b = (_states(fitter.simulator.physics.mj_model, cut.logs[r]) for r in (cut.log[w], partner))
        rows = slice(int(cut.start[w]) + 1, int(cut.start[w]) + 1 + cut.steps)
        d = _apart(fitter.simulator.physics.mj_model, a[rows], b[rows])[:, fitter.used] / fitter.sigma / np.sqrt(2)
        errors.append(_settled(d, fit.B[w], fitter.spread))
        group.append(cut.group[w])
    if len(errors) < LIMITS.fewest:
        return None
    return Prediction(np.stack(errors), np.zeros((len(errors), fit.offsets.shape[1]))), np.array(group)


def _pairs(fitter: Fitter, logs: Sequence[Log]) -> Iterator[tuple[int, int]]:
    """(window, another log with the same commands in the same rows)."""
    cut = fitter.simulator.windows
    index = {id(log): r for r, log in enumerate(logs)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # told where the noise was looked at
        groups = [[index[id(log)] for log in group] for group in noise.repeats(logs)]
    for w, (r, start) in enumerate(zip(cut.log, cut.start, strict=True)):
        for other in (p for group in groups if r in group for p in group if p != r):
            rows = slice(int(start), int(start) + cut.steps)
            if len(cut.logs[other]) > rows.stop and _same(cut.logs[r].ctrl, cut.logs[other].ctrl, rows):
                yield w, other


def _same(a: Array, b: Array, rows: slice) -> bool:
    return bool((np.abs(a[rows] - b[rows]) <= LIMITS.same * np.ptp(a, axis=0) + 1e-12).all())


def _states(model: mujoco.MjModel, log: Log) -> Array:
    return np.concatenate([log.qpos, log.qvel], axis=1)


def _apart(model: mujoco.MjModel, a: Array, b: Array) -> Array:
    """b - a `[H, 2 nv]`, positions in the tangent space."""
    out = np.zeros((len(a), 2 * model.nv))
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        mujoco.mj_differentiatePos(model, out[k, : model.nv], 1.0, x[: model.nq], y[: model.nq])
    out[:, model.nv :] = b[:, model.nq :] - a[:, model.nq :]
    return out


def _settled(d: Array, B: Array, spread: Array) -> Array:
    """d `[H, channels]` without what other start states explain: derivatives B `[n, s]`, a prior of `spread` each."""
    x = np.linalg.solve(B.T @ B + np.diag(1.0 / np.square(spread)), B.T @ d.reshape(-1))
    return np.asarray(d - (B @ x).reshape(d.shape))
