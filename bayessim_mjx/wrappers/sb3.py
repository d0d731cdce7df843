"""Our worlds as Stable-Baselines3's `VecEnv`: `PPO("MlpPolicy", make("Cartpole", 64)).learn(...)`.

Episodes end and begin within one step. An ended world's info has `terminal_observation`, `TimeLimit.truncated` and
`episode` (`r` the return, `l` the length, `t` seconds), as SB3's own `Monitor` writes them.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers.conversion import boxes
from bayessim_mjx.wrappers.pictures import Camera
from bayessim_mjx.wrappers.worlds import Worlds, worlds

try:
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise UserError(f"wrappers.sb3 needs Stable-Baselines3: pip install 'bayessim-mjx[sb3]' ({error})") from error


def make(task: Any, num_envs: int = 64, domain: Any = None, seed: int = 0, **env_settings: Any) -> "SB3VecEnv":
    """Worlds of a task, or of a run under its posterior (arguments as for `wrappers.worlds.worlds`)."""
    return SB3VecEnv(worlds(task, num_envs, domain, seed, **env_settings))


class SB3VecEnv(VecEnv):
    """`worlds` for SB3; observations are the group "policy", as numpy arrays.

    `env_method("set_theta", theta)` sets the physics of episodes that begin from then on, `theta` `[d]` or
    `[num_envs, d]` (None: as by the domain); `get_attr("theta")` gives that of the running ones.
    """

    def __init__(self, worlds: Worlds, render_mode: str | None = None) -> None:
        self.worlds, self.render_mode, self.start = worlds, render_mode, time.perf_counter()
        self.metadata = {"render_modes": ["rgb_array"]}
        super().__init__(worlds.num_envs, *boxes(worlds.env))
        self._actions: Any = None
        self._camera = Camera(worlds.env)

    def seed(self, seed: int | None = None) -> Sequence[None | int]:
        if seed is not None:
            self.worlds.seed(seed)
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray:
        observation = np.array(self.worlds.reset()["policy"])
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = jnp.asarray(actions, jnp.float32)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:  # type: ignore[override]
        batch = self.worlds.step(self._actions)
        observation, reward, terminated, truncated = jax.device_get(
            (batch.obs["policy"], batch.reward, batch.terminated, batch.truncated)
        )
        done = terminated | truncated
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        if done.any():
            final, returns, lengths = jax.device_get((batch.final["policy"], batch.returns, batch.lengths))
            seconds = round(time.perf_counter() - self.start, 6)
            for i in np.flatnonzero(done):
                infos[i] = {
                    "terminal_observation": np.array(final[i]),
                    "TimeLimit.truncated": bool(truncated[i]),
                    "episode": {"r": float(returns[i]), "l": int(lengths[i]), "t": seconds},
                }
        return np.array(observation), np.array(reward), done, infos

    def close(self) -> None:
        pass

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Draw a picture `[height, width, 3]` of each world; None where no OpenGL works."""
        shown = self.worlds.qpos, self.worlds.theta, self.worlds.obs["policy"]
        return [self._camera(*world) for world in zip(*map(np.asarray, shown), strict=True)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        rows = list(self._get_indices(indices))
        if attr_name == "theta":
            return [np.asarray(self.worlds.theta)[i] for i in rows]
        owner = (
            self if hasattr(self, attr_name) else self.worlds if hasattr(self.worlds, attr_name) else self.worlds.env
        )
        return [getattr(owner, attr_name)] * len(rows)

    def has_attr(self, attr_name: str) -> bool:
        return hasattr(self._owner(attr_name), attr_name)

    def _owner(self, name: str) -> Any:
        """Who has the attribute `name`; the task's environment where nobody does."""
        return next((owner for owner in (self, self.worlds) if hasattr(owner, name)), self.worlds.env)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        if attr_name != "theta":
            raise UserError(f"set_attr({attr_name!r}): allowed: theta")
        self.env_method("set_theta", value, indices=indices)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        if method_name != "set_theta":
            raise UserError(f"env_method({method_name!r}): allowed: set_theta")
        if indices is not None and len(list(self._get_indices(indices))) < self.num_envs:
            raise UserError("set_theta for some worlds: give theta [num_envs, d] for all of them")
        self.worlds.set_theta(*method_args, **method_kwargs)
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return True for SB3's `Monitor`, whose `episode` infos these worlds write."""
        rows: Iterable[int] = self._get_indices(indices)
        return [wrapper_class is Monitor for _ in rows]
