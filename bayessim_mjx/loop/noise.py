"""Noise of recorded motion: that of the sensors, and forces that are not modelled; starts under that noise.

Estimated near a theta, by the linear dynamics there: what the simulator cannot follow counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.inference.numbers import NEGLIGIBLE, TURNS
from bayessim_mjx.kalman import Force, Gains, innovations, measured_noise, riccati
from bayessim_mjx.physics.tangent import difference, integrate
from bayessim_mjx.tracking import Record

FINEST = 1e-3  # of a channel's range of motion: no sensor is taken to be better; source: rule of thumb, not counted
# grid of unmodelled forces, in units of the velocity's sensor noise. Without values between 1 and 10 the noise went to
# and fro on a servo's logs. source: commit 4454ff8
PROCESS = (1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
# the most likely of them is multiplied and divided by these: a half and a quarter of a step of the grid; source: the
# grid
FINER = (3.0**0.5, 3.0**0.25)
# grid of the forces' correlations from step to step. With white noise alone gusts of ten steps moved the damping by 2.8
# standard deviations, with these by 1.5. source: commit 95be4ef, 16 cases
LASTING = (0.7, 0.9, 0.97)
RATIOS = tuple(q for q in PROCESS if q < 1)  # grid of factors on the velocity's sensor noise alone


@dataclass(frozen=True)
class Noise:
    """Noise that the simulator does not explain.

    Attributes:
        sensor: `[2 nv]` standard deviations, positions first; inf where nothing is measured.
        process: `[nv]` standard deviations of the velocity that unmodelled forces give in a control step.
        lasting: their correlation from one control step to the next.
    """

    sensor: np.ndarray
    process: np.ndarray
    lasting: float = 0.0

    @property
    def numbers(self) -> float:
        """Count of its numbers beside those of the sensors."""
        return float(self.process.any()) + float(self.lasting > 0)


@dataclass
class _Best:
    """The likeliest noise so far, less what its numbers cost: as it was tried, and with the factor it asked for."""

    value: float
    noise: Noise
    guess: Noise


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
        """Find the most likely noise without numbers that are not needed (BIC): first what acts, then the sensors.

        Sensors have one factor in common, or one each where that pays: one joint with an unknown noise, or
        with a friction that the simulator lacks, is no reason to believe the others less.

        `otherwise` where the dynamics are finite under none.
        """
        paid = 0.5 * np.log(linear.valid.sum() * self.seen.sum())
        unit = np.where(self.seen, self.floor, FINEST * self.scale)[self.nv :]
        still, channels = np.zeros(self.nv), float(self.seen.sum() - 1)  # numbers more than a common factor
        best = _Best(-np.inf, otherwise, Noise(self.floor, still))

        def tried(guess: Noise, cost: float) -> None:
            value, size = self.fit(linear, guess)
            if value - paid * (cost + guess.numbers) > best.value:
                best.value, best.guess = value - paid * (cost + guess.numbers), guess
                best.noise = Noise(guess.sensor * size, guess.process * size, guess.lasting)

        def acting(sensor: np.ndarray, cost: float) -> None:
            tried(Noise(sensor, still), cost)
            for lasting in (0.0, *LASTING):
                for q in PROCESS:
                    tried(Noise(sensor, q * unit, lasting), cost)
            for factor in FINER if best.guess.process.any() else ():
                force, lasting = best.guess.process, best.guess.lasting
                for process in (force * factor, force / factor):
                    tried(Noise(sensor, process, lasting), cost)

        acting(self.floor, 0.0)
        force, lasting = best.guess.process, best.guess.lasting
        for ratio in RATIOS:
            tried(Noise(self.floor * np.repeat([1.0, ratio], self.nv), force, lasting), 1.0)
        common = best.guess
        alone = ((Noise(self.floor, still), self.floor), (best.noise, common.sensor))
        for begin, least in alone if channels else ():
            tried(self.parted(linear, begin, least), channels)
        if best.guess is not common:  # what acts was found with one channel's noise in it
            acting(best.guess.sensor, channels)
        return best.noise

    def parted(self, linear: Linear, noise: Noise, least: np.ndarray) -> Noise:
        """`noise` with its sensors' [2 nv] standard deviations each by itself: steps of EM, none below `least`."""
        rows = linear.valid.sum()
        for _ in range(TURNS):
            gains = self.gains(linear.ways, noise)
            error, slope = linear.whitened(gains, self.dt)
            if not (np.isfinite(error).all() and np.isfinite(slope).all()):
                return noise
            step = -np.linalg.solve(slope.T @ slope + np.eye(len(linear.z)), slope.T @ error + linear.z)
            white = (error + slope @ step).reshape(linear.gaps.shape)
            squares, spread = measured_noise(linear.ways, gains, white, self.dt, linear.valid)
            before = np.where(self.seen, noise.sensor, 1.0) ** 2
            after = np.maximum(before + before**2 * (squares - spread) / rows, np.where(self.seen, least, 1.0) ** 2)
            noise = replace(noise, sensor=np.where(self.seen, np.sqrt(after), np.inf))
            if np.abs(np.log(after / before)).max() < NEGLIGIBLE:
                break
        return noise

    def gains(self, ways: np.ndarray, noise: Noise) -> Gains:
        """Gains of the filter along linear dynamics `ways` [N, T, 2 nv, 2 nv] under that noise."""
        nothing = np.zeros(2 * self.nv)
        if noise.lasting:
            force = Force(noise.process, noise.lasting, self.dt)
            return riccati(ways, noise.sensor, nothing, self._start(noise), force)
        white = np.concatenate([nothing[self.nv :], noise.process])
        return riccati(ways, noise.sensor, white, self._start(noise))

    def _start(self, noise: Noise) -> np.ndarray:
        """Take standard deviations of the start state: as measured, or anything where it is not."""
        known = np.where(self.seen, noise.sensor, 1.0) / np.where(self.seen, self.floor, 1.0)
        return np.where(self.seen, known * self.starts.sd(self.floor), 0.3 * self.scale)

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


