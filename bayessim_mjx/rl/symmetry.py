"""Mirror symmetry in PPO (Mittal et al. 2024): mirrored copies of the samples, and a loss on the policy's asymmetry."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.config import PPOConfig, SymmetryConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import MirrorMap, SignedPermutation
from bayessim_mjx.rl import actions, networks, normalise
from bayessim_mjx.rl.extension import Extension, Figures, Learner
from bayessim_mjx.rl.networks import Params
from bayessim_mjx.rl.segments import Batch
from bayessim_mjx.rl.state import TrainState

if TYPE_CHECKING:
    from bayessim_mjx.env import Env


NAME = "symmetry"


@struct.dataclass
class Copies:
    """K mirrored copies of B transitions, as the collecting policy would have seen and rated them itself."""

    observation: jax.Array  # [B, K, S] normalised
    critic_observation: jax.Array  # [B, K, S']
    action: jax.Array  # [B, K, A] raw
    log_prob: jax.Array  # [B, K] of the mirrored action at the mirrored observation: the policy need not be symmetric
    value: jax.Array  # [B, K]
    weight: jax.Array  # [B, K] up to 1: how much likelier the policy would have done this than its own original


def mirrors(env: Env, groups: Iterable[str]) -> tuple[MirrorMap, ...]:
    """Find the maps of the environment. UserError where it has none, or none for a group."""
    maps = tuple(getattr(env, "mirrors", ()))
    name = getattr(env, "name", "") or type(env).__name__
    if not maps:
        raise UserError(f"ppo.symmetry: {name} declares no mirror; set ppo.symmetry=null")
    for group in sorted(groups):
        if any(group not in m.observation for m in maps):
            known = ", ".join(sorted(maps[0].observation))
            raise UserError(f"ppo.symmetry: {name} has no mirror of the observation group {group!r}; it has {known}")
    return maps


def mirrored(x: jax.Array, part: SignedPermutation) -> jax.Array:
    """Mirror x [..., n]."""
    return x[..., part[0]] * part[1]


def images(x: jax.Array, parts: Sequence[SignedPermutation]) -> jax.Array:
    """All K mirror images of x [..., n], [..., K, n]."""
    return jnp.stack([mirrored(x, part) for part in parts], -2)


def augmented(batch: Batch) -> Batch:
    """Append the K copies to the B samples of a minibatch: B (1 + K). What is for KL and entropy stays B.

    A copy was drawn by the mirrored policy, so it counts by its weight p(M a | M s) / p(a | s),
    held at 1, it counts as if the policy itself had drawn it. Without, what a policy far from symmetric would never do
    drives it away (Ant: returns fell from 3000 to 1000).
    """
    copies = batch.extra[NAME]

    def join(name: str) -> jax.Array:
        own = getattr(batch, name)
        return jnp.concatenate([own, getattr(copies, name).reshape(-1, *own.shape[1:])])

    def again(x: jax.Array) -> jax.Array:
        return jnp.concatenate([x, jnp.repeat(x, copies.value.shape[1], axis=0)])

    names = ("observation", "critic_observation", "action", "log_prob", "value")
    both: dict[str, Any] = {name: join(name) for name in names}
    both |= {name: again(getattr(batch, name)) for name in ("advantage", "returns")}
    weight = jnp.concatenate([jnp.ones_like(batch.advantage), copies.weight.reshape(-1)])
    extra = {name: x for name, x in batch.extra.items() if name != NAME}
    return replace(batch, **both, weight=weight, extra=extra)


def mirror_loss(mean: jax.Array, mean_of_copies: jax.Array, actions: Sequence[SignedPermutation]) -> jax.Array:
    """Mean (mu(M o) - M mu(o))^2 over copies, samples and actions; no gradient through M mu(o).

    mean [B, A] at the observations, mean_of_copies [B, K, A] at their mirror images.
    """
    return ((mean_of_copies - jax.lax.stop_gradient(images(mean, actions))) ** 2).mean()


@dataclass(frozen=True)
class Symmetry(Extension):
    """`ppo.symmetry` as an extension of PPO."""

    settings: SymmetryConfig
    name: ClassVar[str] = NAME
    incompatible_with = SymmetryConfig.incompatible_with
    means = ("Loss/symmetry",)

    @classmethod
    def of(cls, config: PPOConfig) -> Symmetry | None:
        return None if config.symmetry is None else cls(config.symmetry)

    def check(self, learner: Learner) -> None:
        self._maps(learner)

    def _maps(self, learner: Learner) -> tuple[MirrorMap, ...]:
        return mirrors(learner.env, {"policy", learner.critic_group})

    def attach(
        self,
        state: TrainState,
        data: dict,
        normalizer: Mapping[str, normalise.Moments],
        log_prob: jax.Array,
        learner: Learner,
    ) -> Copies:
        """Mirror images [T, N, K, ...] of the collected transitions, as the collecting policy would have rated them."""
        maps, group, config = self._maps(learner), learner.critic_group, learner.config
        act, law = networks.form(config), actions.of(config)

        def seen(group: str, moments: Mapping[str, normalise.Moments]) -> jax.Array:
            raw = images(data["observation"][group], [m.observation[group] for m in maps])
            return normalise.normalise(moments[group], raw) if config.normalize_observations else raw

        observation, critic_observation = seen("policy", normalizer), seen(group, normalizer)
        action = images(data["extras"]["action"], [m.action for m in maps])
        collector = networks.distribution(state.params["actor"], seen("policy", state.normalizer), act)
        density = law.log_prob(*collector, action)
        value = networks.value(state.params, critic_observation, act)
        weight = jnp.exp(jnp.minimum(0.0, density - log_prob[..., None]))
        return Copies(observation, critic_observation, action, density, value, weight)

    def samples(self, batch: Batch) -> Batch:
        return augmented(batch) if self.settings.use_data_augmentation else batch

    def loss(
        self, params: Params, batch: Batch, means: jax.Array, learner: Learner
    ) -> tuple[jax.Array | None, Figures]:
        """Compute the mirror loss; mean actions at the copies are known already where these are samples too."""
        mean, copies = means[: len(batch.action)], batch.extra[NAME]
        if self.settings.use_data_augmentation:  # the copies are the first samples behind the batch
            mirrored = means[len(mean) : len(mean) * (1 + copies.value.shape[1])]
        else:
            act, law = networks.form(learner.config), actions.of(learner.config)
            mirrored = networks.mean_action(params, copies.observation, act, law)
        mirrored = mirrored.reshape(len(mean), -1, mean.shape[-1])
        asymmetry = mirror_loss(mean, mirrored, [mirror.action for mirror in self._maps(learner)])
        term = self.settings.mirror_loss_coeff * asymmetry if self.settings.use_mirror_loss else None
        return term, {"Loss/symmetry": asymmetry}
