"""PPO as `init` and one jitted `update`: new worlds, collection, statistics, advantages once, epochs of minibatches."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bayessim_mjx.compat import brief, program
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import actions, catalogue, episodes, losses, networks, normalise, sharding, transitions, worlds
from bayessim_mjx.rl.checks import check
from bayessim_mjx.rl.extension import Learner, Sizes
from bayessim_mjx.rl.segments import Batch
from bayessim_mjx.rl.sharding import EVERYWHERE, FIRST
from bayessim_mjx.rl.state import TrainState
from bayessim_mjx.rollout import strong

if TYPE_CHECKING:
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.env import Env, State

Update = Callable[..., Any]


def layout(state: TrainState) -> TrainState:
    """Where the state's arrays lie: what belongs to worlds with them, all else on every device."""
    everywhere: Any = jax.tree.map(lambda _: EVERYWHERE, state)
    kept = {e.name: e for e in catalogue.active(state.config) if e.name in state.extensions}
    return everywhere.replace(
        env_states=jax.tree.map(lambda _: FIRST, state.env_states),
        episodes=episodes.layout(everywhere.episodes),
        extensions={name: extension.layout(state.extensions[name]) for name, extension in kept.items()},
    )


def in_worlds_of(state: TrainState, other: TrainState) -> TrainState:
    """Put the learner of `state` in the worlds of `other`, with the sums that run over these worlds."""
    kept = {e.name: e for e in catalogue.active(state.config) if e.name in state.extensions}
    moved = {name: e.in_worlds_of(state.extensions[name], other.extensions[name]) for name, e in kept.items()}
    return state.replace(env_states=other.env_states, episodes=other.episodes, extensions=moved)


def init(
    env: Env,
    config: PPOConfig,
    key: jax.Array,
    domain: Distribution | None = None,
    mesh: Mesh | None = None,
    clock: int = 0,
) -> TrainState:
    """Make the state before the first update.

    Args:
        env: the environment.
        config: settings; the state keeps them.
        key: of everything random in this training.
        domain: where worlds draw theta from; None: all at the nominal one.
        mesh: the devices that share the worlds, see `device.mesh`; None: the default one. Results differ by rounding.
        clock: control steps that each world has trained before, which schedules of randomisation go by.

    Raises:
        UserError: environment, settings and devices do not go together.
    """
    check(env, config, mesh)
    program = _init(env, config, mesh)
    given = (key, domain, np.int32(clock))
    return program(*(given if mesh is None else sharding.agreed(given)))


def outline(env: Env, config: PPOConfig, domain: Distribution | None = None, mesh: Mesh | None = None) -> TrainState:
    """Shapes, types and layout of what `init` returns, of the same arguments."""
    shapes = jax.eval_shape(_init(env, config, mesh), jax.random.PRNGKey(0), domain, np.int32(0))
    if mesh is None:
        return shapes

    def laid_out(x: jax.ShapeDtypeStruct, spec: PartitionSpec) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=NamedSharding(mesh, spec))

    return jax.tree.map(laid_out, shapes, layout(shapes))


@lru_cache(maxsize=32)
def _init(env: Env, config: PPOConfig, mesh: Mesh | None) -> Callable[..., TrainState]:
    learner = catalogue.learner(env, config, mesh)
    env, group, shapes = learner.env, learner.critic_group, learner.env.observation_size
    sizes = networks.Sizes(shapes["policy"][0], shapes[group][0], env.action_size - config.memory_size)

    def run(key: jax.Array, domain: Distribution | None, clock: jax.Array) -> TrainState:
        key, network_key, reset_key, clock_key = jax.random.split(key, 4)
        params = networks.init(network_key, sizes, config)
        fresh = worlds.reset(env, reset_key, domain, config.num_envs, mesh, clock)
        env_states, partial = worlds.stagger(clock_key, fresh, env.episode_length)
        state = TrainState(
            params=params,
            opt_state=losses.optimiser_init(params),
            normalizer={name: normalise.init(shapes[name][0]) for name in {"policy", group}},
            learning_rate=jnp.float32(config.learning_rate),
            env_states=env_states,
            episodes=episodes.init(partial),
            key=key,
            iteration=jnp.int32(0),
            env_steps=jnp.uint32(0),
            config=config,
            extensions=_begun(learner, key, Sizes(shapes, env.action_size, partial)),
            mesh=mesh,
        )
        return sharding.pinned(strong(state), mesh, layout(state))

    return brief(run)


