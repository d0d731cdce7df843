"""Our worlds as rsl_rl's `VecEnv`: `OnPolicyRunner(make("Ant", 1024), settings(), "logs").learn(300)`.

Observations are a `TensorDict` of all groups ("policy", "critic" where the task has one, ...), on the device of the
worlds; pictures of bytes have their channels first there, and values from 0 to 1. Where a time limit ends an episode,
rsl_rl adds the value of the observation *before* the step to the reward; `PPO` here adds that of the observation which
the step led to.
"""

from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers.conversion import device_of, to_jax, to_torch, torch
from bayessim_mjx.wrappers.worlds import Batch, Worlds, worlds

try:
    from rsl_rl import algorithms
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise UserError(f"wrappers.rsl_rl needs rsl_rl: pip install 'bayessim-mjx[rsl-rl]' ({error})") from error


def make(task: Any, num_envs: int = 64, domain: Any = None, seed: int = 0, **env_settings: Any) -> "RslRlVecEnv":
    """Worlds of a task, or of a run under its posterior (arguments as for `wrappers.worlds.worlds`)."""
    return RslRlVecEnv(worlds(task, num_envs, domain, seed, **env_settings))


class RslRlVecEnv(VecEnv):
    """`worlds` for rsl_rl (5.x).

    `extras` of a step: `time_outs` `[N]` bool; `final_observations`, a `TensorDict` of what the step led to, in all
    worlds; `log`, the mean of the task's metrics.

    Attributes:
        device: PyTorch's name of the device that the worlds are on.
        step_dt: control step, s.
        max_episode_length: control steps.
    """

    def __init__(self, worlds: Worlds) -> None:
        self.worlds, self.env = worlds, worlds.env
        self.num_envs, self.num_actions = worlds.num_envs, worlds.env.action_size
        self.max_episode_length = int(worlds.env.episode_length)
        self.step_dt = worlds.env.dt
        self.cfg = {"task": worlds.env.name, "num_envs": worlds.num_envs}
        first = worlds.obs["policy"]
        self._jax_device, self.device = first.devices().pop(), device_of(first)

    @property
    def unwrapped(self) -> "RslRlVecEnv":
        """The environment itself."""
        return self

    @property
    def episode_length_buf(self) -> Any:
        """Steps of the running episodes, `[N]` int64."""
        return to_torch(self.worlds.lengths).clone().long()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Any) -> None:
        """For `init_at_random_ep_len`: the running episodes end as if they were `steps` old."""
        self.worlds.set_lengths(to_jax(steps.int(), self._jax_device))

    def get_observations(self) -> TensorDict:
        return self._groups(self.worlds.obs)

    def reset(self) -> tuple[TensorDict, dict]:
        """Begin new episodes in all worlds."""
        return self._groups(self.worlds.reset()), {}

    def step(self, actions: Any) -> tuple[TensorDict, Any, Any, dict]:
        batch = self.worlds.step(to_jax(actions.clamp(-1.0, 1.0), self._jax_device))
        reward, terminated, truncated = to_torch((batch.reward, batch.terminated, batch.truncated))
        return self._groups(batch.obs), reward.clone(), (terminated | truncated).long(), self._extras(batch, truncated)

    def _extras(self, batch: Batch, truncated: Any) -> dict[str, Any]:
        log = {f"/{name}": to_torch(value).float().mean() for name, value in batch.metrics.items()}
        return {"time_outs": truncated.clone(), "final_observations": self._groups(batch.final), "log": log}

    def _groups(self, obs: dict[str, Any]) -> TensorDict:
        seen = {group: _convolved(x) for group, x in to_torch(obs).items()}
        return TensorDict(seen, batch_size=[self.num_envs], device=self.device)

    def close(self) -> None:
        pass


