"""The inference of one round of the outer loop, and the state that it starts from.

Simulated trajectories over the prior (or over the last posterior, see inference/rounds.py) train a network of
q(theta | summary). Fresh simulations check it. Its posteriors of all real trajectories so far are multiplied. Further
simulations and replays of the real trajectories correct the product.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings, calibration, checks, misspecification, rounds
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import examination, findings, ranges, refining, set_posterior, standing
from bayessim_mjx.loop.factors import conditioned, kept, multiplied
from bayessim_mjx.loop.findings import score
from bayessim_mjx.loop.simulations import at, noise_draws, proposal_of, simulated
from bayessim_mjx.loop.state import (
    Answer,
    Evidence,
    Learnt,
    Loop,
    LoopState,
    Round,
    domain_or_prior,
    joined,
    slot_of,
    space_of,
)
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.ranged import Ranged
from bayessim_mjx.quantities import percent
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, select

__all__ = ["CORRECTIONS", "blank", "infer", "score"]

LOST = 0.05  # weight of a posterior that cannot be divided by the proposal worth a warning

# of the product of the posteriors, in this order: later ones begin with the answer of those before
CORRECTIONS: tuple[Callable[[Round, Answer], tuple[Answer, Evidence]], ...] = (
    examination.widen,  # as far as simulated sets require
    standing.keep_last,  # where it promises more
    refining.refine_by_replays,  # the simulator's own likelihood of the real trajectories
    set_posterior.use_set_network,  # one that sees all trajectories together
)


def infer(loop: Loop, state: LoopState, policy: Policy) -> tuple[LoopState, Evidence]:
    """Simulate, learn, condition on all real trajectories and correct; return the next state and the evidence."""
    begun = time.perf_counter()
    state, simulations, spent = simulate(loop, state, policy)
    state, real = observe(loop, state, policy)
    state, learnt, trained = learn(loop, state, simulations)
    state, answer, combined = condition(loop, state)
    round_, found = Round(loop, state, policy, real, learnt), [spent, trained, combined]
    for correct in CORRECTIONS:
        answer, corrected = correct(round_, answer)
        found.append(corrected)
    posterior, moves, moved = ranges.move(loop, state, answer.posterior)
    share, judged = findings.conclude(round_, answer, moves)
    evidence = joined([*found, findings.describe(round_, answer), moved, judged])
    domain = checks.guarded(posterior, share)
    proposal = rounds.following(posterior, loop.settings.proposal) if loop.sequential else None
    state = dataclasses.replace(state, **evidence.kept, domain=domain, proposal=proposal)
    rest = time.perf_counter() - begun - sum(evidence.seconds.values())
    return state, joined([evidence, Evidence(seconds={"condition": rest})])


@dataclass(frozen=True)
class Simulations:
    """Training and test data of a round's network."""

    fitted: tuple[Array, Array, int]  # thetas, features, valid rows
    held: tuple[Array, Array]  # fresh pairs that no training sees
    again: inference.Again | None  # further draws of the measurement noise; kept ones of earlier rounds have none


def simulate(loop: Loop, state: LoopState, policy: Policy) -> tuple[LoopState, Simulations, Evidence]:
    """Simulate trajectories of this round and add them to those kept."""
    clock, b, n = time.perf_counter(), loop.settings, loop.settings.trainTrajs
    # one program for what is fitted and what tests the fit
    thetas, x, more = simulated(
        loop.source,  # type: ignore[arg-type]
        loop.key(int(state.round), "simulate"),
        policy,
        proposal_of(loop, state),
        b.proposal,
        n + b.checkTrajs,
        functools.partial(ranges.completed, loop, state),
        noise_draws(loop),
    )
    held, thetas, x, more = (thetas[n:], x[n:]), thetas[:n], x[:n], more[:n]
    state, row, count = ranges.room(loop, state)
    if loop.sequential:
        assert state.proposals is not None and state.proposal is not None
        slot = slot_of(loop, state, int(state.round) + 1)
        state = dataclasses.replace(state, proposals=rounds.stored(state.proposals, slot, state.proposal))
    if loop.capacity:
        thetas = jax.lax.dynamic_update_slice(state.thetas, thetas, (row, 0))
        x = jax.lax.dynamic_update_slice(state.features, x, (row, 0))
        state, thetas, x = ranges.mixed(loop, state, thetas, x)
        state = dataclasses.replace(state, thetas=thetas, features=x)
        found = Simulations((thetas, x, count), held, _again(more, row, len(thetas)))
    else:
        found = Simulations((thetas, x, n), held, _again(more, 0, n))
    jax.block_until_ready(found.fitted)
    return state, found, Evidence(seconds={"simulate": time.perf_counter() - clock})


