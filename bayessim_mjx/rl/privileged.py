"""A critic that knows the physics: theta is known in simulation, and the actor does not see it."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State


@lru_cache(maxsize=32)
def knowing_theta(env: Env) -> Any:
    """`env` whose group "critic" ends with theta; the same object for the same environment."""
    return ThetaCritic(env)


class ThetaCritic:
    """An environment whose observation group "critic" is its own (or "policy") and theta, in [-1, 1] over its range.

    theta is kept in info["theta"]. All else is the environment's. UserError where it has no parameters.
    """

    def __init__(self, env: Env) -> None:
        if not len(env.space):
            raise UserError(
                "ppo.critic_theta = True: there are no parameters to show to the critic; randomise some "
                "(task.randomization_params, --randomize), or set it to False"
            )
        self.env = env
        low, high = (np.asarray(x, np.float32) for x in (env.space.low, env.space.high))
        self.middle = (low + high) / 2
        self.half = np.where(high > low, (high - low) / 2, 1).astype(np.float32)
        self.source = "critic" if "critic" in env.observation_size else "policy"
        size = env.observation_size[self.source][0] + len(env.space)
        self.observation_size = {**env.observation_size, "critic": (size,)}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        theta = jnp.asarray(self.env.space.nominal, jnp.float32) if theta is None else theta
        return self._show(self.env.reset(key, theta), theta)

    def step(self, state: State, action: jax.Array) -> State:
        return self._show(self.env.step(state, action), state.info["theta"])

    def _show(self, state: State, theta: jax.Array) -> State:
        def see(obs: dict[str, jax.Array]) -> dict[str, jax.Array]:
            return {**obs, "critic": jnp.concatenate([obs[self.source], (theta - self.middle) / self.half])}

        info = {**state.info, "theta": theta, "final_observation": see(state.info["final_observation"])}
        return state.replace(obs=see(state.obs), info=info)
