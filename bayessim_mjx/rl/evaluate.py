"""Whole episodes of a policy, scored in one jitted program."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from bayessim_mjx.compat import program
from bayessim_mjx.env.finite import NOT_FINITE
from bayessim_mjx.keys import branch
from bayessim_mjx.physics.warp import OVERFLOW, refuse_overflow
from bayessim_mjx.rl import not_finite
from bayessim_mjx.rl.networks import Policy
from bayessim_mjx.rollout import traced

if TYPE_CHECKING:
    from bayessim_mjx.env import Env


def evaluate(
    env: Env, policy: Policy, key: jax.Array, thetas: jax.Array, deterministic: bool = True
) -> dict[str, jax.Array]:
    """One episode in each world: {"return": [n], "length": [n]}.

    Args:
        env: the environment.
        policy: who acts.
        key: of resets and actions.
        thetas: [n, d] of each world.
        deterministic: the mean action, else a sample.

    Raises:
        ValueError: thetas' shape.
        UserError: contacts had no room (`physics.warp`).
    """
    thetas = jnp.asarray(thetas, jnp.float32)
    if thetas.ndim != 2:
        raise ValueError(f"thetas has shape {thetas.shape}: expected [episodes, parameters]")
    return _sound(env, _evaluate(env)(dataclasses.replace(policy, deterministic=deterministic), key, thetas))


def evaluate_together(
    env: Env, policies: Sequence[Policy], key: jax.Array, thetas: jax.Array, deterministic: bool = True
) -> dict[str, jax.Array]:
    """`evaluate` of several policies in one program: thetas [policies, n, d] -> {"return", "length": [policies, n]}.

    On an accelerator this takes hardly longer than one of them alone. The random numbers are the same for all.

    Args:
        env, key, deterministic: as for `evaluate`.
        policies: of one kind.
        thetas: of each policy's worlds.

    Raises:
        ValueError: the policies' networks differ, or thetas' shape.
        UserError: as `evaluate`.
    """
    thetas = jnp.asarray(thetas, jnp.float32)
    if thetas.ndim != 3 or len(thetas) != len(policies):
        raise ValueError(f"thetas has shape {thetas.shape}: expected [{len(policies)} policies, episodes, parameters]")
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *policies)
    return _sound(env, _evaluate_together(env)(dataclasses.replace(stacked, deterministic=deterministic), key, thetas))


def _sound(env: Env, found: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return what was found, where all contacts had room; warn of numbers that are not finite."""
    not_finite.evaluated(env, {name: found.pop(name) for name in [*found] if name.startswith(NOT_FINITE)})
    if (lost := found.pop(OVERFLOW, None)) is not None:
        refuse_overflow(lost.mean(), "the episodes that were evaluated")
    return found


@lru_cache(maxsize=32)
def _evaluate_together(env: Env) -> Callable[..., dict[str, jax.Array]]:
    return program(jax.vmap(_episodes(env), in_axes=(0, None, 0)), env)


@lru_cache(maxsize=32)
def _evaluate(env: Env) -> Callable[..., dict[str, jax.Array]]:
    return program(_episodes(env), env)


def _episodes(env: Env) -> Callable[..., dict[str, jax.Array]]:
    def run(policy: Policy, key: jax.Array, thetas: jax.Array) -> dict[str, jax.Array]:
        count = thetas.shape[0]
        reset_key, key = jax.random.split(key)
        state = jax.vmap(traced(env.reset))(jax.random.split(reset_key, count), thetas)

        def going(carry: tuple) -> jax.Array:
            return (carry[0] < env.episode_length) & carry[2].any()

        def step(carry: tuple) -> Any:
            t, state, alive, total, length, lost = carry
            state = jax.vmap(traced(env.step))(state, policy(branch(key, t), state.obs))
            total, length = total + jnp.where(alive, state.reward, 0.0), length + alive
            ended = state.info["terminated"] + state.info["truncated"] > 0
            lost = {name: jnp.maximum(most, jnp.where(alive, state.metrics[name], 0)) for name, most in lost.items()}
            return t + 1, state, alive & ~ended, total, length, lost

        metrics = getattr(state, "metrics", {})
        lost = {name: jnp.zeros(count) for name in metrics if name == OVERFLOW or name.startswith(NOT_FINITE)}
        carry = (jnp.int32(0), state, jnp.ones(count, bool), jnp.zeros(count), jnp.zeros(count, jnp.int32), lost)
        _, _, _, total, length, lost = jax.lax.while_loop(going, step, carry)
        return {"return": total, "length": length} | lost

    return run
