"""`bayessim.refine`: a posterior refined by the simulator's own likelihood of the real trajectories, replayed.

The product of a network's posteriors proposes, and so do the linear dynamics along the records. `inference.importance`
weighs thetas by how well a filter predicts the recorded motion one step ahead (`tracking`, `likelihood`), with noise
that is estimated in turn. Where the prediction errors of different stretches of time disagree about theta by more than
the likelihood admits, the posterior is widened in those directions, so that model error does not make it sure.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, importance, temperature
from bayessim_mjx.inference.final_importance_sampling import UNRELIABLE
from bayessim_mjx.inference.importance import Problem, Refined
from bayessim_mjx.inference.numbers import AT_ONCE, NEGLIGIBLE, TURNS
from bayessim_mjx.keys import branch
from bayessim_mjx.logs import Channels
from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.loop.noise import Noise
from bayessim_mjx.loop.recorded import Recorded
from bayessim_mjx.loop.state import Answer, Evidence, Loop, LoopState, Round
from bayessim_mjx.physics.tangent import in_tangent
from bayessim_mjx.tracking import Record

# times the squared distance that chance makes: groups that share nothing are moved in .01 to .07 of the cases.
# source: tests/loop/test_widening.py
SHARED = 3.0


def refine_by_replays(round_: Round, answer: Answer) -> tuple[Answer, Evidence]:
    """Refine the posterior by replays of all real trajectories so far, where `bayessim.refine` asks for it."""
    if not round_.loop.refines:
        return answer, Evidence()
    clock, loop, b, warnings = time.perf_counter(), round_.loop, round_.loop.settings, []
    likelihood = _likelihood(loop, round_.state, round_.known)
    if likelihood.silent.any() and not round_.number:
        warnings.append(f"bayessim.refine: {_without_noise(likelihood.silent, likelihood.physics.mj_model)}")
    if not likelihood.seen.any():
        return answer, Evidence(warnings=warnings)
    round_.begin("replaying the real motion")
    seed = int(jax.random.randint(branch(loop.key(round_.number, "fit"), 3), (), 0, 2**31 - 1))
    found = refine(answer.posterior, likelihood, seed=seed, components=b.components)
    seconds = {"refine": time.perf_counter() - clock}
    warnings += [text for text in [found.warning()] if text]
    if not found.used and b.refine == "likelihood":
        warnings.append(f"bayessim.refine: {found.sentence()}")
    evidence = Evidence({"refinement": found}, scores(found), warnings, seconds)
    if not found.used:
        return answer, evidence
    posterior = found.posterior.reduce(b.components).rechart(loop.chart)
    # of the prior as much as in any posterior: the domain of the next training has mass everywhere
    share = min(b.priorShare, InferenceSettings.defensive)
    posterior = dataclasses.replace(posterior, prior_weight=jnp.float32(share))
    return dataclasses.replace(answer, posterior=posterior, source="replays"), evidence


def _without_noise(silent: np.ndarray, model: mujoco.MjModel) -> str:
    names = [f"{stream}:{name}" for stream in ("qpos", "qvel") for name in Channels.of(model).qvel]
    left_out = ", ".join(name for name, there in zip(names, silent, strict=True) if there)
    return (
        f"{left_out}: too few different values to see how noisy they are, so they have no part in the likelihood; "
        "a `sigma` beside the logs (real.noise of a surrogate) gives them one"
    )


def scores(found: Refinement) -> dict[str, float]:
    """Numbers for curves."""
    numbers = {"effective": found.refined.effective, "widening": found.widening}
    numbers |= {"simulations": float(found.refined.simulations), "used": float(found.used)}
    return {f"refine/{name}": float(value) for name, value in numbers.items()}


def _likelihood(loop: Loop, state: LoopState, known: int) -> Likelihood:
    """Make the likelihood of the first `known` real trajectories; windows of one log are one group."""
    physics, source = loop.env.physics, loop.source  # type: ignore[attr-defined]
    model, each = physics.mj_model, loop.settings.realTrajs
    if isinstance(source, Recorded):
        index = source.order[np.arange(known) % len(source.order)]
        record = source.records(index)
        speeds = np.where(source.fast, source.noise["qvel"], np.inf)
        sensor = np.concatenate([in_tangent(model, np.asarray(source.noise["qpos"])), speeds])
        valid = np.ones(record.command.shape[:2])
        return Likelihood(physics, record, valid, sensor, each, groups=source.data["run"][index])
    motion = state.motion
    assert motion is not None
    rows = {name: value[:known] for name, value in motion.items()}
    record = Record(rows["qpos"], rows["qvel"], rows["command"])
    sensor = np.full(2 * model.nv, source.noise, float)  # type: ignore[union-attr]
    return Likelihood(physics, record, np.asarray(rows["valid"]), sensor, each)


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

    @property
    def used(self) -> bool:
        """Whether the posterior is refined."""
        return self.refined.reason is None

    def sentence(self) -> str:
        """One line: what was done, or why it was not."""
        if not self.used:
            return f"the network's posterior is kept: {self.refined.reason}"
        text = f"refined by {self.refined.simulations} replays, effective sample size {self.refined.effective:.0f}"
        wider = f", {self.widening:.2g} times wider as trajectories disagree" if self.widening > 1 else ""
        return f"{text}{wider}; it replaces the network's"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        numbers = {"used": self.used, "sentence": self.sentence(), "simulations": self.refined.simulations}
        return numbers | {
            "effective": self.refined.effective,
            "widening": self.widening,
            "pareto_k": _finite(self.refined.shape),
        }

    def warning(self) -> str | None:
        """Warn of weights with a heavy tail; None: there is none."""
        k = self.refined.shape
        if not self.used or k is None or k <= UNRELIABLE:
            return None
        return (
            f"the refined posterior rests on draws with heavy-tailed weights (k = {k:.2g}; above {UNRELIABLE} a few of "
            "them decide): its width may be off, more rounds or bayessim.components may help"
        )


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def refine(
    proposal: Distribution,
    likelihood: Likelihood,
    *,
    seed: int = 0,
    draws: int = AT_ONCE,
    components: int = InferenceSettings.components,
) -> Refinement:
    """Find the posterior of all records from a proposal that may be wrong.

    Args:
        proposal: e.g. the product of the network's posteriors of the trajectories.
        likelihood: of the records.
        seed: of the draws; draws, components: as in `importance.Problem`.
    """

    def log_likelihood(thetas: np.ndarray) -> np.ndarray:
        return likelihood.log_likelihood(likelihood.squares(thetas))

    problem, theta = importance.Problem(proposal, log_likelihood, components, draws), np.asarray(proposal.mode())
    current = problem
    found, kept, simulations = None, None, 0
    for turn in range(TURNS):
        changed = likelihood.settle(theta)
        if found is not None and not changed:
            break
        found = importance.refine(current, seed + turn, likelihood.laplace)
        simulations += found.simulations
        if found.population is None:
            break
        rank = found.reason is None, found.evidence + likelihood.size
        if kept is None or rank > kept[0]:  # noise and posterior need not settle: the likeliest noise counts
            kept = rank, found, (likelihood.noise, likelihood.gains)
        theta, current = found.theta, replace(problem, proposal=found.fitted)
    if kept is not None:
        _, found, settled = kept
        likelihood.back_to(*settled)
    assert found is not None
    found, widening = replace(found, simulations=simulations), 1.0
    if not found.reason:
        found = importance.sharpened(problem, found, seed=seed)
        found, widening = _adjusted(found, problem, likelihood, seed)
    return Refinement(replace(found, posterior=proposal) if found.reason else found, likelihood.noise, widening)


def _spread(draws: np.ndarray, squares: np.ndarray, likelihood: Likelihood) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the scores over that which the likelihood promises [d, d], I where it is right; and its whitening.

    Args:
        draws: of the posterior [M, d].
        squares: of their prediction errors [M, N, blocks].
        likelihood: that they are from.

    Scores are of stretches of time; those up to half a trajectory apart may go together (Newey and West, 1987). Whole
    trajectories, or logs, may be off in one way each (Liang and Zeger, 1986). What so few of either show by chance is
    not believed.
    """
    use = np.isfinite(squares).all((1, 2))  # what diverged tells no slope
    draws, squares = draws[use], squares[use]
    unit = max(float(squares.sum((1, 2)).mean()) / likelihood.count, likelihood.least)
    gap = draws - draws.mean(0)
    lower = np.linalg.cholesky(gap.T @ gap / len(gap))
    parts = -0.5 * squares.reshape(len(squares), -1) / unit
    slopes = np.linalg.solve(lower, gap.T @ parts / len(gap))  # L^T C^-1 gap parts: whitened scores
    slopes = slopes.reshape(-1, *squares.shape[1:])  # [d, N, B]
    slopes = slopes - slopes.mean((1, 2), keepdims=True)
    lags = squares.shape[2] // 2
    spread = np.einsum("inb,jnb->ij", slopes, slopes)
    for lag in range(1, lags + 1):
        both = np.einsum("inb,jnb->ij", slopes[..., lag:], slopes[..., :-lag])
        spread += (1 - lag / (lags + 1)) * (both + both.T)
    near = _shrunk(spread, squares.shape[1] * squares.shape[2] / lags)
    return _grouped(near, slopes.sum(2).T, likelihood.groups), lower


