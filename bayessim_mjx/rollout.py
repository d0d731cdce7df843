"""Rollouts: scan over time, vmap over worlds. One whole episode per world, or endless collection with resets."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.interpreters import partial_eval

from bayessim_mjx.effects.support.site import AROUND, Motion
from bayessim_mjx.physics import Drive, Physics, begin, control_step
from bayessim_mjx.physics.controllers import Law

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State

PolicyFn = Callable[..., Any]


@struct.dataclass
class Trajectory:
    """One world, time-major; a batch has a leading axis of worlds. After the end the last observation is repeated."""

    observation: jax.Array  # [T+1, S] group "policy"; row 0 is the reset
    action: jax.Array  # [T, A] as the policy gave it
    reward: jax.Array  # [T] 0 after the end
    terminated: jax.Array  # [T] 1 at the step that ended the episode for good
    truncated: jax.Array  # [T] 1 at the step where the time limit ended it
    valid: jax.Array  # [T] 1 while the episode ran
    theta: jax.Array  # [d]
    qpos: jax.Array  # [T+1, nq] as measured; [T+1, 0] where the environment has no physics of ours
    qvel: jax.Array  # [T+1, nv]
    command: jax.Array  # [T, nu] what the action commanded of the actuators; [T, 0] likewise


def select(mask: jax.Array, yes: Any, no: Any) -> Any:
    """Leaf-wise where(mask, yes, no) for pytrees with a leading axis like mask [N]; keeps the dtypes of `yes`."""

    def leaf(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (jnp.ndim(a) - mask.ndim)), a, b).astype(jnp.result_type(a))

    return jax.tree.map(leaf, yes, no)


def as_pytree(policy_fn: PolicyFn) -> PolicyFn:
    """The same function as a pytree, its arrays as leaves: new parameters are then new arguments, not a new program."""
    if inspect.ismethod(policy_fn) and not jax.tree_util.all_leaves([policy_fn.__self__]):
        return jax.tree_util.Partial(policy_fn.__func__, policy_fn.__self__)
    return jax.tree_util.Partial(policy_fn) if jax.tree_util.all_leaves([policy_fn]) else policy_fn


def rollout(env: Env, policy_fn: PolicyFn, key: jax.Array, thetas: jax.Array, length: int) -> Trajectory:
    """One episode of at most `length` steps in each of N worlds; all fields with a leading N.

    policy_fn(key, obs: {group: [S]}) -> action [A] acts in one world; a `Policy`, its method `act`, or any function.
    thetas [N, d]. Compiled once per (env, function, length, N): another key, theta or policy of its kind reuses it.
    """
    if length < 1:
        raise ValueError(f"length = {length}: a rollout has at least 1 step")
    thetas = jnp.asarray(thetas, jnp.float32)
    if thetas.ndim != 2:
        raise ValueError(f"thetas has shape {thetas.shape}: expected [worlds, parameters]")
    return _rollout(env, length)(as_pytree(policy_fn), key, thetas)


@lru_cache(maxsize=32)
def _rollout(env: Env, length: int) -> Callable[..., Trajectory]:
    def run(policy_fn: PolicyFn, key: jax.Array, thetas: jax.Array) -> Trajectory:
        worlds = thetas.shape[0]
        reset_key, key = jax.random.split(key)
        state = jax.vmap(traced(env.reset))(jax.random.split(reset_key, worlds), thetas)

        def step(carry: tuple, keys: jax.Array) -> tuple[tuple, tuple]:
            state, alive, action = carry
            action = select(~alive, action, jax.vmap(policy_fn)(keys, state.obs))
            after = select(~alive, state, jax.vmap(traced(env.step))(state, action))
            terminated = after.info["terminated"] * alive
            truncated = after.info["truncated"] * alive
            row = (
                action,
                after.reward * alive,
                terminated,
                truncated,
                alive.astype(jnp.float32),
                _command(env, action),
            )
            return (after, alive & (terminated + truncated == 0), action), (row, _seen(after))

        keys = jax.vmap(lambda k: jax.random.split(k, worlds))(jax.random.split(key, length))
        carry = (state, jnp.ones(worlds, bool), jnp.zeros((worlds, env.action_size)))
        _, (rows, seen) = jax.lax.scan(step, carry, keys)
        seen = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), _seen(state), seen)
        (action, reward, terminated, truncated, valid, command), (observation, qpos, qvel) = jax.tree.map(
            lambda x: jnp.moveaxis(x, 0, 1), (rows, seen)
        )
        return Trajectory(observation, action, reward, terminated, truncated, valid, thetas, qpos, qvel, command)

    return jax.jit(run)


def _seen(state: State) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Policy observation [N, S] and measured qpos [N, nq], qvel [N, nv] (empty without physics of ours)."""
    observation = state.obs["policy"]
    measurement = getattr(state.pipeline_state, "measurement", None)
    if measurement is None:
        empty = jnp.zeros((observation.shape[0], 0))
        return observation, empty, empty
    return observation, measurement["qpos"], measurement["qvel"]


def _command(env: Env, action: jax.Array) -> jax.Array:
    """Actuator commands [N, nu] of the actions [N, A], clipped as by the task (empty without physics of ours)."""
    command = getattr(env, "command", None)
    return jnp.zeros((action.shape[0], 0)) if command is None else jax.vmap(command)(jnp.clip(action, -1.0, 1.0))


