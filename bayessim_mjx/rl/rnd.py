"""Random network distillation (Burda et al. 2018): a reward where a predictor of a random network still errs.

Options and their meaning are rsl_rl's. Novelty is that of the observation *after* each step, before any reset, and the
predictor learns on the same observations: what ends an episode is as novel as it is, and does not stay so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh

from bayessim_mjx.config import PPOConfig, RNDConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.keys import branch
from bayessim_mjx.rl import episodes, losses, networks, normalise, sharding
from bayessim_mjx.rl.extension import Extension, Figures, Learner, Sizes
from bayessim_mjx.rl.sharding import FIRST

EPSILON = 1e-2  # added to the standard deviation of observations
UNTIL = 1e8  # samples after which the statistics stay as they are


@struct.dataclass
class RND:
    """All of it is saved and restored with the training state, the random target included."""

    target: list[networks.Params]  # never trained
    predictor: list[networks.Params]
    opt_state: Any  # Adam over the predictor
    states: normalise.Moments  # of the observations [S]
    sums: normalise.Moments  # [1] of the discounted sums of novelty
    discounted: jax.Array  # [N] discounted sum of novelty in each world, over all its episodes
    steps: jax.Array  # [] int32, control steps so far: the clock of the weight's schedule
    episodes: episodes.Episodes  # of the weighted novelty


def groups(sizes: Mapping[str, tuple[int, ...]], config: RNDConfig) -> tuple[str, ...]:
    """Choose the networks' observation groups from those in `sizes`: as set, else "rnd_state", else "policy"."""
    chosen = config.obs_groups or ("rnd_state" if "rnd_state" in sizes else "policy",)
    for group in chosen:
        if group not in sizes:
            raise UserError(f"ppo.rnd.obs_groups: no group {group!r}; the environment has {', '.join(sorted(sizes))}")
        if len(sizes[group]) != 1:
            raise UserError(f"ppo.rnd.obs_groups: {group!r} has shape {list(sizes[group])}: only vectors can be used")
    return chosen


def joined(obs: Mapping[str, jax.Array], chosen: Sequence[str]) -> jax.Array:
    """Join the chosen groups side by side, [..., S]."""
    return jnp.concatenate([obs[group] for group in chosen], -1)


def widths(size: int, hidden: Sequence[int], outputs: int) -> list[int]:
    """All widths of a network with `size` inputs; a hidden one of -1 is as wide as the input."""
    return [size, *(size if width == -1 else width for width in hidden), outputs]


def _mlp_init(key: jax.Array, sizes: Sequence[int]) -> list[networks.Params]:
    """Weights [in, out] and biases uniform within 1 / sqrt(in): a random function that is not odd."""

    def layer(key: jax.Array, n: int, m: int) -> networks.Params:
        w, b = jax.random.split(key)
        draw = lambda key, shape: jax.random.uniform(key, shape, minval=-(n**-0.5), maxval=n**-0.5)  # noqa: E731
        return {"w": draw(w, (n, m)), "b": draw(b, (m,))}

    return [layer(*args) for args in zip(jax.random.split(key, len(sizes) - 1), sizes[:-1], sizes[1:], strict=True)]


def init(key: jax.Array, size: int, partial: jax.Array, config: RNDConfig) -> RND:
    """Two random networks of `size` inputs, nothing seen yet; partial [N] as for `episodes.init`."""
    target_key, predictor_key = jax.random.split(key)
    predictor = _mlp_init(predictor_key, widths(size, config.predictor_hidden_dims, config.num_outputs))
    return RND(
        target=_mlp_init(target_key, widths(size, config.target_hidden_dims, config.num_outputs)),
        predictor=predictor,
        opt_state=optax.adam(config.learning_rate).init(predictor),
        states=normalise.init(size),
        sums=normalise.init(1),
        discounted=jnp.zeros_like(partial),
        steps=jnp.int32(0),
        episodes=episodes.init(partial),
    )


def weight(config: RNDConfig, step: jax.Array) -> jax.Array:
    """Compute the weight at control step `step` (from 1), in the units of ppo.rnd.weight."""
    schedule, start = config.weight_schedule, jnp.full(jnp.shape(step), config.weight, jnp.float32)
    if schedule is None or schedule.mode == "constant":
        return start
    last, end = schedule.final_value, schedule.final_step
    assert last is not None and end is not None  # the schedule's own check
    if schedule.mode == "step":
        return jnp.where(step < end, start, last)
    begin = schedule.initial_step
    assert begin is not None
    # w0 + (w1 - w0) (t - t0) / (t1 - t0) within [t0, t1]
    return start + (last - start) * jnp.clip((step - begin) / (end - begin), 0.0, 1.0)


def novelty(rnd: RND, x: jax.Array, config: RNDConfig) -> jax.Array:
    """|| target(x) - predictor(x) ||_2, [...], at normalised observations x [..., S]."""
    act = networks.activation(config.activation)
    return jnp.linalg.norm(networks.mlp(rnd.target, x, act) - networks.mlp(rnd.predictor, x, act), axis=-1)


def in_spreads(rnd: RND, values: jax.Array, gamma: float) -> tuple[RND, jax.Array]:
    """values [T, N] over the standard deviation of all their discounted sums so far; as they are while it is 0."""

    def step(carry: tuple[jax.Array, normalise.Moments], now: jax.Array) -> tuple[tuple, jax.Array]:
        # S_t = gamma S_{t-1} + r_t in each world; its moments are those over worlds and time
        total = gamma * carry[0] + now
        moments = normalise.update(carry[1], total[:, None], UNTIL)
        deviation = jnp.sqrt(moments.var[0])
        return (total, moments), now / jnp.where(deviation > 0, deviation, 1.0)

    (discounted, sums), out = jax.lax.scan(step, (rnd.discounted, rnd.sums), values)
    return replace(rnd, discounted=discounted, sums=sums), out


