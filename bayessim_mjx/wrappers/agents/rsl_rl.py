"""rsl_rl's PPO, with its random network distillation and symmetry where `ppo:` asks for them."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

from bayessim_mjx.config import Config
from bayessim_mjx.rl import Policy
from bayessim_mjx.wrappers import rsl_rl
from bayessim_mjx.wrappers.agents import networks
from bayessim_mjx.wrappers.agents.episodes import Recent
from bayessim_mjx.wrappers.worlds import Worlds

TAKES = ("rnd", "symmetry", "normalize_advantage_per_minibatch")
# that both know, and theirs of them; its gelu is another function
ACTIVATIONS = {name: name for name in ("elu", "relu", "selu", "tanh", "swish", "mish", "lrelu", "softplus", "sigmoid")}
ACTIVATIONS |= {"celu": "crelu"}
LOSSES = ("value", "surrogate", "entropy", "rnd", "symmetry")  # that both log, under the same names


def make(config: Config, worlds: Worlds) -> RslRlAgent:
    return RslRlAgent(config, worlds)


class RslRlAgent:
    """`rsl_rl.runners.OnPolicyRunner` without its own log."""

    def __init__(self, config: Config, worlds: Worlds) -> None:
        import torch
        from rsl_rl.runners import OnPolicyRunner

        self.config, self.iteration = config, 0
        torch.manual_seed(config.seed)
        self.recent = Recent(worlds)
        env = rsl_rl.RslRlVecEnv(worlds)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks
            self.runner = OnPolicyRunner(env, self._settings(env), log_dir=None, device=env.device)
        self.losses: dict[str, float] = {}  # of the last iteration
        self._update, self.runner.alg.update = self.runner.alg.update, self._updated

    def _settings(self, env: Any) -> dict[str, Any]:
        ppo = self.config.ppo
        settings = rsl_rl.settings(symmetry=ppo.symmetry is not None, rnd=ppo.rnd.weight if ppo.rnd else 0.0)
        net = {"activation": ACTIVATIONS[ppo.activation], "obs_normalization": ppo.normalize_observations}
        settings["actor"] |= net | {"hidden_dims": list(ppo.hidden_actor)}
        settings["actor"]["distribution_cfg"] |= {"init_std": ppo.init_std}
        settings["critic"] |= net | {"hidden_dims": list(ppo.hidden_critic)}
        if "critic" in env.env.observation_size:
            settings["obs_groups"]["critic"] = ["critic"]
        settings["algorithm"] |= {
            "value_loss_coef": ppo.value_loss_coef, "use_clipped_value_loss": ppo.use_clipped_value_loss,
            "clip_param": ppo.clip_param, "entropy_coef": ppo.entropy_coef, "num_learning_epochs": ppo.num_epochs,
            "num_mini_batches": ppo.num_minibatches, "learning_rate": ppo.learning_rate, "schedule": ppo.schedule,
            "gamma": ppo.gamma, "lam": ppo.gae_lambda, "desired_kl": ppo.desired_kl, "max_grad_norm": ppo.max_grad_norm,
            "normalize_advantage_per_mini_batch": ppo.normalize_advantage_per_minibatch,
        }  # fmt: skip
        return settings | {"num_steps_per_env": ppo.num_steps}

    def _updated(self) -> dict[str, float]:
        """Its update, which tells the losses to its own log alone."""
        found = self._update()
        self.losses = {f"Loss/{name}": float(found[name]) for name in LOSSES if name in found}
        return found

    def learn(self, iterations: int) -> dict[str, float]:
        first = self.iteration == 0
        with contextlib.redirect_stdout(io.StringIO()):
            self.runner.current_learning_iteration = self.iteration
            self.runner.learn(iterations, init_at_random_ep_len=first)
        self.iteration += iterations
        return self.recent.metrics() | self.losses | {"Loss/learning_rate": float(self.runner.alg.learning_rate)}

    def policy(self) -> Policy:
        actor = self.runner.alg.get_policy()
        linear = [m for m in actor.mlp if hasattr(m, "weight")]
        layers = [(m.weight.detach().cpu().numpy().T, m.bias.detach().cpu().numpy()) for m in linear]
        log_std = actor.distribution.log_std_param.detach().cpu().numpy()
        if not self.config.ppo.normalize_observations:
            return networks.policy(layers, log_std, self.config.ppo)
        seen = actor.obs_normalizer
        scale = seen.std.cpu().numpy() + seen.eps
        return networks.policy(layers, log_std, self.config.ppo, seen.mean.cpu().numpy(), scale)

    def save(self, folder: Path) -> None:
        import torch

        torch.save(self.runner.alg.save() | {"iter": self.iteration, "infos": None}, folder / "model.pt")

    def load(self, folder: Path) -> None:
        import torch

        device = self.runner.env.device
        self.runner.alg.load(torch.load(folder / "model.pt", weights_only=True, map_location=device), None, True)
