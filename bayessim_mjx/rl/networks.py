"""Actor and critic: two plain multilayer perceptrons, and a Gaussian whose spread does not depend on the state."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import normalise
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


def activation(name: str) -> Callable[[jax.Array], jax.Array]:
    """The activation function called `name`; UserError listing the known ones."""
    if name not in ACTIVATIONS:
        raise UserError(f"ppo.activation = {name!r}: allowed are {', '.join(ACTIVATIONS)}")
    return ACTIVATIONS[name]


def mlp_init(key: jax.Array, sizes: Sequence[int], last_gain: float) -> list[Params]:
    """Weights [in, out] orthogonal with gain sqrt(2) (the last layer: `last_gain`), biases zero; sizes: all widths."""
    keys = jax.random.split(key, len(sizes) - 1)
    gains = [2.0**0.5] * (len(sizes) - 2) + [last_gain]
    return [
        {"w": jax.nn.initializers.orthogonal(gain)(k, (n, m)), "b": jnp.zeros(m)}
        for k, gain, n, m in zip(keys, gains, sizes[:-1], sizes[1:], strict=True)
    ]


def mlp(layers: list[Params], x: jax.Array, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """The perceptron at x [..., in] -> [..., out]; the last layer is linear."""
    for layer in layers[:-1]:
        x = act(x @ layer["w"] + layer["b"])
    return x @ layers[-1]["w"] + layers[-1]["b"]


def init(
    key: jax.Array,
    observation_size: int,
    critic_size: int,
    action_size: int,
    hidden_actor: Sequence[int],
    hidden_critic: Sequence[int],
    init_std: float,
) -> Params:
    """Parameters of both networks. The actor's last layer is small: the first policy is nearly N(0, init_std^2)."""
    actor_key, critic_key = jax.random.split(key)
    return {
        "actor": {
            "layers": mlp_init(actor_key, [observation_size, *hidden_actor, action_size], 0.01),
            "log_std": jnp.full(action_size, jnp.log(init_std)),
        },
        "critic": {"layers": mlp_init(critic_key, [critic_size, *hidden_critic, 1], 1.0)},
    }


def mean_action(params: Params, x: jax.Array, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """Mean of the policy's Gaussian, [..., A], at normalised observations x [..., S]."""
    return mlp(params["actor"]["layers"], x, act)


def value(params: Params, x: jax.Array, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """The critic's value [...] at normalised observations x [..., S]."""
    return mlp(params["critic"]["layers"], x, act)[..., 0]


def log_prob(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """log N(action; mean, diag(std^2)), summed over the last axis."""
    z = (action - mean) * jnp.exp(-log_std)
    return -(0.5 * z**2 + log_std + HALF_LOG_2PI).sum(-1)


def entropy(log_std: jax.Array) -> jax.Array:
    """Entropy of the Gaussian in nats: sum over dimensions of log std + (1 + log 2 pi) / 2."""
    return (log_std + 0.5 + HALF_LOG_2PI).sum(-1)


def kl(mean: jax.Array, log_std: jax.Array, new_mean: jax.Array, new_log_std: jax.Array) -> jax.Array:
    """KL(old || new) of diagonal Gaussians, [...]; exactly 0 where they agree.

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

    def distribution(self, obs: Mapping[str, jax.Array] | jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean [..., A] and log standard deviation [A] of the unclipped action; obs: groups, or "policy" alone."""
        x = jnp.asarray(obs["policy"] if isinstance(obs, Mapping) else obs)
        x = normalise.normalise(self.normalizer, x) if self.normalize else x
        return mlp(self.actor["layers"], x, activation(self.activation)), self.actor["log_std"]

    def act(self, key: jax.Array | None, obs: Mapping[str, jax.Array] | jax.Array) -> jax.Array:
        """Action [..., A] within +- action_clip: the mean if `key` is None, else a sample."""
        mean, log_std = self.distribution(obs)
        if key is not None:
            mean = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        return jnp.clip(mean, -self.action_clip, self.action_clip)

    def __call__(self, key: jax.Array | None, obs: Mapping[str, jax.Array] | jax.Array) -> jax.Array:
        return self.act(None if self.deterministic else key, obs)
