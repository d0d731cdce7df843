"""The checks of a finished round done again, as the command `calibrate` asks for."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from bayessim_mjx.inference import checks
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import ranges, set_checks
from bayessim_mjx.loop.simulations import at, proposal_of, simulated
from bayessim_mjx.loop.state import Loop, LoopState, slot_of
from bayessim_mjx.rl import Policy

PAIRS, MOST = 500, 4  # sets are judged in as many lots as there are such parts of the pairs, up to this
REFERENCE = 10000  # simulations that `reexamine` compares real trajectories with, at most


def reexamine(loop: Loop, state: LoopState, policy: Policy, pairs: int, seed: int = 0) -> checks.Checks:
    """The checks of a round done again, on `pairs` fresh simulations and with a posterior predictive check.

    `state` is that after the round and `policy` the one that it was evaluated with, as in its checkpoint. The posterior
    is tested as the round used it: with its temperature, on parameters from what the round was simulated from. So are
    products of as many trajectories as it had, with the round's widening; where `bayessim.refine` refined it, they are
    what was refined.
    """
    b, source, done = loop.settings, loop.source, int(state.round)
    domain = state.domain
    assert source is not None and domain is not None
    key = branch(branch(jax.random.PRNGKey(seed), 0xCA11), done)  # seen by no fit
    known = min(b.trainTrajs, REFERENCE)
    used = None if state.proposals is None else at(state.proposals, slot_of(loop, state, done))
    state, temperature = ranges.as_fitted(dataclasses.replace(state, proposal=used)), float(state.temperature)
    thetas, x, _ = simulated(source, branch(key, 1), policy, proposal_of(loop, state), b.proposal, known + pairs)
    held = thetas[known:], x[known:]
    rows = slice((done - 1) * b.realTrajs if source.policy_dependent else 0, done * b.realTrajs)
    judged: dict[str, Any] = {"temperature": temperature, "tilt": used if b.proposal == "apt" else None}
    verdict = checks.examine(
        key, state.fit, (thetas[:known], x[:known], known), held, state.real_features, rows,
        names=loop.feature_names, **judged,
    )  # fmt: skip
    again = checks.replicated(branch(key, 2), state.fit, held[1], lambda k, t: source.simulate(k, t, policy), **judged)
    report = dataclasses.replace(verdict[0], predictive=again)
    before = dataclasses.replace(state, round=state.round - 1)
    more = min(max(pairs // PAIRS, 1), MOST)
    sets = set_checks.rejudge(loop, before, policy, done * b.realTrajs, branch(key, 3), more)
    return dataclasses.replace(checks.conclude(report, verdict[1], domain, b.distrust), sets=sets)
