"""A posterior refined by the simulator's own likelihood: importance sampling from a proposal, then moves.

Draws of all rounds are weighted by the mixture of all that they were drawn from (Cornuet et al. 2012, AMIS). While the
proposal is far off, the likelihood is tempered so that enough draws count (Beskos et al. 2016) and the next proposal is
fitted to those. What it has not reached by then, sequential Monte Carlo does (smc.py), which also finds out
whether the draws are the posterior's.

Importance sampling is in probit coordinates z, in which the prior is N(0, I), moves and the answer in the unit cube.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp, ndtr
from scipy.stats import multivariate_t

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.charts import EDGE, to_chart
from bayessim_mjx.inference import smc
from bayessim_mjx.inference.final_importance_sampling import FREEDOM, final_importance_sampling
from bayessim_mjx.inference.mixture_fit import Mixture, fitted, fitted_to_islands, in_cube
from bayessim_mjx.inference.numbers import AT_ONCE, DEFENSIVE, NEGLIGIBLE, WIDER
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.inference.smc import KEPT, ParticleState, normalised, powered, tempering

LogLikelihood = Callable[[np.ndarray], np.ndarray]  # theta [N, d] -> [N]; not finite: impossible

ROUNDS, MOVES = 4, 96  # of importance sampling and of moves after it, at most; source: cost alone
ENOUGH = 0.5 / NEGLIGIBLE**2  # independent draws, of the worst parameter: its sd is known to NEGLIGIBLE of itself


@dataclass(frozen=True)
class Problem:
    """A posterior to find.

    Attributes:
        proposal: where the posterior may be, e.g. the product of a network's posteriors; it may be too narrow or off.
        log_likelihood: of all data, for thetas [draws, d] at once.
        components: at most so many Gaussians in the posterior.
        draws: thetas of one call; every call has as many, so one compiled program serves all. A multiple of ISLANDS.
        rounds: of importance sampling, at most.
    """

    proposal: Distribution
    log_likelihood: LogLikelihood
    components: int = InferenceSettings.components
    draws: int = AT_ONCE
    rounds: int = ROUNDS

    @property
    def chart(self) -> str:
        """Coordinates in which the answer is a mixture of Gaussians."""
        return "plain" if self.proposal.chart == "plain" else "probit"

    def of_unit(self, u: np.ndarray) -> np.ndarray:
        """Compute the log likelihood [N] at u [N, d] in the unit cube."""
        return np.asarray(self.log_likelihood(thetas(self.proposal.space, u)), np.float64)


@dataclass(frozen=True)
class Refined:
    """Result of importance sampling and moves.

    Attributes:
        posterior: `fitted`, or the proposal where `reason` is not None.
        fitted: a mixture of Gaussians fitted to draws of the posterior.
        population: these draws, in the unit cube; None where no simulation has a finite likelihood.
        effective: their effective sample size.
        simulations: how many thetas were simulated.
        theta: the most likely theta that was simulated [d].
        reason: why the proposal was kept, or None.
        shape: k of the weights' tail where the posterior is fitted to independent draws; None: to moved ones.
    """

    posterior: Distribution
    fitted: Distribution
    population: ParticleState | None
    effective: float
    simulations: int
    theta: np.ndarray
    reason: str | None
    shape: float | None = None

    @property
    def evidence(self) -> float:
        """Log of the mean likelihood over the prior; -inf where it is finite nowhere."""
        return self.population.evidence if self.population else -np.inf


@dataclass
class _Draws:
    """All that was simulated: z [N, d] in probit coordinates, log likelihood and log prior density less that drawn."""

    problem: Problem
    used: list[Mixture]
    z: np.ndarray
    like: np.ndarray
    base: np.ndarray

    def more(self, rng: np.random.Generator) -> None:
        """Add a call's draws of the last mixture."""
        fresh = _draw(rng, self.used[-1], self.problem.draws)
        found = self.problem.of_unit(ndtr(fresh))
        self.z = np.concatenate([self.z, fresh])
        self.like = np.concatenate([self.like, np.where(np.isfinite(found), found, -np.inf)])
        self.base = _log_prior(self.z) - _mixed(self.used, self.z)


