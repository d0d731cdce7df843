"""rsl_rl's PPO, with its random network distillation and symmetry where `ppo:` has them."""

from __future__ import annotations

import contextlib
import dataclasses
import io
from pathlib import Path
from typing import Any

from bayessim_mjx.config import Config, RNDConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import Policy, rnd, symmetry
from bayessim_mjx.wrappers import rsl_rl
from bayessim_mjx.wrappers.agents import shared
from bayessim_mjx.wrappers.agents.shared import Recent
from bayessim_mjx.wrappers.worlds import Worlds

TAKES = ("rnd", "symmetry", "normalize_advantage_per_minibatch")
# that both know, and theirs of them; its gelu is another function
ACTIVATIONS = {name: name for name in ("elu", "relu", "selu", "tanh", "swish", "mish", "lrelu", "softplus", "sigmoid")}
ACTIVATIONS |= {"celu": "crelu"}
RND_WIDTHS = ("predictor_hidden_dims", "target_hidden_dims")
LOSSES = ("value", "surrogate", "entropy", "rnd", "symmetry")  # that both log, under the same names


def make(config: Config, worlds: Worlds) -> RslRlAgent:
    return RslRlAgent(config, worlds)


def refuse(config: Config, env: Any) -> None:
    """UserError for what rsl_rl cannot do with these settings on `env`."""
    ppo = config.ppo
    widths = {"hidden_actor": ppo.hidden_actor, "hidden_critic": ppo.hidden_critic}
    if ppo.rnd is not None:
        if ppo.rnd.activation not in ACTIVATIONS:
            allowed = ", ".join(ACTIVATIONS)
            raise UserError(f"ppo.rnd.activation = {ppo.rnd.activation!r}: --agent rsl_rl takes {allowed}")
        rnd.groups(env.observation_size, ppo.rnd)
        widths |= {f"rnd.{name}": getattr(ppo.rnd, name) for name in RND_WIDTHS}
    for name, given in widths.items():
        if not given:
            raise UserError(f"ppo.{name} = []: --agent rsl_rl needs a hidden layer, e.g. [64]")
    if ppo.symmetry is not None:
        symmetry.mirrors(env, {"policy", _critic_group(env)})


def _critic_group(env: Any) -> str:
    return "critic" if "critic" in env.observation_size else "policy"


def _fields(section: Any) -> dict[str, Any]:
    """All settings of a section, which has rsl_rl's names: one that rsl_rl has not would be refused by it."""
    return {field.name: getattr(section, field.name) for field in dataclasses.fields(section)}


def _novelty(settings: RNDConfig, dt: float) -> dict[str, Any]:
    """`ppo.rnd` as its `rnd_cfg`; it takes the first weight times the control step itself, but not the last one."""
    found = _fields(settings) | {"activation": ACTIVATIONS[settings.activation]}
    found |= {name: list(getattr(settings, name)) for name in RND_WIDTHS}
    del found["obs_groups"]  # those of the runner
    if (schedule := settings.weight_schedule) is not None:
        found["weight_schedule"] = _fields(schedule) | {"final_value": (schedule.final_value or 0.0) * dt}
    return found


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
        if config.ppo.rnd is not None and config.ppo.rnd.reward_normalization:
            self.runner.alg.rnd.reward_normalizer.disc_avg.gamma = config.ppo.gamma  # its own is .99, whatever PPO's is
        self.losses: dict[str, float] = {}  # of the last iteration
        self._update, self.runner.alg.update = self.runner.alg.update, self._updated

    def _settings(self, env: Any) -> dict[str, Any]:
        ppo = self.config.ppo
        settings = rsl_rl.settings()
        net = {"activation": ACTIVATIONS[ppo.activation], "obs_normalization": ppo.normalize_observations}
        settings["actor"] |= net | {"hidden_dims": list(ppo.hidden_actor)}
        settings["actor"]["distribution_cfg"] |= {"init_std": ppo.init_std}
        settings["critic"] |= net | {"hidden_dims": list(ppo.hidden_critic)}
        settings["obs_groups"]["critic"] = [_critic_group(env.env)]
        settings["algorithm"] |= {
            "value_loss_coef": ppo.value_loss_coef, "use_clipped_value_loss": ppo.use_clipped_value_loss,
            "clip_param": ppo.clip_param, "entropy_coef": ppo.entropy_coef, "num_learning_epochs": ppo.num_epochs,
            "num_mini_batches": ppo.num_minibatches, "learning_rate": ppo.learning_rate, "schedule": ppo.schedule,
            "gamma": ppo.gamma, "lam": ppo.gae_lambda, "desired_kl": ppo.desired_kl, "max_grad_norm": ppo.max_grad_norm,
            "normalize_advantage_per_mini_batch": ppo.normalize_advantage_per_minibatch,
        }  # fmt: skip
        if ppo.rnd is not None:
            settings["obs_groups"]["rnd_state"] = list(rnd.groups(env.env.observation_size, ppo.rnd))
            settings["algorithm"]["rnd_cfg"] = _novelty(ppo.rnd, env.step_dt)
        if ppo.symmetry is not None:
            settings["algorithm"]["symmetry_cfg"] = _fields(ppo.symmetry) | {"data_augmentation_func": rsl_rl.mirrored}
        return settings | {"num_steps_per_env": ppo.num_steps}

    def _updated(self) -> dict[str, float]:
        """Its update, which writes the losses to its own log alone."""
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
            return shared.policy_of(layers, log_std, self.config.ppo)
        seen = actor.obs_normalizer
        scale = seen.std.cpu().numpy() + seen.eps
        return shared.policy_of(layers, log_std, self.config.ppo, seen.mean.cpu().numpy(), scale)

    def save(self, folder: Path) -> None:
        import torch

        torch.save(self.runner.alg.save() | {"iter": self.iteration, "infos": None}, folder / "model.pt")

    def load(self, folder: Path) -> None:
        import torch

        device = self.runner.env.device
        kept = torch.load(folder / "model.pt", weights_only=True, map_location=device)
        self.runner.alg.load(kept, None, True)
        if self.runner.alg.rnd is not None:  # the clock of the weight's schedule, which it does not keep
            self.runner.alg.rnd.update_counter = kept["iter"] * self.config.ppo.num_steps
