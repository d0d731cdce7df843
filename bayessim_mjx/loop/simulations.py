"""Simulated trajectories for the fit and its tests."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
from jax import Array

from bayessim_mjx.compat import program
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import rounds
from bayessim_mjx.loop.sources import Source
from bayessim_mjx.loop.state import Loop, LoopState, space_of
from bayessim_mjx.rl import Policy

CHUNK = 2500  # trajectories simulated at once while collecting


def simulated(
    source: Source,
    key: Array,
    policy: Policy,
    proposal: Distribution,
    method: str,
    count: int,
    chosen: Callable[[Array], Array] = lambda thetas: thetas,
) -> tuple[Array, Array]:
    """`count` simulated trajectories: theta [count, d], features [count, D], in chunks that fit the memory.

    Args:
        source: what simulates.
        key: consumed.
        policy: that acts.
        proposal, method: what theta is drawn from, see `rounds.draw`.
        count: how many.
        chosen: the thetas that are simulated in the place of those drawn, as many.
    """
    chunks = -(-count // CHUNK)
    k_theta, k_roll = jax.random.split(key)
    thetas = rounds.draw(k_theta, proposal, method, -(-count // chunks) * chunks)
    thetas = chosen(thetas)
    x = features(source, k_roll, thetas.reshape(chunks, -1, thetas.shape[-1]), policy)
    return thetas[:count], x[:count]


def features(source: Source, key: Array, thetas: Array, policy: Policy) -> Array:
    """Features [chunks * n, D] of trajectories at thetas [chunks, n, d]."""
    return _features(source)(key, thetas, policy)


@functools.lru_cache(maxsize=32)
def _features(source: Source) -> Callable[[Array, Array, Policy], Array]:
    def run(key: Array, thetas: Array, policy: Policy) -> Array:
        keys = jax.random.split(key, thetas.shape[0])
        features = jax.lax.map(lambda at: source.simulate(at[0], at[1], policy), (keys, thetas))
        return features.reshape(-1, features.shape[-1])

    return program(run, source.env)


def proposal_of(loop: Loop, state: LoopState) -> Distribution:
    """What this round is simulated from."""
    if state.proposal is not None:
        return state.proposal
    return Distribution.prior(space_of(loop, state), loop.settings.components)


def at(batch: Distribution, row: int) -> Distribution:
    """One of batched distributions."""
    return jax.tree.map(lambda leaf: leaf[row], batch)
