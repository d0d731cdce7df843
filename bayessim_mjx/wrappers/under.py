"""An environment of ours whose `reset(key)` draws its own physics, for trainers that know no theta."""

from typing import Any

import jax
import mujoco

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env, State
from bayessim_mjx.parameters import ParameterSpace


class Under(Env):
    """`env` under `domain`: a reset without theta draws it (domain None: the nominal one).

    In its own resets all schedules are over. `wrappers.fresh.wrap` begins them at its first reset, but where
    `schedules_over`, as evaluations want it.
    """

    def __init__(self, env: Env, domain: Distribution | None, schedules_over: bool = False) -> None:
        self.env, self.domain, self.schedules_over = env, domain, schedules_over
        self.name, self.episode_length = env.name, env.episode_length
        self.mirrors, self.nuisance = env.mirrors, env.nuisance

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        if theta is None and self.domain is not None:
            key, theta_key = jax.random.split(key)
            theta = self.domain.sample(theta_key, 1)[0]
        return self.env.reset(key, theta)

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step(state, action)

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def dt(self) -> float:
        return self.env.dt

    @property
    def space(self) -> ParameterSpace:
        return self.env.space

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self.env.mj_model

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)