def _convolved(x: Any) -> Any:
    """Pictures of bytes `[N, H, W, C]` as rsl_rl's convolutions take them, `[N, C, H, W]` from 0 to 1; others as is."""
    return x.permute(0, 3, 1, 2) / 255.0 if x.dim() == 4 and x.dtype == torch().uint8 else x


class PPO(algorithms.PPO):
    """rsl_rl's PPO with the value of the true final observation where a time limit ended an episode."""

    def process_env_step(self, obs: Any, rewards: Any, dones: Any, extras: dict[str, Any]) -> None:
        late, last = extras.get("time_outs"), extras.get("final_observations")
        if late is not None and last is not None and bool(late.any()):
            memory = self.critic.get_hidden_state()  # of all worlds; what follows is a look ahead
            with torch().no_grad():
                values = self.critic(last.to(self.device)) - self.transition.values  # what rsl_rl adds is in the second
            self.critic.reset(hidden_state=memory)
            rewards = rewards + self.gamma * values.squeeze(1) * late.to(self.device)
        super().process_env_step(obs, rewards, dones, extras)


def mirrored(env: RslRlVecEnv, obs: Any = None, actions: Any = None) -> tuple[Any, Any]:
    """rsl_rl's `symmetry_cfg.data_augmentation_func` from the task's mirror maps: the batch, then its mirror images.

    Args:
        env: worlds of a task that has a mirror symmetry.
        obs: `TensorDict` of groups `[B, ...]`, or None.
        actions: `[B, A]`, or None.

    Raises:
        UserError: a task without one.
    """
    maps = env.env.mirrors
    if not maps:
        raise UserError(f"symmetry_cfg: {env.env.name} has no mirror symmetry; leave it out")

    def turned(x: Any, part: tuple) -> Any:
        perm, sign = (torch().as_tensor(value, device=x.device) for value in part)
        return x[..., perm.long()] * sign.to(x.dtype)

    if obs is not None:
        images = [{g: turned(x, m.observation[g]) if g in m.observation else x for g, x in obs.items()} for m in maps]
        obs = torch().cat([obs, *(TensorDict(i, batch_size=obs.batch_size, device=obs.device) for i in images)])
    if actions is not None:
        actions = torch().cat([actions, *(turned(actions, m.action) for m in maps)])
    return obs, actions


def settings(symmetry: bool = False, rnd: float = 0.0, **changes: Any) -> dict[str, Any]:
    """Make a runner's settings with which small tasks learn, in rsl_rl's names.

    Args:
        symmetry: mirrored samples by the task's mirror maps (`mirrored`).
        rnd: weight of the curiosity reward of random network distillation on the group "policy"; 0: none.
        changes: replace settings of the top level, e.g. `num_steps_per_env=24`.
    """
    network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu", "obs_normalization": True}
    noise = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "log"}
    algorithm: dict[str, Any] = {
        "class_name": f"{__name__}:PPO", "value_loss_coef": 1.0, "use_clipped_value_loss": True, "clip_param": 0.2,
        "entropy_coef": 0.005, "num_learning_epochs": 5, "num_mini_batches": 4, "learning_rate": 1e-3,
        "schedule": "adaptive", "gamma": 0.99, "lam": 0.95, "desired_kl": 0.01, "max_grad_norm": 1.0,
    }  # fmt: skip
    groups = {"actor": ["policy"], "critic": ["policy"]}
    if symmetry:
        algorithm["symmetry_cfg"] = {"data_augmentation_func": f"{__name__}:mirrored", "use_data_augmentation": True}
    if rnd:
        groups["rnd_state"] = ["policy"]
        layers = {"predictor_hidden_dims": [64], "target_hidden_dims": [64]}
        algorithm["rnd_cfg"] = {"weight": rnd, "num_outputs": 8, "state_normalization": True} | layers
    found = {
        "num_steps_per_env": 32, "save_interval": 100, "obs_groups": groups,
        "actor": network | {"distribution_cfg": noise}, "critic": dict(network), "algorithm": algorithm,
    }  # fmt: skip
    return found | changes