def _grouped(near: np.ndarray, scores: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """`near` [d, d], moved towards the covariance of the sums of scores [N, d] in groups [N] by what is not chance.

    Few groups have heavy tails, so their distance has to be SHARED times that which chance makes (test_widening.py).
    """
    labels, place = np.unique(groups, return_inverse=True)
    if len(labels) < 2:
        return near
    sums = np.stack([scores[place == k].sum(0) for k in range(len(labels))])
    gap = sums.T @ sums * len(labels) / (len(labels) - 1) - near
    chance = (np.trace(near @ near) + np.trace(near) ** 2) / (len(labels) - 1)  # of Wishart draws
    return near + gap * _beyond(float(np.sum(gap**2)), SHARED * chance)


def _shrunk(spread: np.ndarray, count: float) -> np.ndarray:
    """Move a covariance [d, d] of `count` draws towards I by the part of the way that chance explains.

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


def _adjusted(found: Refined, problem: Problem, likelihood: Likelihood, seed: int) -> tuple[Refined, float]:
    """Widen the posterior as the scores say, in no direction narrower; return the largest factor on its sd too.

    A posterior of one Gaussian is stretched (open-faced sandwich, Shaby 2014), one of several is tempered, or each of
    its Gaussians stretched where moves do not reach the tempered one.
    """
    assert found.population is not None
    u = found.population.u
    spread, lower = _spread(u, likelihood.squares(importance.thetas(problem.proposal.space, u)), likelihood)
    values, axes = np.linalg.eigh(spread)
    values = np.maximum(values, 1.0)
    if np.sqrt(values.max()) < 1 + NEGLIGIBLE:
        return found, 1.0
    if found.fitted.components > 1 or found.fitted.chart != "plain":
        power, wider = 1 / float(values.mean()), float(np.sqrt(values.mean()))
        again = importance.tempered(problem, found, power, seed)
        if again.reason:  # the draws before were the posterior's; the proposal saw no replay at all
            wide = temperature.tempered(found.fitted, wider)
            return replace(found, posterior=wide, fitted=wide, simulations=again.simulations), wider
        return importance.sharpened(problem, again, power, seed), wider
    by = lower @ (axes * np.sqrt(values)) @ axes.T @ np.linalg.inv(lower)
    q = found.fitted
    covariance = by @ np.asarray(q.scales[0] @ q.scales[0].T, np.float64) @ by.T
    wide = Distribution.from_unit(q.space, q.logits, q.means, np.linalg.cholesky(covariance)[None], chart=q.chart)
    return replace(found, posterior=wide, fitted=wide), float(np.sqrt(values.max()))
