"""Observation groups by name for each network: what rsl_rl calls `obs_groups`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl.extension import Extension

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State


def size_of(env: Env, group: str) -> int:
    """Numbers in an observation group.

    Raises:
        UserError: it is no vector but a picture, say: the networks here have no convolutions.
    """
    shape = env.observation_size[group]
    if len(shape) != 1:
        raise UserError(
            f"observation group {group!r} has shape {list(shape)}: our networks take vectors; flatten it in the task, "
            "or train with another library's convolutions (docs/trainers.md, Pictures)"
        )
    return shape[0]


@lru_cache(maxsize=32)
def shown(env: Env, target: str, groups: tuple[str, ...]) -> Any:
    """`env` whose group `target` is its `groups`, one after the other; the same object for the same arguments."""
    return Grouped(env, target, groups)


def for_policy(env: Env, groups: tuple[str, ...]) -> Any:
    """`env` for an actor that sees `groups` (`ppo.actor_groups`)."""
    return shown(env, "policy", groups) if groups else env


@dataclass(frozen=True)
class CriticGroups(Extension):
    """`ppo.critic_groups` as an extension of PPO."""

    seen: tuple[str, ...]
    name: ClassVar[str] = "critic_groups"

    @classmethod
    def of(cls, config: PPOConfig) -> CriticGroups | None:
        return cls(config.critic_groups) if config.critic_groups else None

    def shown(self, env: Env) -> Any:
        return shown(env, "critic", self.seen)


class Grouped:
    """An environment whose observation group `target` is made of others; all else is the environment's.

    The environment goes on with its own observations, which are kept under their names with a leading underscore.

    Raises:
        UserError: a group that there is not.
    """

    def __init__(self, env: Env, target: str, groups: tuple[str, ...]) -> None:
        self.env, self.target, self.groups = env, target, groups
        sizes = env.observation_size
        for name in groups:
            if name not in sizes:
                setting = "actor_groups" if target == "policy" else "critic_groups"
                raise UserError(
                    f"ppo.{setting} = {list(groups)}: no group {name!r}; there are {', '.join(sorted(sizes))}"
                )
        kept = {f"_{target}": sizes[target]} if target in sizes else {}
        self.observation_size = {**sizes, **kept, target: (sum(size_of(env, name) for name in groups),)}
        self.actor_groups = groups if target == "policy" else getattr(env, "actor_groups", ())

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Of the group "policy"."""
        own = tuple(getattr(self.env, "observation_names", ()))
        if self.target != "policy":
            return own
        sizes = self.env.observation_size
        names = {g: own if g == "policy" and own else _numbered(g, sizes[g][0]) for g in self.groups}
        return tuple(name for g in self.groups for name in names[g])

    def reset(self, key: jax.Array, theta: jax.Array | None = None, *course: Any) -> State:
        return self._show(self.env.reset(key, theta, *course))

    def step(self, state: State, action: jax.Array) -> State:
        obs, own = dict(state.obs), f"_{self.target}"
        obs |= {self.target: obs.pop(own)} if own in obs else {}
        return self._show(self.env.step(state.replace(obs=obs), action))

    def _show(self, state: State) -> State:
        def see(obs: dict[str, jax.Array]) -> dict[str, jax.Array]:
            kept = {f"_{self.target}": obs[self.target]} if self.target in obs else {}
            return {**obs, **kept, self.target: jnp.concatenate([obs[name] for name in self.groups])}

        info = {**state.info, "final_observation": see(state.info["final_observation"])}
        return state.replace(obs=see(state.obs), info=info)


def _numbered(group: str, size: int) -> tuple[str, ...]:
    return tuple(f"{group}_{i}" for i in range(size))