class Starts:
    """Measured starts of records, each channel by itself.

    Attributes:
        count: N.
        away: `[N, 2 nv]` position tangents and velocities, from their means.
        freedom: 1 / chi^2 of the N - 1 degrees of freedom that an estimated mean leaves has the mean 1 / (N - 3)
            (Stein; Morris 1983, eqs. 1.16 to 1.18).
    """

    def __init__(self, record: Record, model: mujoco.MjModel) -> None:
        self.record, self.model = record, model
        qpos, qvel = record.qpos[:, 0], record.qvel[:, 0]
        away = jax.vmap(lambda q: difference(model, q, qpos[0]))(qpos)
        channels = np.concatenate([np.asarray(away, float), np.asarray(qvel, float)], axis=1)
        self.count, self.away = len(channels), channels - channels.mean(0)
        self.freedom = max(self.count - 3, 0)

    def share(self, sensor: np.ndarray) -> np.ndarray:
        """[2 nv] of the measured spread that is noise of these standard deviations; 0 where nothing is measured."""
        noise = self.freedom * np.where(np.isfinite(sensor), sensor, 0.0) ** 2
        return np.minimum(noise / np.maximum((self.away**2).sum(0), 1e-300), 1.0)

    def sd(self, sensor: np.ndarray) -> np.ndarray:
        """[2 nv] standard deviations of the start that stay unknown, over all of them."""
        return sensor * np.sqrt(1 - self.share(sensor) * self.freedom / self.count)

    def shrunk(self, sensor: np.ndarray) -> Record:
        """Start the records at their most likely starts under that noise of the sensors [2 nv]."""
        nv, r = self.model.nv, self.record
        step = jnp.asarray(-self.share(sensor) * self.away, jnp.float32)
        qpos = jax.vmap(lambda q, by: integrate(self.model, q, by))(r.qpos[:, 0], step[:, :nv])
        return r.replace(
            qpos=jnp.asarray(r.qpos).at[:, 0].set(qpos), qvel=jnp.asarray(r.qvel).at[:, 0].add(step[:, nv:])
        )
