"""Examination of a round's posteriors by further simulations.

Simulated sets of as many trajectories show whether a product of posteriors is too narrow or off. The product is moved
and widened by that. It replaces the last round's posterior only if it gains as much on simulated trajectories. No rule
uses the real trajectories, so the chosen posterior covers as often as before. The command `calibrate` repeats all
checks of a finished round.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import checks, local_recalibration, product_calibration, rounds
from bayessim_mjx.inference.calibration import Report
from bayessim_mjx.inference.numbers import DRAWS, FEW
from bayessim_mjx.inference.product_calibration import Sets
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import ranges
from bayessim_mjx.loop.posterior import conditioned, kept, multiplied
from bayessim_mjx.loop.state import Answer, Evidence, Loop, LoopState, Round, Situation, slot_of
from bayessim_mjx.loop.trajectories import at, features, proposal_of, simulated
from bayessim_mjx.quantities import fixed
from bayessim_mjx.rl import Policy

# simulated sets of trajectories that judge a posterior: too few for a widening of less than one step of
# product_calibration.FACTORS (docs/inference.md, several trajectories)
SETS = FEW
# trajectories in one set, at most: beyond that the error that all of them share is taken to stay (`Sets.widening`)
MOST = FEW


def calibrate_product(round_: Round, answer: Answer) -> tuple[Answer, Evidence]:
    """Move and widen the product as simulated sets of as many trajectories require."""
    if round_.loop.settings.temperature:
        return answer, Evidence()
    clock, known = time.perf_counter(), round_.known
    if known > 1:  # of one trajectory there is no product to judge
        round_.begin("testing products")
    found = recalibrated(round_, answer.posterior, judge(round_))
    if found is None:
        return answer, Evidence()
    seconds = {"check": time.perf_counter() - clock}
    used = replace(answer, posterior=found.used(answer.posterior, known), sets=found)
    return used, Evidence({"sets": found}, scores(found, known), seconds=seconds)


def judge(now: Situation) -> Sets | None:
    """Judge products of 1, 2, 4 ... posteriors on fresh sets, as the round multiplies them.

    None where there is nothing to judge: a single trajectory, tests switched off, or a division by the proposal, which
    takes the real posteriors alone.
    """
    b = now.loop.settings
    found = _simulated(now, branch(now.loop.key(now.number, "fit"), 4)) if b.checkTrajs else None
    return None if found is None else replace(product_calibration.judge(*found, b.components), known=now.known)


def recalibrated(now: Situation, product: Distribution, found: Sets | None) -> Sets | None:
    """Add to `judge`'s answer the results of sets at draws of the posterior of the real trajectories."""
    if found is None or float(product.prior_weight) >= rounds.REGION:  # else they are those of the prior
        return found
    key = branch(now.loop.key(now.number, "fit"), 6)

    def drawn(posterior: Distribution, turn: int) -> tuple[list[list[Distribution]], np.ndarray] | None:
        return _simulated(now, branch(key, turn), posterior)

    return local_recalibration.recalibrated(found, product, drawn, now.loop.settings.components)


def _simulated(
    now: Situation, key: Array, around: Distribution | None = None
) -> tuple[list[list[Distribution]], np.ndarray] | None:
    """Simulate sets of factors and the thetas [m, d] that they were simulated at; None where hardly any is a density.

    around: what thetas are drawn from; None: what the round is simulated from.
    """
    loop, state, known = now.loop, now.state, now.known
    b, source = loop.settings, loop.source
    if known < 2 or b.proposal == "division" or source is None:
        return None
    k_theta, *keys = jax.random.split(key, 1 + min(known, MOST))
    thetas = (
        around.sample(k_theta, SETS)
        if around is not None
        else rounds.draw(k_theta, proposal_of(loop, state), b.proposal, SETS)
    )
    columns = []
    for k in keys:  # the same program for any number of trajectories
        x = features(source, k, thetas[None], now.policy)
        factors = kept(conditioned(state.fit, x, state.temperature), state.fit.identified, b.priorShare)
        columns.append(jax.tree.map(np.asarray, factors).split())
    rows = [[column[i] for column in columns] for i in range(SETS)]
    good = [i for i, row in enumerate(rows) if all(q.sound for q in row)]
    if len(good) < SETS // 2:
        return None
    return [rows[i] for i in good], np.asarray(thetas)[good]


def scores(found: Sets, known: int) -> dict[str, float]:
    """Numbers for curves, of the posterior of `known` trajectories."""
    one = found.at(known)
    numbers = {"widening": found.widening(known), "gain": one.gain, "carried": float(found.saturates_at)}
    numbers |= {"moved": float(found.move is not None)}
    numbers |= {f"coverage_{100 * level:.0f}": one.coverage(level) for level in product_calibration.LEVELS}
    return {f"sets/{name}": float(value) for name, value in numbers.items()}


