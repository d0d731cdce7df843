"""skrl's PPO, of its JAX agents: no PyTorch is needed."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bayessim_mjx.config import Config
from bayessim_mjx.rl import Policy
from bayessim_mjx.wrappers import skrl
from bayessim_mjx.wrappers.agents import shared
from bayessim_mjx.wrappers.agents.shared import Recent
from bayessim_mjx.wrappers.worlds import Worlds

TAKES = ()
ACTIVATIONS = ("elu", "relu", "selu", "tanh")  # that both know
SCALERS = ("observation_preprocessor", "state_preprocessor", "value_preprocessor")
TAGS = {"Loss / Value loss": "Loss/value", "Loss / Policy loss": "Loss/surrogate"}
MOMENTS = ("running_mean", "running_variance", "current_count")


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Without skrl's words about seeds, and about the GPU that it looks for on every machine."""
    logger = logging.getLogger("skrl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def make(config: Config, worlds: Worlds) -> SkrlAgent:
    return SkrlAgent(config, worlds)


def refuse(config: Config, env: Any) -> None:
    """UserError for what skrl cannot do with these settings on `env`: nothing beyond what none of them can."""
    del config, env


class SkrlAgent:
    """skrl's `Runner` with a `SequentialTrainer`, without its own log."""

    def __init__(self, config: Config, worlds: Worlds) -> None:
        from skrl.utils.runner.jax import Runner

        self.config, self.iteration, self.env = config, 0, skrl.wrapped(worlds)
        with contextlib.redirect_stdout(io.StringIO()), _without_warnings():
            self.runner = Runner(self.env, self._settings())
        self.agent = skrl.told_true_ends(self.runner.agent)
        self.recent = Recent(worlds)

    def _settings(self) -> dict[str, Any]:
        ppo = self.config.ppo
        by_kl = ppo.schedule == "adaptive"
        scaler = "RunningStandardScaler" if ppo.normalize_observations else None
        found = skrl.settings(
            ppo.num_steps, rollouts=ppo.num_steps, learning_epochs=ppo.num_epochs, mini_batches=ppo.num_minibatches,
            discount_factor=ppo.gamma, gae_lambda=ppo.gae_lambda, learning_rate=ppo.learning_rate,
            learning_rate_scheduler="KLAdaptiveLR" if by_kl else None,
            learning_rate_scheduler_kwargs={"kl_threshold": ppo.desired_kl} if by_kl else {},
            observation_preprocessor=scaler, state_preprocessor=scaler if self.env.state_space else None,
            grad_norm_clip=ppo.max_grad_norm, ratio_clip=ppo.clip_param,
            value_clip=ppo.clip_param if ppo.use_clipped_value_loss else 0.0, entropy_loss_scale=ppo.entropy_coef,
            value_loss_scale=ppo.value_loss_coef,
        )  # fmt: skip
        sees = {"policy": "OBSERVATIONS", "value": "STATES" if self.env.state_space else "OBSERVATIONS"}
        for name, widths in (("policy", ppo.hidden_actor), ("value", ppo.hidden_critic)):
            net = {"name": "net", "input": sees[name], "layers": list(widths), "activations": ppo.activation}
            found["models"][name]["network"] = [net]
        # without its limits of the spread, as ours has none
        found["models"]["policy"] |= {"initial_log_std": float(np.log(ppo.init_std)), "clip_log_std": False}
        found["seed"] = self.config.seed
        return found

    def learn(self, iterations: int) -> dict[str, float]:
        steps = iterations * self.config.ppo.num_steps
        agent, env = self.agent, self.env
        agent.enable_training_mode(True)
        obs, state = env.reset()[0], env.state()
        for step in range(steps):
            agent.pre_interaction(timestep=step, timesteps=steps)
            actions, _ = agent.act(obs, state, timestep=step, timesteps=steps)
            after, reward, terminated, truncated, info = env.step(actions)
            agent.record_transition(
                observations=obs, states=state, actions=actions, rewards=reward, next_observations=after,
                next_states=env.state(), terminated=terminated, truncated=truncated, infos=info, timestep=step,
                timesteps=steps,
            )  # fmt: skip
            agent.post_interaction(timestep=step, timesteps=steps)
            obs, state = after, env.state()
        self.iteration += iterations
        return self.recent.metrics() | self._losses() | {"Loss/learning_rate": float(agent.policy_learning_rate)}

    def _losses(self) -> dict[str, float]:
        """Those that it gathers for its own log; that grew for ever if nobody took them."""
        kept = self.agent.tracking_data
        found = {tag: float(np.mean(kept[name])) for name, tag in TAGS.items() if kept.get(name)}
        kept.clear()
        if "Loss/value" in found:
            found["Loss/value"] /= self.config.ppo.value_loss_coef or 1.0  # its own is times that
        return found

    def policy(self) -> Policy:
        params = self.agent.policy.state_dict.params["params"]
        net = params["net_container"]
        names = sorted(net, key=lambda name: int(name.rpartition("_")[2]))
        layers = [(net[name]["kernel"], net[name]["bias"]) for name in names]
        log_std = params["log_std_parameter"]
        if not self.config.ppo.normalize_observations:
            return shared.policy_of(layers, log_std, self.config.ppo)
        seen = self.agent._observation_preprocessor
        scale = np.sqrt(np.asarray(seen.running_variance)) + seen.epsilon
        return shared.policy_of(layers, log_std, self.config.ppo, seen.running_mean, scale)

    def _tree(self) -> dict[str, Any]:
        """All that learning goes on with, as arrays."""
        agent = self.agent
        scalers = {name: getattr(agent, f"_{name}") for name in SCALERS}
        return {
            "policy": agent.policy.state_dict.params,
            "value": agent.value.state_dict.params,
            "optimizers": [agent.policy_optimizer.state, agent.value_optimizer.state],
            "rates": np.array([agent.policy_learning_rate, agent.value_learning_rate]),
            "scales": {n: {m: getattr(s, m) for m in MOMENTS} for n, s in scalers.items() if hasattr(s, MOMENTS[0])},
        }

    def save(self, folder: Path) -> None:
        from flax import serialization

        (folder / "model.msgpack").write_bytes(serialization.to_bytes(jax.device_get(self._tree())))

    def load(self, folder: Path) -> None:
        from flax import serialization

        agent = self.agent
        kept = serialization.from_bytes(self._tree(), (folder / "model.msgpack").read_bytes())
        for name in ("policy", "value"):
            model = getattr(agent, name)
            model.state_dict = model.state_dict.replace(params=kept[name])
        for name, state in zip(("policy_optimizer", "value_optimizer"), kept["optimizers"], strict=True):
            setattr(agent, name, getattr(agent, name).replace(state=state))
        agent.policy_learning_rate, agent.value_learning_rate = (float(x) for x in kept["rates"])
        for name, moments in kept["scales"].items():
            for moment, value in moments.items():
                setattr(getattr(agent, f"_{name}"), moment, value)
