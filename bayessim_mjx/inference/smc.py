"""Draws moved by Metropolis steps until they are the posterior's: sequential Monte Carlo (Del Moral et al. 2006).

Draws of a tempered likelihood are weighted by its next power, resampled and moved in the unit cube, where the prior is
flat, some of the parameters at a time (Laloy and Vrugt 2012). Steps are in turn differences of other draws
(differential evolution, ter Braak and Vrugt 2008), and draws from the Gaussian of the others given the parameters that
stay. Valleys that are straight in the parameters' own units, as several parameters times one number make, are straight
there too.

Draws are resampled within islands that never exchange any. The variance between the islands' means gives the effective
sample size, and shows a likelihood that is too rough to follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp
from scipy.stats import t

from bayessim_mjx.inference.numbers import ALPHA, DEFENSIVE, WIDER

ISLANDS = 8  # populations that never exchange draws; source: rule of thumb, not counted
SPREAD = 2.38  # the best step for Gaussians is this / sqrt(2 d) differences; source: Roberts and Rosenthal 2001
STILL = float(t.isf(ALPHA / 2, ISLANDS - 1))  # Student's t over the islands of a rise of the log likelihood
# effective share of the draws at the next power, and correlation with the start that draws may keep; source: rule of
# thumb, method of Beskos et al. 2016
KEPT = 0.5

LogLikelihood = Callable[[np.ndarray], np.ndarray]  # u [N, d] -> [N]; not finite: impossible


@dataclass(frozen=True)
class ParticleState:
    """Draws u [N, d] of prior x likelihood^power, as many on each of ISLANDS, and their log likelihood [N].

    `kept` are the draws after the last moves at one power, [S, N, d], `likes` their log likelihoods [S, N]; `evidence`
    is the log of the mean of likelihood^power over the prior, `calls` counts moves of all draws; at this power from
    `origin` [N, d] on.
    """

    u: np.ndarray
    like: np.ndarray
    power: float
    evidence: float
    kept: np.ndarray
    likes: np.ndarray
    origin: np.ndarray
    calls: int = 0

    @property
    def simulations(self) -> int:
        """Number of thetas that the moves simulated."""
        return self.calls * len(self.u)

    @property
    def islands(self) -> np.ndarray:
        """The kept draws of each island, [ISLANDS, S N / ISLANDS, d]."""
        moves, count, d = self.kept.shape
        return self.kept.reshape(moves, ISLANDS, count // ISLANDS, d).swapaxes(0, 1).reshape(ISLANDS, -1, d)

    @property
    def ess(self) -> float:
        """Effective sample size of the kept draws, by the variance between islands; of the worst parameter."""
        apart = self.islands
        within = apart.var(axis=1, ddof=1).mean(axis=0)
        between = apart.mean(axis=1).var(axis=0, ddof=1)
        return float(np.min(ISLANDS * within / np.maximum(between, 1e-30)))

    @property
    def memory(self) -> float:
        """Correlation of draws with where they began at this power; of the parameter where it is largest."""
        now, then = self.u - self.u.mean(0), self.origin - self.origin.mean(0)
        size = np.sqrt((now**2).sum(0) * (then**2).sum(0))
        return float(np.max((now * then).sum(0) / np.maximum(size, 1e-300)))

    @property
    def trend(self) -> float:
        """Student's t of the rise of the log likelihood from one half of the kept moves to the other, over islands."""
        moves = len(self.likes) // 2
        if not moves:
            return 0.0
        each = self.likes.reshape(len(self.likes), ISLANDS, -1).mean(axis=2)
        rise = each[-moves:].mean(axis=0) - each[:moves].mean(axis=0)
        return float(rise.mean() / max(rise.std(ddof=1) / ISLANDS**0.5, 1e-30))

    def missing(self, enough: float, to: float = 1.0) -> str | None:
        """Say why these draws do not count as `enough` independent ones at the power `to`; None: they do."""
        if self.power != to:
            return f"the likelihood can be followed to its power {self.power:.2g} only"
        if not self.ess >= enough:
            return f"the draws have an effective sample size of {self.ess:.0f}, {enough:.0f} is needed"
        if self.memory > KEPT:
            return f"draws still depend on where they began, correlation {self.memory:.2f}"
        return "the draws' likelihood still changes" if abs(self.trend) > STILL else None


