"""Ranges that move between rounds (`bayessim.range_ends: move`): they are part of the state, as arrays.

A range only grows, so that its prior is that of before where it was before. Simulations drawn from the prior stay: the
next round simulates what they lack to be draws of the prior over the wider range. Those drawn from a posterior over the
range before go, and the network learns anew, as its outputs are coordinates of a range.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import range_ends
from bayessim_mjx.inference.numbers import DRAWS
from bayessim_mjx.inference.range_ends import Pile
from bayessim_mjx.keys import branch
from bayessim_mjx.loop.sources import limits_of
from bayessim_mjx.loop.state import Evidence, Loop, LoopState, Moving
from bayessim_mjx.parameters.ranged import Ranged


def unmoved(space: Ranged) -> Moving:
    """Return the ranges before the first round."""
    zero = jnp.int32(0)
    return Moving(space, space, zero, zero, zero)


def as_fitted(state: LoopState) -> LoopState:
    """Return the state with the ranges that its last round had."""
    if state.moving is None:
        return state
    return dataclasses.replace(state, moving=state.moving.replace(space=state.fit.space))  # type: ignore[attr-defined]


def share(before: Ranged, after: Ranged) -> float:
    """Return the mass of the prior over the range after a move that lies in the range before."""
    start, end = (np.asarray(after.to_unit(x), np.float64) for x in (before.low, before.high))
    return float(np.prod(end - start))


def completed(loop: Loop, state: LoopState, thetas: Array) -> Array:
    """Change draws of the prior [N, d] where simulations are kept.

    With the first trainTrajs of them these are draws of the prior over the range as it is now.
    """
    moving, n = state.moving, loop.settings.trainTrajs
    if moving is None or not int(moving.rows) or moving.space.same(moving.covered):
        return thetas
    kept, mass = int(moving.rows), share(moving.covered, moving.space)
    rows = np.array(thetas)
    inside = np.flatnonzero(moving.covered.contains(rows[:n]))
    spare = inside[max(0, round(mass * (kept + n)) - kept) :]  # the region has as many already
    prior, key = Distribution.prior(moving.space), loop.key(int(state.round), "simulate")
    found: list[np.ndarray] = []
    while sum(len(drawn) for drawn in found) < len(spare):
        key = branch(key, 1)
        drawn = prior.sample(key, DRAWS)
        found.append(np.asarray(drawn)[~np.asarray(moving.covered.contains(drawn))])
    if found:
        rows[spare] = np.concatenate(found)[: len(spare)]
    return jnp.asarray(rows)


def room(loop: Loop, state: LoopState) -> tuple[LoopState, int, int]:
    """Make room for a round's simulations; return the state, their first row, and how many rows there are with them."""
    n, done = loop.settings.trainTrajs, int(state.round) + 1
    if state.moving is None:
        slots = max(1, loop.capacity // n)
        return state, (done - 1) % slots * n, min(done * n, loop.capacity)
    moving = state.moving
    row = int(moving.next) if int(moving.next) + n <= loop.capacity else 0
    count = max(int(moving.rows), row + n)
    fields = {"rows": count if loop.capacity else 0, "next": row + n, "slot": row // n}
    moving = moving.replace(**{k: jnp.int32(v) for k, v in fields.items()})  # type: ignore[attr-defined]
    return dataclasses.replace(state, moving=moving), row, count


def mixed(loop: Loop, state: LoopState, thetas: Array, x: Array) -> tuple[LoopState, Array, Array]:
    """Mix simulations kept and new where they are draws of the prior together only: any of them may go."""
    moving = state.moving
    if moving is None or moving.space.same(moving.covered):
        return state, thetas, x
    state = dataclasses.replace(state, moving=moving.replace(covered=moving.space))  # type: ignore[attr-defined]
    if loop.sequential:
        return state, thetas, x
    order, count = np.arange(len(thetas)), int(moving.rows)
    rng = np.random.default_rng(np.asarray(branch(loop.key(int(state.round), "simulate"), 2)))
    order[:count] = rng.permutation(count)
    return state, thetas[order], x[order]


def move(loop: Loop, state: LoopState, posterior: Distribution) -> tuple[Distribution, tuple[Pile, ...], Evidence]:
    """Move ends at which the posterior piles up; return it over the ranges of the next round, and those ends."""
    last = int(state.round) + 1 >= loop.settings.realIters
    if state.moving is None or last or not (found := range_ends.piles(posterior)):
        return posterior, (), Evidence()
    before = state.moving.space
    space, found = range_ends.moved(before, found, *limits_of(loop.env))
    moves = tuple(found)
    if space.same(before):
        return posterior, moves, Evidence({"moves": moves})
    rows = jnp.int32(_kept(loop, state.moving, share(before, space)))
    moving = state.moving.replace(space=space, covered=before, rows=rows, next=rows)  # type: ignore[attr-defined]
    kept, warnings = {"moving": moving}, []
    if loop.source.policy_dependent:  # type: ignore[union-attr]
        warnings.append("ranges have moved: earlier real trajectories count within the old ranges only")
        kept["real_posteriors"] = _forgotten(state.real_posteriors, space)
    return posterior.over(space), moves, Evidence({"moves": moves}, warnings=warnings, kept=kept)


def _kept(loop: Loop, moving: Moving, mass: float) -> int:
    """Count the simulations that stay: as many as, with one more round outside their range, are draws of the prior."""
    n = loop.settings.trainTrajs
    if loop.sequential or not loop.capacity:
        return 0
    return max(0, min(int(moving.rows), int(mass / max(1 - mass, 1e-9) * n), loop.capacity - n))


def _forgotten(factors: Distribution | None, space: Ranged) -> Distribution:
    """Put the prior over `space` in place of each factor."""
    assert factors is not None
    ends = (
        jnp.broadcast_to(end, np.shape(old))
        for end, old in ((space.low, factors.space.low), (space.high, factors.space.high))
    )
    flat = jnp.ones_like(factors.prior_weight)
    return dataclasses.replace(factors, prior_weight=flat, space=Ranged(space.start, *ends))
