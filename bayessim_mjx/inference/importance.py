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
from bayessim_mjx.inference.final_importance_sampling import FREEDOM, WIDER, final_importance_sampling
from bayessim_mjx.inference.mixture_fit import Mixture, fitted, fitted_to_islands, in_cube
from bayessim_mjx.inference.smc import KEPT, ParticleState, normalised, powered, tempering

LogLikelihood = Callable[[np.ndarray], np.ndarray]  # theta [N, d] -> [N]; not finite: impossible

# share of draws from the prior, whatever was learnt; source: rule of thumb, method of Hesterberg 1995
DEFENSIVE = 0.1
ROUNDS, MOVES = 4, 96  # of importance sampling and of moves after it, at most; source: cost alone
ENOUGH = 150.0  # independent draws that a posterior needs, of the worst parameter; source: rule of thumb, not counted


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

    space: Any
    used: list[Mixture]
    z: np.ndarray
    like: np.ndarray
    base: np.ndarray

    def more(self, rng: np.random.Generator, log_likelihood: LogLikelihood, count: int) -> None:
        """`count` draws of the last mixture."""
        fresh = _draw(rng, self.used[-1], count)
        found = np.asarray(log_likelihood(thetas(self.space, ndtr(fresh))), np.float64)
        self.z = np.concatenate([self.z, fresh])
        self.like = np.concatenate([self.like, np.where(np.isfinite(found), found, -np.inf)])
        self.base = _log_prior(self.z) - _mixed(self.used, self.z)


def refine(
    proposal: Distribution,
    log_likelihood: LogLikelihood,
    *,
    seed: int = 0,
    draws: int = 1024,
    rounds: int = ROUNDS,
    moves: int = MOVES,
    components: int = 8,
    enough: float = ENOUGH,
    also: tuple[np.ndarray, np.ndarray] | None = None,
) -> Refined:
    """The posterior prior x likelihood, found from `proposal`.

    Args:
        proposal: where the posterior may be, e.g. the product of a network's posteriors; it may be too narrow or off.
        log_likelihood: of all data, for thetas [draws, d] at once.
        seed: of the draws.
        draws: thetas of one call; every call has as many, so one compiled program serves all. A multiple of ISLANDS.
        rounds: of importance sampling, at most.
        moves: of all draws after that, at most.
        components: at most so many Gaussians in the posterior.
        enough: independent draws to end with.
        also: mean [d] and covariance [d, d] of z (theta in the probit chart) where the posterior may be too: half of
            the first draws are from there.

    Returns:
        The refined posterior, or the proposal with the reason why it was kept.
    """
    space, rng = proposal.space, np.random.default_rng(seed)
    near = _near(rng, proposal, log_likelihood, draws, rounds, also)
    if not np.isfinite(near.like).any():
        reason = f"none of {len(near.z)} simulations has a finite likelihood"
        return Refined(proposal, proposal, None, 0.0, len(near.z), np.asarray(proposal.mode()), reason)
    start = smc.init(rng, ndtr(near.z), near.like, near.base, draws)
    found = smc.run(rng, lambda u: log_likelihood(thetas(space, u)), start, enough, moves)
    return _answer(rng, proposal, found, components, enough, len(near.z))


def tempered(
    found: Refined, proposal: Distribution, log_likelihood: LogLikelihood, power: float,
    *, moves: int = MOVES // 2, components: int = 8, enough: float = ENOUGH, seed: int = 0,
) -> Refined:  # fmt: skip
    """The same with the likelihood to a power, a generalised posterior (Bissiri et al. 2016)."""
    assert found.population is not None
    rng, space = np.random.default_rng(seed), proposal.space
    at = smc.run(rng, lambda u: log_likelihood(thetas(space, u)), found.population, enough, moves, power)
    return _answer(rng, proposal, at, components, enough, found.simulations - found.population.simulations, power)


