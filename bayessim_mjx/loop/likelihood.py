"""The simulator's own likelihood of recorded trajectories: one-step prediction errors, with noise that is estimated.

Sensor and process noise are estimated near a theta: what the simulator cannot follow counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammainc, gammaln

from bayessim_mjx.distributions.charts import from_chart, to_chart
from bayessim_mjx.kalman import Force, Gains, innovations, riccati
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.tangent import addresses
from bayessim_mjx.tracking import Record, close, errors, transitions

FINEST = 1e-3  # of a channel's range of motion: no sensor is believed to be better
PROCESS = (1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 10.0)  # of unmodelled forces, in the velocity's sensor noise
LASTING = (0.7, 0.9, 0.97)  # their correlations from step to step
RATIOS = (0.1, 0.3, 1.0, 3.0, 10.0)  # velocity's sensor noise against position's, times what was given
SETTLED = 0.1  # relative change of the log likelihood's unit at which noise and posterior agree
LOOKED = 4  # trajectories at which noise is estimated
SLOPE = 0.01  # step of central differences in z
LEAP = 1.0  # longest step in z that linear dynamics are believed


@dataclass(frozen=True)
class Noise:
    """What the simulator does not explain.

    Attributes:
        sensor: `[2 nv]` standard deviations, positions first; inf where nothing is measured.
        process: `[nv]` standard deviations of the velocity that unmodelled forces give in a control step.
        lasting: their correlation from one control step to the next.
    """

    sensor: np.ndarray
    process: np.ndarray
    lasting: float = 0.0


@dataclass(frozen=True)
class _Linear:
    """Dynamics of n records near a theta: `ways`, `gaps`, `path` as in `kalman.innovations`.

    slopes: `[d, n, T, 2 nv]` of the gaps in the probit coordinates z `[d]` of theta; valid: `[n, T]`.
    """

    ways: np.ndarray
    gaps: np.ndarray
    slopes: np.ndarray
    z: np.ndarray
    path: Gains
    valid: np.ndarray

    def whitened(self, gains: Gains, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Prediction errors [R] of the filter with those gains, and their slopes [R, d] in z."""
        rows = [self.gaps, *self.slopes]

        def again(x: Any) -> np.ndarray:
            return np.concatenate([np.asarray(x, float)] * len(rows))

        path, gains = jax.tree.map(again, self.path), jax.tree.map(again, gains)
        found = innovations(again(self.ways), np.concatenate(rows), path, gains, dt)
        found = found.reshape(len(rows), *self.gaps.shape) * self.valid[:, :, None]
        return found[0].ravel(), found[1:].reshape(len(self.slopes), -1).T


