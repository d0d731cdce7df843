"""The inference of one round of the outer loop: simulate, observe, learn, condition, correct, describe.

Simulated trajectories over the prior (or over the last posterior, see inference/rounds.py) train a network of
q(theta | summary). Fresh simulations check it. Its posteriors of all real trajectories so far are multiplied. Further
simulations and replays of the real trajectories correct the product.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings, calibration, checks, misspecification, rounds
from bayessim_mjx.inference.calibration import Report
from bayessim_mjx.inference.numbers import FEW, NEGLIGIBLE
from bayessim_mjx.inference.range_ends import Pile
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import examination, likelihood_refinement, ranges, set_posterior
from bayessim_mjx.loop.posterior import condition
from bayessim_mjx.loop.state import UNWATCHED, Answer, Begin, Evidence, Learnt, Loop, LoopState, Round, space_of
from bayessim_mjx.loop.trajectories import Simulations, observe, simulate
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.quantities import percent
from bayessim_mjx.rl import Policy

__all__ = ["CORRECTIONS", "PREDICTIVE_DRAWS", "infer", "new_network", "score"]


# share of fresh simulations on which a network's posterior has to be a density. Ant's networks that went on from an
# older policy's trajectories had .99 of them and more in second rounds (5 runs), .66 to .91 in third ones, whose
# posteriors were lost. source: docs/decisions/keep_or_replace.md
SOUND = 1 - NEGLIGIBLE
PREDICTIVE_DRAWS = FEW  # thetas of the posterior predictive motion
# share of clipped summary entries: no data have more of them beyond so many of their own standard deviations
# (Chebyshev); these are other data than those of the first fit
CLIPPED = InferenceSettings.clip**-2

# of the product of the posteriors, in this order: later ones begin with the answer of those before
CORRECTIONS: tuple[Callable[[Round, Answer], tuple[Answer, Evidence]], ...] = (
    examination.calibrate_product,  # as far as simulated sets require
    examination.keep_or_replace,  # where it promises more
    likelihood_refinement.refine_by_replays,  # the simulator's own likelihood of the real trajectories
    set_posterior.use_set_network,  # one that sees all trajectories together
)


def infer(loop: Loop, state: LoopState, policy: Policy, begin: Begin = UNWATCHED) -> tuple[LoopState, Evidence]:
    """Simulate, learn, condition on all real trajectories and correct; return the next state and the evidence."""
    begun = time.perf_counter()
    begin("simulating trajectories")
    state, simulations, spent = simulate(loop, state, policy)
    state, real = observe(loop, state, policy)
    state, learnt, trained = learn(loop, state, simulations, begin)
    begin("conditioning on real motion")
    state, answer, combined = condition(loop, state)
    round_, found = Round(loop, state, policy, real, learnt, begin), [spent, trained, combined]
    for correct in CORRECTIONS:
        answer, corrected = correct(round_, answer)
        found.append(corrected)
    posterior, moves, moved = ranges.move(loop, state, answer.posterior)
    begin("predicting the real motion")
    described = describe(round_, answer)
    domain, judged = conclude(round_, answer, posterior, moves)
    proposal = rounds.following(posterior, loop.settings.proposal) if loop.sequential else None
    evidence = sum([*found, described, moved, judged], Evidence())
    state = dataclasses.replace(state, **evidence.kept, domain=domain, proposal=proposal)
    rest = time.perf_counter() - begun - sum(evidence.seconds.values())
    return state, evidence + Evidence(seconds={"condition": rest})


def learn(
    loop: Loop, state: LoopState, simulations: Simulations, begin: Begin = UNWATCHED
) -> tuple[LoopState, Learnt, Evidence]:
    """Train the network and check it; train a new one where the network of the last round has lost its range."""
    b, known_before = loop.settings, np.asarray(state.fit.identified)
    begin("fitting the network")
    state, fit, trained = train(loop, state, simulations)
    begin("testing the network")
    verdict, checked = check(loop, state, simulations)
    found = trained + checked
    goes_on = b.checkTrajs and b.ftune and int(state.round)
    if goes_on and lost(verdict and verdict[0], simulations.held[1]):
        warning = "the network of the last round lost its range under this round's policy: fitted anew"
        begin("fitting a new network")
        state, fit, trained = train(loop, state, simulations, anew=True)
        verdict, checked = check(loop, state, simulations)
        found += Evidence(warnings=[warning]) + trained + checked
    widening = b.temperature or (verdict[0].temperature if verdict is not None else None) or 1.0
    state = dataclasses.replace(state, temperature=jnp.float32(widening))
    return state, Learnt(fit, known_before, verdict), found


def lost(report: Report | None, x: Array) -> bool:
    """Whether a network's posteriors of fresh summaries [n, D] are no densities too often; report: None: hardly any is.

    Their components have left the range: a network that goes on over rounds can do that where a new policy moves
    otherwise than those before.
    """
    usable = int(np.isfinite(np.asarray(x)).all(1).sum())
    return (0 if report is None else report.densities) < SOUND * usable


def train(
    loop: Loop, state: LoopState, simulations: Simulations, anew: bool = False
) -> tuple[LoopState, dict[str, Any], Evidence]:
    """Train the network so far or a new one; anew: a new one in any case."""
    clock, b, round_, (thetas, x, count) = time.perf_counter(), loop.settings, int(state.round), simulations.fitted
    keeps = (b.ftune or round_ == 0) and not state.has_moved and not anew
    network = state.fit if keeps else new_network(loop, round_, space_of(loop, state))
    correction: dict[str, Any] = {"again": simulations.again}
    if b.proposal == "apt":
        correction |= {"proposals": state.proposals, "origin": np.arange(len(thetas), dtype=np.int32) // b.trainTrajs}
    network, info = inference.fit(loop.key(round_, "fit"), network, thetas, x, jnp.int32(count), **correction)
    fit = {name: np.asarray(value) for name, value in dataclasses.asdict(info).items()}
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
    tilt = state.proposal if b.proposal == "apt" else None
    key, verdict, warnings = branch(loop.key(round_, "fit"), 2), None, []
    try:
        verdict = checks.examine(
            key, state.fit, simulations.fitted, simulations.held, state.real_features, known,
            temperature=b.temperature, tilt=tilt, names=loop.feature_names,
        )  # fmt: skip
    except UserError as error:
        warnings.append(str(error))
    return verdict, Evidence(warnings=warnings, seconds={"check": time.perf_counter() - clock})


def new_network(loop: Loop, round_: int, space: ParameterSpace) -> Any:
    """Start a fresh FitState for that round, over its ranges."""
    changing = loop.source is not None and loop.source.policy_dependent
    embedding = None if loop.source is None else loop.source.channels.embedding(loop.settings.summarizerFxn)
    settings = InferenceSettings.of(loop.settings, restandardise=changing, embedding=embedding)
    return inference.init(branch(loop.key(round_, "fit"), 1), settings, space, loop.feature_size)


def describe(round_: Round, answer: Answer) -> Evidence:
    """Describe the posterior by scores and predictions, and complain about the fit behind it."""
    loop, learnt, posterior = round_.loop, round_.learnt, answer.posterior
    assert loop.source is not None
    keys = [loop.key(number, "real") for number in range(round_.number + 1)]
    truth = loop.source.truth_of(keys, loop.settings.realTrajs)
    fields = {
        "posterior": posterior,
        "real": jax.tree.map(np.asarray, round_.real),
        "truth": truth,
        "predictive": _predict(round_, posterior),
    }
    fresh = int(round_.state.fit.fits) == 1
    warnings = complaints(posterior.names, learnt.fit, learnt.known_before, answer.source == "replays", fresh)
    return Evidence(fields, score(posterior, truth), warnings)


def conclude(
    round_: Round, answer: Answer, posterior: Distribution, moves: tuple[Pile, ...]
) -> tuple[Distribution, Evidence]:
    """Conclude the checks; return `posterior`, with the share of the prior that misfit asks for."""
    verdict, names = round_.learnt.verdict, answer.posterior.names
    if verdict is None:
        return posterior, Evidence(warnings=[pile.sentence() for pile in moves])
    found = checks.conclude(*verdict, answer.posterior, round_.loop.settings.distrust, moves or None)
    found = dataclasses.replace(found, sets=answer.sets)
    known_already = names if round_.number else _unknown(names, round_.learnt.fit)
    replaced = answer.source in ("replays", "set network")
    return found.guarded(posterior), Evidence({"checks": found}, warnings=found.warnings(known_already, replaced))


def complaints(
    names: tuple[str, ...], fit: dict[str, Any], known_before: np.ndarray, by_replays: bool, fresh: bool
) -> list[str]:
    """List complaints about this round's fit.

    Args:
        names: of the parameters.
        fit: numbers of the fit.
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
        other = "another summary (bayessim.summarizerFxn) or longer trajectories (bayessim.trainTrajLen) may help"
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


def _predict(round_: Round, posterior: Distribution) -> dict[str, np.ndarray] | None:
    """Posterior predictive: the first real trajectory's commands replayed from its first state at posterior draws."""
    loop = round_.loop
    if getattr(loop.env, "physics", None) is None:
        return None
    assert loop.source is not None
    thetas = posterior.sample(loop.key(round_.number, "predict"), PREDICTIVE_DRAWS)
    motion = loop.source.repeated(round_.number * loop.settings.realTrajs, round_.real, thetas)
    return {name: np.asarray(value) for name, value in motion.items()}
