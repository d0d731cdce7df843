"""q(theta | x) of single trajectories as they are multiplied."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference.temperature import widened
from bayessim_mjx.loop.state import Loop, LoopState, space_of


@jax.jit
def conditioned(network: Any, features: Array, widening: Array) -> Distribution:
    """Batched posteriors of summaries [n, D], widened."""
    return widened(inference.condition(network, features), widening)


@jax.jit
def kept(factors: Distribution, identified: Array, prior_share: float) -> Distribution:
    """The prior where nothing is identified, and a share of it everywhere."""
    factors = jax.vmap(inference.restore_prior, in_axes=(0, None))(factors, identified)
    return dataclasses.replace(factors, prior_weight=jnp.full_like(factors.prior_weight, prior_share))


def multiplied(loop: Loop, state: LoopState, known: int) -> tuple[Distribution, int]:
    """The product of the factors of the first `known` real trajectories, and how many are no densities: left out."""
    b = loop.settings
    # on the host: an index on the device compiles each time
    rows = jax.tree.map(np.asarray, state.real_posteriors).split()
    usable = [row for row in rows[:known] if row.sound]
    if not usable:
        return Distribution.prior(space_of(loop, state), b.components, loop.chart), known
    return inference.combine(usable, b.components).rechart(loop.chart), known - len(usable)
