"""The Kalman filter along linear error dynamics of recorded motion: gains, and what it does not predict.

The state is (position tangent, velocity) of 2 nv numbers, and a force that is not modelled and lasts, as the velocity
that it gives in a control step (nv numbers). Sarkka (2013), Bayesian Filtering and Smoothing, 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array


@dataclass(frozen=True)
class Force:
    """A force that is not modelled and lasts: a stationary first-order process in each degree of freedom.

    Attributes:
        sd: `[nv]` standard deviations of the velocity that it gives in a control step.
        lasting: its correlation from one control step to the next.
        dt: control step, s.
    """

    sd: np.ndarray
    lasting: float
    dt: float


class Gains(struct.PyTreeNode):
    """Of a filter along N recorded trajectories, for errors (position tangent, velocity) of 2 nv numbers.

    Attributes:
        gain: `[N, T, 3 nv, 2 nv]`, 0 in the columns of what is not measured; the last nv rows are those of a force that
            is not modelled, as the velocity that it gives in a control step.
        whitener: `[N, T, 2 nv, 2 nv]`, W with W^T W the inverse of the innovations' covariance (0 where not measured).
        log_size: `[N, T]`, log |W| over what is measured.
        lasting: `[N]`, the share of that force that is still there a control step later.
    """

    gain: Array
    whitener: Array
    log_size: Array
    lasting: Array


def push(nv: int, dt: float) -> np.ndarray:
    """[2 nv, nv] what a force that gives those velocities in a control step of dt s does to the state in it."""
    return np.concatenate([0.5 * dt * np.eye(nv), np.eye(nv)])


def riccati(
    ways: np.ndarray, sensor: np.ndarray, process: np.ndarray, start: np.ndarray, force: Force | None = None
) -> Gains:
    """Gains of the Kalman filter along linear error dynamics.

    Args:
        ways: `[N, T, 2 nv, 2 nv]`, see `transitions`.
        sensor: `[2 nv]` standard deviations of the measurement noise; inf where nothing is measured.
        process: `[2 nv]` standard deviations of what a control step adds to the state.
        start: `[2 nv]` standard deviations of the start state's error.
        force: one that lasts, or None.
    """
    n, steps, size, _ = ways.shape
    nv, seen = size // 2, np.isfinite(sensor)
    force = force or Force(np.zeros(nv), 0.0, 0.0)
    noise = np.diag(sensor[seen] ** 2)
    fresh = force.sd**2 * (1 - force.lasting**2)
    added = np.diag(np.concatenate([process**2, fresh]))
    spread = np.repeat(np.diag(np.concatenate([start**2, force.sd**2]))[None], n, axis=0)
    gain, whitener = np.zeros((n, steps, size + nv, size)), np.zeros((n, steps, size, size))
    log_size, at = np.zeros((n, steps)), np.ix_(seen, seen)
    way = np.zeros((n, size + nv, size + nv))
    way[:, :size, size:] = push(nv, force.dt)
    way[:, size:, size:] = force.lasting * np.eye(nv)
    for t in range(steps):
        way[:, :size, :size] = np.nan_to_num(ways[:, t])
        spread = np.clip(way @ spread @ np.swapaxes(way, -1, -2) + added, -1e12, 1e12)
        known = np.concatenate([seen, np.zeros(nv, bool)])
        inner = spread[:, known][:, :, known] + noise
        k = np.swapaxes(np.linalg.solve(inner, spread[:, known, :]), -1, -2)
        gain[:, t][:, :, seen] = k
        lower = np.linalg.cholesky(inner)
        white = np.linalg.inv(lower)
        for row in range(n):
            whitener[row, t][at] = white[row]
        log_size[:, t] = -np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
        keep = np.eye(size + nv) - np.concatenate([gain[:, t], np.zeros((n, size + nv, nv))], axis=-1)
        spread = keep @ spread @ np.swapaxes(keep, -1, -2) + k @ noise @ np.swapaxes(k, -1, -2)
    arrays = (jnp.asarray(x, jnp.float32) for x in (gain, whitener, log_size, np.full(n, force.lasting)))
    return Gains(*arrays)


def measured_noise(
    ways: np.ndarray, gains: Gains, white: np.ndarray, dt: float, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sum [2 nv] over all rows of u^2 and of its variance D, where the sensors' noise is R (u, diag(R - R D R)).

    The smoothed measurement noise, by a backward pass over innovations: Koopman (1993), Biometrika 80, 117. Each number
    of R then has the EM step R + R^2 (mean u^2 - mean D).

    Args:
        ways: `[N, T, 2 nv, 2 nv]`, see `transitions`.
        gains: of the filter.
        white: `[N, T, 2 nv]` its whitened innovations.
        dt: control step, s.
        valid: `[N, T]` 1 where a row counts.
    """
    n, steps, size, _ = ways.shape
    nv = size // 2
    known = np.asarray(valid, float)[:, :, None, None]
    gain, whitener = np.asarray(gains.gain, float) * known, np.asarray(gains.whitener, float) * known
    lasting = np.asarray(gains.lasting, float)
    way = np.zeros((n, size + nv, size + nv))
    way[:, :size, size:] = push(nv, dt)
    way[:, size:, size:] = lasting[:, None, None] * np.eye(nv)
    after, spread = np.zeros((n, size + nv)), np.zeros((n, size + nv, size + nv))  # r and N behind the next row's step
    squares, variances = np.zeros(size), np.zeros(size)
    for t in range(steps - 1, -1, -1):
        k, w = gain[:, t], whitener[:, t]
        inverse = np.swapaxes(w, -1, -2) @ w
        u = np.einsum("nji,nj->ni", w, white[:, t]) - np.einsum("nji,nj->ni", k, after)
        d = inverse + np.swapaxes(k, -1, -2) @ spread @ k
        squares += (u**2 * known[:, t, :, 0]).sum(0)
        variances += (np.diagonal(d, axis1=1, axis2=2) * known[:, t, :, 0]).sum(0)
        keep = np.eye(size + nv) - np.concatenate([k, np.zeros((n, size + nv, nv))], axis=-1)
        here = np.einsum("nji,nj->ni", keep, after)
        here[:, :size] += np.einsum("nji,nj->ni", w, white[:, t])
        about = np.swapaxes(keep, -1, -2) @ spread @ keep
        about[:, :size, :size] += inverse
        way[:, :size, :size] = np.nan_to_num(ways[:, t])
        after = np.einsum("nji,nj->ni", way, here)
        spread = np.swapaxes(way, -1, -2) @ about @ way
    return squares, variances


