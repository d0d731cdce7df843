"""Stable-Baselines3's PPO. It has no learning rate by KL: ours moves its rate once an iteration.

`ppo.desired_kl` is its `target_kl` too, at 1.5 times of which it ends an iteration.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np

from bayessim_mjx.config import Config
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import Policy
from bayessim_mjx.rl.losses import adapt
from bayessim_mjx.wrappers.agents import shared
from bayessim_mjx.wrappers.agents.shared import Recent
from bayessim_mjx.wrappers.sb3 import SB3VecEnv
from bayessim_mjx.wrappers.worlds import Worlds

TAKES = ("normalize_advantage_per_minibatch",)
ACTIVATIONS = {
    "elu": "ELU", "relu": "ReLU", "selu": "SELU", "tanh": "Tanh", "swish": "SiLU", "celu": "CELU",
    "lrelu": "LeakyReLU", "mish": "Mish", "softplus": "Softplus", "sigmoid": "Sigmoid",
}  # fmt: skip  # its gelu is another function
TAGS = {
    "train/value_loss": "Loss/value", "train/policy_gradient_loss": "Loss/surrogate", "train/approx_kl": "Loss/kl",
    "train/clip_fraction": "Loss/clip_fraction", "train/explained_variance": "Loss/explained_variance",
    "train/learning_rate": "Loss/learning_rate",
}  # fmt: skip
CLIP = 10.0  # of normalised observations, as ours


def make(config: Config, worlds: Worlds) -> SB3Agent:
    return SB3Agent(config, worlds)


def refuse(config: Config, env: Any) -> None:
    """UserError for what SB3 cannot do with these settings on `env`."""
    ppo = config.ppo
    if "critic" in env.observation_size:
        raise UserError(
            f"--agent sb3: {env.name} has observations of its own for the critic, and both networks of SB3 see the "
            "policy's; allowed are rsl_rl, skrl and our own PPO (leave --agent out)"
        )
    size, left = divmod(ppo.num_envs * ppo.num_steps, ppo.num_minibatches)
    if left or size < 2:
        raise UserError(
            f"ppo.num_minibatches = {ppo.num_minibatches}: --agent sb3 takes a divisor of ppo.num_envs * ppo.num_steps "
            f"= {ppo.num_envs * ppo.num_steps} that leaves at least two samples"
        )


def _normalised_once() -> Any:
    """Its buffer with advantages normalised over all samples of a batch, as it does in each minibatch alone."""
    from stable_baselines3.common.buffers import RolloutBuffer

    class Normalised(RolloutBuffer):
        def compute_returns_and_advantage(self, *args: Any, **kwargs: Any) -> None:
            super().compute_returns_and_advantage(*args, **kwargs)
            raw: np.ndarray = self.advantages  # type: ignore[has-type]
            self.advantages = (raw - raw.mean()) / (raw.std() + 1e-8)

    return Normalised


def _by_kl(agent: SB3Agent) -> Any:
    """Its callback that moves the learning rate before the next rollout, by the KL of the update before it."""
    from stable_baselines3.common.callbacks import BaseCallback

    class ByKL(BaseCallback):
        def _on_rollout_start(self) -> None:
            agent.adapt()

        def _on_step(self) -> bool:
            return True

    return ByKL()


class SB3Agent:
    """`stable_baselines3.PPO` with `MlpPolicy` behind `VecNormalize`."""

    def __init__(self, config: Config, worlds: Worlds) -> None:
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import VecNormalize

        self.config, self.iteration, ppo = config, 0, config.ppo
        self.env, self.recent = cast(Any, SB3VecEnv(worlds)), Recent(worlds)
        if ppo.normalize_observations:
            self.env = VecNormalize(self.env, norm_reward=False, clip_obs=CLIP)
        by_minibatch = ppo.normalize_advantage_per_minibatch
        self.model = PPO(
            "MlpPolicy", self.env, learning_rate=ppo.learning_rate, n_steps=ppo.num_steps,
            batch_size=ppo.num_envs * ppo.num_steps // ppo.num_minibatches, n_epochs=ppo.num_epochs,
            normalize_advantage=by_minibatch, rollout_buffer_class=None if by_minibatch else _normalised_once(),
            gamma=ppo.gamma, gae_lambda=ppo.gae_lambda, clip_range=ppo.clip_param,
            clip_range_vf=ppo.clip_param if ppo.use_clipped_value_loss else None, ent_coef=ppo.entropy_coef,
            vf_coef=ppo.value_loss_coef, max_grad_norm=ppo.max_grad_norm, seed=config.seed, device=_device(),
            target_kl=ppo.desired_kl if ppo.schedule == "adaptive" else None, policy_kwargs=self._networks(),
        )  # fmt: skip
        self.rate = ppo.learning_rate
        self.model.lr_schedule = lambda progress: self.rate

    def adapt(self) -> None:
        """Move the learning rate as ours moves in a minibatch, by the KL of the last update of this call of `learn`."""
        kl = self.model.logger.name_to_value.get("train/approx_kl")
        if kl is not None and self.config.ppo.schedule == "adaptive":
            self.rate = float(adapt(self.rate, kl, self.config.ppo.desired_kl))  # type: ignore[arg-type]
            for group in self.model.policy.optimizer.param_groups:  # as it is saved
                group["lr"] = self.rate

    def _networks(self) -> dict[str, Any]:
        import torch

        ppo = self.config.ppo
        widths = {"pi": list(ppo.hidden_actor), "vf": list(ppo.hidden_critic)}
        activation = getattr(torch.nn, ACTIVATIONS[ppo.activation])
        return {"net_arch": widths, "activation_fn": activation, "log_std_init": float(np.log(ppo.init_std))}

    def learn(self, iterations: int) -> dict[str, float]:
        steps = iterations * self.config.ppo.num_steps * self.config.ppo.num_envs
        first = self.iteration == 0 and self.model.num_timesteps == 0
        self.model.learn(steps, reset_num_timesteps=first, log_interval=None, callback=_by_kl(self))  # type: ignore[arg-type]
        self.adapt()
        self.iteration += iterations
        logged = self.model.logger.name_to_value
        found = {ours: float(logged[theirs]) for theirs, ours in TAGS.items() if theirs in logged}
        return found | self.recent.metrics()

    def policy(self) -> Policy:
        net: Any = self.model.policy
        linear = [m for m in net.mlp_extractor.policy_net if hasattr(m, "weight")] + [net.action_net]
        layers = [(m.weight.detach().cpu().numpy().T, m.bias.detach().cpu().numpy()) for m in linear]
        log_std = net.log_std.detach().cpu().numpy()
        if not self.config.ppo.normalize_observations:
            return shared.policy_of(layers, log_std, self.config.ppo)
        seen = self.env.obs_rms
        return shared.policy_of(layers, log_std, self.config.ppo, seen.mean, np.sqrt(seen.var + self.env.epsilon))

    def save(self, folder: Path) -> None:
        import torch

        torch.save(self.model.get_parameters(), folder / "model.pt")
        if self.config.ppo.normalize_observations:
            seen = self.env.obs_rms
            np.savez(folder / "scales.npz", mean=seen.mean, var=seen.var, count=seen.count)

    def load(self, folder: Path) -> None:
        import torch

        kept = torch.load(folder / "model.pt", weights_only=True, map_location=self.model.device)
        self.model.set_parameters(kept, device=self.model.device)
        self.model.num_timesteps = 1  # not the first call of `learn`
        self.rate = self.model.policy.optimizer.param_groups[0]["lr"]
        if self.config.ppo.normalize_observations:
            with np.load(folder / "scales.npz", allow_pickle=False) as scales:
                for name in ("mean", "var", "count"):
                    setattr(self.env.obs_rms, name, scales[name])


def _device() -> str:
    from bayessim_mjx.wrappers.conversion import torch

    return "cuda" if torch().cuda.is_available() else "cpu"
