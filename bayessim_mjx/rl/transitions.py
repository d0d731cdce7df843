"""What was collected as a batch of transitions to learn from: statistics, values, advantages and returns, once."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import actions, networks, normalise, recurrent, segments, sharding
from bayessim_mjx.rl.extension import Learner
from bayessim_mjx.rl.gae import gae
from bayessim_mjx.rl.segments import Batch
from bayessim_mjx.rl.state import TrainState


def statistics(config: PPOConfig, state: TrainState, data: dict) -> dict[str, normalise.Moments]:
    """Those of the observations up to these: learnt with at once, as the policy will act with them.

    A policy that learns with the statistics that it was collected with acts with others than it learnt with, which
    costs most where they are still young (CartpoleBalance of Playground: twice the samples; benchmarks/history.md).
    """
    if not config.normalize_observations:
        return state.normalizer
    return {group: normalise.update(m, data["observation"][group]) for group, m in state.normalizer.items()}


def batch(learner: Learner, state: TrainState, data: dict, normalizer: dict[str, normalise.Moments]) -> Batch:
    """Flatten the collected [T, N] arrays to B = T N transitions with values, advantages and returns, computed once.

    With a memory as N sequences of T steps instead, with ppo.segment as B / L segments of L steps. Observations are
    normalised by `normalizer`; the actions' probabilities are those of the policy that acted, by the state's. KL counts
    from the policy that learning starts from: new statistics alone would slow an adaptive rate down.

    Args:
        learner: environment, settings and extensions.
        state: before the update.
        data: of `worlds.gather`, with the rewards that are learnt from.
        normalizer: of `statistics`.
    """
    config, group = learner.config, learner.critic_group
    act = networks.form(config)

    def seen(which: str, group: str) -> Any:
        x = data[which][group]
        return normalise.normalise(normalizer[group], x) if config.normalize_observations else x

    def valued(which: str) -> Any:
        x = seen(which, group)
        return recurrent.Remembered(x, data[which]["memory"]) if config.memory and config.shared_trunk else x

    observation, critic_observation = seen("observation", "policy"), valued("observation")
    value = networks.value(state.params, critic_observation, act)
    next_value = networks.value(state.params, valued("final_observation"), act)
    if config.memory:
        steps = recurrent.Remembered(observation, data["observation"]["memory"])
        ended = jnp.maximum(data["terminated"], data["truncated"])
        observation = recurrent.sequences(steps, ended, config.gradient_length)
        critic_observation = observation if config.shared_trunk else critic_observation
    reward = config.reward_scale * data["reward"]
    ends = (data["terminated"], data["truncated"])
    advantage, returns = gae(reward, value, next_value, *ends, config.gamma, config.gae_lambda)
    log_prob, mean, log_std = _densities(config, state, data, observation)
    whole = Batch(
        observation=observation,
        critic_observation=critic_observation,
        action=data["extras"]["action"],
        mean=mean,
        log_prob=log_prob,
        value=value,
        advantage=advantage,
        returns=returns,
        log_std=log_std,
        extra=_attached(learner, state, data, normalizer, log_prob),
    )
    if config.segment:
        future = segments.Future(reward, *ends, next_value, seen("final_observation", group))
        whole = dataclasses.replace(whole, future=segments.ended(future, config.segment))
    return _in_rows(learner, whole)


def _densities(
    config: PPOConfig, state: TrainState, data: dict, observation: Any
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Log-probability of the actions by the policy that took them; its mean and log sd at the observations as learnt.

    The log sd is None where it does not depend on the state.
    """
    action, mean, log_std = data["extras"]["action"], data["extras"]["mean"], data["extras"].get("log_std")
    actor, form = state.params["actor"], networks.form(config)
    spread = networks.log_std(actor, form) if log_std is None else log_std
    log_prob = actions.of(config).log_prob(mean, spread, action)  # type: ignore[arg-type]
    if config.normalize_observations:
        turned = partial(jax.tree.map, lambda x: x.swapaxes(0, 1) if config.memory else x)
        mean, spread = networks.distribution(actor, turned(observation), form)
        mean, log_std = turned((mean, None if log_std is None else spread))
    return log_prob, mean, log_std


def _attached(
    learner: Learner,
    state: TrainState,
    data: dict,
    normalizer: dict[str, normalise.Moments],
    log_prob: jax.Array,
) -> dict[str, Any]:
    """Collect what extensions send into minibatches with the transitions, by name."""
    found = {e.name: e.attach(state, data, normalizer, log_prob, learner) for e in learner.extensions}
    return {name: x for name, x in found.items() if x is not None}


def _in_rows(learner: Learner, whole: Batch) -> Batch:
    """Flatten the batch [T, N, ...] on every device to one leading axis: transitions, sequences or segments."""
    config = learner.config
    # where actor and critic see the same, it is sent to the devices once
    alike = learner.critic_group == "policy" and not config.memory
    whole = dataclasses.replace(whole, critic_observation=None) if alike else whole
    whole = sharding.pinned(whole, learner.mesh)  # minibatches are drawn from all worlds
    whole = dataclasses.replace(whole, critic_observation=whole.observation) if alike else whole
    if config.segment:
        return segments.cut(whole, config.segment)
    return jax.tree.map(lambda x: x.swapaxes(0, 1) if config.memory else x.reshape(-1, *x.shape[2:]), whole)
