"""Actor and critic as multilayer perceptrons, apart or on one trunk; `actions` has the distributions of actions.

The parameters' structure says what they are: with neither "log_std" nor "std" the actor's last layer gives the spread
as well, and a critic of one "head" stands on the actor's hidden layers. What it does not say is in `Form`.
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
from bayessim_mjx.keys import branch
from bayessim_mjx.rl import actions, normalise, recurrent
from bayessim_mjx.rl.actions import bounded, entropy, kl, log_prob, log_slope, squashed_entropy
from bayessim_mjx.rl.normalise import Moments

__all__ = [
    "ACTIVATIONS", "Form", "Params", "Policy", "Sizes", "activation", "bounded", "distribution", "entropy", "form",
    "gaussian", "init", "kl", "log_prob", "log_slope", "log_std", "mean_action", "mlp", "mlp_init", "squashed_entropy",
    "value",
]  # fmt: skip

Params = dict[str, Any]
ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "elu": jax.nn.elu,
    "relu": jax.nn.relu,
    "selu": jax.nn.selu,
    "tanh": jnp.tanh,
    "swish": jax.nn.swish,
    "gelu": jax.nn.gelu,
    "celu": jax.nn.celu,
    "lrelu": jax.nn.leaky_relu,
    "mish": jax.nn.mish,
    "softplus": jax.nn.softplus,
    "sigmoid": jax.nn.sigmoid,
}
LOG_STD_LIMIT = 5.0  # of a spread that depends on the state: |log std| stays below it
LEAST_STD = 1e-6  # of a spread that is a parameter itself, without limits of its own


def activation(name: str) -> Callable[[jax.Array], jax.Array]:
    """Find the activation function called `name`; UserError listing the known ones."""
    if name not in ACTIVATIONS:
        raise UserError(f"ppo.activation = {name!r}: allowed are {', '.join(ACTIVATIONS)}")
    return ACTIVATIONS[name]


@dataclass(frozen=True)
class Form:
    """What the parameters' structure does not say. As a function: the activation."""

    activation: str = "elu"
    std_range: tuple[float, ...] = ()
    beta: bool = False
    half: bool = False

    def __call__(self, x: jax.Array) -> jax.Array:
        return activation(self.activation)(x)


def form(config: PPOConfig) -> Form:
    """Read the form of the networks from the settings."""
    return Form(config.activation, config.std_range, config.distribution == "beta", config.precision == "bfloat16")


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
    """Apply the perceptron to x [..., in] -> [..., out]; the last layer is linear.

    Of a `Form` of half precision, what a layer is given and what hidden ones give is bfloat16; the result is float32.
    """
    kind = jnp.bfloat16 if getattr(act, "half", False) else x.dtype
    x = x.astype(kind)
    for layer in layers[:-1]:
        x = act(x @ layer["w"].astype(kind) + layer["b"].astype(kind))
    last = layers[-1]
    return jnp.matmul(x, last["w"].astype(kind), preferred_element_type=last["w"].dtype) + last["b"]


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
    if config.std_type == "scalar":
        actor = {"layers": layers, "std": jnp.full(sizes.action, config.init_std)}
    if config.state_dependent_std or config.distribution == "beta":
        new = _spread if config.state_dependent_std else _second
        spread = new(branch(key, 2), layers[-1]["w"], config)
        joined = jax.tree.map(lambda mean, log_std: jnp.concatenate([mean, log_std], -1), layers[-1], spread)
        actor = {"layers": [*layers[:-1], joined]}
    if config.memory:
        memory_key = branch(key, 1)
        cell, count = config.memory_cell, config.memory_layers
        actor |= recurrent.stacked(memory_key, sizes.policy, config.memory, cell, count)
    return actor


def _second(key: jax.Array, like: jax.Array, config: PPOConfig) -> Params:
    """Make a Beta's other concentration: small outputs, as the first."""
    return mlp_init(key, like.shape, 0.01, config.weight_init)[0]


def _spread(key: jax.Array, like: jax.Array, config: PPOConfig) -> Params:
    """Make outputs for a spread that depends on the state: they begin at init_std, orthogonal weights everywhere."""
    bias = jnp.full(like.shape[-1], LOG_STD_LIMIT * np.arctanh(np.log(config.init_std) / LOG_STD_LIMIT))
    weights = jnp.zeros_like(like)
    if config.weight_init == "lecun_uniform":
        weights = jax.nn.initializers.lecun_uniform()(key, weights.shape)
    return {"w": weights, "b": bias}


def _trunk(actor: Params, x: Any) -> jax.Array:
    """Compute the input of the actor's layers at normalised observations x, of `recurrent` where it has a memory."""
    return recurrent.features(actor, x) if recurrent.kind(actor) else x


