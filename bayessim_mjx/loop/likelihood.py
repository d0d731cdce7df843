"""The simulator's own likelihood of recorded trajectories: one-step prediction errors, with noise that is estimated.

Sensor and process noise are estimated at a theta: what the simulator cannot follow counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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
        self.count = float(self.valid.sum() * self.seen.sum())

    def settle(self, theta: np.ndarray) -> bool:
        """Estimate the noise at theta [d]; returns whether it has changed much."""
        before = self.noise
        if self.gains is None:
            self._linearise(theta, close(self.record, self.nv))
        self._linearise(theta, self.gains)
        noise, seen = self.noise, self.seen
        moved = np.abs(np.log(noise.sensor[seen] / before.sensor[seen])).max()
        most = max(before.process.max(), noise.process.max(), 1e-30)
        drift = np.abs(noise.process - before.process).max() / most + abs(noise.lasting - before.lasting)
        return bool(moved > SETTLED or drift > SETTLED)

    def _linearise(self, theta: np.ndarray, path: Gains) -> None:
        """Noise and gains from the dynamics along the filter's path with those gains.

        Around the measurements themselves, half the dynamics' curvature times the sensors' variance would look like a
        force that lasts (Jazwinski 1970, 9.7: the iterated filter).
        """
        parts = [self._dynamics(theta, path, part) for part in self.parts]
        ways, gaps = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
        few = slice(0, min(LOOKED, len(self.valid)))
        self.noise = self._noise(ways[few], gaps[few], _rows(path, few), self.valid[few])
        gains = self._gains(ways, self.noise)
        mask = jnp.asarray(self.valid, jnp.float32)[:, :, None, None]
        self.gains = gains.replace(gain=gains.gain * mask, whitener=gains.whitener * mask)

    def _noise(self, ways: np.ndarray, gaps: np.ndarray, path: Gains, valid: np.ndarray) -> Noise:
        """The most likely noise, each number that is not needed left out (BIC): first what acts, then the sensors."""
        paid = 0.5 * np.log(valid.sum() * self.seen.sum())
        unit = np.where(self.seen, self.floor, FINEST * self.scale)[self.nv :]
        still = np.zeros(self.nv)
        acting = [(0.0, still, 0.0), *((1.0, q * unit, 0.0) for q in PROCESS)]
        acting += [(2.0, q * unit, lasting) for q in PROCESS for lasting in LASTING]
        best, noise = -np.inf, self.noise

        def tried(ratio: float, cost: float, force: np.ndarray, lasting: float) -> None:
            nonlocal best, noise
            sensor = self.floor * np.concatenate([np.ones(self.nv), np.full(self.nv, ratio)])
            guess = Noise(sensor, force, lasting)
            value, size = self._fit(ways, gaps, path, guess, valid)
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

    def _dynamics(self, theta: np.ndarray, path: Gains, part: slice) -> tuple[np.ndarray, np.ndarray]:
        return transitions(self.physics, theta, _rows(self.record, part), _rows(path, part), self.scale)

    def _start(self, noise: Noise) -> np.ndarray:
        """Standard deviations of the start state: as measured, or anything where it is not."""
        return np.where(self.seen, noise.sensor, 0.3 * self.scale)

    def _fit(
        self, ways: np.ndarray, gaps: np.ndarray, path: Gains, noise: Noise, valid: np.ndarray
    ) -> tuple[float, float]:
        """(log likelihood at the best common factor on the noise, that factor), by linear error dynamics."""
        gains = self._gains(ways, noise)
        squares = float(np.sum(innovations(ways, gaps, path, gains, self.physics.dt) ** 2 * valid[:, :, None]))
        count = valid.sum() * self.seen.sum()
        factor = max(squares / count, 1.0)  # not below the floor
        sizes = float(np.sum(np.asarray(gains.log_size, float) * valid))
        return sizes - 0.5 * count * np.log(factor) - 0.5 * squares / factor, float(np.sqrt(factor))

    def squares(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared whitened prediction errors [M, N, blocks] at thetas [M, d]."""
        assert self.gains is not None, "settle first"
        each = [errors(self.physics, thetas, _rows(self.record, part), _rows(self.gains, part)) for part in self.parts]
        return np.concatenate([np.asarray(x, np.float64) for x in each], axis=1)

    def log_likelihood(self, squares: np.ndarray) -> np.ndarray:
        """[M] of `squares`, the common factor on all noise marginalised with a prior of one number's worth at 1."""
        total = squares.sum((1, 2))
        return -0.5 * (self.count + 1) * np.log1p(total)


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
