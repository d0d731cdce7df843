"""Trajectories of a round: simulated ones for the fit and its tests, real ones, and the motion that replays need."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.compat import program
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import rounds
from bayessim_mjx.inference.numbers import DRAWS
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import ranges
from bayessim_mjx.loop.recorded import Recorded
from bayessim_mjx.loop.sources import Source
from bayessim_mjx.loop.state import Evidence, Loop, LoopState, space_of
from bayessim_mjx.physics.tangent import noisy
from bayessim_mjx.physics.warp import refuse_overflow
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory

ROOM = 2**27  # bytes that draws of measurement noise may fill


@dataclass(frozen=True)
class Simulations:
    """Training and test data of a round's network."""

    fitted: tuple[Array, Array, int]  # thetas, features, valid rows
    held: tuple[Array, Array]  # fresh pairs that no training sees
    again: inference.Again | None  # further draws of the measurement noise; kept ones of earlier rounds have none


def simulate(loop: Loop, state: LoopState, policy: Policy) -> tuple[LoopState, Simulations, Evidence]:
    """Simulate trajectories of this round and add them to those kept."""
    clock, b, n = time.perf_counter(), loop.settings, loop.settings.trainTrajs
    assert loop.source is not None
    draws, proposal, before = noise_draws(loop), proposal_of(loop, state), state

    def drawn(key: Array, count: int) -> Array:
        return ranges.completed(loop, before, rounds.draw(key, proposal, b.proposal, count))

    # one program for what is fitted and what tests the fit
    key = loop.key(int(state.round), "simulate")
    thetas, x, more = simulated(loop.source, key, policy, drawn, n + b.checkTrajs, draws)
    held, thetas, x, more, count = (thetas[n:], x[n:]), thetas[:n], x[:n], more[:n], n
    state, row, kept = ranges.room(loop, state)
    if loop.capacity:
        thetas = jax.lax.dynamic_update_slice(state.thetas, thetas, (row, 0))
        x = jax.lax.dynamic_update_slice(state.features, x, (row, 0))
        state, thetas, x = ranges.mixed(loop, state, thetas, x)
        state, count = dataclasses.replace(state, thetas=thetas, features=x), kept
    if loop.sequential:
        assert state.proposals is not None and state.proposal is not None
        state = dataclasses.replace(state, proposals=rounds.stored(state.proposals, row // n, state.proposal))
    again = None
    if more.shape[1]:  # the rows of this round are measured more than once
        place = np.arange(len(thetas), dtype=np.int32) - row
        again = inference.Again(more, jnp.asarray(np.where((place >= 0) & (place < len(more)), place, -1)))
    found = Simulations((thetas, x, count), held, again)
    jax.block_until_ready(found.fitted)
    return state, found, Evidence(seconds={"simulate": time.perf_counter() - clock})


def observe(loop: Loop, state: LoopState, policy: Policy) -> tuple[LoopState, Trajectory]:
    """Add this round's real trajectories to those of the rounds before."""
    round_, count = int(state.round), loop.settings.realTrajs
    assert loop.source is not None
    features, real = loop.source.real(loop.key(round_, "real"), round_ * count, count, policy)
    features = jax.lax.dynamic_update_slice(state.real_features, features, (round_ * count, 0))
    return stored(loop, dataclasses.replace(state, real_features=features), real), real


def simulated(
    source: Source, key: Array, policy: Policy, drawn: Callable[[Array, int], Array], count: int, draws: int = 1
) -> tuple[Array, Array, Array]:
    """Simulate `count` trajectories: theta [count, d], features [count, D], in chunks that fit the memory.

    Third come the features [count, draws - 1, D] of the same trajectories with other draws of the measurement noise.

    Args:
        source: what simulates.
        key: consumed.
        policy: that acts.
        drawn: (key, n) -> theta [n, d].
        count: how many.
        draws: how often each trajectory is measured.

    Raises:
        UserError: contacts had no room (`physics.warp`).
    """
    chunks = -(-count // DRAWS)
    k_theta, k_roll = jax.random.split(key)
    thetas = drawn(k_theta, -(-count // chunks) * chunks)
    x, again = _features(source, draws)(k_roll, thetas.reshape(chunks, -1, thetas.shape[-1]), policy)
    _refuse_overflow(source, x, chunks)
    return thetas[:count], x[:count], again[:count]


def features(source: Source, key: Array, thetas: Array, policy: Policy) -> Array:
    """Features [chunks * n, D] of trajectories at thetas [chunks, n, d]."""
    x = _features(source, 1)(key, thetas, policy)[0]
    _refuse_overflow(source, x, len(thetas))
    return x


def _refuse_overflow(source: Source, x: Array, chunks: int) -> None:
    """Raise a UserError where all trajectories of a chunk [chunks * n, D] are lost: Warp's contacts had no room."""
    if getattr(getattr(source.env, "physics", None), "warp", None) is not None:
        lost = jnp.isnan(x).any(-1).reshape(chunks, -1).all(-1)
        refuse_overflow(lost.mean(), f"the trajectories, simulated {len(x) // chunks} at once")


def noise_draws(loop: Loop) -> int:
    """Count the noise draws of each simulated trajectory: `bayessim.noiseDraws`, or fewer that fit the memory."""
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
    """Return the distribution that this round is simulated from."""
    if state.proposal is not None:
        return state.proposal
    return Distribution.prior(space_of(loop, state), loop.settings.components)


def at(batch: Distribution, row: int) -> Distribution:
    """One of batched distributions."""
    return jax.tree.map(lambda leaf: leaf[row], batch)


def no_motion(loop: Loop, rows: int) -> dict[str, Array] | None:
    """Room for the measured motion of `rows` real trajectories; None where logs keep it."""
    if isinstance(loop.source, Recorded):
        return None
    model, length = loop.env.physics.mj_model, loop.settings.trainTrajLen  # type: ignore[attr-defined]
    sizes = {"qpos": (length + 1, model.nq), "qvel": (length + 1, model.nv), "command": (length, model.nu)}
    return {name: jnp.zeros((rows, *size)) for name, size in (sizes | {"valid": (length,)}).items()}


def stored(loop: Loop, state: LoopState, real: Trajectory) -> LoopState:
    """Add the measured motion of this round's trajectories; a surrogate's sensors are as noisy as its observations."""
    if state.motion is None:
        return state
    first, source = int(state.round) * loop.settings.realTrajs, loop.source
    k_qpos, k_qvel = jax.random.split(branch(loop.key(int(state.round), "real"), 7))
    rows = {name: jnp.asarray(getattr(real, name)) for name in state.motion}
    model, noise = loop.env.physics.mj_model, source.noise  # type: ignore[union-attr,attr-defined]
    rows["qpos"] = noisy(model, k_qpos, rows["qpos"], noise)  # type: ignore[arg-type]
    rows["qvel"] = rows["qvel"] + noise * jax.random.normal(k_qvel, rows["qvel"].shape)  # type: ignore[operator]
    kept = {
        name: jax.lax.dynamic_update_slice(old, rows[name], (first, *[0] * (old.ndim - 1)))
        for name, old in state.motion.items()
    }
    return dataclasses.replace(state, motion=kept)
