"""One whole episode in each world: scan over time, vmap over worlds."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.compat import brief
from bayessim_mjx.physics.warp import OVERFLOW

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
    """Make the function a pytree with arrays as leaves: new parameters are then new arguments, not a new program."""
    if inspect.ismethod(policy_fn) and not jax.tree_util.all_leaves([policy_fn.__self__]):
        return jax.tree_util.Partial(policy_fn.__func__, policy_fn.__self__)
    return jax.tree_util.Partial(policy_fn) if jax.tree_util.all_leaves([policy_fn]) else policy_fn


@lru_cache(maxsize=64)
def traced(function: Callable[..., Any]) -> Callable[..., Any]:
    """Write out a function (an environment's `reset` or `step`) once for all programs that it is part of."""
    return jax.jit(function)


def rollout(env: Env, policy_fn: PolicyFn, key: jax.Array, thetas: jax.Array, length: int) -> Trajectory:
    """One episode of at most `length` steps in each of N worlds; all fields with a leading N.

    Compiled once per (env, function, length, N): another key, theta or policy of its kind reuses it. Where contacts had
    no room (`physics.warp`), no observation is a number: all worlds stood still from there on.

    Args:
        env: any environment.
        policy_fn: (key, obs {group: [S]}) -> action [A] of one world; a `Policy`, its method `act`, or any function.
        key: of resets and actions.
        thetas: [N, d], one row per world.
        length: control steps.

    Raises:
        ValueError: length below 1; thetas of another shape.
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
                _command(env, state, action),
            )
            counted = getattr(after, "metrics", {}).get(OVERFLOW)
            lost = None if counted is None else counted.max()
            return (after, alive & (terminated + truncated == 0), action), (row, _seen(after), lost)

        keys = jax.vmap(lambda k: jax.random.split(k, worlds))(jax.random.split(key, length))
        carry = (state, jnp.ones(worlds, bool), jnp.zeros((worlds, env.action_size)))
        _, (rows, seen, lost) = jax.lax.scan(step, carry, keys)
        seen = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), _seen(state), seen)
        (action, reward, terminated, truncated, valid, command), (observation, qpos, qvel) = jax.tree.map(
            lambda x: jnp.moveaxis(x, 0, 1), (rows, seen)
        )
        if lost is not None:
            observation = jnp.where(jnp.max(lost) > 0, jnp.nan, observation)
        return Trajectory(observation, action, reward, terminated, truncated, valid, thetas, qpos, qvel, command)

    return brief(run)


def _seen(state: State) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Policy observation [N, S] and measured qpos [N, nq], qvel [N, nv] (empty without physics of ours)."""
    observation = state.obs["policy"]
    measurement = getattr(state.pipeline_state, "measurement", None)
    if measurement is None:
        empty = jnp.zeros((observation.shape[0], 0))
        return observation, empty, empty
    return observation, measurement["qpos"], measurement["qvel"]


def _command(env: Env, state: State, action: jax.Array) -> jax.Array:
    """Actuator commands [N, nu] of the actions [N, A], clipped as by the task (empty without physics of ours)."""
    actuate = getattr(env, "actuate", None)
    if actuate is None:
        return jnp.zeros((action.shape[0], 0))
    return jax.vmap(actuate)(state.pipeline_state, jnp.clip(action, -1.0, 1.0))[1]
