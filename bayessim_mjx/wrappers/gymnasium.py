"""Our environments as `gymnasium.Env` (one world) and `gymnasium.vector.VectorEnv` (many worlds, resets themselves)."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from bayessim_mjx.env import Env
from bayessim_mjx.rollout import select


def _spaces(env: Env) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    (size,) = env.observation_size["policy"]
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


class GymnasiumEnv(gymnasium.Env):
    """One world; observations are the group "policy". `reset(options={"theta": [d]})` sets theta from then on."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, env: Env, theta: Any = None) -> None:
        self.env = env
        self.observation_space, self.action_space = _spaces(env)
        self._theta = jnp.asarray(env.space.nominal if theta is None else theta, jnp.float32)
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        if options and "theta" in options:
            self._theta = jnp.asarray(options["theta"], jnp.float32)
        key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self._state = self._reset(key, self._theta)
        return np.array(self._state.obs["policy"]), {"theta": np.array(self._theta)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self._state is None:
            raise ValueError("step before reset: call reset() first")
        self._state = self._step(self._state, jnp.asarray(action, jnp.float32))
        info = self._state.info
        metrics = {name: float(value) for name, value in self._state.metrics.items()}
        observation = np.array(self._state.obs["policy"])
        terminated, truncated = bool(info["terminated"]), bool(info["truncated"])
        return observation, float(self._state.reward), terminated, truncated, metrics


class GymnasiumVectorEnv(VectorEnv):
    """`num_envs` worlds in one batch; theta comes from `domain` anew in each episode (None: nominal).

    An ended world restarts in the same step: its last observation is info["final_obs"][i] where info["_final_obs"][i].
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, env: Env, num_envs: int, domain: Any = None) -> None:
        self.env, self.num_envs, self._domain = env, num_envs, domain
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = jax.jit(self._fresh), jax.jit(self._advance)
        self._key, self._state = jax.random.PRNGKey(0), None  # type: ignore[var-annotated]

    def _fresh(self, key: jax.Array, domain: Any) -> Any:
        theta_key, reset_key = jax.random.split(key)
        nominal = jnp.asarray(self.env.space.nominal, jnp.float32)
        thetas = jnp.tile(nominal, (self.num_envs, 1)) if domain is None else domain.sample(theta_key, self.num_envs)
        return jax.vmap(self.env.reset)(jax.random.split(reset_key, self.num_envs), thetas)

    def _advance(self, key: jax.Array, state: Any, action: jax.Array, domain: Any) -> tuple[Any, Any]:
        after = jax.vmap(self.env.step)(state, action)
        ended = after.info["terminated"] + after.info["truncated"] > 0
        return after, select(ended, self._fresh(key, domain), after)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        if seed is not None:
            self._key = jax.random.PRNGKey(seed)
        self._key, key = jax.random.split(self._key)
        self._state = self._reset(key, self._domain)
        return np.array(self._state.obs["policy"]), {}  # type: ignore[attr-defined]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        if self._state is None:
            raise ValueError("step before reset: call reset() first")
        self._key, key = jax.random.split(self._key)
        after, self._state = self._step(key, self._state, jnp.asarray(actions, jnp.float32), self._domain)
        terminated, truncated = (np.asarray(after.info[name]) > 0 for name in ("terminated", "truncated"))
        ended, info = terminated | truncated, {}
        if ended.any():
            final = np.empty(self.num_envs, object)
            for i in np.flatnonzero(ended):
                final[i] = np.array(after.info["final_observation"]["policy"][i])
            info = {"final_obs": final, "_final_obs": ended}
        return np.array(self._state.obs["policy"]), np.asarray(after.reward), terminated, truncated, info