def refine(problem: Problem, seed: int = 0, also: tuple[np.ndarray, np.ndarray] | None = None) -> Refined:
    """Find the posterior prior x likelihood from the proposal.

    Args:
        problem: what is looked for.
        seed: of the draws.
        also: mean [d] and covariance [d, d] of z (theta in the probit chart) where the posterior may be too: half of
            the first draws are from there.

    Returns:
        The refined posterior, or the proposal with the reason why it was kept.
    """
    rng, proposal = np.random.default_rng(seed), problem.proposal
    near = _near(rng, problem, also)
    if not np.isfinite(near.like).any():
        reason = f"none of {len(near.z)} simulations has a finite likelihood"
        return Refined(proposal, proposal, None, 0.0, len(near.z), np.asarray(proposal.mode()), reason)
    start = smc.init(rng, ndtr(near.z), near.like, near.base, problem.draws)
    found = smc.run(rng, problem.of_unit, start, ENOUGH, MOVES)
    return _answer(rng, problem, found, len(near.z))


def tempered(problem: Problem, found: Refined, power: float, seed: int = 0) -> Refined:
    """Refine with the likelihood to a power: a generalised posterior (Bissiri et al. 2016)."""
    assert found.population is not None
    rng = np.random.default_rng(seed)
    at = smc.run(rng, problem.of_unit, found.population, ENOUGH, MOVES // 2, power)
    return _answer(rng, problem, at, found.simulations - found.population.simulations, power)


def sharpened(problem: Problem, found: Refined, power: float = 1.0, seed: int = 0) -> Refined:
    """Fit Gaussians to independent draws, where the effective sample size of these is larger.

    Args:
        problem: as `refine` took it.
        found: as `refine` (power 1) or `tempered` left it.
        power: of the likelihood.
        seed: of the draws.
    """
    if found.reason or found.population is None:
        return found
    rng = np.random.default_rng(seed)
    q = fitted_to_islands(rng, found.population.islands, problem.components)
    drawn = final_importance_sampling(rng, q, lambda u: power * problem.of_unit(u), problem.draws)
    if drawn is None or drawn.ess <= found.effective:
        return found
    u, weights, count = drawn.u, drawn.weights, drawn.ess
    z = np.asarray(to_chart(jnp.asarray(u), problem.chart), np.float64)
    fit = _mixture(problem, lambda own: fitted(rng, z[:, own], weights, problem.components), z, count, weights)
    simulations = found.simulations + len(u)
    return replace(found, posterior=fit, fitted=fit, effective=count, simulations=simulations, shape=drawn.shape)


def _near(rng: np.random.Generator, problem: Problem, also: tuple[np.ndarray, np.ndarray] | None) -> _Draws:
    """Draw by importance sampling, until half of one call's number count or `problem.rounds` are over."""
    d, draws = len(problem.proposal.space), problem.draws
    first = _begin(problem.proposal) if also is None else _joined(_begin(problem.proposal), *also)
    near = _Draws(problem, [first], np.zeros((0, d)), np.zeros(0), np.zeros(0))
    for turn in range(problem.rounds):
        near.more(rng)
        if not np.isfinite(near.like).any():
            continue
        power = tempering(near.base, near.like, KEPT * draws)
        if power == 1.0 or turn == problem.rounds - 1:
            break
        weights = normalised(powered(near.base, near.like, power))
        near.used.append(_wider(fitted(rng, near.z, weights, 2)))
    return near


def _answer(rng: np.random.Generator, problem: Problem, at: ParticleState, before: int, power: float = 1.0) -> Refined:
    """Make the result of the particles, if their islands agree."""
    draws = np.asarray(to_chart(jnp.asarray(at.islands), problem.chart), np.float64)
    every, count = draws.reshape(-1, draws.shape[-1]), max(at.ess, 1.0)
    fit = _mixture(problem, lambda own: fitted_to_islands(rng, draws[..., own], problem.components), every, count)
    simulations, missing = before + at.simulations, at.missing(ENOUGH, power)
    reason = missing and f"{missing}, after {simulations} simulations"
    best = thetas(problem.proposal.space, at.u[np.argmax(at.like)][None])[0]
    return Refined(problem.proposal if reason else fit, fit, at, at.ess, simulations, best, reason)


def _mixture(
    problem: Problem, fit: Callable[[np.ndarray], Mixture], draws: np.ndarray, count: float,
    weights: np.ndarray | None = None,
) -> Distribution:  # fmt: skip
    """Gaussians that `fit` finds in the coordinates (`[d]`, bool) it is asked for, in the chart of draws [N, d]."""
    space, chart = problem.proposal.space, problem.chart
    q = in_cube(fit, draws, count, weights) if chart == "plain" else fit(np.ones(draws.shape[1], bool))
    return Distribution.from_unit(space, np.log(q.weights), q.means, np.linalg.cholesky(q.covariances), chart=chart)


def _begin(proposal: Distribution) -> Mixture:
    """Take the proposal's Gaussians in z, and the prior."""
    q = proposal.rechart("probit")
    logits = np.asarray(q.logits, np.float64)
    weights = np.exp(logits - logsumexp(logits))
    scales = np.asarray(q.scales, np.float64)
    keep = weights > 1e-4
    covariances = scales @ np.swapaxes(scales, -1, -2) * WIDER**2
    return _defended(
        Mixture(weights[keep] / weights[keep].sum(), np.asarray(q.means, np.float64)[keep], covariances[keep])
    )


def _joined(q: Mixture, mean: np.ndarray, covariance: np.ndarray) -> Mixture:
    """`q`, whose last part is the prior, and a Gaussian of as much weight before it."""
    return Mixture(
        np.concatenate([[0.5], 0.5 * q.weights]),
        np.concatenate([mean[None], q.means]),
        np.concatenate([(covariance * WIDER**2)[None], q.covariances]),
    )


def _wider(q: Mixture) -> Mixture:
    return _defended(Mixture(q.weights, q.means, q.covariances * WIDER**2))


def _defended(mixture: Mixture) -> Mixture:
    d = mixture.means.shape[1]
    return Mixture(
        np.append((1 - DEFENSIVE) * mixture.weights, DEFENSIVE),
        np.concatenate([mixture.means, np.zeros((1, d))]),
        np.concatenate([mixture.covariances, np.eye(d)[None]]),
    )


def _draw(rng: np.random.Generator, q: Mixture, count: int) -> np.ndarray:
    """Draws [count, d] of the mixture with tails of FREEDOM degrees of freedom; the prior's part is Gaussian."""
    part = rng.choice(len(q.weights), count, p=q.weights / q.weights.sum())
    noise = rng.standard_normal((count, q.means.shape[1]))
    stretch = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, count))
    stretch[part == len(q.weights) - 1] = 1.0
    lower = np.linalg.cholesky(q.covariances)
    return q.means[part] + np.einsum("nij,nj->ni", lower[part], noise) * stretch[:, None]


def _mixed(used: list[Mixture], z: np.ndarray) -> np.ndarray:
    """Log density [N] of all that the draws of all rounds were drawn from; every round has as many draws."""
    rounds = max(1, len(used))
    return logsumexp([_heavy(q, z) for q in used], axis=0) - np.log(rounds)


def _heavy(q: Mixture, z: np.ndarray) -> np.ndarray:
    parts = [
        np.log(w) + multivariate_t(m, c, df=FREEDOM).logpdf(z)
        for w, m, c in zip(q.weights[:-1], q.means[:-1], q.covariances[:-1], strict=True)
    ]
    return logsumexp([*parts, np.log(q.weights[-1]) + _log_prior(z)], axis=0)


def _log_prior(z: np.ndarray) -> np.ndarray:
    return -0.5 * (z**2).sum(1) - 0.5 * z.shape[1] * np.log(2 * np.pi)


def thetas(space: Any, u: np.ndarray) -> np.ndarray:
    """theta [N, d] at u [N, d] in the unit cube, as it is simulated."""
    return np.asarray(space.from_unit(jnp.asarray(np.clip(u, EDGE, 1 - EDGE), jnp.float32)))


__all__ = ["Problem", "Refined", "refine", "sharpened", "tempered", "thetas"]
