"""Endless collection: a world starts a new episode wherever one ends."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval

from bayessim_mjx.rollout.episodes import PolicyFn, select, traced

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State


def collect(
    env: Env,
    policy_fn: PolicyFn,
    draws: Any,
    env_states: State,
    pool: State,
    groups: Sequence[str] = ("policy",),
) -> tuple[State, dict[str, Any]]:
    """T steps in N worlds, each starting a new episode wherever one ends; to be called inside a jitted function.

    Args:
        env: any environment.
        policy_fn: (draw, obs {group: [N, S]}) -> (action [N, A], extras), in all worlds at once; extras is kept.
        draws: keys or noise, leaves [T, ...], one for each step.
        env_states: of the N worlds.
        pool: N freshly reset states, shared in rings of R = `ring(N)` worlds: for its k-th new episode in this call a
            world takes the entry k `_stride(R)` further in its ring, so that all draw different ones, and theta is
            drawn anew with each episode. Whole rings can be run apart.
        groups: of observations to be kept.

    Returns:
        (the last states, time-major arrays [T, N, ...]): observation and final_observation (the next one, before any
        reset) by group, reward, terminated, truncated, extras, and metrics (those that are one number a world). What
        later steps do not depend on is not carried on: it stays in the states as it was.
    """
    worlds = env_states.reward.shape[0]
    size, lasting = ring(worlds), _lasting(env, env_states, tuple(groups))
    stride, first = _stride(size), jnp.arange(worlds) // size * size

    def step(carry: tuple[State, jax.Array], draw: Any) -> tuple[tuple, dict]:
        state, index = carry
        action, extras = policy_fn(draw, state.obs)
        after = jax.vmap(traced(env.step))(state, action)
        terminated = after.info["terminated"]
        truncated = after.info["truncated"] * (1 - terminated)
        ended = terminated + truncated > 0
        row = {
            "observation": {g: state.obs[g] for g in groups},
            "final_observation": {g: after.info["final_observation"][g] for g in groups},
            "reward": after.reward,
            "terminated": terminated,
            "truncated": truncated,
            "extras": extras,
            "metrics": {name: x for name, x in getattr(after, "metrics", {}).items() if x.ndim == 1},
        }
        following = first + (index - first + stride) % size
        fresh = jax.tree.map(lambda lasts, new: new[index] if lasts else new, lasting, pool)
        fresh = next_episodes(env, ended, after, fresh)

        def next_one(lasts: bool, old: jax.Array, new: jax.Array, fresh: jax.Array) -> jax.Array:
            return select(ended, fresh, new) if lasts else old

        return (jax.tree.map(next_one, lasting, state, after, fresh), jnp.where(ended, following, index)), row

    (state, _), batch = jax.lax.scan(step, (env_states, jnp.arange(worlds)), draws)
    return state, batch


def strong(tree: Any) -> Any:
    """Drop weak types: what goes into the first update is then typed like what comes out of it."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), tree)


def next_episodes(env: Env, ended: jax.Array, after: State, fresh: State) -> State:
    """`fresh` resets [N] of worlds that went on to `after`, with what these carry on from episode to episode.

    Training's clock goes on; by `frequency` an ended world keeps its parameters, gravity and lasting
    noise, and is reset anew with them.

    Args:
        env: any environment.
        ended: [N] bool, whose episode ended.
        after: [N] states at that end.
        fresh: [N] states after a reset.
    """
    random = getattr(env, "nuisance", None)
    if random is None:
        return fresh
    course = after.info["nuisance"].course
    if random.frequency > 1:
        keeps, fresh = ended & (course.age < random.frequency), strong(fresh)
        keys, before = fresh.info["nuisance"].key, after.pipeline_state

        def again() -> State:
            state = jax.vmap(traced(env.reset))(keys, before.theta, course)
            # what follows from theta is there: nobody reads it of `state`, so that XLA leaves out its derivation
            same = {name: x for name, x in before.fields.items() if name not in random.fields}
            world = state.pipeline_state
            world = world.replace(fields={**world.fields, **same})
            return strong(select(keeps, state.replace(pipeline_state=world), fresh))

        fresh = jax.lax.cond(keeps.any(), again, lambda: fresh)
    drawn = fresh.info["nuisance"]
    drawn = drawn.replace(course=drawn.course.replace(clock=course.clock))
    return fresh.replace(info={**fresh.info, "nuisance": drawn})


def _lasting(env: Env, states: State, groups: tuple[str, ...]) -> State:
    """Which arrays of a batch of states later observations (of these groups), rewards and ends depend on; of bools.

    The states of a simulator hold much that each step computes anew: carrying it on costs as many copies.
    """
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), states)

    def step(state: State, action: jax.Array) -> tuple[State, Any]:
        after = traced(env.step)(state, action)
        final = {g: after.info["final_observation"][g] for g in groups}
        carried = () if getattr(env, "nuisance", None) is None else (after.info["nuisance"], after.pipeline_state.theta)
        return after, (final, after.reward, after.info["terminated"], after.info["truncated"], carried)

    closed, shapes = jax.make_jaxpr(step, return_shape=True)(one, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
    seen = jax.tree.map(lambda _: False, one)
    seen = dataclasses.replace(seen, obs={g: g in groups for g in seen.obs})
    needed, structure = jax.tree.flatten(seen)
    shown = [True] * len(jax.tree.leaves(shapes[1]))
    while True:  # what is needed now, and what it is computed from
        used = partial_eval.dce_jaxpr(closed.jaxpr, [*needed, *shown])[1]
        more = [a or b for a, b in zip(needed, used, strict=False)]
        if more == needed:
            return jax.tree.unflatten(structure, needed)
        needed = more


def ring(worlds: int) -> int:
    """How many neighbouring worlds share their resets: the least divisor of `worlds` from 32 on, or all."""
    return next((size for size in range(32, worlds) if worlds % size == 0), worlds)


def _stride(worlds: int) -> int:
    """Choose a step near the golden section of the pool and coprime with its size: no repeat before every entry."""
    return next(s for s in range(max(1, round(0.618 * worlds)), 0, -1) if math.gcd(s, worlds) == 1)