def log_std(actor: Params, act: Any) -> jax.Array | None:
    """Log standard deviation [A] where it is a parameter, within `std_range` of a `Form`; None elsewhere."""
    limits = getattr(act, "std_range", ())
    if "std" in actor:
        return jnp.log(actions.clamped(actor["std"], *(limits or (LEAST_STD, np.inf))))
    if "log_std" in actor:
        return actions.clamped(actor["log_std"], *np.log(limits)) if limits else actor["log_std"]
    return None


def gaussian(actor: Params, x: Any, act: Callable[[jax.Array], jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Mean [..., A] and log standard deviation ([A], or [..., A] where it depends on the state) at normalised x."""
    out, alike = mlp(actor["layers"], _trunk(actor, x), act), log_std(actor, act)
    if alike is not None:
        return out, alike
    mean, spread = jnp.split(out, 2, -1)
    spread = LOG_STD_LIMIT * jnp.tanh(spread / LOG_STD_LIMIT)
    limits = getattr(act, "std_range", ())
    return mean, actions.clamped(spread, *np.log(limits)) if limits else spread


def distribution(actor: Params, x: Any, form: Any) -> tuple[jax.Array, jax.Array]:
    """Compute the two parameters of the distribution of raw actions (`actions`) at normalised observations x."""
    if not getattr(form, "beta", False):
        return gaussian(actor, x, form)
    a, b = jnp.split(1 + jax.nn.softplus(mlp(actor["layers"], _trunk(actor, x), form)), 2, -1)
    return a, b


def mean_action(params: Params, x: Any, act: Callable[[jax.Array], jax.Array], law: actions.Law | None = None) -> Any:
    """Mean raw action, [..., A], at normalised observations x [..., S]; law None: of a Gaussian."""
    return (law or actions.Gaussian()).mean(*distribution(params["actor"], x, act))


def value(params: Params, x: Any, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """Compute the critic's value [...] at normalised observations x [..., S]."""
    if "head" in params["critic"]:
        actor = params["actor"]
        return mlp([*actor["layers"][:-1], *params["critic"]["head"]], _trunk(actor, x), act)[..., 0]
    return mlp(params["critic"]["layers"], x, act)[..., 0]


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
    std_range: tuple[float, ...] = struct.field(pytree_node=False, default=())
    beta: bool = struct.field(pytree_node=False, default=False)
    half: bool = struct.field(pytree_node=False, default=False)

    @property
    def law(self) -> actions.Law:
        """The distribution of its raw actions."""
        return actions.Beta(self.action_clip) if self.beta else actions.Gaussian(self.action_clip, self.squash)

    def _seen(self, obs: Mapping[str, jax.Array] | jax.Array) -> Any:
        """Compute the actor's input: normalised, with the memory where it has one."""
        x = jnp.asarray(obs["policy"] if isinstance(obs, Mapping) else obs)
        x = normalise.normalise(self.normalizer, x) if self.normalize else x
        if recurrent.kind(self.actor):
            assert isinstance(obs, Mapping), "a policy with a memory acts on groups of observations"
            return recurrent.Remembered(x, obs["memory"])
        return x

    def distribution(self, obs: Mapping[str, jax.Array] | jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean [..., A] and log sd ([A] or [..., A]) of the raw action; obs: groups, or "policy" alone.

        Of a Beta both concentrations.
        """
        return distribution(self.actor, self._seen(obs), Form(self.activation, self.std_range, self.beta, self.half))

    def carried(self, obs: Mapping[str, jax.Array] | jax.Array, action: jax.Array) -> jax.Array:
        """Append the memory after `obs` to the environment's action, where there is one."""
        if not recurrent.kind(self.actor):
            return action
        return jnp.concatenate([action, recurrent.memories(self.actor, self._seen(obs))], -1)

    def bounded(self, raw: jax.Array) -> jax.Array:
        """Clip a raw action to +- action_clip."""
        return actions.bounded(raw, self.action_clip, self.squash)

    def log_prob(self, obs: Mapping[str, jax.Array] | jax.Array, raw: jax.Array) -> jax.Array:
        """Log density [...] of the raw action [..., A]; where it is squashed, that of what the environment gets."""
        density = self.law.log_prob(*self.distribution(obs), raw)
        return density - log_slope(raw, self.action_clip) if self.squash else density

    def act(self, key: jax.Array | None, obs: Mapping[str, jax.Array] | jax.Array) -> jax.Array:
        """Choose actions [..., A] in +- action_clip: the mean if `key` is None, else a sample; a memory behind it."""
        found = self.distribution(obs)
        raw = self.law.mean(*found) if key is None else self.law.drawn(key, *found)
        return self.carried(obs, self.bounded(raw))

    def __call__(self, key: jax.Array | None, obs: Mapping[str, jax.Array] | jax.Array) -> jax.Array:
        return self.act(None if self.deterministic else key, obs)
