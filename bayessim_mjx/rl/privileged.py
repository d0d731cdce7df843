"""Observations with the physics in them: theta is known in simulation, to a critic or to a policy that teaches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl.extension import Extension
from bayessim_mjx.rl.groups import size_of

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State


@lru_cache(maxsize=32)
def _knowing(env: Env, source: str, target: str, setting: str) -> Any:
    return ThetaSeen(env, source, target, setting)


def for_critic(env: Env) -> Any:
    """`env` whose group "critic" ends with theta; the same object for the same environment."""
    return _knowing(env, "critic" if "critic" in env.observation_size else "policy", "critic", "ppo.critic_theta")


def for_policy(env: Env) -> Any:
    """`env` whose group "policy" ends with theta."""
    return _knowing(env, "policy", "policy", "ppo.policy_theta")


def for_teacher(env: Env) -> Any:
    """`env` with a group "teacher": its "policy" with theta at the end."""
    return _knowing(env, "policy", "teacher", "ppo.teacher")


def teacher_knowing(env: Env) -> Any:
    """`env` whose group "teacher" ends with theta."""
    return _knowing(env, "teacher", "teacher", "ppo.teacher")


@dataclass(frozen=True)
class CriticTheta(Extension):
    """`ppo.critic_theta` as an extension of PPO."""

    name: ClassVar[str] = "critic_theta"

    @classmethod
    def of(cls, config: PPOConfig) -> CriticTheta | None:
        return cls() if config.critic_theta else None

    def shown(self, env: Env) -> Any:
        return for_critic(env)


class ThetaSeen:
    """An environment whose observation group `target` is its group `source` and theta, in [-1, 1] over its range.

    theta is kept in info["theta"]; all else is the environment's.

    Raises:
        UserError: naming `setting`, where there are no parameters.
    """

    def __init__(self, env: Env, source: str, target: str, setting: str) -> None:
        if not len(env.space):
            raise UserError(
                f"{setting}: there are no parameters to show; randomise some (task.randomization_params, --randomize)"
            )
        self.env, self.source, self.target = env, source, target
        low, high = (np.asarray(x, np.float32) for x in (env.space.low, env.space.high))
        self.middle = (low + high) / 2
        self.half = np.where(high > low, (high - low) / 2, 1).astype(np.float32)
        size = size_of(env, source) + len(env.space)
        self.observation_size = {**env.observation_size, target: (size,)}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Of the group "policy"."""
        return (*getattr(self.env, "observation_names", ()), *(self.env.space.names if self.target == "policy" else ()))

    def reset(self, key: jax.Array, theta: jax.Array | None = None, *course: Any) -> State:
        theta = jnp.asarray(self.env.space.nominal, jnp.float32) if theta is None else theta
        return self._show(self.env.reset(key, theta, *course), theta)

    def step(self, state: State, action: jax.Array) -> State:
        own = state
        if self.source == self.target:  # an environment may make its next observation of the last one
            whole = state.obs[self.target]
            own = state.replace(obs={**state.obs, self.target: whole[: whole.shape[0] - len(self.middle)]})
        return self._show(self.env.step(own, action), state.info["theta"])

    def _show(self, state: State, theta: jax.Array) -> State:
        def see(obs: dict[str, jax.Array]) -> dict[str, jax.Array]:
            return {**obs, self.target: jnp.concatenate([obs[self.source], (theta - self.middle) / self.half])}

        info = {**state.info, "theta": theta, "final_observation": see(state.info["final_observation"])}
        return state.replace(obs=see(state.obs), info=info)
