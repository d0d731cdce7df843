"""The settings that agents of other libraries were made with, read from the libraries' own objects.

{path of the setting in `ppo:`: its value}; `...` stands for a section, whose settings follow.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.config import SymmetryConfig
from bayessim_mjx.rl import networks


def widths(modules):
    """Of the hidden layers among these modules of PyTorch."""
    return tuple(m.out_features for m in modules if hasattr(m, "out_features"))[:-1]


def function(modules):
    """The name of the activation among these modules, by its values."""
    import torch

    x = np.linspace(-3, 3, 31, dtype=np.float32)
    acts = [m for m in modules if not hasattr(m, "weight") and type(m).__name__ != "Identity"]
    same = {n: f for n, f in networks.ACTIVATIONS.items() if n != "celu"}  # which is elu at the scale it has
    alike = lambda m, f: np.allclose(m(torch.from_numpy(x)).numpy(), f(jnp.asarray(x)), atol=1e-6)  # noqa: E731
    (name,) = {name for m in acts for name, ours in same.items() if alike(m, ours)}
    return name


def of_sb3(agent):
    model, wrapped = agent.model, agent.env
    pi, vf = model.policy.mlp_extractor.policy_net, model.policy.mlp_extractor.value_net
    worlds = wrapped.unwrapped.worlds if hasattr(wrapped, "obs_rms") else wrapped.worlds
    buffer, samples = model.rollout_buffer, model.n_envs * model.n_steps
    once = [r for r in (np.random.default_rng(0).normal(size=buffer.rewards.shape),) if not model.normalize_advantage]
    for rewards in once:  # advantages of the buffer have mean 0 and spread 1 themselves
        buffer.rewards[:] = rewards
        import torch

        buffer.compute_returns_and_advantage(torch.zeros(model.n_envs), np.zeros(model.n_envs))
        assert buffer.advantages.mean() == pytest.approx(0.0, abs=1e-5) and buffer.advantages.std() == pytest.approx(
            1.0
        )
    found = {
        "num_envs": model.n_envs, "num_steps": model.n_steps, "num_epochs": model.n_epochs,
        "num_minibatches": samples / model.batch_size, "gamma": model.gamma, "gae_lambda": buffer.gae_lambda,
        "clip_param": model.clip_range(1.0), "use_clipped_value_loss": model.clip_range_vf is not None,
        "value_loss_coef": model.vf_coef, "entropy_coef": model.ent_coef, "max_grad_norm": model.max_grad_norm,
        "learning_rate": model.policy.optimizer.param_groups[0]["lr"],
        "schedule": "fixed" if model.target_kl is None else "adaptive", "desired_kl": model.target_kl,
        "normalize_observations": getattr(wrapped, "norm_obs", False), "reward_scale": worlds.reward_scale,
        "normalize_advantage_per_minibatch": model.normalize_advantage,
        "hidden_actor": widths([*pi, model.policy.action_net]),
        "hidden_critic": widths([*vf, model.policy.value_net]), "activation": function([*pi, *vf]),
        "init_std": float(model.policy.log_std.detach().exp().mean()),
    }  # fmt: skip
    assert buffer.gamma == model.gamma
    assert model.clip_range_vf is None or model.clip_range_vf(1.0) == found["clip_param"]
    return found


def of_rsl_rl(agent):
    alg, env = agent.runner.alg, agent.runner.env
    normalised = {type(net.obs_normalizer).__name__ != "Identity" for net in (alg.actor, alg.critic)}
    assert alg.critic.obs_groups == ["critic"] and alg.actor.obs_groups == ["policy"] and len(normalised) == 1
    found = {
        "num_envs": env.num_envs, "num_steps": alg.storage.num_transitions_per_env, "gamma": alg.gamma,
        "num_epochs": alg.num_learning_epochs, "num_minibatches": alg.num_mini_batches, "gae_lambda": alg.lam,
        "clip_param": alg.clip_param,
        "use_clipped_value_loss": alg.use_clipped_value_loss, "value_loss_coef": alg.value_loss_coef,
        "entropy_coef": alg.entropy_coef, "learning_rate": alg.optimizer.param_groups[0]["lr"],
        "schedule": alg.schedule,
        "desired_kl": alg.desired_kl, "max_grad_norm": alg.max_grad_norm, "normalize_observations": normalised.pop(),
        "normalize_advantage_per_minibatch": alg.normalize_advantage_per_mini_batch,
        "reward_scale": env.worlds.reward_scale, "hidden_actor": widths(alg.actor.mlp),
        "hidden_critic": widths(alg.critic.mlp), "activation": function([*alg.actor.mlp, *alg.critic.mlp]),
        "init_std": float(alg.actor.distribution.log_std_param.detach().exp().mean()),
        "rnd": None, "symmetry": None,
    }  # fmt: skip
    assert alg.learning_rate == found["learning_rate"] and agent.runner.cfg["num_steps_per_env"] == found["num_steps"]
    if (s := alg.symmetry) is not None:
        names = [field.name for field in dataclasses.fields(SymmetryConfig)]
        found |= {"symmetry": ...} | {f"symmetry.{name}": getattr(s, name) for name in names}
    if (own := alg.rnd) is not None:
        dt = env.step_dt
        found |= {
            "rnd": ..., "rnd.num_outputs": own.num_outputs, "rnd.predictor_hidden_dims": widths(own.predictor),
            "rnd.target_hidden_dims": widths(own.target), "rnd.activation": function([*own.predictor, *own.target]),
            "rnd.state_normalization": type(own.state_normalizer).__name__ != "Identity",
            "rnd.reward_normalization": type(own.reward_normalizer).__name__ != "Identity",
            "rnd.weight": own.initial_weight / dt, "rnd.learning_rate": own.optimizer.param_groups[0]["lr"],
            "rnd.obs_groups": tuple(own.obs_groups["rnd_state"]), "rnd.weight_schedule": ...,
        }  # fmt: skip
        assert own.num_states == sum(env.env.observation_size[group][0] for group in found["rnd.obs_groups"])
        if found["rnd.reward_normalization"]:
            assert own.reward_normalizer.disc_avg.gamma == agent.config.ppo.gamma
        if own.weight_scheduler is not None:
            given = own.weight_scheduler_params
            last = given["final_value"] / dt
            found |= {f"rnd.weight_schedule.{n}": given[n] for n in ("mode", "initial_step", "final_step")}
            found |= {"rnd.weight_schedule.final_value": last}
    return found


def of_skrl(agent):
    own, cfg = agent.agent, agent.agent.cfg

    def net(model):
        params = model.state_dict.params["params"]["net_container"]
        layers = sorted(params, key=lambda name: int(name.rpartition("_")[2]))
        return [params[name]["kernel"].shape for name in layers]

    assert net(own.policy)[0][0] == 3 and net(own.value)[0][0] == 6  # the critic sees its own group
    scaled = {cfg.observation_preprocessor is not None, cfg.state_preprocessor is not None}
    assert len(scaled) == 1 and own.policy_learning_rate == own.value_learning_rate
    found = {
        "num_envs": agent.env.num_envs, "num_steps": cfg.rollouts, "num_epochs": cfg.learning_epochs,
        "num_minibatches": cfg.mini_batches, "gamma": cfg.discount_factor, "gae_lambda": cfg.gae_lambda,
        "clip_param": cfg.ratio_clip, "use_clipped_value_loss": cfg.value_clip > 0,
        "entropy_coef": cfg.entropy_loss_scale,
        "value_loss_coef": cfg.value_loss_scale, "learning_rate": own.policy_learning_rate,
        "schedule": "fixed" if own.policy_scheduler is None else "adaptive",
        "desired_kl": cfg.learning_rate_scheduler_kwargs[0].get("kl_threshold"), "max_grad_norm": cfg.grad_norm_clip,
        "normalize_observations": scaled.pop(), "reward_scale": agent.env.worlds.reward_scale,
        "hidden_actor": tuple(shape[1] for shape in net(own.policy)[:-1]),
        "hidden_critic": tuple(shape[1] for shape in net(own.value)[:-1]),
        "init_std": float(np.exp(own.policy.state_dict.params["params"]["log_std_parameter"]).mean()),
        "activation": agent.config.ppo.activation,  # `acts_alike`
    }  # fmt: skip
    assert (
        cfg.time_limit_bootstrap
        and cfg.value_clip in (0.0, found["clip_param"])
        and own.memory.memory_size == cfg.rollouts
    )
    return found
