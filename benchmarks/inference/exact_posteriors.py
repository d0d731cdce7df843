"""Exact posteriors of recorded motion of one joint: known sensor noise, unknown start states, nothing else random.

Starts are integrated out along the tangents of the most likely motion. What is identified is drawn by importance
sampling; of three parameters that motion knows up to one number, that number is integrated out in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import multivariate_t

from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record

STEP = 5e-3  # of central differences
DRAWS, WIDER = 1024, 1.15
FREEDOM = 5.0  # degrees of freedom of the draws
MOST = 40  # steps of Gauss-Newton


@dataclass(frozen=True)
class Recorded:
    """The first n records of a joint [n, T+1] with commands [n, T, nu], and the sensors' standard deviation.

    Attributes:
        ratios: whether motion knows the parameters' ratios to the first one only: theta = m (1, r).
    """

    physics: Physics
    record: Record
    sd: float
    ratios: bool

    def seen(self) -> np.ndarray:
        """[n, R] as measured."""
        return np.concatenate([np.asarray(x, float)[:, :, 0] for x in (self.record.qpos, self.record.qvel)], axis=1)

    def gaps(self, r: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """[M, n, R] simulated less measured, in standard deviations, at r [M, k] and starts [M, n, 2]."""
        count, n = starts.shape[:2]
        theta = np.concatenate([np.ones((count, 1)), r], axis=1) if self.ratios else r
        q, v = (starts[..., i].reshape(-1, 1).astype(np.float32) for i in (0, 1))
        command = np.tile(np.asarray(self.record.command), (count, 1, 1))
        found = replay(self.physics, q, v, command, np.repeat(theta, n, axis=0).astype(np.float32))
        rows = np.concatenate([np.asarray(found[k], float)[:, :, 0] for k in ("qpos", "qvel")], axis=1)
        return (rows.reshape(count, n, -1) - self.seen()) / self.sd

    def prior(self, r: np.ndarray) -> np.ndarray:
        """Density [M] of r where theta is uniform in its box."""
        low, high = self.physics.space.low, self.physics.space.high
        volume = np.prod(high - low)
        if not self.ratios:
            return np.all((r >= low) & (r <= high), axis=1) / volume
        first, last = self.ends(r)
        power = r.shape[1] + 1  # theta[1:] = m r: d theta = m^k dm dr
        return np.where(np.all(r > 0, axis=1), np.maximum(last**power - first**power, 0) / power, 0) / volume

    def ends(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest first parameter [M] that ratios [M, k] leave in the box."""
        low, high, positive = self.physics.space.low, self.physics.space.high, np.maximum(r, 1e-9)
        return np.maximum((low[1:] / positive).max(1), low[0]), np.minimum((high[1:] / positive).min(1), high[0])

    def drawn(self, rng: np.random.Generator, r: np.ndarray) -> np.ndarray:
        """theta [M, d] at r [M, k], what is not identified drawn from the prior."""
        if not self.ratios:
            return r
        first, last = (x ** (r.shape[1] + 1) for x in self.ends(r))
        m = (first + rng.random(len(r)) * (last - first)) ** (1 / (r.shape[1] + 1))
        return m[:, None] * np.concatenate([np.ones((len(r), 1)), r], axis=1)


@dataclass(frozen=True)
class Exact:
    """What the exact posterior says.

    Attributes:
        gain: of the truth over the prior, nats.
        level: of the smallest region that holds the truth.
        draws: [DRAWS, d] of it.
        gains: [DRAWS] of these draws over the prior, nats.
    """

    gain: float
    level: float
    draws: np.ndarray
    gains: np.ndarray


def exact(at: Recorded, theta: np.ndarray) -> Exact:
    """The exact posterior, and what it says of theta [d].

    Args:
        at: what was recorded.
        theta: the truth, from which the search for the most likely motion begins, with starts as measured.
    """
    truth = theta[1:] / theta[0] if at.ratios else theta
    measured = np.stack([np.asarray(x, float)[:, 0, 0] for x in (at.record.qpos, at.record.qvel)], axis=1)
    r, starts, slopes, tangents = _likeliest(at, truth, measured)
    rest = [np.eye(len(s)) - s @ np.linalg.pinv(s) for s in tangents]  # a start that is free takes its directions out

    def log_likelihood(at_r: np.ndarray) -> np.ndarray:
        gaps = at.gaps(at_r, np.broadcast_to(starts, (len(at_r), *starts.shape)))
        return -0.5 * sum(((gaps[:, i] @ own) ** 2).sum(1) for i, own in enumerate(rest))

    precision = sum(s.T @ own @ s for s, own in zip(slopes, rest, strict=True))
    proposal = multivariate_t(r, np.linalg.inv(precision) * WIDER**2, df=FREEDOM)
    rng = np.random.default_rng(0)
    draws = proposal.rvs(DRAWS, random_state=rng)
    value = log_likelihood(np.concatenate([truth[None], draws]))
    with np.errstate(divide="ignore"):
        logs = value[1:] + np.log(at.prior(draws)) - proposal.logpdf(draws)
    weights = np.exp(logs - logs.max())
    evidence = logs.max() + np.log(weights.mean())
    level, chosen = (
        weights @ (value[1:] > value[0]) / weights.sum(),
        rng.choice(DRAWS, DRAWS, p=weights / weights.sum()),
    )
    return Exact(value[0] - evidence, float(level), at.drawn(rng, draws[chosen]), value[1:][chosen] - evidence)


def _likeliest(
    at: Recorded, r: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(r [k], starts [n, 2], slopes in r [n, R, k], in the starts [n, R, 2]) of the most likely motion."""
    gaps, slopes, tangents = _linear(at, r, starts)
    share = 1.0
    for _ in range(MOST):
        by = np.zeros((len(r), len(r)))
        pull, solved = np.zeros(len(r)), []
        for gap, slope, own in zip(gaps, slopes, tangents, strict=True):
            back = np.linalg.pinv(own)
            left = slope - own @ (back @ slope)
            by, pull = by + left.T @ left, pull + left.T @ gap
            solved.append((back, gap, slope))
        step = -np.linalg.solve(by, pull)
        moved = np.stack([-back @ (gap + slope @ step) for back, gap, slope in solved])
        if np.sqrt(step @ by @ step) < 1e-2:
            break
        while share > 1e-3:
            found = _linear(at, r + share * step, starts + share * moved)
            if np.isfinite(found[0]).all() and (found[0] ** 2).sum() <= (gaps**2).sum():
                break
            share *= 0.5
        else:
            break
        r, starts, share = r + share * step, starts + share * moved, min(1.0, 2 * share)
        gaps, slopes, tangents = found
    return r, starts, slopes, tangents


def _linear(at: Recorded, r: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(gaps [n, R], their slopes in r [n, R, k], in the starts [n, R, 2])."""
    k = len(r)
    ways = STEP * np.concatenate([np.zeros((1, k + 2)), np.eye(k + 2), -np.eye(k + 2)])
    found = at.gaps(r + ways[:, :k], starts + ways[:, None, k:])
    slopes = np.moveaxis(found[1 : k + 3] - found[k + 3 :], 0, -1) / (2 * STEP)
    return found[0], slopes[..., :k], slopes[..., k:]


__all__ = ["Exact", "Recorded", "exact"]