def sharpened(
    found: Refined, proposal: Distribution, log_likelihood: LogLikelihood,
    *, draws: int = 1024, components: int = 8, power: float = 1.0, seed: int = 0,
) -> Refined:  # fmt: skip
    """`found` with Gaussians fitted to independent draws, where the effective sample size of these is larger.

    Args:
        found: as `refine` (power 1) or `tempered` left it.
        proposal, log_likelihood, draws, components: as in `refine`.
        power: of the likelihood.
        seed: of the draws.
    """
    if found.reason or found.population is None:
        return found
    rng, space = np.random.default_rng(seed), proposal.space
    q = fitted_to_islands(rng, found.population.islands, components)
    drawn = final_importance_sampling(
        rng, q, lambda u: power * np.asarray(log_likelihood(thetas(space, u)), np.float64), draws
    )
    if drawn is None or drawn.ess <= found.effective:
        return found
    u, weights, count = drawn.u, drawn.weights, drawn.ess
    chart = "plain" if proposal.chart == "plain" else "probit"
    z = np.asarray(to_chart(jnp.asarray(u), chart), np.float64)
    fit = _mixture(space, chart, lambda own: fitted(rng, z[:, own], weights, components), z, count, weights)
    simulations = found.simulations + len(u)
    return replace(found, posterior=fit, fitted=fit, effective=count, simulations=simulations, shape=drawn.shape)


def _near(
    rng: np.random.Generator, proposal: Distribution, log_likelihood: LogLikelihood, draws: int, rounds: int,
    also: tuple[np.ndarray, np.ndarray] | None,
) -> _Draws:  # fmt: skip
    """Draws by importance sampling, of which half of one call's number count if `rounds` are enough."""
    d = len(proposal.space)
    first = _begin(proposal) if also is None else _joined(_begin(proposal), *also)
    near = _Draws(proposal.space, [first], np.zeros((0, d)), np.zeros(0), np.zeros(0))
    for turn in range(rounds):
        near.more(rng, log_likelihood, draws)
        if not np.isfinite(near.like).any():
            continue
        power = tempering(near.base, near.like, KEPT * draws)
        if power == 1.0 or turn == rounds - 1:
            break
        weights = normalised(powered(near.base, near.like, power))
        near.used.append(_wider(fitted(rng, near.z, weights, 2)))
    return near


def _answer(
    rng: np.random.Generator, proposal: Distribution, at: ParticleState, components: int, enough: float, before: int,
    power: float = 1.0,
) -> Refined:  # fmt: skip
    """The result of the particles, if their islands agree."""
    chart = "plain" if proposal.chart == "plain" else "probit"
    draws = np.asarray(to_chart(jnp.asarray(at.islands), chart), np.float64)
    every, count = draws.reshape(-1, draws.shape[-1]), max(at.ess, 1.0)
    fit = _mixture(proposal.space, chart, lambda own: fitted_to_islands(rng, draws[..., own], components), every, count)
    simulations, missing = before + at.simulations, at.missing(enough, power)
    reason = missing and f"{missing}, after {simulations} simulations"
    best = thetas(proposal.space, at.u[np.argmax(at.like)][None])[0]
    return Refined(proposal if reason else fit, fit, at, at.ess, simulations, best, reason)


def _mixture(
    space: Any, chart: str, fit: Callable[[np.ndarray], Mixture], draws: np.ndarray, count: float,
    weights: np.ndarray | None = None,
) -> Distribution:  # fmt: skip
    """Gaussians that `fit` finds in the coordinates (`[d]`, bool) it is asked for, in the chart of draws [N, d]."""
    q = in_cube(fit, draws, count, weights) if chart == "plain" else fit(np.ones(draws.shape[1], bool))
    return Distribution.from_unit(space, np.log(q.weights), q.means, np.linalg.cholesky(q.covariances), chart=chart)


def _begin(proposal: Distribution) -> Mixture:
    """The proposal's Gaussians in z, and the prior."""
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


__all__ = ["Refined", "refine", "sharpened", "tempered", "thetas"]