def _again(more: Array, first: int, rows: int) -> inference.Again | None:
    """Further draws of the noise of as many rows as there are in `more`, from `first` on."""
    if not more.shape[1]:
        return None
    place = np.arange(rows, dtype=np.int32) - first
    return inference.Again(more, jnp.asarray(np.where((place >= 0) & (place < len(more)), place, -1)))


def observe(loop: Loop, state: LoopState, policy: Policy) -> tuple[LoopState, Trajectory]:
    """Add this round's real trajectories to those of the rounds before."""
    round_, count = int(state.round), loop.settings.realTrajs
    assert loop.source is not None
    features, real = loop.source.real(loop.key(round_, "real"), round_ * count, count, policy)
    features = jax.lax.dynamic_update_slice(state.real_features, features, (round_ * count, 0))
    return refining.stored(loop, dataclasses.replace(state, real_features=features), real), real


def learn(loop: Loop, state: LoopState, simulations: Simulations) -> tuple[LoopState, Learnt, Evidence]:
    """Train the network and check it; train a new one where the network of the last round has lost its range."""
    b, known_before = loop.settings, np.asarray(state.fit.identified)
    state, fit, trained = train(loop, state, simulations)
    verdict, checked = check(loop, state, simulations)
    found = [trained, checked]
    goes_on = b.checkTrajs and b.ftune and int(state.round)
    if goes_on and standing.lost(verdict and verdict[0], simulations.held[1]):
        warning = "the network of the last round lost its range under this round's policy: fitted anew"
        state, fit, trained = train(loop, state, simulations, anew=True)
        verdict, checked = check(loop, state, simulations)
        found += [Evidence(warnings=[warning]), trained, checked]
    widening = b.temperature or (verdict[0].temperature if verdict is not None else None) or 1.0
    state = dataclasses.replace(state, temperature=jnp.float32(widening))
    return state, Learnt(fit, known_before, verdict), joined(found)


