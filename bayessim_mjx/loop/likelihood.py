"""The simulator's own likelihood of recorded trajectories: one-step prediction errors, with noise that is estimated."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.special import gammainc, gammaln

from bayessim_mjx.distributions.charts import from_chart, to_chart
from bayessim_mjx.inference.numbers import EPS, FEW, NEGLIGIBLE, TURNS
from bayessim_mjx.kalman import Gains
from bayessim_mjx.logs.signals import LEVELS, values_shown
from bayessim_mjx.loop.noise import FINEST, Linear, Noise, NoiseModel, Starts
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.tangent import addresses, difference
from bayessim_mjx.tracking import Record, close, errors, transitions

# step of central differences in z, prior standard deviations: rounding and curvature are alike small (Press et al.,
# Numerical Recipes, 2007, sec. 5.7). With .05 Cartpole's damping was off by 1.1 of its standard deviations, with .01 by
# .02.
SLOPE = EPS ** (1 / 3)
# longest step in z in which linear dynamics are used, prior standard deviations; source: rule of thumb, not counted
LEAP = 1.0
# Rows of one value that tell as much as if their errors were independent: with it root mean squares of z are .92 to .99
# where encoders show 2 to 52 rows a count, up to 3.5 without. source: benchmarks/inference/counts.py
ROWS = 4
# standard deviations of the sensor: resampling changes a value between two equal rows by less; source: rule of thumb,
# not counted
SAME = 0.1


class Likelihood:
    """The likelihood of records, with noise that is estimated at a theta.

    Args:
        physics: the simulator.
        record: what was measured, N trajectories of T steps.
        valid: `[N, T]` 1 while the episode ran.
        sensor: `[2 nv]` standard deviations of the measurement noise: inf where nothing is measured, 0 where it is not
            known.
        together: trajectories in one call, so that more of them need no other program; None: all.
        groups: `[N]` equal numbers where what differs from trajectory to trajectory is shared, as in one log; None:
            each is alone.
    """

    def __init__(
        self, physics: Physics, record: Record, valid: np.ndarray, sensor: np.ndarray, together: int | None = None,
        groups: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.physics, self.record, self.valid = physics, record, np.asarray(valid, float)
        count = len(self.valid)
        self.groups = np.arange(count) if groups is None else np.asarray(groups)
        each = together if together and count % together == 0 else count
        self.parts = [slice(i, i + each) for i in range(0, count, each)]
        nv = physics.mj_model.nv
        self.silent = silent(record, physics.mj_model, sensor)
        self.scale = size = travel(record, physics.mj_model)
        known = np.isfinite(sensor) & ~self.silent
        stated = np.where(known, sensor, 0.0)
        self.stated = np.where(known, np.maximum(stated, FINEST * size), np.inf)  # of one row, as of a start
        more = repeated(record, physics.mj_model, stated, self.valid)
        self.floor = np.where(known, np.maximum(stated * more, FINEST * size), np.inf)
        self.seen = np.isfinite(self.floor)
        self.starts = Starts(record, physics.mj_model)
        self.shrunk = record  # from the most likely starts
        self.model = NoiseModel(self.floor, size, physics.dt, self.starts)
        self.nv = nv
        self.noise = Noise(self.floor, np.zeros(nv))
        self.gains: Gains | None = None
        self.laplace: tuple[np.ndarray, np.ndarray] | None = None  # of z, by the last linear dynamics
        self.count = float(self.valid.sum() * self.seen.sum())

    def settle(self, theta: np.ndarray) -> bool:
        """Estimate the noise near theta [d]; returns whether it has changed much.

        The first time theta follows the linear dynamics to where they lead (Gauss-Newton): far from the likely thetas,
        what these explain would count as noise.
        """
        before = self.noise
        if self.gains is not None:
            self.gains = self._linearised(theta, self.gains)
            return self._moved(before)
        self.gains = close(self.record, self.nv)
        for turn in range(TURNS):
            last = self.noise
            self.gains = self._linearised(theta, self.gains)
            if turn == 0:  # along the measurements themselves
                continue
            near = self._next(theta)
            if near is None or (near[1] < NEGLIGIBLE and not self._moved(last)):
                break
            theta = near[0]
        return self._moved(before)

    def back_to(self, noise: Noise, gains: Gains | None) -> None:
        """Return to a noise that was settled on before, and to its gains."""
        self.noise, self.gains = noise, gains

    def _next(self, theta: np.ndarray) -> tuple[np.ndarray, float] | None:
        """Find the posterior's mean [d] by linear dynamics around theta, and how many of its sd that is away."""
        if self.laplace is None:
            return None
        mean, covariance = self.laplace
        step = mean - self._z(theta)
        away = float(np.sqrt(step @ np.linalg.solve(covariance, step) / len(step)))
        return self._theta(mean), away

    def _moved(self, before: Noise) -> bool:
        noise, seen = self.noise, self.seen
        moved = np.abs(np.log(noise.sensor[seen] / before.sensor[seen])).max()
        most = max(before.process.max(), noise.process.max(), 1e-30)
        drift = np.abs(noise.process - before.process).max() / most + abs(noise.lasting - before.lasting)
        return bool(max(moved, drift) > NEGLIGIBLE)

    def _z(self, theta: np.ndarray) -> np.ndarray:
        return np.asarray(to_chart(self.physics.space.to_unit(jnp.asarray(theta, jnp.float32)), "probit"), float)

    def _theta(self, z: np.ndarray) -> np.ndarray:
        return np.asarray(self.physics.space.from_unit(from_chart(jnp.asarray(z, jnp.float32), "probit")))

    def _linearised(self, theta: np.ndarray, path: Gains) -> Gains:
        """Gains, and the noise behind them, from the dynamics along the filter's path with those gains.

        Around the measurements themselves, half the dynamics' curvature times the sensors' variance would look like a
        force that lasts (Jazwinski 1970, 9.7: the iterated filter).
        """
        ways, gaps = self._dynamics(theta, path, self.parts)
        linear = self._linear(theta, path, ways, gaps)
        self.noise = self.model.likely(linear, self.noise)
        self.shrunk = self.starts.shrunk(
            self.stated
        )  # by the stated noise: what else sensors show is no error of starts
        self.laplace = self._posterior(linear)
        gains = self.model.gains(ways, self.noise)
        mask = jnp.asarray(self.valid, jnp.float32)[:, :, None, None]
        return gains.replace(gain=gains.gain * mask, whitener=gains.whitener * mask)

    def _linear(self, theta: np.ndarray, path: Gains, ways: np.ndarray, gaps: np.ndarray) -> Linear:
        few, each = min(FEW, len(self.valid)), self.parts[0].stop
        parts = self.parts[: -(-few // each)]
        z = self._z(theta)

        def moved(step: np.ndarray) -> np.ndarray:
            return self._dynamics(self._theta(z + step), path, parts)[1][:few]

        steps = SLOPE * np.eye(len(z))
        slopes = np.stack([(moved(step) - moved(-step)) / (2 * SLOPE) for step in steps])
        rows = slice(0, few)
        return Linear(ways[rows], gaps[rows], slopes, z, _rows(path, rows), self.valid[rows])

    def _dynamics(self, theta: np.ndarray, path: Gains, parts: list[slice]) -> tuple[np.ndarray, np.ndarray]:
        found = [
            transitions(self.physics, theta, _rows(self.shrunk, part), _rows(path, part), self.scale) for part in parts
        ]
        return np.concatenate([ways for ways, _ in found]), np.concatenate([gaps for _, gaps in found])

    def _posterior(self, linear: Linear) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean [d] and covariance [d, d] of z by the linear dynamics of the first trajectories, all they tell.

        A step of Gauss-Newton, at most LEAP in any direction: farther away the dynamics are others.
        """
        error, slope = linear.whitened(self.model.gains(linear.ways, self.noise), self.physics.dt)
        if not (np.isfinite(error).all() and np.isfinite(slope).all()):
            return None
        precision = slope.T @ slope + np.eye(len(linear.z))
        step = -np.linalg.solve(precision, slope.T @ error + linear.z)
        return linear.z + step * min(1.0, LEAP / max(np.abs(step).max(), 1e-30)), np.linalg.inv(precision)

    def squares(self, thetas: np.ndarray) -> np.ndarray:
        """Sum squared whitened prediction errors [M, N, blocks] at thetas [M, d]."""
        assert self.gains is not None, "settle first"
        each = [errors(self.physics, thetas, _rows(self.shrunk, part), _rows(self.gains, part)) for part in self.parts]
        return np.concatenate([np.asarray(x, np.float64) for x in each], axis=1)

    @property
    def size(self) -> float:
        """Log of the density of prediction errors of 0 under this noise, but for a constant: its share of evidence."""
        assert self.gains is not None, "settle first"
        return float(np.sum(np.asarray(self.gains.log_size, float) * self.valid))

    @property
    def least(self) -> float:
        """The least factor on the variance of the noise as it was estimated: no sensor is better than its stated noise.

        Velocity's noise may be any ratio of position's (RATIOS), so positions tell, where they are measured.
        """
        use = self.seen & (np.arange(2 * self.nv) < self.nv) if self.seen[: self.nv].any() else self.seen
        return float(np.max((self.floor[use] / self.noise.sensor[use]) ** 2))

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


def _rows(tree: Any, rows: slice) -> Any:
    return jax.tree.map(lambda x: x[rows], tree)


def travel(record: Record, model: mujoco.MjModel) -> np.ndarray:
    """Range of motion [2 nv] of positions (angles at most pi) and velocities; of what rests, a share of the largest."""
    qpos, qvel = (np.asarray(x, float).reshape(-1, x.shape[-1]) for x in (record.qpos, record.qvel))
    places = addresses(model)
    moved = np.array([min(np.ptp(qpos[:, q]), np.pi) if q is not None else 1.0 for q in places])
    return np.concatenate([np.maximum(x, max(FINEST * x.max(), EPS)) for x in (moved, np.ptp(qvel, axis=0))])


def silent(record: Record, model: mujoco.MjModel, sensor: np.ndarray) -> np.ndarray:
    """[2 nv]: measured channels without a stated noise (0) that show fewer than LEVELS values, too few to estimate it.

    A held joint has no residual, hence no estimate of its noise. Whatever was assumed would be the simulator's own
    rounding, and each of its residuals millions of standard deviations.
    """
    shown = [values_shown(column) for column in _channels(record, model).reshape(-1, 2 * model.nv).T]
    return np.isfinite(sensor) & ~(np.asarray(sensor) > 0) & (np.array(shown) < LEVELS)


def repeated(record: Record, model: mujoco.MjModel, sensor: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[2 nv] factors on the sensors' standard deviations: of rows that repeat a value, ROWS tell and others do not.

    An encoder's error stays while its count does. Taken for white noise, a hundred rows of one count would be averaged
    to a tenth of it, and a posterior would be surer the more often a slow motion is sampled.
    """
    steps = np.abs(np.diff(_channels(record, model), axis=1))
    same = steps <= SAME * np.where(np.isfinite(sensor), sensor, 0.0)
    last = same.shape[1] - ROWS + 1
    if last < 1:
        return np.ones(len(sensor))
    more = np.all([same[:, k : k + last] for k in range(ROWS)], axis=0) & (valid[:, ROWS - 1 :, None] > 0)
    rows = len(valid) + float(np.sum(valid))
    return np.sqrt(rows / (rows - more.sum((0, 1))))


def _channels(record: Record, model: mujoco.MjModel) -> np.ndarray:
    """Position tangents from the first position, and velocities [N, T + 1, 2 nv]."""
    first = record.qpos[0, 0]
    away = jax.vmap(jax.vmap(lambda q: difference(model, q, first)))(record.qpos)
    return np.concatenate([np.asarray(away, float), np.asarray(record.qvel, float)], axis=2)