def reward(
    rnd: RND, obs: jax.Array, terminated: jax.Array, truncated: jax.Array, config: RNDConfig, dt: float, gamma: float
) -> tuple[RND, jax.Array, jax.Array]:
    """Compute (the state after the collection, the networks' observations, the reward [T, N]).

    The reward is weight(t) dt novelty: `weight` is per second, at every control step.

    Args:
        rnd: networks and statistics.
        obs: [T, N, S] after each step.
        terminated, truncated: [T, N].
        config: `ppo.rnd`.
        dt: control step in s.
        gamma: the learner's discount, also of the sums of novelty.
    """
    x = obs
    if config.state_normalization:
        rnd = replace(rnd, states=normalise.update(rnd.states, obs, UNTIL))
        x = normalise.normalise(rnd.states, obs, EPSILON, None)
    values = novelty(rnd, x, config)
    if config.reward_normalization:
        rnd, values = in_spreads(rnd, values, gamma)
    clock = rnd.steps + 1 + jnp.arange(obs.shape[0])
    values = (weight(config, clock) * dt)[:, None] * values
    finished = episodes.update(rnd.episodes, values, terminated, truncated)
    return replace(rnd, steps=rnd.steps + obs.shape[0], episodes=finished), x, values


def loss(predictor: list[networks.Params], rnd: RND, x: jax.Array, config: RNDConfig) -> jax.Array:
    """Mean squared error of the predictor at x [B, S], over samples and outputs."""
    act = networks.activation(config.activation)
    return ((networks.mlp(predictor, x, act) - networks.mlp(rnd.target, x, act)) ** 2).mean()


def train(
    key: jax.Array,
    rnd: RND,
    x: jax.Array,
    config: RNDConfig,
    epochs: int,
    minibatches: int,
    mesh: Mesh | None = None,
) -> tuple[RND, jax.Array]:
    """One Adam step of the predictor per minibatch, and the losses before them [epochs minibatches].

    Args:
        key: of the shuffles.
        rnd: networks.
        x: [B, S] as the networks see them.
        config: `ppo.rnd`.
        epochs: passes over x.
        minibatches: per pass.
        mesh: devices that share each minibatch; None: one.
    """
    optimiser = optax.adam(config.learning_rate)

    def step(carry: tuple[Any, Any], index: jax.Array) -> tuple[tuple[Any, Any], jax.Array]:
        predictor, opt_state = carry
        value, gradient = jax.value_and_grad(loss)(predictor, rnd, x[index], config)
        change, opt_state = optimiser.update(gradient, opt_state)
        return (optax.apply_updates(predictor, change), opt_state), value

    order = losses.minibatches(key, epochs, x.shape[0], minibatches, mesh)
    (predictor, opt_state), values = jax.lax.scan(step, (rnd.predictor, rnd.opt_state), order)
    return replace(rnd, predictor=predictor, opt_state=opt_state), values


def metrics(rnd: RND, extrinsic: jax.Array, config: RNDConfig) -> dict[str, jax.Array]:
    """Both rewards of an episode apart, in the task's units, and the present weight; extrinsic: the mean so far."""
    return {
        "Rnd/mean_extrinsic_reward": extrinsic,
        "Rnd/mean_intrinsic_reward": episodes.metrics(rnd.episodes)["Train/mean_reward"],
        "Rnd/weight": weight(config, rnd.steps),
    }


@dataclass(frozen=True)
class Novelty(Extension):
    """`ppo.rnd` as an extension of PPO."""

    settings: RNDConfig
    name: ClassVar[str] = "rnd"
    incompatible_with = RNDConfig.incompatible_with
    means = ("Loss/rnd",)
    latest = ("Rnd/mean_extrinsic_reward", "Rnd/mean_intrinsic_reward", "Rnd/weight")

    @classmethod
    def of(cls, config: PPOConfig) -> "Novelty | None":
        return None if config.rnd is None else cls(config.rnd)

    def groups(self, sizes: Mapping[str, tuple[int, ...]]) -> tuple[str, ...]:
        return groups(sizes, self.settings)

    def init(self, key: jax.Array, sizes: Sizes, config: PPOConfig) -> RND:
        size = sum(sizes.observation[group][0] for group in self.groups(sizes.observation))
        return init(branch(key, 1), size, sizes.partial, self.settings)

    def reward(self, own: RND, data: dict, key: jax.Array, learner: Learner) -> tuple[RND, jax.Array, Figures]:
        """Reward the novelty before the predictor learns the collected observations."""
        config, mesh = learner.config, learner.mesh
        after = joined(data["final_observation"], self.groups(learner.env.observation_size))
        ends = (data["terminated"], data["truncated"])
        own, x, bonus = reward(own, after, *ends, self.settings, learner.env.dt, config.gamma)
        x = sharding.pinned(x, mesh).reshape(-1, x.shape[-1])
        own, values = train(key, own, x, self.settings, config.num_epochs, config.num_minibatches, mesh)
        return own, bonus, {"Loss/rnd": values}

    def metrics(self, own: RND, figures: Figures, learner: Learner) -> Figures:
        return metrics(own, figures["Train/mean_reward"], self.settings)

    def layout(self, own: RND) -> Any:
        everywhere = super().layout(own)
        return replace(everywhere, discounted=FIRST, episodes=episodes.layout(everywhere.episodes))

    def in_worlds_of(self, own: RND, other: RND) -> RND:
        return replace(own, discounted=other.discounted, episodes=other.episodes)