def replay(
    physics: Physics,
    qpos0: jax.Array,
    qvel0: jax.Array,
    command: jax.Array,
    thetas: jax.Array,
    around: Motion | None = None,
    law: Law | None = None,
) -> dict[str, jax.Array]:
    """Open loop: the commands [N, T, nu] from measured states [N, nq], [N, nv] in the worlds thetas [N, d].

    It begins as `physics.begin`: in the true state behind the measured one, with memories filled by the recorded past.

    Args:
        around: the recording around the starts (leaves [N, rows, ...]), moved as a whole so that it goes through them;
            None: nothing is known but the start.
        law: controllers between commands and actuators (leaves [N, nu]); None: there are none.

    Returns:
        the measurements {"qpos": [N, T+1, nq], "qvel": [N, T+1, nv]}, row 0 at the start.
    """
    arrays = [jnp.asarray(x, jnp.float32) for x in (qpos0, qvel0, command, thetas)]
    shapes = [x.shape for x in arrays]
    if [len(s) for s in shapes] != [2, 2, 3, 2] or len({s[0] for s in shapes}) != 1:
        raise ValueError(
            f"qpos0 {shapes[0]}, qvel0 {shapes[1]}, command {shapes[2]}, thetas {shapes[3]}: "
            "expected [N, nq], [N, nv], [N, T, nu], [N, d] with the same N"
        )
    return _replay(physics)(*arrays, around, law)


@lru_cache(maxsize=32)
def _replay(physics: Physics) -> Callable[..., dict[str, jax.Array]]:
    def one(
        qpos: jax.Array, qvel: jax.Array, command: jax.Array, theta: jax.Array, around: Motion | None, law: Law | None
    ) -> dict[str, jax.Array]:
        if around is None:
            around = Motion(qpos[None], qvel[None], _throughout(physics, command[:1]), start=0)
        moved = [x + (own - x[around.start]) for x, own in ((around.qpos, qpos), (around.qvel, qvel))]
        world = begin(physics, theta, around.replace(qpos=moved[0], qvel=moved[1]))
        drive = Drive(law=law)

        def step(world: Any, command: jax.Array) -> tuple[Any, dict]:
            world, _ = control_step(physics, world, command, drive)
            return world, world.measurement

        _, after = jax.lax.scan(step, world, command)
        return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), world.measurement, after)

    return jax.jit(jax.vmap(one))


def _throughout(physics: Physics, command: jax.Array) -> jax.Array:
    """Commands [..., nu] as held over the sub-steps of their control steps, [..., substeps, nu]."""
    held = (*command.shape[:-1], physics.substeps, command.shape[-1])
    return jnp.broadcast_to(command[..., None, :], held)


def recording(physics: Physics, qpos: jax.Array, qvel: jax.Array, command: jax.Array) -> Motion:
    """The recording around starts, `around_*` of `logs.segments` [N, 2 L + 1, ...], as `replay` takes it."""
    qpos, qvel, command = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, command))
    return Motion(qpos, qvel, _throughout(physics, command), start=(qpos.shape[-2] - 1) // 2)


def remembered(physics: Physics) -> int:
    """Control steps of a recording around a start that the effects look at: three of their longest times."""
    times = [p.high for effect in physics.effects for p in effect.space().parameters if p.unit == "s"]
    return max(2, math.ceil(max([AROUND, *(3 * t for t in times)]) / physics.dt - 1e-6)) if physics.effects else 0


def collect(
    env: Env,
    policy_fn: PolicyFn,
    draws: Any,
    env_states: State,
    pool: State,
    groups: Sequence[str] = ("policy",),
) -> tuple[State, dict[str, Any]]:
    """T steps in N worlds, each starting a new episode wherever one ends; to be called inside a jitted function.

    policy_fn(draw, obs: {group: [N, S]}) -> (action [N, A], extras) acts in all worlds at once; extras is kept.
    draws: keys or noise, leaves [T, ...], one for each step. pool: N freshly reset states, shared in rings of R =
    `ring(N)` worlds: for its k-th new episode in this call a world takes the entry k `_stride(R)` further in its ring,
    so that all draw different ones, and theta is drawn anew with each episode. Whole rings can be run apart.
    Returns the last states and time-major arrays [T, N, ...]: observation and final_observation (the next one,
    before any reset) by group, reward, terminated, truncated, extras. What later steps do not depend on is not carried
    on: it stays in the states as it was.
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
    """The same arrays without weak types: what goes into the first update is then typed like what comes out of it."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), tree)


def next_episodes(env: Env, ended: jax.Array, after: State, fresh: State) -> State:
    """`fresh` resets [N] of worlds that went on to `after`, with what these carry on from episode to episode.

    Training's clock goes on; where `frequency` asks for it, an ended world keeps its parameters, gravity and lasting
    noise, and is reset anew with them.
    """
    random = getattr(env, "nuisance", None)
    if random is None:
        return fresh
    course = after.info["nuisance"].course
    if random.frequency > 1:
        keeps, fresh = ended & (course.age < random.frequency), strong(fresh)
        keys, theta = fresh.info["nuisance"].key, after.pipeline_state.theta
        again = lambda: strong(select(keeps, jax.vmap(traced(env.reset))(keys, theta, course), fresh))  # noqa: E731
        fresh = jax.lax.cond(keeps.any(), again, lambda: fresh)
    drawn = fresh.info["nuisance"]
    drawn = drawn.replace(course=drawn.course.replace(clock=course.clock))
    return fresh.replace(info={**fresh.info, "nuisance": drawn})


@lru_cache(maxsize=64)
def traced(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function (an environment's `reset` or `step`), written out once for all programs that it is part of."""
    return jax.jit(function)


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
    """A step near the golden section of the pool and coprime with its size: visits every entry before repeating one."""
    return next(s for s in range(max(1, round(0.618 * worlds)), 0, -1) if math.gcd(s, worlds) == 1)