def innovations(ways: np.ndarray, gaps: np.ndarray, path: Gains, gains: Gains, dt: float) -> np.ndarray:
    """Whitened prediction errors [N, T, 2 nv] of a filter, by linear error dynamics along the path of another.

    Args:
        ways: `[N, T, 2 nv, 2 nv]` along that path; gaps: `[N, T, 2 nv]` prediction errors of the filter that took it.
        path: gains of the filter that took it.
        gains: of the filter that is asked for.
        dt: control step, s.
    """
    size = gaps.shape[-1]
    gain, white = np.asarray(gains.gain, float), np.asarray(gains.whitener, float)
    lasting, pushes = np.asarray(gains.lasting, float)[:, None], push(size // 2, dt).T
    drawn = np.einsum("ntij,ntj->nti", np.asarray(path.gain, float), np.nan_to_num(gaps))
    their_lasting = np.asarray(path.lasting, float)[:, None]
    away = np.zeros((len(gaps), size))  # of this filter's state from the path's
    force, theirs = np.zeros((2, len(gaps), size // 2))
    out = np.zeros(gaps.shape)
    for t in range(gaps.shape[1]):
        ahead = np.einsum("nij,nj->ni", np.nan_to_num(ways[:, t]), away) + (force - theirs) @ pushes
        gap = gaps[:, t] - ahead
        by = np.einsum("nij,nj->ni", gain[:, t], gap)
        out[:, t] = np.einsum("nij,nj->ni", white[:, t], gap)
        away = ahead + by[:, :size] - drawn[:, t, :size]
        force, theirs = lasting * force + by[:, size:], their_lasting * theirs + drawn[:, t, size:]
    return out
