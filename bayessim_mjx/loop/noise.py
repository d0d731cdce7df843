"""What the simulator does not explain of recorded motion: sensor noise, and forces that are not modelled.

Estimated near a theta, by the linear dynamics there: what the simulator cannot follow counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from bayessim_mjx.kalman import Force, Gains, innovations, riccati
from bayessim_mjx.loop.starts import Starts

FINEST = 1e-3  # of a channel's range of motion: no sensor is believed to be better
PROCESS = (1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # of unmodelled forces, in the velocity's sensor noise
FINER = (3.0**0.5, 3.0**0.25)  # what the most likely of them is multiplied and divided by after that
LASTING = (0.7, 0.9, 0.97)  # their correlations from step to step
RATIOS = (0.1, 0.3, 1.0, 3.0, 10.0)  # velocity's sensor noise against position's, times what was given


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
class Linear:
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


@dataclass(frozen=True)
class NoiseModel:
    """The noise that may be, and the filter that each makes.

    Attributes:
        floor: `[2 nv]` standard deviations of the sensors at least; inf where nothing is measured.
        scale: `[2 nv]` range of motion.
        dt: control step, s.
        starts: as measured.
    """

    floor: np.ndarray
    scale: np.ndarray
    dt: float
    starts: Starts

    @property
    def nv(self) -> int:
        return len(self.floor) // 2

    @property
    def seen(self) -> np.ndarray:
        """[2 nv] what is measured."""
        return np.isfinite(self.floor)

    def likely(self, linear: Linear, otherwise: Noise) -> Noise:
        """The most likely noise, each number that is not needed left out (BIC): first what acts, then the sensors.

        `otherwise` where the dynamics are finite under none.
        """
        paid = 0.5 * np.log(linear.valid.sum() * self.seen.sum())
        unit = np.where(self.seen, self.floor, FINEST * self.scale)[self.nv :]
        still = np.zeros(self.nv)
        acting = [(0.0, still, 0.0), *((1.0, q * unit, 0.0) for q in PROCESS)]
        acting += [(2.0, q * unit, lasting) for q in PROCESS for lasting in LASTING]
        best, noise, force = -np.inf, otherwise, still

        def tried(ratio: float, cost: float, guessed: np.ndarray, lasting: float) -> None:
            nonlocal best, noise, force
            sensor = self.floor * np.concatenate([np.ones(self.nv), np.full(self.nv, ratio)])
            value, size = self.fit(linear, Noise(sensor, guessed, lasting))
            value -= paid * (cost + (ratio != 1.0))
            if value > best:
                best, force = value, guessed
                noise = Noise(sensor * size, guessed * size, lasting)

        for cost, guess, lasting in acting:
            tried(1.0, cost, guess, lasting)
        cost = float(noise.process.any()) + float(noise.lasting > 0)
        for factor in FINER if cost else ():
            for guess in (force * factor, force / factor):
                tried(1.0, cost, guess, noise.lasting)
        at, lasting = force, noise.lasting
        for ratio in RATIOS:
            tried(ratio, cost, at, lasting)
        return noise

    def gains(self, ways: np.ndarray, noise: Noise) -> Gains:
        """Of the filter along linear dynamics `ways` [N, T, 2 nv, 2 nv] under that noise."""
        nothing = np.zeros(2 * self.nv)
        if noise.lasting:
            force = Force(noise.process, noise.lasting, self.dt)
            return riccati(ways, noise.sensor, nothing, self._start(noise), force)
        white = np.concatenate([nothing[self.nv :], noise.process])
        return riccati(ways, noise.sensor, white, self._start(noise))

    def _start(self, noise: Noise) -> np.ndarray:
        """Standard deviations of the start state: as measured, or anything where it is not."""
        return np.where(self.seen, self.starts.sd(noise.sensor), 0.3 * self.scale)

    def fit(self, linear: Linear, noise: Noise) -> tuple[float, float]:
        """(log evidence at the best common factor on the noise, that factor), by linear dynamics.

        Theta is integrated out near where it was: at one theta, what a better one explains would count as noise.
        """
        gains = self.gains(linear.ways, noise)
        error, slope = linear.whitened(gains, self.dt)
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


__all__ = ["FINEST", "Linear", "Noise", "NoiseModel"]
