"""A posterior refined with the simulator's own likelihood of the real trajectories, replayed under their commands.

The product of a network's posteriors proposes; `inference.importance` weighs thetas by how well a filter predicts the
recorded motion one step ahead (`tracking`). Sensor and process noise are estimated with theta: what the simulator
cannot follow counts as noise. Where the prediction errors of different trajectories disagree about theta by more than
the likelihood admits, its logarithm is scaled down (Ribatet et al. 2012; the magnitude adjustment of a composite
likelihood), so that model error widens the posterior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import importance
from bayessim_mjx.inference.importance import Refined
from bayessim_mjx.physics import Physics
from bayessim_mjx.tracking import Gains, Record, close, errors, riccati, transitions

FINEST = 1e-3  # of a channel's range of motion: no sensor is believed to be better
PROCESS = (
    0.0,
    1e-3,
    1e-2,
    0.1,
    1.0,
    10.0,
)  # process noise of a control step, sd in units of the velocity's sensor noise
RATIOS = (0.1, 0.3, 1.0, 3.0, 10.0)  # velocity's sensor noise against position's, times what was given
PASSES = 3  # of noise and posterior in turn
SETTLED = 0.1  # relative change of the log likelihood's unit at which noise and posterior agree
BELIEF = 4.0  # trajectories' worth of belief that the simulator is right, against which they are heard
LOOKED = 4  # trajectories at which noise is estimated


@dataclass(frozen=True)
class Noise:
    """Standard deviations [2 nv] per control step, positions first."""

    sensor: np.ndarray
    process: np.ndarray


@dataclass(frozen=True)
class Refinement:
    """A refined posterior and what it rests on.

    Attributes:
        posterior: refined, or the proposal where `refined.reason` is not None.
        refined: see `inference.importance`.
        noise: sensor and process noise as estimated.
        rate: power of the likelihood, 1 where the simulator can explain the trajectories.
    """

    posterior: Distribution
    refined: Refined
    noise: Noise
    rate: float


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
        self.noise = Noise(self.floor, np.zeros(2 * nv))
        self.gains: Gains | None = None
        self.count = float(self.valid.sum() * self.seen.sum())

    def settle(self, theta: np.ndarray) -> bool:
        """Estimate the noise at theta [d]; returns whether it has changed much."""
        parts = [self._dynamics(theta, part) for part in self.parts]
        ways, gaps = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
        few = min(LOOKED, len(self.valid))
        best, noise = -np.inf, self.noise
        paid = 0.5 * np.log(self.valid[:few].sum() * self.seen.sum())  # for each number that is not needed (BIC)
        for ratio in RATIOS:
            sensor = self.floor * np.concatenate([np.ones(self.nv), np.full(self.nv, ratio)])
            unit = np.where(np.isfinite(sensor), sensor, FINEST * self.scale)
            for q in PROCESS:
                process = q * np.concatenate([np.zeros(self.nv), unit[self.nv :]])
                value, size = self._fit(ways[:few], gaps[:few], sensor, process, self.valid[:few])
                value -= paid * ((ratio != 1.0) + (q > 0))
                if value > best:
                    best, noise = value, Noise(sensor * size, process * size)
        before, self.noise = self.noise, noise
        gains = riccati(ways, noise.sensor, noise.process, self._start(noise))
        mask = jnp.asarray(self.valid, jnp.float32)[:, :, None, None]
        self.gains = gains.replace(gain=gains.gain * mask, whitener=gains.whitener * mask)
        seen = self.seen
        moved = np.abs(np.log(noise.sensor[seen] / before.sensor[seen])).max()
        drift = np.abs(noise.process - before.process).max() / max(before.process.max(), noise.process.max(), 1e-30)
        return bool(moved > SETTLED or drift > SETTLED)

    def _dynamics(self, theta: np.ndarray, part: slice) -> tuple[np.ndarray, np.ndarray]:
        record = _rows(self.record, part)
        return transitions(self.physics, theta, record, close(record, self.nv), self.scale)

    def _start(self, noise: Noise) -> np.ndarray:
        """Standard deviations of the start state: as measured, or anything where it is not."""
        return np.where(self.seen, np.where(np.isfinite(noise.sensor), noise.sensor, 0.0), 0.3 * self.scale)

    def _fit(
        self, ways: np.ndarray, gaps: np.ndarray, sensor: np.ndarray, process: np.ndarray, valid: np.ndarray
    ) -> tuple[float, float]:
        """(log likelihood at the best common factor on the noise, that factor), by linear error dynamics."""
        gains = riccati(ways, sensor, process, self._start(Noise(sensor, process)))
        gain, white = np.asarray(gains.gain, float), np.asarray(gains.whitener, float)
        away = np.zeros(gaps.shape[:1] + gaps.shape[2:])
        squares = 0.0
        for t in range(gaps.shape[1]):
            ahead = np.einsum("nij,nj->ni", np.nan_to_num(ways[:, t]), away) - gaps[:, t]
            miss = -ahead
            squares += float(np.sum(np.einsum("nij,nj->ni", white[:, t], miss) ** 2 * valid[:, t, None]))
            away = ahead + np.einsum("nij,nj->ni", gain[:, t], miss)
        count = valid.sum() * self.seen.sum()
        size = max(squares / count, 1.0)  # not below the floor
        sizes = float(np.sum(np.asarray(gains.log_size, float) * valid))
        return sizes - 0.5 * count * np.log(size) - 0.5 * squares / size, float(np.sqrt(size))

    def squares(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared whitened prediction errors [M, N, blocks] at thetas [M, d]."""
        assert self.gains is not None, "settle first"
        each = [errors(self.physics, thetas, _rows(self.record, part), _rows(self.gains, part)) for part in self.parts]
        return np.concatenate([np.asarray(x, np.float64) for x in each], axis=1)

    def log_likelihood(self, squares: np.ndarray) -> np.ndarray:
        """[M] of `squares`, the common factor on all noise marginalised with a prior of one number's worth at 1."""
        total = squares.sum((1, 2))
        return -0.5 * (self.count + 1) * np.log1p(total)


