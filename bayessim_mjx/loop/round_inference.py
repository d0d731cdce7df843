"""The inference of one round of the outer loop, and what it needs from round to round.

Simulated trajectories over the prior (or over the last posterior, see inference/rounds.py), a fit of
q(theta | summary), tests of it, and the product of the posteriors of all real trajectories so far.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import calibration, checks, misspecification, rounds
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import ranges, refining, set_checks, set_posterior, standing
from bayessim_mjx.loop.factors import conditioned, kept, multiplied
from bayessim_mjx.loop.inference_state import new_network
from bayessim_mjx.loop.simulations import at, noise_draws, proposal_of, simulated
from bayessim_mjx.loop.state import Loop, LoopState, RoundInfo, slot_of, space_of
from bayessim_mjx.quantities import percent
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, select

PREDICTIVE_DRAWS = 64
CLIPPED = 0.01  # share of clipped summary entries worth a warning
LOST = 0.05  # weight of a posterior that cannot be divided by the proposal worth a warning


def infer(loop: Loop, state: LoopState, policy: Policy, info: RoundInfo) -> LoopState:
    """A round's inference: simulate, fit, test, condition on all real trajectories; what was found goes into `info`."""
    b, source, round_ = loop.settings, loop.source, int(state.round)
    assert source is not None and state.domain is not None
    clock = time.perf_counter()
    state, fitted, held, again = _collect(loop, state, policy)
    jax.block_until_ready(fitted)
    info.seconds["simulate"] = time.perf_counter() - clock

    clock = time.perf_counter()
    known_before = np.asarray(state.fit.identified)
    state = _learn(loop, state, fitted, again, info)
    info.seconds["fit"] = time.perf_counter() - clock

    clock = time.perf_counter()
    seen = round_ * b.realTrajs
    real_features, real = source.real(loop.key(round_, "real"), seen, b.realTrajs, policy)
    state = dataclasses.replace(
        state, real_features=jax.lax.dynamic_update_slice(state.real_features, real_features, (seen, 0))
    )
    verdict = _examine(loop, state, fitted, held, info)
    if b.checkTrajs and b.ftune and round_ and standing.lost(verdict and verdict[0], held[1]):
        info.warnings.append("the network of the last round lost its range under this round's policy: fitted anew")
        state = _learn(loop, state, fitted, again, info, anew=True)
        verdict = _examine(loop, state, fitted, held, info)
    widening = b.temperature or (verdict[0].temperature if verdict is not None else None) or 1.0
    state = dataclasses.replace(state, temperature=jnp.float32(widening))
    state = dataclasses.replace(state, real_posteriors=_factors(loop, state, info))
    posterior = _widened(loop, state, policy, _posterior(loop, state, info), info)
    if verdict is not None and not b.temperature and not loop.sequential:
        gain = standing.expected(verdict[0], info.sets, seen + b.realTrajs)
        state, posterior = standing.chosen(state, posterior, gain, info)
    if loop.refines:
        state, posterior = refining.refined(loop, state, real, posterior, info)
    by_replays = info.refinement is not None and info.refinement.used
    if not by_replays and "sets/stood" not in info.scores:
        posterior = set_posterior.chosen(loop, state, policy, posterior, info)
    replaced = by_replays or (info.set_posterior is not None and info.set_posterior.used)
    info.warnings += _complaints(posterior.names, info.fit, known_before, by_replays, int(state.fit.fits) == 1)
    info.posterior, info.real = posterior, jax.tree.map(np.asarray, real)
    info.truth = source.truth_of([loop.key(r, "real") for r in range(round_ + 1)], b.realTrajs)
    info.scores |= score(posterior, info.truth)
    state, domain = ranges.move(loop, state, posterior, info)
    following = rounds.following(domain, b.proposal) if loop.sequential else None
    if verdict is not None:
        found = checks.conclude(*verdict, posterior, b.distrust, info.moves or None)
        info.checks = dataclasses.replace(found, sets=info.sets)
        told = posterior.names if round_ else _unknown(posterior.names, info.fit)
        info.warnings += info.checks.warnings(told, replaced)
        domain = checks.guarded(domain, info.checks.prior_share)
    else:
        info.warnings += [pile.sentence() for pile in info.moves]
    info.predictive = _predict(loop, posterior, seen, real, loop.key(round_, "predict"))
    others = sum(info.seconds.get(name, 0.0) for name in ("check", "refine", "sets"))
    info.seconds["condition"] = time.perf_counter() - clock - others
    return dataclasses.replace(state, domain=domain, proposal=following)


