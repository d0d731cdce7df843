"""Mirror symmetry in PPO (Mittal et al. 2024): mirrored copies of the samples, and a loss on the policy's asymmetry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import MirrorMap, SignedPermutation

if TYPE_CHECKING:
    from bayessim_mjx.env import Env


@struct.dataclass
class Copies:
    """K mirrored copies of B transitions, as the collecting policy would have seen and rated them itself."""

    observation: jax.Array  # [B, K, S] normalised
    critic_observation: jax.Array  # [B, K, S']
    action: jax.Array  # [B, K, A] raw
    log_prob: jax.Array  # [B, K] of the mirrored action at the mirrored observation: the policy need not be symmetric
    value: jax.Array  # [B, K]
    weight: jax.Array  # [B, K] up to 1: how much likelier the policy would have done this than its own original


def mirrors(env: Env, config: PPOConfig, groups: Iterable[str]) -> tuple[MirrorMap, ...]:
    """The maps of the environment; none where ppo.symmetry is off. UserError where it has none, or none for a group."""
    if config.symmetry is None:
        return ()
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
    """The mirror image of x [..., n]."""
    return x[..., part[0]] * part[1]


def images(x: jax.Array, parts: Sequence[SignedPermutation]) -> jax.Array:
    """All K mirror images of x [..., n], [..., K, n]."""
    return jnp.stack([mirrored(x, part) for part in parts], -2)


def augmented(batch: Any) -> Any:
    """The B samples of a minibatch and behind them their K copies: B (1 + K). What is for KL and entropy stays B.

    A copy was drawn by the mirrored policy, which tells how often it occurs: by its weight p(M a | M s) / p(a | s),
    held at 1, it counts as if the policy itself had drawn it. Without, what a policy far from symmetric would never do
    drives it away (Ant: returns fell from 3000 to 1000).
    """
    copies = batch.copies

    def join(name: str) -> jax.Array:
        own = getattr(batch, name)
        return jnp.concatenate([own, getattr(copies, name).reshape(-1, *own.shape[1:])])

    def again(x: jax.Array) -> jax.Array:
        return jnp.concatenate([x, jnp.repeat(x, copies.value.shape[1], axis=0)])

    both = {name: join(name) for name in ("observation", "critic_observation", "action", "log_prob", "value")}
    both |= {name: again(getattr(batch, name)) for name in ("advantage", "returns")}
    weight = jnp.concatenate([jnp.ones_like(batch.advantage), copies.weight.reshape(-1)])
    return batch.replace(**both, weight=weight, copies=None)


def mirror_loss(mean: jax.Array, mean_of_copies: jax.Array, actions: Sequence[SignedPermutation]) -> jax.Array:
    """Mean (mu(M o) - M mu(o))^2 over copies, samples and actions; no gradient through M mu(o).

    mean [B, A] at the observations, mean_of_copies [B, K, A] at their mirror images.
    """
    return ((mean_of_copies - jax.lax.stop_gradient(images(mean, actions))) ** 2).mean()
