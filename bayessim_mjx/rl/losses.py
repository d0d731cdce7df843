"""Proximal policy optimisation (Schulman et al. 2017): the losses, and the epochs of minibatches over one batch."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from bayessim_mjx.rl import actions, networks, segments, sharding
from bayessim_mjx.rl.extension import Learner
from bayessim_mjx.rl.networks import Params
from bayessim_mjx.rl.segments import Batch

MIN_LEARNING_RATE, MAX_LEARNING_RATE = 1e-5, 1e-2  # bounds of the adaptive schedule
RATE_FACTOR = 1.5
# transitions from which epochs are shuffled one after the other: a GPU sorts many numbers at once slower than each by
# itself (H200, five epochs of a million: 4.4 ms against 1.3; of 65 536: .36 against .86)
MANY = 200_000
FARTHEST = 3.0  # log of the ratio of probabilities beyond which it goes on in a line


def surrogate_loss(
    log_prob: jax.Array, old_log_prob: jax.Array, advantage: jax.Array, clip: float, weight: jax.Array | None = None
) -> jax.Array:
    """Clipped surrogate: mean max(-A ratio, -A clip(ratio, 1 +- clip)), ratio = pi_new / pi_old; arrays [B].

    weight: of the samples in the mean.

    Beyond e^FARTHEST a ratio grows in a line, with the slope that it has there: what is worse than expected keeps its
    gradient however likely it became, and one such sample makes neither the loss nor its gradient infinite.
    """
    change = log_prob - old_log_prob
    ratio = jnp.exp(jnp.minimum(change, FARTHEST)) * (1.0 + jnp.maximum(change - FARTHEST, 0.0))
    losses = jnp.maximum(-advantage * ratio, -advantage * jnp.clip(ratio, 1 - clip, 1 + clip))
    return losses.mean() if weight is None else (weight * losses).sum() / weight.sum()


def value_loss(value: jax.Array, old_value: jax.Array, returns: jax.Array, clip: float | None) -> jax.Array:
    """Mean squared error of the critic, [B] each; the worse of it and that of the value within +- clip of the old."""
    error = (value - returns) ** 2
    if clip is None:
        return error.mean()
    clipped = old_value + jnp.clip(value - old_value, -clip, clip)
    return jnp.maximum(error, (clipped - returns) ** 2).mean()


def standardise(x: jax.Array) -> jax.Array:
    """Zero mean, unit standard deviation."""
    return (x - x.mean()) / (x.std() + 1e-8)


def loss(params: Params, old_log_std: Any, batch: Batch, learner: Learner) -> tuple[jax.Array, dict]:
    """Surrogate + c_v value loss - c_e entropy + the terms of extensions, and the figures of this minibatch.

    KL is of old || new, analytic; it, the entropy and the clip fraction are of the batch's own samples, not of those
    that extensions add.

    Args:
        params: actor and critic.
        old_log_std: [A] of the collecting policy; not used where the batch has its own.
        batch: a minibatch.
        learner: settings and extensions.
    """
    config, known = learner.config, None
    if config.segment:
        batch, known = segments.renewed(params, batch, config)
    act, law, size = networks.form(config), actions.of(config), batch.advantage.shape[0]
    if config.normalize_advantage_per_minibatch:
        batch = dataclasses.replace(batch, advantage=standardise(batch.advantage))
    samples = batch
    for extension in learner.extensions:
        samples = extension.samples(samples)
    means, log_stds = networks.distribution(params["actor"], samples.observation, act)
    log_prob = law.log_prob(means, log_stds, samples.action)  # of raw actions: tanh's slope cancels in the ratio
    surrogate = surrogate_loss(log_prob, samples.log_prob, samples.advantage, config.clip_param, samples.weight)
    value = value_loss(
        networks.value(params, samples.critic_observation, act) if known is None or samples is not batch else known,
        samples.value,
        samples.returns,
        config.clip_param if config.use_clipped_value_loss else None,
    )
    mean, log_std = means[:size], log_stds if log_stds.ndim == 1 else log_stds[:size]
    old = old_log_std if batch.log_std is None else batch.log_std
    entropy = law.entropy(mean, log_std).mean()
    metrics = {
        "Loss/surrogate": surrogate,
        "Loss/value": value,
        "Loss/entropy": entropy,
        "Loss/kl": law.kl(batch.mean, old, mean, log_std).mean(),
        "Loss/clip_fraction": (jnp.abs(jnp.exp(log_prob[:size] - batch.log_prob) - 1) > config.clip_param).mean(),
    }
    total = surrogate + config.value_loss_coef * value - config.entropy_coef * entropy
    for extension in learner.extensions:
        term, figures = extension.loss(params, batch, law.mean(means, log_stds), learner)
        total, metrics = total if term is None else total + term, metrics | figures
    return total, metrics


def adapt(learning_rate: jax.Array, kl: jax.Array, desired_kl: float) -> jax.Array:
    """Down by 1.5 where the policy moved too far (KL > 2 desired), up where it hardly moved (0 < KL < desired / 2)."""
    down = jnp.maximum(MIN_LEARNING_RATE, learning_rate / RATE_FACTOR)
    up = jnp.minimum(MAX_LEARNING_RATE, learning_rate * RATE_FACTOR)
    rate = jnp.where((kl > 0) & (kl < desired_kl / 2), up, learning_rate)
    return jnp.where(kl > 2 * desired_kl, down, rate)


def clip_norm(gradient: jax.Array, limit: float) -> tuple[jax.Array, jax.Array]:
    """Scale the flat gradient down to the norm `limit` where it is longer; return it and its norm before."""
    norm = jnp.linalg.norm(gradient)
    return gradient * jnp.minimum(1.0, limit / (norm + 1e-6)), norm


def minibatches(key: jax.Array, epochs: int, size: int, count: int, mesh: Mesh | None = None) -> jax.Array:
    """Draw indices [epochs * count, size // count]: a fresh permutation of all `size` transitions in each epoch.

    A remainder is left out at the end of each permutation, so a different one in each epoch. Devices of a mesh share
    every minibatch; the minibatches are those of one device.
    """
    shuffle, keys = partial(jax.random.permutation, x=size), jax.random.split(key, epochs)
    order = jax.vmap(shuffle)(keys) if size < MANY else jax.lax.map(shuffle, keys)
    order = order[:, : size - size % count].reshape(epochs * count, size // count)
    return sharding.pinned(order, mesh, sharding.SECOND)


def optimiser_init(params: Params) -> optax.OptState:
    """State of Adam over the flattened parameters (one vector: a few kernels per step instead of one set per layer)."""
    return optax.scale_by_adam().init(ravel_pytree(params)[0])


def optimise(
    key: jax.Array,
    params: Params,
    opt_state: optax.OptState,
    learning_rate: jax.Array,
    batch: Batch,
    learner: Learner,
) -> tuple[Params, optax.OptState, jax.Array, dict[str, jax.Array]]:
    """All epochs of minibatches: new parameters, Adam state, learning rate, and figures [epochs * minibatches] each.

    Args:
        key: of the shuffles.
        params: actor and critic.
        opt_state: of `optimiser_init`, or of the last call.
        learning_rate: [] at the start.
        batch: all that was collected.
        learner: settings and extensions.
    """
    old_log_std = networks.log_std(params["actor"], networks.form(learner.config))
    if not learner.config.normalize_advantage_per_minibatch:
        batch = dataclasses.replace(batch, advantage=standardise(batch.advantage))

    def objective(params: Params, part: Batch) -> tuple[jax.Array, dict]:
        return loss(params, old_log_std, part, learner)

    return descend(key, params, opt_state, learning_rate, batch, learner, objective)


def descend(
    key: jax.Array,
    params: Params,
    opt_state: optax.OptState,
    learning_rate: jax.Array,
    batch: Any,
    learner: Learner,
    objective: Callable[[Params, Any], tuple[jax.Array, dict]],
) -> tuple[Params, optax.OptState, jax.Array, dict[str, jax.Array]]:
    """Adam on objective(params, minibatch) -> (loss, figures) over all epochs of minibatches; returns as `optimise`.

    The rate adapts to the figure "Loss/kl" where there is one and ppo.schedule says so.

    Args:
        key, params, opt_state, learning_rate: as for `optimise`.
        batch: a pytree of arrays with one leading axis.
        learner: epochs, minibatches and the schedule of the rate; the devices that share each minibatch.
        objective: pure.
    """
    config = learner.config
    flat, unravel = ravel_pytree(params)
    size = jax.tree.leaves(batch)[0].shape[0]
    order = minibatches(key, config.num_epochs, size, config.num_minibatches, learner.mesh)

    def step(carry: tuple[Any, Any, Any], now: tuple[jax.Array, jax.Array]) -> tuple[Any, dict]:
        flat, opt_state, rate = carry
        number, index = now
        part = jax.tree.map(lambda x: x[index], batch)
        gradient, metrics = jax.grad(lambda p: objective(unravel(p), part), has_aux=True)(flat)
        if (
            config.schedule == "adaptive" and "Loss/kl" in metrics
        ):  # nothing has moved before the first minibatch: its KL is rounding noise
            rate = jnp.where(number > 0, adapt(rate, metrics["Loss/kl"], config.desired_kl), rate)
        gradient, norm = clip_norm(gradient, config.max_grad_norm)
        direction, opt_state = optax.scale_by_adam().update(gradient, opt_state)
        metrics |= {"Policy/grad_norm": norm, "Loss/learning_rate": rate}
        return (flat - rate * direction, opt_state, rate), metrics

    start = (flat, opt_state, learning_rate)
    (flat, opt_state, rate), metrics = jax.lax.scan(step, start, (jnp.arange(order.shape[0]), order))
    return unravel(flat), opt_state, rate, metrics
