"""The worlds of a training: fresh episodes, and what the policy does in them between two updates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from bayessim_mjx.physics.nuisance import starting
from bayessim_mjx.rl import actions, sharding
from bayessim_mjx.rl.extension import Learner
from bayessim_mjx.rl.networks import Policy, form
from bayessim_mjx.rl.sharding import EVERYWHERE, FIRST, SECOND
from bayessim_mjx.rl.state import TrainState, policy_of
from bayessim_mjx.rollout import collect, traced

if TYPE_CHECKING:
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.env import Env, State


def reset(
    env: Env, key: jax.Array, domain: Distribution | None, worlds: int, mesh: Mesh | None = None, clock: Any = 0
) -> State:
    """Fresh episodes in all worlds.

    Args:
        env: the environment as the learner sees it.
        key: of theta and of the episodes' beginnings.
        domain: where theta comes from; None: all at the nominal one.
        worlds: how many.
        mesh: the devices that share them; None: one.
        clock: control steps since training began.
    """
    theta_key, reset_key = jax.random.split(key)
    return reset_at(env, reset_key, drawn(env, theta_key, domain, worlds), mesh, clock)


def drawn(env: Env, key: jax.Array, domain: Distribution | None, worlds: int) -> jax.Array:
    """theta `[worlds, d]` from `domain`; None: the nominal one."""
    if domain is not None:
        return domain.sample(key, worlds)
    return jnp.tile(jnp.asarray(env.space.nominal, jnp.float32), (worlds, 1))


def reset_at(env: Env, key: jax.Array, thetas: jax.Array, mesh: Mesh | None = None, clock: Any = 0) -> State:
    """Fresh episodes with parameters `thetas` `[N, d]`; the rest as for `reset`."""
    worlds = thetas.shape[0]
    given: tuple[Any, ...] = (jax.random.split(key, worlds), thetas)
    if getattr(env, "nuisance", None) is not None:
        given = (given[0], env.space.scheduled(thetas, clock), starting(clock, worlds))
    return sharding.local(jax.vmap(traced(env.reset)), mesh, (FIRST,) * len(given), FIRST)(*given)


def held(env: Env, state: State, thetas: jax.Array) -> jax.Array:
    """Parameters `[N, d]` of worlds whose `thetas` were drawn: schedules, and those that last, make them others."""
    return thetas if getattr(env, "nuisance", None) is None else state.pipeline_state.theta


def clock(env: Env, env_states: State) -> jax.Array:
    """Control steps of each world since training began; 0 where nothing goes by them."""
    if getattr(env, "nuisance", None) is None:
        return jnp.int32(0)
    return env_states.info["nuisance"].course.clock.max()


def stagger(key: jax.Array, state: State, episode_length: int) -> tuple[State, jax.Array]:
    """First episodes' clocks spread out, so that time limits do not come all at once; and which are late, [N]."""
    steps = jax.random.randint(key, state.reward.shape, 0, episode_length).astype(state.info["steps"].dtype)
    return aged(state, steps), (steps > 0).astype(jnp.float32)


def aged(state: State, steps: jax.Array) -> State:
    """Return the same worlds as if their episodes were `steps` `[N]` control steps old, for the time limit."""
    steps = steps.astype(state.info["steps"].dtype)
    world = state.pipeline_state
    if "steps" in getattr(world, "task", {}):  # our tasks count in the world, the others in info
        world = world.replace(task={**world.task, "steps": steps})
    return dataclasses.replace(state, pipeline_state=world, info={**state.info, "steps": steps})


def gather(
    learner: Learner, state: TrainState, domain: Distribution | None, key: jax.Array, more: Sequence[str] = ()
) -> tuple[State, dict]:
    """num_steps in every world with the current policy; resets come from a pool drawn once per update.

    Returns the worlds' states after them, and arrays [T, N, ...]: those of `rollout.collect`, with the observation
    groups that networks and extensions need.

    Args:
        learner: environment and settings.
        state: the policy, and the worlds as they are.
        domain: where new episodes draw theta from; None: all at the nominal one.
        key: of the resets and of the actions' noise.
        more: observation groups beside these.
    """
    pool_key, noise_key = jax.random.split(key)
    env, config, mesh = learner.env, learner.config, state.mesh
    needed = [group for extension in learner.extensions for group in extension.groups(env.observation_size)]
    memory = ("memory",) if config.memory else ()
    groups = tuple(sorted({*state.normalizer, *needed, *memory, *more}))

    def run(policy: Policy, noise: jax.Array, env_states: State, pool: State) -> tuple[State, dict]:
        def act(noise: jax.Array, obs: dict[str, jax.Array]) -> tuple[jax.Array, dict]:
            mean, log_std = policy.distribution(obs)
            action = law.made(noise, mean, log_std)
            extras = {"action": action, "mean": mean}
            done = policy.carried(obs, policy.bounded(action))
            return done, extras if log_std.ndim == 1 else extras | {"log_std": log_std}

        return collect(env, act, noise, env_states, pool, groups)

    shape = (config.num_steps, config.num_envs, env.action_size - config.memory_size)
    law = actions.of(config)
    noise = sharding.pinned(law.noise(noise_key, *shape), mesh, SECOND)
    pool = reset(env, pool_key, domain, config.num_envs, mesh, clock(env, state.env_states))
    run = sharding.local(run, mesh, (EVERYWHERE, SECOND, FIRST, FIRST), (FIRST, SECOND))
    # rounded as in the losses, or ratios would begin beside 1
    policy = dataclasses.replace(policy_of(state), half=form(config).half)
    return run(policy, noise, state.env_states, pool)
