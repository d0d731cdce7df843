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
    from bayessim_mjx.parameters import ParameterSpace


@lru_cache(maxsize=32)
def _knowing(env: Env, source: str, target: str, setting: str, space: ParameterSpace | None = None) -> Any:
    return ThetaSeen(env, source, target, setting, space)


def for_critic(env: Env) -> Any:
    """`env` whose group "critic" ends with theta; the same object for the same environment."""
    return _knowing(env, "critic" if "critic" in env.observation_size else "policy", "critic", "ppo.critic_theta")


def for_policy(env: Env, space: ParameterSpace | None = None) -> Any:
    """`env` whose group "policy" ends with theta; space: that which the policy was trained with (None: `env`'s)."""
    return _knowing(env, "policy", "policy", "ppo.policy_theta", space)


def for_teacher(env: Env, space: ParameterSpace | None = None) -> Any:
    """`env` with a group "teacher": its "policy" with theta at the end; space: the teacher's (None: `env`'s)."""
    return _knowing(env, "policy", "teacher", "ppo.teacher", space)


def teacher_knowing(env: Env, space: ParameterSpace | None = None) -> Any:
    """`env` whose group "teacher" ends with theta; space: the teacher's (None: `env`'s)."""
    return _knowing(env, "teacher", "teacher", "ppo.teacher", space)


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
    """An environment whose observation group `target` is its group `source` and theta.

    The parameters are in the order of `space`, each in [-1, 1] over its range there. A policy that was trained with
    other ranges than `env`'s so sees a mass of 1 kg as it has learnt to. theta is kept in info["theta"]; all else is
    the environment's.

    Raises:
        UserError: naming `setting`, where there are no parameters, or `space` (None: `env`'s) has others than `env`.
    """

    def __init__(self, env: Env, source: str, target: str, setting: str, space: ParameterSpace | None = None) -> None:
        if not len(env.space):
            raise UserError(
                f"{setting}: there are no parameters to show; randomise some (task.randomization_params, --randomize)"
            )
        self.env, self.source, self.target = env, source, target
        self.space_seen, self.order = space or env.space, np.arange(len(env.space))
        if space is not None:
            if set(space.names) != set(env.space.names):
                theirs, ours = (", ".join(names) for names in (space.names, env.space.names))
                raise UserError(
                    f"{setting}: the policy was trained to see the parameters {theirs}, but here {ours} are "
                    "randomised; randomise the same (task.randomization_params, effects)"
                )
            self.order = np.array([env.space.index(name) for name in space.names])
        low, high = (np.asarray(x, np.float32) for x in (self.space_seen.low, self.space_seen.high))
        self.middle = (low + high) / 2
        self.half = np.where(high > low, (high - low) / 2, 1).astype(np.float32)
        size = size_of(env, source) + len(env.space)
        self.observation_size = {**env.observation_size, target: (size,)}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Of the group "policy"."""
        return (
            *getattr(self.env, "observation_names", ()),
            *(self.space_seen.names if self.target == "policy" else ()),
        )

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
            shown = (theta[self.order] - self.middle) / self.half
            return {**obs, self.target: jnp.concatenate([obs[self.source], shown])}

        info = {**state.info, "theta": theta, "final_observation": see(state.info["final_observation"])}
        return state.replace(obs=see(state.obs), info=info)
