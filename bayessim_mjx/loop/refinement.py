"""A posterior refined with the simulator's own likelihood of the real trajectories, replayed under their commands.

The product of a network's posteriors proposes, and so do the linear dynamics along the records. `inference.importance`
weighs thetas by how well a filter predicts the recorded motion one step ahead (`tracking`, `likelihood`), with noise
that is estimated in turn. Where the prediction errors of different stretches of time disagree about theta by more than
the likelihood admits, the posterior is widened in those directions, so that model error does not make it sure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import importance
from bayessim_mjx.inference.importance import Refined
from bayessim_mjx.loop.likelihood import Likelihood, Noise

PASSES = 5  # at most, of noise and posterior in turn
WIDER = 1.1  # variance of the scores, in what the likelihood promises, from which on a posterior is widened


@dataclass(frozen=True)
class Refinement:
    """A refined posterior and what it rests on.

    Attributes:
        refined: see `inference.importance`.
        noise: sensor and process noise as estimated.
        widening: largest factor on its standard deviations, 1 where the simulator can explain the trajectories.
    """

    refined: Refined
    noise: Noise
    widening: float

    @property
    def posterior(self) -> Distribution:
        """Refined, or the proposal where `refined.reason` is not None."""
        return self.refined.posterior


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
        if found is not None and not changed and not found.reason:
            break
        parts: list[np.ndarray] = []

        def log_likelihood(thetas: np.ndarray, parts: list[np.ndarray] = parts) -> np.ndarray:
            parts.append(likelihood.squares(thetas))
            return likelihood.log_likelihood(parts[-1])

        found = importance.refine(
            current, log_likelihood, seed=seed + turn, draws=draws, rounds=rounds, components=components,
            also=likelihood.laplace,
        )  # fmt: skip
        kept = np.concatenate(parts)
        if not np.isfinite(found.evidence):
            break
        theta = found.theta[np.argmax(found.log_likelihood)]
        current = found.fitted
    assert found is not None
    widening = 1.0
    if not found.reason:
        found, widening = _adjusted(found, _spread(found, kept, likelihood), components, seed)
    return Refinement(replace(found, posterior=proposal) if found.reason else found, likelihood.noise, widening)


def _spread(found: Refined, squares: np.ndarray, likelihood: Likelihood) -> np.ndarray:
    """Covariance of the scores over that which the likelihood promises [d, d], in whitened z: I where it is right.

    Scores are of stretches of time; those up to half a trajectory apart may go together (Newey and West, 1987). What
    so few stretches show by chance is not believed.
    """
    use = found.weights > 1e-6 * found.weights.max()  # diverged simulations have infinite squares and no weight
    weights, z, squares = found.weights[use] / found.weights[use].sum(), found.z[use], squares[use]
    unit = float(weights @ squares.sum((1, 2))) / likelihood.count
    gap = z - weights @ z
    covariance = gap.T @ (gap * weights[:, None])
    lower = np.linalg.cholesky(covariance)
    parts = -0.5 * squares.reshape(len(squares), -1) / unit
    slopes = np.linalg.solve(lower, gap.T @ (weights[:, None] * parts))  # L^T C^-1 gap parts: whitened scores
    slopes = slopes.reshape(-1, *squares.shape[1:])  # [d, N, B]
    slopes = slopes - slopes.mean((1, 2), keepdims=True)
    lags = squares.shape[2] // 2
    spread = np.einsum("inb,jnb->ij", slopes, slopes)
    for lag in range(1, lags + 1):
        both = np.einsum("inb,jnb->ij", slopes[..., lag:], slopes[..., :-lag])
        spread += (1 - lag / (lags + 1)) * (both + both.T)
    return _shrunk(spread, squares.shape[1] * squares.shape[2] / lags)


def _shrunk(spread: np.ndarray, count: float) -> np.ndarray:
    """A covariance [d, d] of `count` draws, nearer to I by what chance explains of the way to it.

    First its mean variance to 1, then the rest to that (positive-part James-Stein; Ledoit and Wolf, 2004).
    """
    d = len(spread)
    away = np.trace(spread) / d - 1
    common = 1 + away * _beyond(away**2, 2 / (count * d))
    gap = spread - common * np.eye(d)
    return common * np.eye(d) + gap * _beyond(float(np.sum(gap**2)), common**2 * (d * d + d) / count)


def _beyond(seen: float, chance: float) -> float:
    """Share of a squared distance that is not chance."""
    return max(0.0, 1 - chance / max(seen, 1e-30))


def _adjusted(found: Refined, spread: np.ndarray, components: int, seed: int) -> tuple[Refined, float]:
    """The draws as wide as the scores say, in no direction narrower; and the largest factor on standard deviations.

    A posterior of one mode is stretched (open-faced sandwich, Shaby 2014), one of several is tempered.
    """
    values, axes = np.linalg.eigh(spread)
    values = np.maximum(values, 1.0)
    if values.max() < WIDER:
        return found, 1.0
    if found.fitted.components > 1:
        return importance.tempered(found, 1 / float(values.mean()), components, seed), float(np.sqrt(values.mean()))
    return importance.stretched(found, axes @ np.diag(np.sqrt(values)) @ axes.T, seed), float(np.sqrt(values.max()))


__all__ = ["Refinement", "refine"]
