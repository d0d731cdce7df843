"""Actor and critic as multilayer perceptrons, apart or on one trunk; Gaussian actions, clipped or squashed by tanh.

A Gaussian acts on *raw* actions u; the environment gets clip(u, +- limit), or limit tanh(u) where it is squashed. The
parameters' structure says what they are: without "log_std" the actor's last layer gives the spread as well, and a
critic of one "head" stands on the actor's hidden layers.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import normalise, recurrent
from bayessim_mjx.rl.normalise import Moments

Params = dict[str, Any]
ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "elu": jax.nn.elu,
    "relu": jax.nn.relu,
    "selu": jax.nn.selu,
    "tanh": jnp.tanh,
    "swish": jax.nn.swish,
    "gelu": jax.nn.gelu,
}
HALF_LOG_2PI = 0.9189385332046727
LOG_STD_LIMIT = 5.0  # of a spread that depends on the state: |log std| stays below it
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(16)  # sum w f(x) = sqrt(2 pi) E f(x), x ~ N(0, 1)


def activation(name: str) -> Callable[[jax.Array], jax.Array]:
    """The activation function called `name`; UserError listing the known ones."""
    if name not in ACTIVATIONS:
        raise UserError(f"ppo.activation = {name!r}: allowed are {', '.join(ACTIVATIONS)}")
    return ACTIVATIONS[name]


def mlp_init(key: jax.Array, sizes: Sequence[int], last_gain: float, kind: str = "orthogonal") -> list[Params]:
    """Weights [in, out] and biases of zero; sizes: all widths.

    kind: orthogonal, with gain sqrt(2) (the last layer: `last_gain`), or lecun_uniform: uniform with variance 1 / in.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    gains = [2.0**0.5] * (len(sizes) - 2) + [last_gain]
    uniform = jax.nn.initializers.lecun_uniform()
    return [
        {
            "w": (uniform if kind == "lecun_uniform" else jax.nn.initializers.orthogonal(gain))(k, (n, m)),
            "b": jnp.zeros(m),
        }
        for k, gain, n, m in zip(keys, gains, sizes[:-1], sizes[1:], strict=True)
    ]


