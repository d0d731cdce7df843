"""One batch as the losses see it, and advantages over segments of a few steps that every minibatch estimates anew.

With the critic of that moment, as Brax does. The critic that collected is a whole update old at the last minibatch; and
a short segment rests on the critic after a few steps, where rewards summed up further vary more. Measured on ant:
benchmarks/history.md.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import networks
from bayessim_mjx.rl.gae import gae


@struct.dataclass
class Future:
    """What advantages are made of besides values, for S segments of L steps."""

    reward: jax.Array  # [S, L] with its scale, and the bonus for novelty
    terminated: jax.Array  # [S, L]
    truncated: jax.Array  # [S, L]
    next_value: jax.Array  # [S, L] of the true next observation, by the critic that collected
    last: jax.Array  # [S, S'] true next observation of the critic after the last step


def ended(future: Future, length: int) -> Future:
    """Time-major arrays [T, N, ...] with the observations `last` of segments' ends alone, [T / length, N, S']."""
    return dataclasses.replace(future, last=future.last[length - 1 :: length])


def cut(batch: Any, length: int) -> Any:
    """Time-major arrays [T, N, ...] of a batch, its future `ended` -> segments [T / length * N, length, ...]."""

    def segmented(x: jax.Array) -> jax.Array:
        steps, worlds = x.shape[:2]
        return x.reshape(steps // length, length, worlds, *x.shape[2:]).swapaxes(1, 2).reshape(-1, length, *x.shape[2:])

    last = batch.future.last
    batch = jax.tree.map(segmented, dataclasses.replace(batch, future=dataclasses.replace(batch.future, last=None)))
    last = last.reshape(-1, last.shape[-1])
    return dataclasses.replace(batch, future=dataclasses.replace(batch.future, last=last))


def renewed(params: networks.Params, batch: Any, config: PPOConfig) -> tuple[Any, jax.Array]:
    """Make S L transitions of the segments [S, L, ...], advantages and returns by the critic `params`; and its values.

    Inside a segment the next value is that of the next observation seen, but the one from the collection where an
    episode is cut off: the true next observation is then not the next one seen. No gradient flows through advantages
    and returns; the values [S L] are those to learn from, so that the critic is evaluated once.
    """
    act, future = networks.form(config), batch.future
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), dataclasses.replace(batch, future=None))
    values, last = (networks.value(params, x, act) for x in (flat.critic_observation, future.last))
    value = jax.lax.stop_gradient(values).reshape(future.reward.shape)
    following = jnp.concatenate([value[:, 1:], last[:, None]], 1)
    following = jnp.where(future.truncated > 0, future.next_value, following)
    ends = (future.terminated.T, future.truncated.T)
    estimates = gae(future.reward.T, value.T, following.T, *ends, config.gamma, config.gae_lambda, config.segment)
    advantage, returns = (jax.lax.stop_gradient(x.T).reshape(-1) for x in estimates)
    return dataclasses.replace(flat, advantage=advantage, returns=returns), values


@struct.dataclass
class Batch:
    """B transitions; observations normalised by statistics that include them."""

    observation: jax.Array  # [B, S]
    critic_observation: Any  # [B, S'] array
    action: jax.Array  # [B, A] unclipped sample
    mean: jax.Array  # [B, A] of the policy before learning
    log_prob: jax.Array  # [B] by the policy that collected: with older statistics
    value: jax.Array  # [B]
    advantage: jax.Array  # [B]
    returns: jax.Array  # [B]
    log_std: jax.Array | None = None  # [B, A] like the mean, where it depends on the state
    extra: dict[str, Any] = struct.field(default_factory=dict)  # by extension: what it attached, [B, ...]
    weight: jax.Array | None = None  # [B] in the surrogate's mean, where an extension gave some
    future: Future | None = None  # where ppo.segment is: all arrays are then segments [B / L, L, ...]
