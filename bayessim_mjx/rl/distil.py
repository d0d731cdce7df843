"""Teacher and student: a policy learns the actions of another, which may see more, on its own rollouts.

As rsl_rl's distillation (after DAgger, Ross et al. 2011): the student acts, with noise; the teacher says what it would
have done. The training state is PPO's, so a student can be trained further by PPO.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import optax

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import actions, catalogue, episodes, losses, networks, normalise, ppo, recurrent, sharding, worlds
from bayessim_mjx.rl.networks import Params, Policy
from bayessim_mjx.rl.state import TrainState, policy_of

if TYPE_CHECKING:
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.env import Env

TAGS = (
    "Loss/behavior", "Loss/learning_rate", "Policy/grad_norm", "Policy/mean_std", "Train/mean_reward",
    "Train/mean_episode_length", "env_steps",
)  # fmt: skip


def teacher_group(env: Env) -> str:
    """Name the observation group that the teacher sees: "teacher" where there is one, else the student's."""
    return "teacher" if "teacher" in env.observation_size else "policy"


def loss(params: Params, observation: Any, target: jax.Array, config: PPOConfig) -> jax.Array:
    """Mean error of the student's deterministic action at normalised observations [B, S]; target [B, A].

    Of a student with a memory at `recurrent.Sequences` [B, T, S]; target [B, T, A].

    Squared, or Huber's with threshold 1. An action that will be clipped is compared before that: it must not be stuck.
    """
    mean = networks.mean_action(params, observation, networks.form(config), actions.of(config))
    action = networks.bounded(mean, config.action_clip, True) if config.action_bound == "tanh" else mean
    error = action - target
    return (optax.huber_loss(error) if config.distil_loss == "huber" else error**2).mean()


def update(
    env: Env, config: PPOConfig, state: TrainState, domain: Distribution | None, teacher: Policy
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One iteration, to be jitted: the student's rollout, the teacher's actions there, epochs of minibatches."""
    key, collect_key, epochs_key = jax.random.split(state.key, 3)
    learner, group = catalogue.learner(env, config, state.mesh), teacher_group(env)
    env_states, data = worlds.gather(learner, state, domain, collect_key, (group,))
    seen = data["observation"]["policy"]
    normalizer, observation = state.normalizer, seen
    if config.normalize_observations:  # learnt with the statistics that the student will act with
        normalizer = {**normalizer, "policy": normalise.update(normalizer["policy"], seen)}
        observation = normalise.normalise(normalizer["policy"], seen)
    target = teacher.act(None, data["observation"][group])
    if config.memory:
        steps = recurrent.Remembered(observation, data["observation"]["memory"])
        ended = jnp.maximum(data["terminated"], data["truncated"])
        batch = sharding.pinned((recurrent.sequences(steps, ended, config.gradient_length), target), state.mesh)
        batch = jax.tree.map(lambda x: x.swapaxes(0, 1), batch)
    else:
        batch = sharding.pinned((observation, target), state.mesh)
        batch = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), batch)

    def objective(params: Params, part: tuple[Any, jax.Array]) -> tuple[jax.Array, dict]:
        error = loss(params, *part, config)
        return error, {"Loss/behavior": error}

    params, opt_state, rate, figures = losses.descend(
        epochs_key, state.params, state.opt_state, state.learning_rate, batch, learner, objective
    )
    after = dataclasses.replace(
        ppo.moved_on(config, state, env_states, data, key), params=params, opt_state=opt_state, normalizer=normalizer
    )
    student, groups = policy_of(after), data["observation"] | {"policy": seen}
    metrics: dict[str, Any] = {name: x.mean() for name, x in figures.items()} | {
        "Loss/learning_rate": rate,
        "Policy/mean_std": student.law.sd(*student.distribution(groups)).mean(),
        "env_steps": after.env_steps,
        **episodes.metrics(after.episodes),
        **episodes.of_steps(data),
    }
    return sharding.pinned(after, state.mesh, ppo.layout(after)), metrics
