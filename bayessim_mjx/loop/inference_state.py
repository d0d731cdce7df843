"""The inference's part of a LoopState before the first round."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, rounds
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import ranges, refining
from bayessim_mjx.loop.state import Loop, domain_or_prior
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.ranged import Ranged


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
