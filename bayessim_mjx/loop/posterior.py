"""The posterior of all real trajectories: posteriors of single ones, their product, and the stored one of a run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.config import Config
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env
from bayessim_mjx.inference.numbers import FEW, NEGLIGIBLE
from bayessim_mjx.inference.rounds import REGION
from bayessim_mjx.inference.temperature import widened
from bayessim_mjx.loop.state import Answer, Evidence, Loop, LoopState, chart_of, space_of
from bayessim_mjx.loop.trajectories import at
from bayessim_mjx.parameters.ranged import Ranged
from bayessim_mjx.quantities import percent
from bayessim_mjx.rollout import select
from bayessim_mjx.runs import checkpoints


def condition(loop: Loop, state: LoopState) -> tuple[LoopState, Answer, Evidence]:
    """Multiply the posteriors of all real trajectories so far."""
    factors, warnings = _factors(loop, state)
    state = dataclasses.replace(state, real_posteriors=factors)
    product, lost = multiplied(loop, state, (int(state.round) + 1) * loop.settings.realTrajs)
    if lost:
        warnings.append(f"{lost} real trajectories left out: their posteriors are no densities")
    return state, Answer(product), Evidence(warnings=warnings)


def _factors(loop: Loop, state: LoopState) -> tuple[Distribution, list[str]]:
    """Condition on every real trajectory: q(theta | x), leaves [real trajectories, ...], and warnings."""
    b, seen, warnings = loop.settings, int(state.round) * loop.settings.realTrajs, []
    count = len(state.real_features)
    # as many rows as the sets that judge the product: one program for both
    padded = np.zeros((max(FEW, count), loop.feature_size), np.float32)
    padded[:count] = state.real_features
    factors = conditioned(state.fit, padded, state.temperature)
    if b.proposal == "division":
        assert state.proposals is not None
        rows = jax.tree.map(np.asarray, factors).split()
        done = seen + b.realTrajs
        if float(state.proposals.prior_weight[0]) < REGION:  # else it is the prior itself
            quotients, lost = zip(*(row.divide(at(state.proposals, 0)) for row in rows[:done]), strict=True)
            factors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *quotients, *rows[done:])
            if (share := float(np.mean(lost))) > NEGLIGIBLE:
                warnings.append(f"{percent(share)} of the posterior's weight cannot be divided by the proposal")
    factors = kept(factors, state.fit.identified, b.priorShare)
    factors = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[:count]), factors)
    if loop.source.policy_dependent:  # type: ignore[union-attr]
        # an older trajectory was made by an older policy: its posterior stays that of the network of its time
        factors = select(jnp.arange(factors.logits.shape[0]) >= seen, factors, state.real_posteriors)
    return factors, warnings


@jax.jit
def conditioned(network: Any, features: Array, widening: Array) -> Distribution:
    """Batched posteriors of summaries [n, D], widened."""
    return widened(inference.condition(network, features), widening)


@jax.jit
def kept(factors: Distribution, identified: Array, prior_share: float) -> Distribution:
    """Put the prior where nothing is identified, and a share of it everywhere."""
    factors = jax.vmap(inference.restore_prior, in_axes=(0, None))(factors, identified)
    return dataclasses.replace(factors, prior_weight=jnp.full_like(factors.prior_weight, prior_share))


def multiplied(loop: Loop, state: LoopState, known: int) -> tuple[Distribution, int]:
    """Multiply the factors of the first `known` real trajectories; return how many are no densities too: left out."""
    b = loop.settings
    # on the host: an index on the device compiles each time
    rows = jax.tree.map(np.asarray, state.real_posteriors).split()
    usable = [row for row in rows[:known] if row.sound]
    if not usable:
        return Distribution.prior(space_of(loop, state), b.components, loop.chart), known
    return inference.combine(usable, b.components).rechart(loop.chart), known - len(usable)


def restored(checkpoint: Path, env: Env, config: Config) -> Distribution | None:
    """Restore the domain of a checkpoint, to draw physics from it; None where the loop did not write it.

    Args:
        checkpoint: its folder.
        env: the run's environment, or one with the same parameters.
        config: the run's settings.
    """
    if not checkpoints.has(checkpoint, "state.domain"):
        return None
    own = checkpoints.chart(checkpoint, "state.domain") or chart_of(config.bayessim, env.space)
    moves = checkpoints.has(checkpoint, "state.domain.space")
    like = Distribution.prior(Ranged(env.space) if moves else env.space, config.bayessim.components, own)
    return checkpoints.restore(checkpoint, {"state.domain": like})[0]["state.domain"]
