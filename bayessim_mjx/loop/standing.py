"""Which posterior stands after a round, and whether the network may go on: by what fresh simulations say of both.

A posterior of more trajectories tells more only if the network that made it can carry them. Both rules look at
simulations alone, never at the real trajectories, so a posterior that is chosen by them covers as often as it did.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference.calibration import Report
from bayessim_mjx.inference.product_calibration import Sets
from bayessim_mjx.loop.state import Answer, Evidence, LoopState, Round
from bayessim_mjx.quantities import fixed

# of fresh simulations, on which the posterior has to be a density. Ant's networks that went on from an older policy's
# trajectories had .99 of them and more in second rounds (5 runs), .66 to .91 in third ones, whose posteriors were lost
SOUND = 0.95


def lost(report: Report | None, x: Array) -> bool:
    """Whether a network's posteriors of fresh summaries [n, D] are no densities too often; report: None: hardly any is.

    Their components have left the range: a network that goes on over rounds can do that where a new policy moves
    otherwise than those before.
    """
    usable = int(np.isfinite(np.asarray(x)).all(1).sum())
    return (0 if report is None else report.pairs) < SOUND * usable


def expected(report: Report | None, found: Sets | None, known: int) -> float:
    """Nats over the prior that a posterior of `known` trajectories gains on simulated ones; -inf: none is a density."""
    gain = report.gain if report is not None and known == 1 else found.at(known).gain if found is not None else -np.inf
    return float(gain) if np.isfinite(gain) else -np.inf


def keep_last(round_: Round, answer: Answer) -> tuple[Answer, Evidence]:
    """Keep the last round's posterior where it gained more on simulated trajectories."""
    b, state, verdict = round_.loop.settings, round_.state, round_.learnt.verdict
    if verdict is None or b.temperature or round_.loop.sequential:  # no gain is judged, or rounds cannot be compared
        return answer, Evidence()
    gain = expected(verdict[0], answer.sets, round_.known)
    last, before = state.standing, -np.inf if state.standing_gain is None else float(state.standing_gain)
    if last is not None and gain < before and not _moved(last, answer.posterior):
        told = f"{fixed(gain, 1)} nats" if np.isfinite(gain) else "nothing"
        warning = (
            f"this round's posterior gains {told} on simulated trajectories, that of the last round {fixed(before, 1)} "
            "nats: the last one stands"
        )
        stands = dataclasses.replace(answer, posterior=last, source="last round")
        return stands, Evidence(scores={"sets/stood": 1.0}, warnings=[warning])
    if not np.isfinite(gain):
        return answer, Evidence()
    own = jnp.asarray(state.round, jnp.int32) + 1
    kept = {"standing": answer.posterior, "standing_gain": jnp.float32(gain), "standing_round": own}
    return answer, Evidence(kept=kept)


def told(state: LoopState) -> str:
    """What is to be said of a finished round whose posterior is an earlier one's; "" where it is its own."""
    stands, done = int(state.standing_round or 0), int(state.round)
    if stands in (0, done):
        return ""
    return f"the posterior in use is that of round {stands}: simulated trajectories promise less of round {done}'s"


def _moved(last: Distribution, posterior: Distribution) -> bool:
    """Whether their ranges differ, so that their gains cannot be compared."""
    ends = ((np.asarray(d.space.low), np.asarray(d.space.high)) for d in (last, posterior))
    return not all(np.array_equal(a, b) for a, b in zip(*ends, strict=True))


__all__ = ["expected", "keep_last", "lost", "told"]
