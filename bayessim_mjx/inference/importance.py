"""A posterior refined by the simulator's own likelihood: adaptive importance sampling from a proposal.

Draws of all rounds are weighted by the mixture of all that they were drawn from (Cornuet et al. 2012, AMIS). While the
proposal is far off, the likelihood is tempered so that enough draws count (Beskos et al. 2016) and the next proposal is
fitted to those. The largest weights are smoothed by the generalised Pareto distribution of their tail, whose shape says
whether the weights can be trusted at all (Vehtari et al. 2024, PSIS).

All of it is in probit coordinates z, in which the prior is N(0, I).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.charts import EDGE, from_chart
from bayessim_mjx.inference.pareto import effective, normalised, smoothed
from bayessim_mjx.inference.weighted import Mixture, fitted

LogLikelihood = Callable[[np.ndarray], np.ndarray]  # theta [N, d] -> [N]; not finite: impossible

DEFENSIVE = 0.1  # share of the draws that come from the prior, whatever was learnt (Hesterberg 1995)
FREEDOM = 5.0  # degrees of freedom of the proposals: their tails are heavier than a posterior's
WIDER = 1.2  # standard deviations of a fitted proposal, times
EFFECTIVE = 0.5  # share of the draws of one round that should count when the next proposal is fitted
TRUSTED = 0.7  # shape of the weights' tail beyond which they have no finite mean error (PSIS)


@dataclass(frozen=True)
class Refined:
    """What importance sampling found.

    Attributes:
        posterior: `fitted`, or the proposal where `reason` is not None.
        fitted: a mixture of Gaussians fitted to the weighted draws.
        effective: effective number of draws, (sum w)^2 / sum w^2.
        tail: shape k of the Pareto tail of the weights; above 0.7 they are not to be trusted.
        evidence: log of the mean likelihood over the prior (NaN where nothing is finite).
        simulations: how many thetas were simulated.
        rounds: in how many rounds.
        reason: why the proposal was kept, or None.
        z: the draws [N, d] in probit coordinates; theta: in the parameters' units; weights: [N], they sum to 1.
        log_likelihood: of the draws [N]; base: their log prior density less that of the draws' own mixture [N].
    """

    posterior: Distribution
    fitted: Distribution
    effective: float
    tail: float
    evidence: float
    simulations: int
    rounds: int
    reason: str | None
    z: np.ndarray
    theta: np.ndarray
    weights: np.ndarray
    log_likelihood: np.ndarray
    base: np.ndarray


def refine(
    proposal: Distribution,
    log_likelihood: LogLikelihood,
    *,
    seed: int = 0,
    draws: int = 1024,
    rounds: int = 8,
    components: int = 8,
    enough: float | None = None,
    also: tuple[np.ndarray, np.ndarray] | None = None,
) -> Refined:
    """The posterior prior x likelihood, found from `proposal`.

    Args:
        proposal: where the posterior may be, e.g. the product of a network's posteriors; it may be too narrow or off.
        log_likelihood: of all data, for thetas [draws, d] at once.
        seed: of the draws.
        draws: thetas of one round; every round has as many, so one compiled program serves all.
        rounds: at most so many rounds.
        components: at most so many Gaussians in the posterior.
        enough: effective draws to end with; by default 40 for each parameter, at least 200.
        also: mean [d] and covariance [d, d] of z (theta in the probit chart) where the posterior may be too: half of
            the first draws are from there.

    Returns:
        The refined posterior, or the proposal with the reason why it was kept.
    """
    space, d = proposal.space, len(proposal.space)
    enough = max(200.0, 40.0 * d) if enough is None else enough
    rng = np.random.default_rng(seed)
    used = [_begin(proposal) if also is None else _joined(_begin(proposal), *also)]
    z, like, base = np.zeros((0, d)), np.zeros(0), np.zeros(0)
    done, weights, tail = 0, np.zeros(0), np.inf
    for done in range(1, rounds + 1):  # noqa: B007
        fresh = _draw(rng, used[-1], draws)
        found = np.asarray(log_likelihood(_theta(space, fresh)), np.float64)
        z, like = np.concatenate([z, fresh]), np.concatenate([like, np.where(np.isfinite(found), found, -np.inf)])
        base = _log_prior(z) - _mixed(used, z)
        if not np.isfinite(like).any():
            continue
        weights, tail = smoothed(base + like)
        if effective(weights) >= enough and tail < TRUSTED and done > 1:
            break
        if done < rounds:
            power = _tempering(base, like, min(EFFECTIVE * draws, enough))
            used.append(_wider(fitted(rng, z, normalised(_powered(base, like, power)), components)))
    if not len(weights):
        reason = f"none of {len(z)} simulations has a finite likelihood"
        flat = np.full(len(z), 1 / len(z))
        theta = _theta(space, z)
        return Refined(proposal, proposal, 0.0, np.inf, np.nan, len(z), done, reason, z, theta, flat, like, base)
    log_weights = base + like
    evidence = float(logsumexp(log_weights[np.isfinite(log_weights)]) - np.log(len(z)))
    size, reason = effective(weights), ""
    if size < enough:
        reason = f"{size:.0f} effective draws of {len(z)} simulations, {enough:.0f} are needed"
    elif tail >= TRUSTED:
        reason = f"weights of {len(z)} simulations have a tail of shape {tail:.2f}, at most {TRUSTED:g} can be trusted"
    theta = _theta(space, z)
    answer = _distribution(space, fitted(rng, z, weights, components))
    posterior = proposal if reason else answer
    return Refined(posterior, answer, size, tail, evidence, len(z), done, reason or None, z, theta, weights, like, base)


def tempered(found: Refined, power: float, components: int = 8, seed: int = 0) -> Refined:
    """The same draws weighted by the likelihood to a power below 1, a generalised posterior (Bissiri et al. 2016)."""
    weights, tail = smoothed(found.base + power * found.log_likelihood)
    answer = _distribution(found.fitted.space, fitted(np.random.default_rng(seed), found.z, weights, components))
    return replace(found, posterior=answer, fitted=answer, effective=effective(weights), tail=tail, weights=weights)


def stretched(found: Refined, by: np.ndarray, seed: int = 0) -> Refined:
    """The same draws away from their mean by the factor `by` [d, d], in coordinates of unit covariance."""
    z, space = found.z, found.fitted.space
    mean = found.weights @ z
    lower = np.linalg.cholesky((z - mean).T @ ((z - mean) * found.weights[:, None]))
    away = mean + (z - mean) @ np.linalg.solve(lower.T, by @ lower.T)
    answer = _distribution(space, fitted(np.random.default_rng(seed), away, found.weights, 1))
    return replace(found, posterior=answer, fitted=answer, z=away, theta=_theta(space, away))


def _distribution(space: Any, q: Mixture) -> Distribution:
    scales = np.linalg.cholesky(q.covariances)
    return Distribution.from_unit(space, np.log(q.weights), q.means, scales, chart="probit")


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


def _theta(space: Any, z: np.ndarray) -> np.ndarray:
    u = from_chart(jnp.asarray(z, jnp.float32), "probit")
    return np.asarray(space.from_unit(jnp.clip(u, EDGE, 1 - EDGE)))


def _powered(base: np.ndarray, like: np.ndarray, power: float) -> np.ndarray:
    """Log weights [N] by a power of the likelihood that may be 0: what is impossible stays so."""
    possible = np.isfinite(like)
    return base + np.where(possible, power * np.where(possible, like, 0.0), -np.inf)


def _tempering(base: np.ndarray, like: np.ndarray, wanted: float) -> float:
    """The largest power of the likelihood, at most 1, at which `wanted` draws count."""
    held = np.where(np.isfinite(like), like, -1e300)
    if effective(normalised(base + held)) >= wanted:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(normalised(base + middle * held)) >= wanted else (low, middle)
    return low


__all__ = ["Refined", "refine", "stretched", "tempered"]
