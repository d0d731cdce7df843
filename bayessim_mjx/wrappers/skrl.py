"""Our worlds as environments of skrl, for its JAX agents (`make`) and its PyTorch ones (`make(..., library="torch")`).

The group "policy" is the observation; the group "critic", where a task has one, is the state. What the step itself led
to are `info["final_observation"]` and `info["final_state"]`. skrl's trainers take the next observation for that, which
is the first one of a new episode where an episode ended: `told_true_ends(runner.agent)` corrects it.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers.conversion import boxes
from bayessim_mjx.wrappers.worlds import Worlds, worlds

try:
    import skrl  # noqa: F401
except ImportError as error:
    raise UserError(f"wrappers.skrl needs skrl: pip install 'bayessim-mjx[skrl]' ({error})") from error

LIBRARIES = ("jax", "torch")


def make(
    task: Any, num_envs: int = 64, domain: Any = None, seed: int = 0, library: str = "jax", **env_settings: Any
) -> Any:
    """Worlds of a task, or of a run under its posterior, as a wrapped environment of skrl.

    Args:
        task, num_envs, domain, seed, env_settings: as for `wrappers.worlds.worlds`.
        library: what the agents are written in, "jax" or "torch".
    """
    return wrapped(worlds(task, num_envs, domain, seed, **env_settings), library)


def wrapped(worlds: Worlds, library: str = "jax") -> Any:
    """`worlds` as an environment that skrl's trainers take as it is."""
    if library not in LIBRARIES:
        raise UserError(f"library = {library!r}: allowed are {', '.join(LIBRARIES)}")
    return _JaxEnv(worlds) if library == "jax" else _torch_env()(worlds)


def _numbers(box: gymnasium.spaces.Box) -> gymnasium.spaces.Box:
    """Return the box; that of bytes as one of float32 from 0 to 1, as skrl's models cannot take bytes."""
    return box if box.dtype != np.uint8 else gymnasium.spaces.Box(0.0, 1.0, box.shape, np.float32)


class _Env:
    """What both kinds share; observations are taken over by `_out`, actions by `_in`."""

    def __init__(self, worlds: Worlds) -> None:
        self.worlds = self._env = self._unwrapped = worlds
        self.spaces = boxes(worlds.env)
        self._begun = False
        self._obs = worlds.obs

    @property
    def num_envs(self) -> int:
        return self.worlds.num_envs

    @property
    def num_agents(self) -> int:
        return 1

    @property
    def observation_space(self) -> Any:
        return _numbers(self.spaces[0])

    @property
    def action_space(self) -> Any:
        return self.spaces[1]

    @property
    def state_space(self) -> Any:
        return _numbers(boxes(self.worlds.env, "critic")[0]) if "critic" in self.worlds.env.observation_size else None

    def reset(self) -> tuple[Any, dict]:
        """Begin new episodes the first time; after that return the running ones, as they restart by themselves."""
        if not self._begun:
            self._begun, self._obs = True, self.worlds.reset()
        return self._flat(self._obs["policy"]), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict]:
        batch = self.worlds.step(jnp.clip(self._in(actions), -1.0, 1.0))
        self._obs = batch.obs
        columns = (self._out(x.reshape(-1, 1)) for x in (batch.reward, batch.terminated, batch.truncated))
        info = {"final_observation": self._flat(batch.final["policy"])}
        if "critic" in batch.final:
            info["final_state"] = self._flat(batch.final["critic"])
        return self._flat(batch.obs["policy"]), *columns, info

    def state(self) -> Any:
        return self._flat(self._obs["critic"]) if "critic" in self._obs else None

    def _flat(self, x: jax.Array) -> Any:
        """As skrl has observations of any shape: `[N, S]`, the shape is in the space; bytes of pictures from 0 to 1."""
        flat = x.reshape(len(x), -1)
        return self._out(flat / 255.0 if flat.dtype == jnp.uint8 else flat)

    def render(self, *args: Any, **kwargs: Any) -> None:
        return None

    def close(self) -> None:
        pass

    def _out(self, x: jax.Array) -> Any:
        raise NotImplementedError

    def _in(self, x: Any) -> jax.Array:
        raise NotImplementedError


class _JaxEnv(_Env):
    @property
    def device(self) -> jax.Device:
        return self._obs["policy"].devices().pop()

    def _out(self, x: jax.Array) -> jax.Array:
        return x

    def _in(self, x: Any) -> jax.Array:
        return jnp.asarray(x)


def _torch_env() -> type:
    from bayessim_mjx.wrappers.conversion import device_of, to_jax, to_torch, torch

    class TorchEnv(_Env):
        @property
        def device(self) -> Any:
            return torch().device(device_of(self._obs["policy"]))

        def _out(self, x: jax.Array) -> Any:
            return to_torch(x).clone()

        def _in(self, x: Any) -> jax.Array:
            return to_jax(x, self._obs["policy"].devices().pop())

    return TorchEnv


def told_true_ends(agent: Any) -> Any:
    """Make skrl's agent learn of what each step led to in place of a new episode's first observation.

    Its PPO adds the value of that observation where a time limit ended an episode (`time_limit_bootstrap`). Nothing
    else changes: after an end no value of the next observation is used.
    """
    record = agent.record_transition

    def recorded(*, infos: dict, next_observations: Any, next_states: Any, **given: Any) -> None:
        true = infos["final_observation"], infos.get("final_state", next_states)
        record(infos=infos, next_observations=true[0], next_states=true[1], **given)

    agent.record_transition = recorded
    return agent


def settings(timesteps: int, folder: str = "logs/skrl", **changes: Any) -> dict[str, Any]:
    """Make settings of skrl's `Runner` with which small tasks learn by PPO, in skrl's names.

    Args:
        timesteps: control steps of each world.
        folder: for TensorBoard and checkpoints.
        changes: replace settings of the agent, e.g. `rollouts=24`.
    """
    network = {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "elu"}
    policy = {
        "class": "GaussianMixin", "clip_actions": False, "clip_log_std": True, "min_log_std": -20.0, "max_log_std": 2.0,
        "initial_log_std": 0.0, "network": [network], "output": "ACTIONS",
    }  # fmt: skip
    value = {"class": "DeterministicMixin", "clip_actions": False, "network": [network], "output": "ONE"}
    agent = {
        "class": "PPO", "rollouts": 32, "learning_epochs": 5, "mini_batches": 4, "discount_factor": 0.99,
        "gae_lambda": 0.95, "learning_rate": 1e-3, "learning_rate_scheduler": "KLAdaptiveLR",
        "learning_rate_scheduler_kwargs": {"kl_threshold": 0.01}, "observation_preprocessor": "RunningStandardScaler",
        "value_preprocessor": "RunningStandardScaler", "grad_norm_clip": 1.0, "time_limit_bootstrap": True,
        "experiment": {"directory": folder, "write_interval": 0, "checkpoint_interval": 0},
    }  # fmt: skip
    return {
        "seed": 0,
        "models": {"separate": True, "policy": policy, "value": value},
        "memory": {"class": "RandomMemory", "memory_size": -1},
        "agent": agent | changes,
        "trainer": {
            "class": "SequentialTrainer",
            "timesteps": timesteps,
            "environment_info": "log",
            "close_environment_at_exit": False,
        },  # fmt: skip
    }