def mlp(layers: list[Params], x: jax.Array, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """The perceptron at x [..., in] -> [..., out]; the last layer is linear."""
    for layer in layers[:-1]:
        x = act(x @ layer["w"] + layer["b"])
    return x @ layers[-1]["w"] + layers[-1]["b"]


@dataclass(frozen=True)
class Sizes:
    """What the networks have to fit."""

    policy: int  # numbers that the actor sees
    critic: int
    action: int  # without a memory


def init(key: jax.Array, sizes: Sizes, config: PPOConfig) -> Params:
    """Parameters of both networks: widths, kind and first weights as the settings say.

    Orthogonal weights make the actor's last layer small: the first policy is nearly N(0, init_std^2).
    """
    actor_key, critic_key = jax.random.split(key)
    layers = functools.partial(mlp_init, kind=config.weight_init)
    actor = _actor(actor_key, sizes, config)
    if config.shared_trunk:
        return {"actor": actor, "critic": {"head": layers(critic_key, [config.hidden_actor[-1], 1], 1.0)}}
    return {"actor": actor, "critic": {"layers": layers(critic_key, [sizes.critic, *config.hidden_critic, 1], 1.0)}}


def _actor(key: jax.Array, sizes: Sizes, config: PPOConfig) -> Params:
    """Its layers, the spread of its actions, and a recurrent layer before all where there is a memory."""
    widths = [config.memory or sizes.policy, *config.hidden_actor, sizes.action]
    layers = mlp_init(key, widths, 0.01, config.weight_init)
    actor: Params = {"layers": layers, "log_std": jnp.full(sizes.action, jnp.log(config.init_std))}
    if config.state_dependent_std:
        spread = _spread(jax.random.fold_in(key, 2), layers[-1]["w"], config)
        joined = jax.tree.map(lambda mean, log_std: jnp.concatenate([mean, log_std], -1), layers[-1], spread)
        actor = {"layers": [*layers[:-1], joined]}
    if config.memory:
        memory_key = jax.random.fold_in(key, 1)
        actor[config.memory_cell] = recurrent.init(memory_key, sizes.policy, config.memory, config.memory_cell)
    return actor


def _spread(key: jax.Array, like: jax.Array, config: PPOConfig) -> Params:
    """Outputs for a spread that depends on the state: they begin at init_std, orthogonal weights everywhere."""
    bias = jnp.full(like.shape[-1], LOG_STD_LIMIT * np.arctanh(np.log(config.init_std) / LOG_STD_LIMIT))
    weights = jnp.zeros_like(like)
    if config.weight_init == "lecun_uniform":
        weights = jax.nn.initializers.lecun_uniform()(key, weights.shape)
    return {"w": weights, "b": bias}


def _trunk(actor: Params, x: Any) -> jax.Array:
    """What the actor's layers see of normalised observations x, of `recurrent` where it has a memory."""
    return recurrent.features(actor, x) if recurrent.kind(actor) else x


def gaussian(actor: Params, x: Any, act: Callable[[jax.Array], jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Mean [..., A] and log standard deviation ([A], or [..., A] where it depends on the state) at normalised x."""
    out = mlp(actor["layers"], _trunk(actor, x), act)
    if "log_std" in actor:
        return out, actor["log_std"]
    mean, spread = jnp.split(out, 2, -1)
    return mean, LOG_STD_LIMIT * jnp.tanh(spread / LOG_STD_LIMIT)


def mean_action(params: Params, x: Any, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """Mean of the policy's Gaussian, [..., A], at normalised observations x [..., S]."""
    return gaussian(params["actor"], x, act)[0]


def value(params: Params, x: Any, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """The critic's value [...] at normalised observations x [..., S]."""
    if "head" in params["critic"]:
        actor = params["actor"]
        return mlp([*actor["layers"][:-1], *params["critic"]["head"]], _trunk(actor, x), act)[..., 0]
    return mlp(params["critic"]["layers"], x, act)[..., 0]


def bounded(raw: jax.Array, limit: float, squash: bool) -> jax.Array:
    """What the environment gets of raw actions: within +- limit."""
    return limit * jnp.tanh(raw) if squash else jnp.clip(raw, -limit, limit)


def log_slope(raw: jax.Array, limit: float) -> jax.Array:
    """log |d a / d u| of a = limit tanh(u), summed over the last axis: log limit + 2 (log 2 - u - softplus(-2 u))."""
    return (jnp.log(limit) + 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))).sum(-1)


def log_prob(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """log N(action; mean, diag(std^2)), summed over the last axis."""
    z = (action - mean) * jnp.exp(-log_std)
    return -(0.5 * z**2 + log_std + HALF_LOG_2PI).sum(-1)


def entropy(log_std: jax.Array) -> jax.Array:
    """Entropy of the Gaussian in nats: sum over dimensions of log std + (1 + log 2 pi) / 2."""
    return (log_std + 0.5 + HALF_LOG_2PI).sum(-1)


def squashed_entropy(mean: jax.Array, log_std: jax.Array, limit: float) -> jax.Array:
    """Entropy of limit tanh(u), [...]: that of u plus E log |d a / d u|, by Gauss-Hermite quadrature."""
    nodes, weights = jnp.asarray(NODES, jnp.float32), jnp.asarray(WEIGHTS / WEIGHTS.sum(), jnp.float32)
    u = mean[..., None, :] + jnp.exp(log_std)[..., None, :] * nodes[:, None]  # [..., nodes, A]
    return entropy(log_std) + log_slope(u, limit) @ weights


def kl(mean: jax.Array, log_std: jax.Array, new_mean: jax.Array, new_log_std: jax.Array) -> jax.Array:
    """KL(old || new) of diagonal Gaussians, [...]; exactly 0 where they agree. Squashing both leaves it as it is.

    = sum 1/2 [ (r - 1 - log r) + ((mean - new_mean) / new_std)^2 ],  r = (std / new_std)^2
    """
    log_ratio = 2 * (log_std - new_log_std)
    distance = (mean - new_mean) * jnp.exp(-new_log_std)
    return 0.5 * (jnp.expm1(log_ratio) - log_ratio + distance**2).sum(-1)


@struct.dataclass
class Policy:
    """A trained policy: all that is needed to act, the normaliser included. Also a policy function (key, obs)."""

    actor: Params
    normalizer: Moments
    activation: str = struct.field(pytree_node=False, default="elu")
    normalize: bool = struct.field(pytree_node=False, default=True)
    action_clip: float = struct.field(pytree_node=False, default=1.0)
    deterministic: bool = struct.field(pytree_node=False, default=False)
    squash: bool = struct.field(pytree_node=False, default=False)

    def _seen(self, obs: Mapping[str, jax.Array] | jax.Array) -> Any:
        """What the actor sees: normalised, with the memory where it has one."""
        x = jnp.asarray(obs["policy"] if isinstance(obs, Mapping) else obs)
        x = normalise.normalise(self.normalizer, x) if self.normalize else x
        if recurrent.kind(self.actor):
            assert isinstance(obs, Mapping), "a policy with a memory acts on groups of observations"
            return recurrent.Remembered(x, obs["memory"])
        return x

    def distribution(self, obs: Mapping[str, jax.Array] | jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean [..., A] and log sd ([A] or [..., A]) of the raw action; obs: groups, or "policy" alone."""
        return gaussian(self.actor, self._seen(obs), activation(self.activation))

    def carried(self, obs: Mapping[str, jax.Array] | jax.Array, action: jax.Array) -> jax.Array:
        """The action for the environment: with the memory after `obs` behind it, where there is one."""
        if not recurrent.kind(self.actor):
            return action
        return jnp.concatenate([action, recurrent.memories(self.actor, self._seen(obs))], -1)

    def bounded(self, raw: jax.Array) -> jax.Array:
        """The action within +- action_clip of a raw one."""
        return bounded(raw, self.action_clip, self.squash)

    def log_prob(self, obs: Mapping[str, jax.Array] | jax.Array, raw: jax.Array) -> jax.Array:
        """Log density [...] of the raw action [..., A]; where it is squashed, that of what the environment gets."""
        density = log_prob(*self.distribution(obs), raw)
        return density - log_slope(raw, self.action_clip) if self.squash else density

    def act(self, key: jax.Array | None, obs: Mapping[str, jax.Array] | jax.Array) -> jax.Array:
        """Action [..., A] within +- action_clip: at the mean if `key` is None, else a sample; a memory behind it."""
        mean, log_std = self.distribution(obs)
        if key is not None:
            mean = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        return self.carried(obs, self.bounded(mean))

    def __call__(self, key: jax.Array | None, obs: Mapping[str, jax.Array] | jax.Array) -> jax.Array:
        return self.act(None if self.deterministic else key, obs)