def init(rng: np.random.Generator, u: np.ndarray, like: np.ndarray, base: np.ndarray, count: int) -> ParticleState:
    """`count` draws of the highest power, at most 1, at which half as many count, out of weighted draws u [M, d].

    Args:
        rng: randomness.
        u: draws in the unit cube.
        like: their log likelihood [M].
        base: their log prior density less that of what they were drawn from [M].
        count: how many, a multiple of ISLANDS.
    """
    power = tempering(base, like, KEPT * count)
    logs = powered(base, like, power)
    chosen = rng.permutation(_systematic(rng, normalised(logs), count))
    evidence = float(logsumexp(logs) - np.log(len(logs)))
    return ParticleState(u[chosen], like[chosen], power, evidence, u[chosen][None], like[chosen][None], u[chosen])


def run(
    rng: np.random.Generator,
    log_likelihood: LogLikelihood,
    at: ParticleState,
    enough: float,
    most: int,
    to: float = 1.0,
) -> ParticleState:
    """Draws at the power `to`, moved until their effective sample size is `enough`, `most` times at most."""
    left = most
    while at.power != to and left > 0:
        at = _reweighted(rng, at, to)
        if at.power != to:
            for _ in KERNELS:
                at, left = _swept(rng, log_likelihood, at, at.u), left - 1
    passed: list[ParticleState] = []
    others = at.u
    at = replace(at, origin=at.u)
    while left > 0:
        if passed and len(passed) % len(KERNELS) == 0:
            kept = passed[-(-len(passed) // 2) :]  # the first half forgets where it began
            at = replace(at, kept=np.stack([x.u for x in kept]), likes=np.stack([x.like for x in kept]))
            if at.missing(enough, to) is None:
                break
            others = at.u
        at, left = _swept(rng, log_likelihood, at, others), left - 1
        passed.append(at)
    return at


def _reweighted(rng: np.random.Generator, at: ParticleState, to: float) -> ParticleState:
    """Resampled for the next power towards `to`, at which KEPT of the draws count."""
    count = len(at.u)
    step = tempering(np.zeros(count), np.sign(to - at.power) * at.like, KEPT * count, abs(to - at.power))
    step = max(step, 1e-6) * np.sign(to - at.power)
    power = to if abs(to - at.power - step) < 1e-9 else at.power + step
    logs = powered(np.zeros(count), at.like, power - at.power)
    each = logs.reshape(ISLANDS, -1)
    side = each.shape[1]
    chosen = np.concatenate([i * side + _systematic(rng, normalised(row), side) for i, row in enumerate(each)])
    evidence = at.evidence + float(logsumexp(logs) - np.log(count))
    return replace(at, u=at.u[chosen], like=at.like[chosen], power=power, evidence=evidence)


def _swept(
    rng: np.random.Generator, log_likelihood: LogLikelihood, at: ParticleState, others: np.ndarray
) -> ParticleState:
    """One Metropolis step of every draw; `others` [M, d], which do not change meanwhile, tell how far and where to."""
    count, d = at.u.shape
    part = rng.random((count, d)) < rng.random((count, 1))  # any share of them is as likely
    part[np.arange(count), rng.integers(d, size=count)] = True
    fresh, bias = KERNELS[at.calls % len(KERNELS)](rng, at.u, others, part)
    inside = np.all((fresh >= 0) & (fresh <= 1), axis=1)
    like = np.asarray(log_likelihood(np.where(inside[:, None], fresh, at.u)), np.float64)
    like = np.where(inside & np.isfinite(like), like, -np.inf)
    with np.errstate(invalid="ignore"):  # from one impossible draw to another
        gain = at.power * (like - at.like) + bias
    taken = np.log(rng.random(count)) < np.where(np.isfinite(at.like), gain, np.inf)
    u, like = np.where(taken[:, None], fresh, at.u), np.where(taken, like, at.like)
    return replace(at, u=u, like=like, calls=at.calls + 1)


def _stepped(
    rng: np.random.Generator, u: np.ndarray, others: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(u, its log bias) after a share of the difference of two others, in `part` of the parameters; without bias."""
    count, d = u.shape
    one, two = rng.integers(len(others), size=(2, count))
    # a tenth of the best step to all of it, for valleys that bend; rule of thumb, not counted
    size = SPREAD / np.sqrt(2 * part.sum(1)) * 10 ** rng.uniform(-1, 0, count)
    size = np.where(rng.random(count) < DEFENSIVE, 1.0, size)[:, None]
    step = (
        size * (others[one] - others[two]) + 1e-3 * rng.standard_normal((count, d)) @ np.linalg.cholesky(_cov(others)).T
    )
    return reflected(u + step * part), np.zeros(count)


def _redrawn(
    rng: np.random.Generator, u: np.ndarray, others: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(u, its log bias) with `part` of the parameters drawn anew, given the rest by the others' mean and covariance."""
    mean = others.mean(0)
    precision = np.linalg.inv(_cov(others)) / WIDER**2
    both = part[:, :, None] & part[:, None, :]
    own = np.where(both, precision, np.eye(len(mean)))  # of the part, among the rest 1
    rest = np.where(part, 0.0, u - mean)
    centre = mean - np.linalg.solve(own, np.where(part, rest @ precision, 0.0)[..., None])[..., 0]
    lower = np.linalg.cholesky(own)
    step = np.linalg.solve(np.swapaxes(lower, 1, 2), rng.standard_normal(u.shape)[..., None])[..., 0]
    fresh = np.where(part, centre + step, u)

    def squared(x: np.ndarray) -> np.ndarray:
        gap = np.where(part, x - centre, 0.0)
        return np.einsum("ni,nij,nj->n", gap, own, gap)

    return fresh, 0.5 * (squared(fresh) - squared(u))


KERNELS = (_stepped, _redrawn)  # in turn; at a power below the last, each once


def _cov(draws: np.ndarray) -> np.ndarray:
    """Covariance [d, d] of draws [M, d], regular also where they span a plane only."""
    d = draws.shape[1]
    found = np.cov(draws.T).reshape(d, d)
    return found + np.diag(1e-9 * np.diag(found) + 1e-24)


def reflected(u: np.ndarray) -> np.ndarray:
    """Coordinates folded into [0, 1], so that a step and its way back stay as likely."""
    u = np.mod(u, 2.0)
    return np.where(u > 1, 2.0 - u, u)


def powered(base: np.ndarray, like: np.ndarray, power: float) -> np.ndarray:
    """Log weights [N] by a power of the likelihood that may be 0: what is impossible stays so."""
    possible = np.isfinite(like)
    return base + np.where(possible, power * np.where(possible, like, 0.0), -np.inf)


def tempering(base: np.ndarray, like: np.ndarray, wanted: float, most: float = 1.0) -> float:
    """Find the largest power of the likelihood, at most `most`, at which `wanted` draws count."""
    held = np.where(np.isfinite(like), like, -1e300)
    if ess_of(normalised(base + most * held)) >= wanted:
        return most
    low, high = 0.0, most
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ess_of(normalised(base + middle * held)) >= wanted else (low, middle)
    return low


def _systematic(rng: np.random.Generator, weights: np.ndarray, count: int) -> np.ndarray:
    """Draw indices [count], each as often as its weight says, to less than one."""
    return np.minimum(np.searchsorted(np.cumsum(weights), (rng.random() + np.arange(count)) / count), len(weights) - 1)


def normalised(log_weights: np.ndarray) -> np.ndarray:
    """Weights [N] that sum to 1."""
    weights = np.exp(log_weights - np.max(log_weights))
    return weights / weights.sum()


def ess_of(weights: np.ndarray) -> float:
    """Effective sample size of weights [N] that sum to 1 (Kish 1965)."""
    return float(1.0 / np.sum(weights**2)) if len(weights) else 0.0


__all__ = ["ParticleState", "ess_of", "init", "normalised", "powered", "reflected", "run", "tempering"]