def keep_or_replace(round_: Round, answer: Answer) -> tuple[Answer, Evidence]:
    """Keep the last round's posterior where it gained more on simulated trajectories."""
    b, state, verdict = round_.loop.settings, round_.state, round_.learnt.verdict
    if verdict is None or b.temperature or round_.loop.sequential:  # no gain is judged, or rounds cannot be compared
        return answer, Evidence()
    gain = expected(verdict[0], answer.sets, round_.known)
    last, before = state.standing, -np.inf if state.standing_gain is None else float(state.standing_gain)
    if last is not None and gain < before and not _moved(last, answer.posterior):
        gained = f"{fixed(gain, 1)} nats" if np.isfinite(gain) else "nothing"
        warning = (
            f"the network's posterior of this round gains {gained} on simulated trajectories, that of the last round "
            f"{fixed(before, 1)} nats: the last one stands"
        )
        stands = dataclasses.replace(answer, posterior=last, source="last round")
        return stands, Evidence(scores={"sets/stood": 1.0}, warnings=[warning])
    if not np.isfinite(gain):
        return answer, Evidence()
    own = jnp.asarray(state.round, jnp.int32) + 1
    kept = {"standing": answer.posterior, "standing_gain": jnp.float32(gain), "standing_round": own}
    return answer, Evidence(kept=kept)


def expected(report: Report | None, found: Sets | None, known: int) -> float:
    """Nats over the prior that a posterior of `known` trajectories gains on simulated ones; -inf: none is a density."""
    gain = report.gain if report is not None and known == 1 else found.at(known).gain if found is not None else -np.inf
    return float(gain) if np.isfinite(gain) else -np.inf


def _moved(last: Distribution, posterior: Distribution) -> bool:
    """Whether their ranges differ, so that their gains cannot be compared."""
    ends = ((np.asarray(d.space.low), np.asarray(d.space.high)) for d in (last, posterior))
    return not all(np.array_equal(a, b) for a, b in zip(*ends, strict=True))


def reused_posterior(state: LoopState) -> str:
    """Write a sentence on a finished round that uses an earlier posterior; "" where it uses its own."""
    stands, done = int(state.standing_round or 0), int(state.round)
    if stands in (0, done):
        return ""
    return f"the posterior in use is that of round {stands}: simulated trajectories promise less of round {done}'s"


def reexamine(loop: Loop, state: LoopState, policy: Policy, pairs: int, seed: int = 0) -> checks.Checks:
    """Repeat the checks of a round on `pairs` fresh simulations and with a posterior predictive check.

    `state` is that after the round and `policy` the one that it was evaluated with, as in its checkpoint. The posterior
    is tested as the round used it: with its temperature, on parameters from what the round was simulated from. So are
    products of as many trajectories as it had, with the round's widening; where `bayessim.refine` refined it, they are
    what was refined.
    """
    b, source, done = loop.settings, loop.source, int(state.round)
    domain = state.domain
    assert source is not None and domain is not None
    key = branch(branch(jax.random.PRNGKey(seed), 0xCA11), done)  # seen by no fit
    known = min(b.trainTrajs, DRAWS)
    used = None if state.proposals is None else at(state.proposals, slot_of(loop, state, done))
    state, temperature = ranges.as_fitted(replace(state, proposal=used)), float(state.temperature)
    proposal = proposal_of(loop, state)
    drawn = lambda key, n: rounds.draw(key, proposal, b.proposal, n)  # noqa: E731
    thetas, x, _ = simulated(source, branch(key, 1), policy, drawn, known + pairs)
    held = thetas[known:], x[known:]
    rows = slice((done - 1) * b.realTrajs if source.policy_dependent else 0, done * b.realTrajs)
    judged: dict[str, Any] = {"temperature": temperature, "tilt": used if b.proposal == "apt" else None}
    verdict = checks.examine(
        key, state.fit, (thetas[:known], x[:known], known), held, state.real_features, rows,
        names=loop.feature_names, **judged,
    )  # fmt: skip
    again = checks.replicated(branch(key, 2), state.fit, held[1], lambda k, t: source.simulate(k, t, policy), **judged)
    report = replace(verdict[0], predictive=again)
    now = Situation(loop, replace(state, round=state.round - 1), policy)
    lots = max(1, pairs // (SETS * min(now.known, MOST)))  # sets of as many trajectories as there are pairs
    sets = rejudge(now, branch(key, 3), lots)
    return replace(checks.conclude(report, verdict[1], domain, b.distrust), sets=sets)


def rejudge(now: Situation, key: Array, more: int = 1) -> Sets | None:
    """Judge products as the round used them, widened and moved, on `more` times as many sets, unseen by it."""
    b, known = now.loop.settings, now.known
    product, used, k = multiplied(now.loop, now.state, known)[0], None, b.components
    if not b.temperature:
        used = recalibrated(now, product, judge(now))

    def again(first: int, around: Distribution | None) -> tuple[list[list[Distribution]], np.ndarray] | None:
        lots = [_simulated(now, branch(key, first + i), around) for i in range(more)]
        good = [lot for lot in lots if lot is not None]
        return ([row for lot in good for row in lot[0]], np.concatenate([lot[1] for lot in good])) if good else None

    if (found := again(0, None)) is None:
        return None
    judged = product_calibration.judge(*found, k, widened_by=(lambda n: 1.0) if used is None else used.widening)
    if used is None or not used.near or (found := again(more, used.used(product, known))) is None:
        return judged
    row = local_recalibration.count(*found, k, used.move, used.widening(used.counts[-1].trajectories))
    return replace(judged, near=(row,), move=used.move)


__all__ = [
    "calibrate_product", "expected", "judge", "keep_or_replace", "reexamine", "rejudge", "reused_posterior", "scores",
    "recalibrated",
]  # fmt: skip
