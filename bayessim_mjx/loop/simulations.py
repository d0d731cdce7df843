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
from bayessim_mjx.loop.state import Loop, LoopState
from bayessim_mjx.rl import Policy

CHUNK = 2500  # trajectories simulated at once while collecting


def simulated(
    source: Source, key: Array, policy: Policy, proposal: Distribution, method: str, count: int
) -> tuple[Array, Array]:
    """`count` simulated trajectories: theta [count, d], features [count, D], in chunks that fit the memory."""
    chunks = -(-count // CHUNK)
    k_theta, k_roll = jax.random.split(key)
    thetas = rounds.draw(k_theta, proposal, method, -(-count // chunks) * chunks)
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
    return Distribution.prior(loop.env.space, loop.settings.components) if state.proposal is None else state.proposal


def at(batch: Distribution, row: int) -> Distribution:
    """One of batched distributions."""
    return jax.tree.map(lambda leaf: leaf[row], batch)
