"""Mixtures of Gaussians fitted to weighted draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.special import logsumexp

from bayessim_mjx.distributions import box
from bayessim_mjx.inference.numbers import DRAWS, FEW, NEGLIGIBLE, SURE
from bayessim_mjx.inference.smc import ess_of

# sd, in widths of the cube, of a density that falls by NEGLIGIBLE from the middle to an end: exp(-0.5^2 / (2 FLAT^2))
FLAT = float((-8 * np.log(1 - NEGLIGIBLE)) ** -0.5)


@dataclass(frozen=True)
class Mixture:
    """Gaussians in z: weights [K], means [K, d], covariances [K, d, d]."""

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """[N] of z [N, d], as Gaussians."""
        return logsumexp(self.each(z), axis=1)

    def each(self, z: np.ndarray) -> np.ndarray:
        """[N, K] of each weighted Gaussian."""
        rows = []
        for w, m, c in zip(self.weights, self.means, self.covariances, strict=True):
            lower = np.linalg.cholesky(c)
            away = np.linalg.solve(lower, (z - m).T)
            size = np.log(np.diag(lower)).sum() + 0.5 * len(m) * np.log(2 * np.pi)
            rows.append(np.log(np.maximum(w, 1e-300)) - 0.5 * (away**2).sum(0) - size)
        return np.stack(rows, axis=1)

    def shares(self, z: np.ndarray) -> np.ndarray:
        """[N, K] of each z that each Gaussian accounts for; they sum to 1."""
        each = self.each(z)
        return np.asarray(np.exp(each - logsumexp(each, axis=1, keepdims=True)))


def fitted(rng: np.random.Generator, z: np.ndarray, weights: np.ndarray, most: int) -> Mixture:
    """Gaussians fitted to weighted draws: as many, of 1, 2, 4 ... `most`, as explain draws that were held out best."""
    keep = weights > 1e-12
    z, weights = z[keep], weights[keep] / weights[keep].sum()
    fold = rng.permutation(len(z)) % 2
    halves = [(z[fold == part], weights[fold == part]) for part in (0, 1)]
    return supported(rng, z, weights, _count(rng, halves, most))


def fitted_to_islands(rng: np.random.Generator, islands: np.ndarray, most: int) -> Mixture:
    """Gaussians fitted to draws [I, n, d]: as many, at most `most`, as explain those of the other islands best."""
    count, each, d = islands.shape
    islands = islands[:, :: -(-count * each // DRAWS)]
    halves = [(half, np.full(len(half), 1 / len(half))) for half in (islands[k::2].reshape(-1, d) for k in (0, 1))]
    draws = islands.reshape(-1, d)
    return supported(rng, draws, np.full(len(draws), 1 / len(draws)), _count(rng, halves, most))


def supported(rng: np.random.Generator, z: np.ndarray, weights: np.ndarray, k: int) -> Mixture:
    """`em` with k Gaussians, or half as many and so on where one would stand on fewer draws than it has numbers.

    A few draws of much weight span a plane, and a Gaussian fitted to them is a spike beside everything else.
    """
    q = em(rng, z, weights, k)
    share = q.shares(z) * weights[:, None]
    fewest = min(ess_of(own / own.sum()) if own.sum() > 0 else 0.0 for own in share.T)
    return q if k == 1 or fewest >= numbers_of(z.shape[1]) else supported(rng, z, weights, k // 2)


def numbers_of(d: int) -> int:
    """Count the numbers of a Gaussian over d coordinates: fewer draws span a plane, or say nothing of some of them."""
    return d * (d + 3) // 2


def _count(rng: np.random.Generator, halves: list[tuple[np.ndarray, np.ndarray]], most: int) -> int:
    """Count the Gaussians that, fitted to one half (draws [N, d], weights [N]), explain the other half best."""
    best, score = 1, -np.inf
    for k in (k for k in (1, 2, 4, 8, 16, 32) if k <= most):
        held = 0.0
        for (z, weights), (others, theirs) in (halves, halves[::-1]):
            own = weights / weights.sum()
            if ess_of(own) < numbers_of(z.shape[1]) * k:
                held = -np.inf
                break
            held += float(theirs @ em(rng, z, own, k).log_density(others))
        if held > score + 1e-3:  # nats a draw, for twice the Gaussians; rule of thumb, not counted
            best, score = k, held
    return best


def in_cube(
    fit: Callable[[np.ndarray], Mixture], draws: np.ndarray, ess: float, weights: np.ndarray | None = None
) -> Mixture:
    """Gaussians for draws in the unit cube, matched in coordinates that are not uniform; the others are flat.

    In those coordinates alone draws are enough for more Gaussians, and a curved valley needs them.

    Args:
        fit: Gaussians for the coordinates (`[d]`, bool) that are asked for.
        draws, ess, weights: as for `match_truncated_moments`.
    """
    weights, d = _equal(draws) if weights is None else weights, draws.shape[1]
    flat = _flat(*_moments(draws, weights), ess)
    own = np.flatnonzero(~flat)
    nothing = Mixture(np.ones(1), np.zeros((1, 0)), np.ones((1, 0, 0)))
    q = match_truncated_moments(fit(~flat), draws[:, own], ess, weights) if len(own) else nothing
    means, covariances = np.full((len(q.weights), d), 0.5), np.tile(FLAT**2 * np.eye(d), (len(q.weights), 1, 1))
    means[:, own], covariances[:, own[:, None], own] = q.means, q.covariances
    return Mixture(q.weights, means, covariances)


def _equal(draws: np.ndarray) -> np.ndarray:
    return np.full(len(draws), 1 / len(draws))


def _moments(draws: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [d] and covariance [d, d] of draws [N, d] with weights [N] that sum to 1."""
    mean = weights @ draws
    return mean, (draws - mean).T @ ((draws - mean) * weights[:, None])


