"""Our worlds as rl_games' `IVecEnv`: `register("Ant", num_envs=1024)`, then a runner whose `env_name` is "Ant".

Tensors share memory with the worlds. `infos["time_outs"]` says whose episode a time limit ended, for rl_games'
`value_bootstrap`; observations of the group "critic", where a task has one, are the `states` of a central value.
"""

from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers.conversion import boxes, to_jax, to_torch
from bayessim_mjx.wrappers.worlds import Worlds, worlds

try:
    from rl_games.common import env_configurations, vecenv
    from rl_games.common.ivecenv import IVecEnv
except ImportError as error:
    raise UserError(f"wrappers.rl_games needs rl_games: pip install 'bayessim-mjx[rl-games]' ({error})") from error

TYPE = "BAYESSIM_MJX"  # rl_games' `vecenv_type`


def make(task: Any, num_envs: int = 64, domain: Any = None, seed: int = 0, **env_settings: Any) -> "RlGamesVecEnv":
    """Worlds of a task, or of a run under its posterior (arguments as for `wrappers.worlds.worlds`)."""
    return RlGamesVecEnv(worlds(task, num_envs, domain, seed, **env_settings))


def register(name: str, task: Any = None, domain: Any = None, seed: int = 0, **env_settings: Any) -> None:
    """Make rl_games know worlds under `name`, for `config.env_name`; `config.num_actors` says how many.

    Args:
        name: what rl_games is to call them.
        task: as for `wrappers.worlds.worlds`; None: the task called `name`.
        domain, seed, env_settings: as there.
    """
    given = name if task is None else task
    vecenv.register(TYPE, lambda config_name, num_actors, **_: _made(config_name, num_actors))
    create = lambda num_actors=64, **_: make(given, num_actors, domain, seed, **env_settings)  # noqa: E731
    env_configurations.register(name, {"vecenv_type": TYPE, "env_creator": create})


def _made(name: str, num_actors: int) -> "RlGamesVecEnv":
    return env_configurations.configurations[name]["env_creator"](num_actors=num_actors)


class RlGamesVecEnv(IVecEnv):
    """`worlds` for rl_games."""

    def __init__(self, worlds: Worlds) -> None:
        self.worlds, self.num_envs = worlds, worlds.num_envs
        self.observation_space, self.action_space = boxes(worlds.env)
        self._device = worlds.obs["policy"].devices().pop()

    def reset(self) -> Any:
        return self._seen(self.worlds.reset())

    def step(self, actions: Any) -> tuple[Any, Any, Any, dict]:
        batch = self.worlds.step(to_jax(actions.clamp(-1.0, 1.0), self._device))
        reward, terminated, truncated = to_torch((batch.reward, batch.terminated, batch.truncated))
        return self._seen(batch.obs), reward.clone(), terminated | truncated, {"time_outs": truncated.clone()}

    def _seen(self, obs: dict[str, Any]) -> Any:
        seen = to_torch(obs["policy"])
        return {"obs": seen, "states": to_torch(obs["critic"])} if "critic" in obs else seen

    def get_number_of_agents(self) -> int:
        return 1

    def get_env_info(self) -> dict[str, Any]:
        info = {"observation_space": self.observation_space, "action_space": self.action_space, "agents": 1}
        if "critic" in self.worlds.env.observation_size:
            info["state_space"] = boxes(self.worlds.env, "critic")[0]
        return info

    def seed(self, seed: int) -> None:
        self.worlds.seed(seed)


def settings(name: str, num_envs: int, epochs: int, folder: str = "logs/rl_games", **changes: Any) -> dict[str, Any]:
    """Make what `Runner.load` takes, with which small tasks learn by PPO, in rl_games' names.

    Args:
        name: as registered.
        num_envs: worlds.
        epochs: PPO iterations.
        folder: for TensorBoard and checkpoints.
        changes: replace entries of `config`, e.g. `horizon_length=16`.
    """
    continuous = {
        "mu_activation": "None", "sigma_activation": "None", "mu_init": {"name": "default"},
        "sigma_init": {"name": "const_initializer", "val": 0}, "fixed_sigma": True,
    }  # fmt: skip
    layers = {"units": [64, 64], "activation": "elu", "initializer": {"name": "default"}}
    config = {
        "name": name, "env_name": name, "num_actors": num_envs, "train_dir": folder, "max_epochs": epochs, "ppo": True,
        "mixed_precision": False, "normalize_input": True, "normalize_value": True, "value_bootstrap": True,
        "reward_shaper": {"scale_value": 1.0}, "normalize_advantage": True, "gamma": 0.99, "tau": 0.95,
        "learning_rate": 1e-3, "lr_schedule": "adaptive", "kl_threshold": 0.01, "score_to_win": 1e9,
        "save_best_after": 10_000, "save_frequency": 0, "grad_norm": 1.0, "entropy_coef": 0.0, "truncate_grads": True,
        "e_clip": 0.2, "horizon_length": 32, "minibatch_size": 8 * num_envs, "mini_epochs": 5, "critic_coef": 2,
        "clip_value": True, "bounds_loss_coef": 1e-4, "device": "cpu",
    }  # fmt: skip
    return {
        "params": {
            "seed": 0,
            "algo": {"name": "a2c_continuous"},
            "model": {"name": "continuous_a2c_logstd"},
            "network": {"name": "actor_critic", "separate": False, "space": {"continuous": continuous}, "mlp": layers},
            "config": config | changes,
        }
    }