def _collect(
    loop: Loop, state: LoopState, policy: Policy
) -> tuple[LoopState, tuple[Array, Array, int], tuple[Array, Array], inference.Again | None]:
    """Simulate this round's trajectories: (thetas, features, valid rows) to fit, and fresh pairs that test the fit.

    Last come further draws of their measurement noise; simulations of earlier rounds have but those that were kept.
    """
    b, round_ = loop.settings, int(state.round)
    # one program for what is fitted and what tests the fit
    draws = noise_draws(loop)
    thetas, x, more = simulated(
        loop.source,  # type: ignore[arg-type]
        loop.key(round_, "simulate"),
        policy,
        proposal_of(loop, state),
        b.proposal,
        b.trainTrajs + b.checkTrajs,
        functools.partial(ranges.completed, loop, state),
        draws,
    )
    held, thetas, x = (thetas[b.trainTrajs :], x[b.trainTrajs :]), thetas[: b.trainTrajs], x[: b.trainTrajs]
    state, row, count = ranges.room(loop, state)
    if loop.sequential:
        assert state.proposals is not None and state.proposal is not None
        slot = slot_of(loop, state, round_ + 1)
        state = dataclasses.replace(state, proposals=rounds.stored(state.proposals, slot, state.proposal))
    if not loop.capacity:
        return state, (thetas, x, b.trainTrajs), held, _again(more[: b.trainTrajs], 0, b.trainTrajs)
    thetas = jax.lax.dynamic_update_slice(state.thetas, thetas, (row, 0))
    x = jax.lax.dynamic_update_slice(state.features, x, (row, 0))
    state, thetas, x = ranges.mixed(loop, state, thetas, x)
    again = _again(more[: b.trainTrajs], row, len(thetas))
    return dataclasses.replace(state, thetas=thetas, features=x), (thetas, x, count), held, again


def _again(more: Array, first: int, rows: int) -> inference.Again | None:
    """Further draws of the noise of as many rows as there are in `more`, from `first` on."""
    if not more.shape[1]:
        return None
    place = np.arange(rows, dtype=np.int32) - first
    return inference.Again(more, jnp.asarray(np.where((place >= 0) & (place < len(more)), place, -1)))


def _learn(
    loop: Loop,
    state: LoopState,
    fitted: tuple[Array, Array, int],
    again: inference.Again | None,
    info: RoundInfo,
    anew: bool = False,
) -> LoopState:
    """Fit the network, the one so far or a new one; anew: a new one in any case."""
    b, round_, (thetas, x, count) = loop.settings, int(state.round), fitted
    keeps = (b.ftune or round_ == 0) and not ranges.has_moved(state) and not anew
    network = state.fit if keeps else new_network(loop, round_, space_of(loop, state))
    correction: dict[str, Any] = {"again": again}
    if b.proposal == "apt":
        correction |= {"proposals": state.proposals, "origin": np.arange(len(thetas), dtype=np.int32) // b.trainTrajs}
    network, fit_info = inference.fit(loop.key(round_, "fit"), network, thetas, x, jnp.int32(count), **correction)
    info.fit = {name: np.asarray(value) for name, value in dataclasses.asdict(fit_info).items()}
    return dataclasses.replace(state, fit=network)


def _examine(
    loop: Loop, state: LoopState, fitted: tuple, held: tuple, info: RoundInfo
) -> tuple[calibration.Report, misspecification.Misfit] | None:
    """Calibration and misfit, or None where they are switched off or too few fresh simulations are usable."""
    clock, b, round_ = time.perf_counter(), loop.settings, int(state.round)
    if not b.checkTrajs:
        return None
    known = slice(round_ * b.realTrajs if loop.source.policy_dependent else 0, (round_ + 1) * b.realTrajs)  # type: ignore[union-attr]
    # what the network of this round is tested on comes from what it was simulated from
    tilt = state.proposals and at(state.proposals, slot_of(loop, state, round_ + 1)) if b.proposal == "apt" else None
    key = branch(loop.key(round_, "fit"), 2)
    try:
        return checks.examine(
            key, state.fit, fitted, held, state.real_features, known,
            temperature=b.temperature, tilt=tilt, names=loop.feature_names,
        )  # fmt: skip
    except UserError as error:
        info.warnings.append(str(error))
        return None
    finally:
        info.seconds["check"] = time.perf_counter() - clock


def _factors(loop: Loop, state: LoopState, info: RoundInfo) -> Distribution:
    """q(theta | x) of every real trajectory, leaves [real trajectories, ...]."""
    b, seen = loop.settings, int(state.round) * loop.settings.realTrajs
    factors = conditioned(state.fit, state.real_features, state.temperature)
    if b.proposal == "division":
        assert state.proposals is not None
        rows = jax.tree.map(np.asarray, factors).split()
        done = seen + b.realTrajs
        quotients, lost = rounds.divided(rows[:done], at(state.proposals, 0))
        factors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *quotients, *rows[done:])
        if lost > LOST:
            info.warnings.append(f"{percent(lost)} of the posterior's weight cannot be divided by the proposal")
    factors = kept(factors, state.fit.identified, b.priorShare)
    if not loop.source.policy_dependent:  # type: ignore[union-attr]
        return factors
    # an older trajectory was made by an older policy: its posterior stays that of the network of its time
    return select(jnp.arange(factors.logits.shape[0]) >= seen, factors, state.real_posteriors)