def _begun(learner: Learner, key: jax.Array, sizes: Sizes) -> dict[str, Any]:
    """Begin the states of extensions, by name."""
    states = {e.name: e.init(key, sizes, learner.config) for e in learner.extensions}
    return {name: own for name, own in states.items() if own is not None}


def _rewarded(learner: Learner, state: TrainState, data: dict, key: jax.Array) -> tuple[dict, jax.Array, dict]:
    """(states of extensions after what was collected, reward [T, N] with theirs added, their figures)."""
    states: dict[str, Any] = {}
    figures: dict[str, jax.Array] = {}
    reward = data["reward"]
    for extension in learner.extensions:
        own, bonus, more = extension.reward(state.extensions.get(extension.name), data, key, learner)
        reward, figures = reward if bonus is None else reward + bonus, figures | more
        states |= {} if own is None else {extension.name: own}
    return states, reward, figures


def moved_on(config: PPOConfig, state: TrainState, env_states: State, data: dict, key: jax.Array) -> TrainState:
    """Move the state on after a collection: worlds, episodes and counters; the learner is as before."""
    return dataclasses.replace(
        state,
        env_states=env_states,
        episodes=episodes.update(state.episodes, data["reward"], data["terminated"], data["truncated"]),
        key=key,
        iteration=state.iteration + 1,
        env_steps=state.env_steps + jnp.uint32(config.num_envs * config.num_steps),
    )


def update(
    env: Env, config: PPOConfig, state: TrainState, domain: Distribution | None
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One iteration, to be jitted: the new state and its metrics, scalars under their TensorBoard tags.

    Args:
        env: the environment.
        config: the settings that the state was made with.
        state: before.
        domain: where new episodes draw theta from; None: all at the nominal one.
    """
    learner = catalogue.learner(env, config, state.mesh)
    key, collect_key, epochs_key = jax.random.split(state.key, 3)
    env_states, data = worlds.gather(learner, state, domain, collect_key)
    states, reward, more = _rewarded(learner, state, data, epochs_key)
    normalizer = transitions.statistics(config, state, data)
    batch = transitions.batch(learner, state, data | {"reward": reward}, normalizer)
    params, opt_state, rate, figures = losses.optimise(
        epochs_key, state.params, state.opt_state, state.learning_rate, batch, learner
    )
    after = dataclasses.replace(
        moved_on(config, state, env_states, data, key),
        params=params,
        opt_state=opt_state,
        normalizer=normalizer,
        learning_rate=rate,
        extensions=states,
    )
    metrics = {name: x.mean() for name, x in (figures | more).items()} | {
        "Loss/learning_rate": rate,
        # explained variance = 1 - var(R - V) / var(R)
        "Loss/explained_variance": 1 - (batch.returns - batch.value).var() / (batch.returns.var() + 1e-8),
        "Policy/mean_std": _spread(config, params, batch),
        "env_steps": after.env_steps,
        **episodes.metrics(after.episodes),
        **episodes.of_steps(data),
    }
    for extension in learner.extensions:
        shown = extension.metrics(states.get(extension.name), metrics, learner)
        metrics |= {tag: jnp.asarray(x, jnp.float32) for tag, x in shown.items()}
    return sharding.pinned(after, state.mesh, layout(after)), metrics


def _spread(config: PPOConfig, params: networks.Params, batch: Batch) -> jax.Array:
    """Mean standard deviation of raw actions: the new one, or before learning where it depends on the state."""
    alike = networks.log_std(params["actor"], networks.form(config))
    return actions.of(config).sd(batch.mean, batch.log_std if alike is None else alike).mean()  # type: ignore[arg-type]


@lru_cache(maxsize=32)
def make_update(env: Env, config: PPOConfig) -> Update:
    """update(state, domain) -> (state, metrics of scalars), one jitted program; the same one for the same arguments."""
    return program(lambda state, domain=None: update(env, config, state, domain), env)