def match_truncated_moments(
    q: Mixture, draws: np.ndarray, ess: float, weights: np.ndarray | None = None, steps: int = FEW
) -> Mixture:
    """Gaussians that have the draws' moments once they are cut off at the unit cube (Lee and Scott 2012).

    Of a parameter of which nothing is known, draws fill the range and so must the Gaussian: one whose draws cannot be
    told from uniform ones that vary alone is FLAT wide. By its moments alone the chance of the draws would make it
    narrower, in every such direction.

    Args:
        draws: `[N, d]`; ess: their effective sample size.
        weights: `[N]` that sum to 1; None: equal ones.
    """
    share = q.shares(draws) * (_equal(draws) if weights is None else weights)[:, None]
    means, covariances = q.means.copy(), q.covariances.copy()
    for k, part in enumerate(share.T):
        mean, wanted = _moments(draws, part / np.maximum(part.sum(), 1e-9))
        flat = _flat(mean, wanted, ess * part.sum())
        own = np.flatnonzero(~flat)
        means[k][flat], covariances[k] = 0.5, np.diag(np.where(flat, FLAT**2, 0.0))
        block = np.ix_(own, own)
        means[k][own], covariances[k][block] = _matched(
            q.means[k][own], q.covariances[k][block], mean[own], wanted[block], steps
        )
    return Mixture(q.weights, means, covariances)


def _flat(mean: np.ndarray, covariance: np.ndarray, count: float) -> np.ndarray:
    """[d] whether `count` draws of the cube with these moments may be uniform in a direction and vary there alone."""
    variance = np.diag(covariance)
    middle = np.abs(mean - 0.5) < SURE * np.sqrt(1 / 12 / count)
    wide = np.abs(12 * variance - 1) < SURE * np.sqrt(0.8 / count)  # of a uniform distribution's fourth moment
    together = np.abs(covariance) / np.sqrt(np.maximum(np.outer(variance, variance), 1e-300)) - np.eye(len(mean))
    return middle & wide & (together.max(axis=1, initial=0.0) < SURE / np.sqrt(count))


def _matched(
    mean: np.ndarray, covariance: np.ndarray, to: np.ndarray, wanted: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """(mean [d], covariance [d, d]) that are `to` and `wanted` once cut off, as near as so many steps come."""
    for _ in range(steps if len(mean) else 0):
        x, weights = box.within(mean, np.linalg.cholesky(covariance))
        at = weights @ x
        mean = np.clip(mean + to - at, -1, 2)
        covariance = _towards(covariance, wanted, (x - at).T @ ((x - at) * weights[:, None]))
        narrower = np.minimum(FLAT / np.sqrt(np.diag(covariance)), 1.0)  # as good as flat
        covariance = covariance * np.outer(narrower, narrower)
    return mean, covariance


def _towards(covariance: np.ndarray, wanted: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Change the covariance [d, d] so that, cut off, it comes nearer to `wanted` than it was, which is `cut`."""
    ratio, axes = eigh(wanted, cut)  # axes.T @ cut @ axes = I
    back = np.linalg.inv(axes)
    by = back.T * np.clip(ratio, 0.5, 2.0) ** 0.5 @ axes.T
    return by @ covariance @ by.T


def em(rng: np.random.Generator, z: np.ndarray, weights: np.ndarray, k: int, steps: int = FEW) -> Mixture:
    """Fit weighted draws by expectation maximisation; variances are at least 1e-3 of all.

    It begins at the centres of greedy k-means++ (Arthur and Vassilvitskii 2007): with one candidate for each, both of
    two modes were found from 38 of 60 seeds.
    """
    mean, whole = _moments(z, weights)
    # a few draws span a plane only: densities need every direction, well above rounding
    whole += np.diag(1e-8 * np.diag(whole) + 1e-20)
    if k == 1:
        return Mixture(np.ones(1), mean[None], whole[None])
    root = np.linalg.inv(np.linalg.cholesky(whole))
    white = (z - mean) @ root.T
    centres = [rng.choice(len(z), p=weights)]
    near = ((white - white[centres[0]]) ** 2).sum(1)
    for _ in range(k - 1):
        far = near * weights if near @ weights > 0 else weights
        tried = rng.choice(len(z), FEW, p=far / far.sum())
        nearer = np.minimum(near, ((white - white[tried][:, None]) ** 2).sum(2))
        best = int(np.argmin(nearer @ weights))
        centres.append(tried[best])
        near = nearer[best]
    q = Mixture(np.full(k, 1 / k), z[centres], np.repeat(whole[None] / k ** (2 / z.shape[1]), k, axis=0))
    for _ in range(steps):
        share = q.shares(z) * weights[:, None]
        mass = np.maximum(share.sum(0), 1e-9)
        means = share.T @ z / mass[:, None]
        gap = z[None] - means[:, None]
        covariances = np.einsum("nk,kni,knj->kij", share, gap, gap) / mass[:, None, None] + 1e-3 * whole
        new = Mixture(mass / mass.sum(), means, covariances)
        if np.max(np.abs(new.weights - q.weights)) < 1e-4 and np.max(np.abs((new.means - q.means) @ root.T)) < 1e-3:
            return new
        q = new
    return q