def train(
    loop: Loop, state: LoopState, simulations: Simulations, anew: bool = False
) -> tuple[LoopState, dict[str, Any], Evidence]:
    """Train the network so far or a new one; anew: a new one in any case."""
    clock, b, round_, (thetas, x, count) = time.perf_counter(), loop.settings, int(state.round), simulations.fitted
    keeps = (b.ftune or round_ == 0) and not ranges.has_moved(state) and not anew
    network = state.fit if keeps else new_network(loop, round_, space_of(loop, state))
    correction: dict[str, Any] = {"again": simulations.again}
    if b.proposal == "apt":
        correction |= {"proposals": state.proposals, "origin": np.arange(len(thetas), dtype=np.int32) // b.trainTrajs}
    network, told = inference.fit(loop.key(round_, "fit"), network, thetas, x, jnp.int32(count), **correction)
    fit = {name: np.asarray(value) for name, value in dataclasses.asdict(told).items()}
    evidence = Evidence({"fit": fit}, seconds={"fit": time.perf_counter() - clock})
    return dataclasses.replace(state, fit=network), fit, evidence


def check(
    loop: Loop, state: LoopState, simulations: Simulations
) -> tuple[tuple[calibration.Report, misspecification.Misfit] | None, Evidence]:
    """Test calibration and misfit; None where tests are switched off or too few fresh simulations are usable."""
    clock, b, round_ = time.perf_counter(), loop.settings, int(state.round)
    if not b.checkTrajs:
        return None, Evidence()
    assert loop.source is not None
    known = slice(round_ * b.realTrajs if loop.source.policy_dependent else 0, (round_ + 1) * b.realTrajs)
    # the fresh pairs that test a network were drawn from the same proposal as its round's simulations
    tilt = state.proposals and at(state.proposals, slot_of(loop, state, round_ + 1)) if b.proposal == "apt" else None
    key, verdict, warnings = branch(loop.key(round_, "fit"), 2), None, []
    try:
        verdict = checks.examine(
            key, state.fit, simulations.fitted, simulations.held, state.real_features, known,
            temperature=b.temperature, tilt=tilt, names=loop.feature_names,
        )  # fmt: skip
    except UserError as error:
        warnings.append(str(error))
    return verdict, Evidence(warnings=warnings, seconds={"check": time.perf_counter() - clock})


def condition(loop: Loop, state: LoopState) -> tuple[LoopState, Answer, Evidence]:
    """Multiply the posteriors of all real trajectories so far."""
    factors, warnings = _factors(loop, state)
    state = dataclasses.replace(state, real_posteriors=factors)
    product, lost = multiplied(loop, state, (int(state.round) + 1) * loop.settings.realTrajs)
    if lost:
        warnings.append(f"{lost} real trajectories left out: their posteriors are no densities")
    return state, Answer(product), Evidence(warnings=warnings)


def _factors(loop: Loop, state: LoopState) -> tuple[Distribution, list[str]]:
    """q(theta | x) of every real trajectory, leaves [real trajectories, ...], and warnings about them."""
    b, seen, warnings = loop.settings, int(state.round) * loop.settings.realTrajs, []
    factors = conditioned(state.fit, state.real_features, state.temperature)
    if b.proposal == "division":
        assert state.proposals is not None
        rows = jax.tree.map(np.asarray, factors).split()
        done = seen + b.realTrajs
        quotients, lost = rounds.divided(rows[:done], at(state.proposals, 0))
        factors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *quotients, *rows[done:])
        if lost > LOST:
            warnings.append(f"{percent(lost)} of the posterior's weight cannot be divided by the proposal")
    factors = kept(factors, state.fit.identified, b.priorShare)
    if loop.source.policy_dependent:  # type: ignore[union-attr]
        # an older trajectory was made by an older policy: its posterior stays that of the network of its time
        factors = select(jnp.arange(factors.logits.shape[0]) >= seen, factors, state.real_posteriors)
    return factors, warnings


def blank(loop: Loop) -> dict[str, Any]:
    """The inference's fields of a LoopState before the first round: no data, the prior as domain."""
    b, space, d = loop.settings, loop.space, len(loop.env.space)
    domain = domain_or_prior(space, b.components, loop.chart)
    infers = b.modelClass is not None
    capacity, real_rows = (loop.capacity, b.realIters * b.realTrajs) if infers else (0, 0)
    return {
        "domain": domain,
        "fit": new_network(loop, 0, space) if infers else None,
        "thetas": jnp.zeros((capacity, d)),
        "features": jnp.zeros((capacity, loop.feature_size)),
        "real_features": jnp.zeros((real_rows, loop.feature_size)),
        "real_posteriors": _no_factors(loop, real_rows) if infers else None,
        **_no_proposals(loop),
        "temperature": jnp.float32(1.0),
        "moving": ranges.unmoved(space) if isinstance(space, Ranged) else None,
        "motion": refining.no_motion(loop, real_rows) if infers and loop.refines else None,
        "standing": domain if infers else None,
        "standing_gain": jnp.float32(-jnp.inf) if infers else None,
        "standing_round": jnp.int32(0) if infers else None,
    }


def _no_factors(loop: Loop, rows: int) -> Distribution:
    settings = InferenceSettings.of(loop.settings).at(loop.env.space)
    factor = Distribution.prior(loop.space, settings.components * settings.ensemble, settings.chart)
    return jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape)), factor)


def _no_proposals(loop: Loop) -> dict[str, Any]:
    if not loop.sequential:
        return {"proposal": None, "proposals": None}
    b = loop.settings
    prior = rounds.first(loop.space, b.proposal, b.components, loop.chart)
    return {"proposal": prior, "proposals": rounds.repeated(prior, max(1, loop.capacity // b.trainTrajs))}


def new_network(loop: Loop, round_: int, space: ParameterSpace) -> Any:
    """A fresh FitState for that round, over its ranges."""
    changing = loop.source is not None and loop.source.policy_dependent
    embedding = None if loop.source is None else loop.source.channels.embedding(loop.settings.summarizerFxn)
    settings = InferenceSettings.of(loop.settings, restandardise=changing, embedding=embedding)
    return inference.init(branch(loop.key(round_, "fit"), 1), settings, space, loop.feature_size)