def refine(
    proposal: Distribution,
    likelihood: Likelihood,
    *,
    seed: int = 0,
    draws: int = 1024,
    rounds: int = 8,
    components: int = 8,
) -> Refinement:
    """The posterior of all records, from a proposal that may be wrong.

    Args:
        proposal: e.g. the product of the network's posteriors of the trajectories.
        likelihood: of the records.
        seed, draws, rounds, components: as in `importance.refine`.
    """
    current, theta = proposal, np.asarray(proposal.mode())
    found, kept = None, np.zeros(0)
    for turn in range(PASSES):
        changed = likelihood.settle(theta)
        if found is not None and not changed:
            break
        parts: list[np.ndarray] = []

        def log_likelihood(thetas: np.ndarray, parts: list[np.ndarray] = parts) -> np.ndarray:
            parts.append(likelihood.squares(thetas))
            return likelihood.log_likelihood(parts[-1])

        found = importance.refine(
            current, log_likelihood, seed=seed + turn, draws=draws, rounds=rounds, components=components
        )
        kept = np.concatenate(parts)
        if not np.isfinite(found.evidence):
            break
        theta = found.theta[np.argmax(found.log_likelihood)]
        current = found.fitted
    assert found is not None
    rate = 1.0 if found.reason else _rate(found, kept, likelihood)
    if rate < 1.0:
        found = importance.tempered(found, rate, components, seed)
    posterior = proposal if found.reason else found.posterior
    return Refinement(posterior, replace(found, posterior=posterior), likelihood.noise, rate)


def _rate(found: Refined, squares: np.ndarray, likelihood: Likelihood) -> float:
    """The power of the likelihood at which its scores spread as its curvature says they should.

    Scores are of stretches of time; those up to half a trajectory apart may go together (Newey and West, 1987).
    """
    unit = float(found.weights @ squares.sum((1, 2))) / likelihood.count
    use = found.weights > 1e-6 * found.weights.max()
    weights, z = found.weights[use] / found.weights[use].sum(), importance.coordinates(found)[use]
    gap = z - weights @ z
    covariance = gap.T @ (gap * weights[:, None])
    parts = -0.5 * squares[use].reshape(use.sum(), -1) / unit
    slopes = np.linalg.solve(covariance, gap.T @ (weights[:, None] * parts)).reshape(
        -1, *squares.shape[1:]
    )  # [d, N, B]
    slopes = slopes - slopes.mean((1, 2), keepdims=True)
    lags = squares.shape[2] // 2
    spread = np.einsum("inb,jnb->ij", slopes, slopes)
    for lag in range(1, lags + 1):
        both = np.einsum("inb,jnb->ij", slopes[..., lag:], slopes[..., :-lag])
        spread += (1 - lag / (lags + 1)) * (both + both.T)
    ratio = max(float(np.trace(covariance @ spread)) / len(covariance), 0.0)
    clusters = squares.shape[1] * squares.shape[2] / lags
    return float(min(1.0, (clusters + BELIEF) / (clusters * ratio + BELIEF)))


def _travel(record: Record, physics: Physics) -> np.ndarray:
    """Range of motion [2 nv] of positions (angles at most pi) and velocities."""
    nv = physics.mj_model.nv
    speed = np.asarray(record.qvel, float).reshape(-1, nv)
    span = np.ptp(speed, axis=0)
    qpos = np.asarray(record.qpos, float).reshape(-1, physics.mj_model.nq)
    travel = np.array([min(np.ptp(qpos[:, q]), np.pi) if q is not None else 1.0 for q in _addresses(physics)])
    return np.maximum(np.concatenate([travel, span]), 1e-6)


def _addresses(physics: Physics) -> list[int | None]:
    """For each degree of freedom its place in qpos; None for a rotation's."""
    out: list[int | None] = []
    for kind, q in zip(physics.mj_model.jnt_type, physics.mj_model.jnt_qposadr, strict=True):
        if kind == 0:
            out += [int(q), int(q) + 1, int(q) + 2, None, None, None]
        else:
            out += [None] * 3 if kind == 1 else [int(q)]
    return out


def _rows(tree: Any, rows: slice) -> Any:
    return jax.tree.map(lambda x: x[rows], tree)


__all__ = ["Likelihood", "Noise", "Refinement", "refine"]