def _posterior(loop: Loop, state: LoopState, info: RoundInfo) -> Distribution:
    """The product of the factors of all real trajectories so far."""
    posterior, lost = multiplied(loop, state, (int(state.round) + 1) * loop.settings.realTrajs)
    if lost:
        info.warnings.append(f"{lost} real trajectories left out: their posteriors are no densities")
    return posterior


def _widened(loop: Loop, state: LoopState, policy: Policy, posterior: Distribution, info: RoundInfo) -> Distribution:
    """The product, moved and widened as simulated sets of as many trajectories ask for."""
    clock, known = time.perf_counter(), (int(state.round) + 1) * loop.settings.realTrajs
    found = None if loop.settings.temperature else set_checks.judge(loop, state, policy, known)
    found = set_checks.settled(loop, state, policy, known, posterior, found)
    if found is None:
        return posterior
    info.sets = found
    info.scores |= set_checks.scores(found, known)
    info.seconds["check"] = info.seconds.get("check", 0.0) + time.perf_counter() - clock
    return found.used(posterior, known)


def _complaints(
    names: tuple[str, ...], fit: dict[str, Any], known_before: np.ndarray, by_replays: bool, fresh: bool
) -> list[str]:
    """What a person should know about this round's fit.

    Args:
        names: of the parameters.
        fit: what the fit told.
        known_before: which parameters were identified [d].
        by_replays: whether the posterior is not the network's alone.
        fresh: whether it was the network's first fit.
    """
    texts, unknown = [], _unknown(names, fit)
    if unknown and not np.array_equal(fit["identified"], known_before):
        what = ", ".join(unknown)
        from_network = f"the network does not tell {what} from these trajectories; the posterior is that of replays"
        texts.append(from_network if by_replays else f"not identified by these trajectories, kept at the prior: {what}")
    if fit["clipped"] > CLIPPED:
        texts.append(f"{percent(fit['clipped'])} of the summaries' entries lie beyond 10 sd and were clipped")
    if fit["n_invalid"] > 0:
        texts.append(f"{int(fit['n_invalid'])} simulated trajectories left out: their summaries are not finite")
    if fresh and fit["best"] < 0:
        n = f"{int(fit['steps'])} steps on {int(fit['n_train'])} trajectories"
        other = "another summary (bayessim.summarizerFxn) or longer trajectories (bayessim.trainTrajLen) may tell more"
        hint = "" if np.any(fit["identified"]) else f"; {other}"
        texts.append(f"the network is the linear posterior that training begins at: {n} found none better{hint}")
    if fit["skipped"] > 0:
        texts.append(f"{int(fit['skipped'])} steps of the fit skipped: gradient not finite")
    return texts


def _unknown(names: tuple[str, ...], fit: dict[str, Any]) -> tuple[str, ...]:
    """Parameters that the fit gives back their prior."""
    return tuple(name for name, known in zip(names, fit["identified"], strict=True) if not known)


def score(domain: Distribution, truth: np.ndarray | None) -> dict[str, float]:
    """Log density of the truth where it is known, and per-parameter contraction and sd against the prior."""
    found = domain.estimates()
    scores = {f"contraction/{name}": float(c) for name, c in zip(domain.space.names, found.contraction, strict=True)}
    scores |= {f"width/{name}": float(w) for name, w in zip(domain.space.names, found.width, strict=True)}
    scores["prior_share"] = found.prior_share
    if truth is not None:
        if np.isfinite(gain := float(domain.log_gain(jnp.asarray(truth)))):  # a truth beyond the range has no density
            scores["log_p_truth"] = float(domain.log_prob(jnp.asarray(truth)))
            scores["gain_over_prior"] = gain
        scores["credible_level"] = float(domain.credible_level(jnp.asarray(truth)))
    return scores


def _predict(
    loop: Loop, domain: Distribution, first: int, real: Trajectory, key: Array
) -> dict[str, np.ndarray] | None:
    """Posterior predictive: the first real trajectory's commands replayed from its first state at posterior draws."""
    if getattr(loop.env, "physics", None) is None:
        return None
    assert loop.source is not None
    motion = loop.source.repeated(first, real, domain.sample(key, PREDICTIVE_DRAWS))
    return {name: np.asarray(value) for name, value in motion.items()}