class Likelihood:
    """The likelihood of records, with noise that is estimated at a theta.

    Args:
        physics: the simulator.
        record: what was measured, N trajectories of T steps.
        valid: `[N, T]` 1 while the episode ran.
        sensor: `[2 nv]` standard deviations of the measurement noise as far as known: inf where nothing is measured.
        together: trajectories in one call, so that more of them need no other program; None: all.
    """

    def __init__(
        self, physics: Physics, record: Record, valid: np.ndarray, sensor: np.ndarray, together: int | None = None
    ) -> None:
        self.physics, self.record, self.valid = physics, record, np.asarray(valid, float)
        count = len(self.valid)
        each = together if together and count % together == 0 else count
        self.parts = [slice(i, i + each) for i in range(0, count, each)]
        nv = physics.mj_model.nv
        size = _travel(record, physics)
        self.scale = size
        self.floor = np.where(np.isfinite(sensor), np.maximum(np.nan_to_num(sensor, posinf=0.0), FINEST * size), np.inf)
        self.seen = np.isfinite(self.floor)
        self.nv = nv
        self.noise = Noise(self.floor, np.zeros(nv))
        self.gains: Gains | None = None
        self.laplace: tuple[np.ndarray, np.ndarray] | None = None  # of z, by the last linear dynamics
        self.count = float(self.valid.sum() * self.seen.sum())

    def settle(self, theta: np.ndarray) -> bool:
        """Estimate the noise at theta [d]; returns whether it has changed much."""
        before = self.noise
        path = self.gains or self._linearised(theta, close(self.record, self.nv))
        self.gains = self._linearised(theta, path)
        noise, seen = self.noise, self.seen
        moved = np.abs(np.log(noise.sensor[seen] / before.sensor[seen])).max()
        most = max(before.process.max(), noise.process.max(), 1e-30)
        drift = np.abs(noise.process - before.process).max() / most + abs(noise.lasting - before.lasting)
        return bool(moved > SETTLED or drift > SETTLED)

    def _linearised(self, theta: np.ndarray, path: Gains) -> Gains:
        """Gains, and the noise behind them, from the dynamics along the filter's path with those gains.

        Around the measurements themselves, half the dynamics' curvature times the sensors' variance would look like a
        force that lasts (Jazwinski 1970, 9.7: the iterated filter).
        """
        ways, gaps = self._dynamics(theta, path, self.parts)
        linear = self._linear(theta, path, ways, gaps)
        self.noise = self._noise(linear)
        self.laplace = self._posterior(linear)
        gains = self._gains(ways, self.noise)
        mask = jnp.asarray(self.valid, jnp.float32)[:, :, None, None]
        return gains.replace(gain=gains.gain * mask, whitener=gains.whitener * mask)

    def _linear(self, theta: np.ndarray, path: Gains, ways: np.ndarray, gaps: np.ndarray) -> _Linear:
        few, each = min(LOOKED, len(self.valid)), self.parts[0].stop
        parts = self.parts[: -(-few // each)]
        space = self.physics.space
        z = to_chart(space.to_unit(jnp.asarray(theta, jnp.float32)), "probit")

        def moved(k: int, by: float) -> np.ndarray:
            at = space.from_unit(from_chart(z.at[k].add(by), "probit"))
            return self._dynamics(np.asarray(at), path, parts)[1][:few]

        slopes = np.stack([(moved(k, SLOPE) - moved(k, -SLOPE)) / (2 * SLOPE) for k in range(len(z))])
        rows = slice(0, few)
        return _Linear(ways[rows], gaps[rows], slopes, np.asarray(z, float), _rows(path, rows), self.valid[rows])

    def _noise(self, linear: _Linear) -> Noise:
        """The most likely noise, each number that is not needed left out (BIC): first what acts, then the sensors."""
        paid = 0.5 * np.log(linear.valid.sum() * self.seen.sum())
        unit = np.where(self.seen, self.floor, FINEST * self.scale)[self.nv :]
        still = np.zeros(self.nv)
        acting = [(0.0, still, 0.0), *((1.0, q * unit, 0.0) for q in PROCESS)]
        acting += [(2.0, q * unit, lasting) for q in PROCESS for lasting in LASTING]
        best, noise = -np.inf, self.noise

        def tried(ratio: float, cost: float, force: np.ndarray, lasting: float) -> None:
            nonlocal best, noise
            sensor = self.floor * np.concatenate([np.ones(self.nv), np.full(self.nv, ratio)])
            guess = Noise(sensor, force, lasting)
            value, size = self._fit(linear, guess)
            value -= paid * (cost + (ratio != 1.0))
            if value > best:
                best, noise = value, replace(guess, sensor=sensor * size, process=force * size)

        for cost, force, lasting in acting:
            tried(1.0, cost, force, lasting)
        size = float(np.median(noise.sensor[self.seen] / self.floor[self.seen]))
        cost = float(noise.process.any()) + float(noise.lasting > 0)
        for ratio in RATIOS:
            tried(ratio, cost, noise.process / size, noise.lasting)
        return noise

    def _gains(self, ways: np.ndarray, noise: Noise) -> Gains:
        nothing = np.zeros(2 * self.nv)
        if noise.lasting:
            force = Force(noise.process, noise.lasting, self.physics.dt)
            return riccati(ways, noise.sensor, nothing, self._start(noise), force)
        white = np.concatenate([nothing[self.nv :], noise.process])
        return riccati(ways, noise.sensor, white, self._start(noise))

    def _dynamics(self, theta: np.ndarray, path: Gains, parts: list[slice]) -> tuple[np.ndarray, np.ndarray]:
        found = [
            transitions(self.physics, theta, _rows(self.record, part), _rows(path, part), self.scale) for part in parts
        ]
        return np.concatenate([ways for ways, _ in found]), np.concatenate([gaps for _, gaps in found])

    def _start(self, noise: Noise) -> np.ndarray:
        """Standard deviations of the start state: as measured, or anything where it is not."""
        return np.where(self.seen, noise.sensor, 0.3 * self.scale)

    def _posterior(self, linear: _Linear) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean [d] and covariance [d, d] of z by the linear dynamics of the first trajectories, all they tell.

        A step of Gauss-Newton, at most LEAP in any direction: farther away the dynamics are others.
        """
        error, slope = linear.whitened(self._gains(linear.ways, self.noise), self.physics.dt)
        if not (np.isfinite(error).all() and np.isfinite(slope).all()):
            return None
        precision = slope.T @ slope + np.eye(len(linear.z))
        step = -np.linalg.solve(precision, slope.T @ error + linear.z)
        return linear.z + step * min(1.0, LEAP / max(np.abs(step).max(), 1e-30)), np.linalg.inv(precision)

    def _fit(self, linear: _Linear, noise: Noise) -> tuple[float, float]:
        """(log evidence at the best common factor on the noise, that factor), by linear dynamics.

        Theta is integrated out near where it was: at one theta, what a better one explains would count as noise.
        """
        gains = self._gains(linear.ways, noise)
        error, slope = linear.whitened(gains, self.physics.dt)
        if not (np.isfinite(error).all() and np.isfinite(slope).all()):
            return -np.inf, 1.0
        count, factor = linear.valid.sum() * self.seen.sum(), 1.0
        for _ in range(2):
            precision = slope.T @ slope / factor + np.eye(len(linear.z))
            step = -np.linalg.solve(precision, slope.T @ error / factor + linear.z)
            squares = float(np.sum((error + slope @ step) ** 2))
            factor = max(squares / count, 1.0)  # not below the floor
        sizes = float(np.sum(np.asarray(gains.log_size, float) * linear.valid))
        value = sizes - 0.5 * count * np.log(factor) - 0.5 * squares / factor
        value -= 0.5 * float(np.sum((linear.z + step) ** 2)) + 0.5 * float(np.linalg.slogdet(precision)[1])
        return value, float(np.sqrt(factor))

    def squares(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared whitened prediction errors [M, N, blocks] at thetas [M, d]."""
        assert self.gains is not None, "settle first"
        each = [errors(self.physics, thetas, _rows(self.record, part), _rows(self.gains, part)) for part in self.parts]
        return np.concatenate([np.asarray(x, np.float64) for x in each], axis=1)

    @property
    def least(self) -> float:
        """The least factor on the variance of the noise as it was estimated: sensors are no better than was told.

        Velocity's noise may be any ratio of position's (RATIOS), so positions tell, where they are measured.
        """
        use = self.seen & (np.arange(2 * self.nv) < self.nv) if self.seen[: self.nv].any() else self.seen
        return float(np.min((self.floor[use] / self.noise.sensor[use]) ** 2))

    def log_likelihood(self, squares: np.ndarray) -> np.ndarray:
        """[M] of `squares`, the common factor on all noise marginalised with a prior of one number's worth at 1.

        It is no less than `least`: prediction errors that are small by chance make nothing sharper.
        """
        total = squares.sum((1, 2))
        shape = 0.5 * (self.count + 1)
        return -shape * np.log1p(total) + _log_gammainc(shape, 0.5 * (1 + total) / self.least)


def _log_gammainc(shape: float, x: np.ndarray) -> np.ndarray:
    """Log of the regularised lower incomplete gamma function [M] at x [M], also where that is no number of float64."""
    found = gammainc(shape, x)
    with np.errstate(divide="ignore", invalid="ignore"):  # x is infinite where a simulation diverged: 0 is right there
        first = shape * np.log(x) - x - gammaln(shape + 1) - np.log1p(-np.minimum(x / (shape + 1), 0.999))
        return np.where(found > 1e-200, np.log(found), first)


def _travel(record: Record, physics: Physics) -> np.ndarray:
    """Range of motion [2 nv] of positions (angles at most pi) and velocities."""
    nv = physics.mj_model.nv
    speed = np.asarray(record.qvel, float).reshape(-1, nv)
    span = np.ptp(speed, axis=0)
    qpos = np.asarray(record.qpos, float).reshape(-1, physics.mj_model.nq)
    travel = np.array([min(np.ptp(qpos[:, q]), np.pi) if q is not None else 1.0 for q in addresses(physics.mj_model)])
    return np.maximum(np.concatenate([travel, span]), 1e-6)


def _rows(tree: Any, rows: slice) -> Any:
    return jax.tree.map(lambda x: x[rows], tree)


__all__ = ["Likelihood", "Noise"]
