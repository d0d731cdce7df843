"""Simulated trajectories for the fit and its tests."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from bayessim_mjx.compat import program
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import rounds
from bayessim_mjx.loop.sources import Source
from bayessim_mjx.loop.state import Loop, LoopState, space_of
from bayessim_mjx.physics.warp import refuse_overflow
from bayessim_mjx.rl import Policy

CHUNK = 2500  # trajectories simulated at once while collecting
ROOM = 2**27  # bytes that draws of measurement noise may fill


def simulated(
    source: Source,
    key: Array,
    policy: Policy,
    proposal: Distribution,
    method: str,
    count: int,
    chosen: Callable[[Array], Array] = lambda thetas: thetas,
    draws: int = 1,
) -> tuple[Array, Array, Array]:
    """`count` simulated trajectories: theta [count, d], features [count, D], in chunks that fit the memory.

    Third come the features [count, draws - 1, D] of the same trajectories with other draws of the measurement noise.

    Args:
        source: what simulates.
        key: consumed.
        policy: that acts.
        proposal, method: what theta is drawn from, see `rounds.draw`.
        count: how many.
        chosen: the thetas that are simulated in the place of those drawn, as many.
        draws: how often each trajectory is measured.

    Raises:
        UserError: contacts had no room (`physics.warp`).
    """
    chunks = -(-count // CHUNK)
    k_theta, k_roll = jax.random.split(key)
    thetas = rounds.draw(k_theta, proposal, method, -(-count // chunks) * chunks)
    thetas = chosen(thetas)
    x, again = _features(source, draws)(k_roll, thetas.reshape(chunks, -1, thetas.shape[-1]), policy)
    _refuse_overflow(source, x, chunks)
    return thetas[:count], x[:count], again[:count]


def features(source: Source, key: Array, thetas: Array, policy: Policy) -> Array:
    """Features [chunks * n, D] of trajectories at thetas [chunks, n, d]."""
    x = _features(source, 1)(key, thetas, policy)[0]
    _refuse_overflow(source, x, len(thetas))
    return x


def _refuse_overflow(source: Source, x: Array, chunks: int) -> None:
    """UserError where all trajectories of a chunk [chunks * n, D] are lost: Warp's contacts had no room."""
    if getattr(getattr(source.env, "physics", None), "warp", None) is not None:
        lost = jnp.isnan(x).any(-1).reshape(chunks, -1).all(-1)
        refuse_overflow(lost.mean(), f"the trajectories, simulated {len(x) // chunks} at once")


def noise_draws(loop: Loop) -> int:
    """How often each simulated trajectory is measured: as often as asked for and as there is room for."""
    b, source = loop.settings, loop.source
    if source is None or not source.noisy or loop.moves:  # simulations kept lose their order where ranges move
        return 1
    return max(1, min(b.noiseDraws, ROOM // (4 * (b.trainTrajs + b.checkTrajs) * max(1, loop.feature_size))))


@functools.lru_cache(maxsize=32)
def _features(source: Source, draws: int) -> Callable[[Array, Array, Policy], tuple[Array, Array]]:
    def measured(at: tuple[Array, Array], policy: Policy) -> Array:
        return source.simulate(*at, policy)[:, None] if draws == 1 else source.measured(*at, policy, draws)

    def run(key: Array, thetas: Array, policy: Policy) -> tuple[Array, Array]:
        keys = jax.random.split(key, thetas.shape[0])
        features = jax.lax.map(lambda at: measured(at, policy), (keys, thetas))
        features = features.reshape(-1, *features.shape[-2:])
        return features[:, 0], features[:, 1:]

    return program(run, source.env)


def proposal_of(loop: Loop, state: LoopState) -> Distribution:
    """What this round is simulated from."""
    if state.proposal is not None:
        return state.proposal
    return Distribution.prior(space_of(loop, state), loop.settings.components)


def at(batch: Distribution, row: int) -> Distribution:
    """One of batched distributions."""
    return jax.tree.map(lambda leaf: leaf[row], batch)
