"""What Brax and MuJoCo Playground publish for their PPO, and the same in our words."""

from dataclasses import replace

# Brax's published settings (its training notebook; Playground's brax_ppo_config), with its names
SHARED = {
    "reward_scaling": 10, "normalize_observations": True, "num_minibatches": 32, "entropy_cost": 1e-2,
    "episode_length": 1000,
}  # fmt: skip
PUBLISHED = {
    "brax:ant": SHARED | {
        "num_timesteps": 50_000_000, "num_evals": 10, "unroll_length": 5, "num_updates_per_batch": 4,
        "discounting": 0.97, "learning_rate": 3e-4, "num_envs": 4096, "batch_size": 2048,
    },
    "brax:inverted_pendulum": SHARED | {
        "num_timesteps": 2_000_000, "num_evals": 20, "unroll_length": 5, "num_updates_per_batch": 4,
        "discounting": 0.97, "learning_rate": 3e-4, "num_envs": 2048, "batch_size": 1024,
    },
    "playground:CartpoleBalance": SHARED | {
        "num_timesteps": 60_000_000, "num_evals": 10, "unroll_length": 30, "num_updates_per_batch": 16,
        "discounting": 0.995, "learning_rate": 1e-3, "num_envs": 2048, "batch_size": 1024, "num_resets_per_eval": 10,
    },
    "playground:Go1JoystickFlatTerrain": SHARED | {
        "reward_scaling": 1.0, "num_timesteps": 200_000_000, "num_evals": 10, "unroll_length": 20,
        "num_updates_per_batch": 4, "discounting": 0.97, "learning_rate": 3e-4, "num_envs": 8192, "batch_size": 256,
        "num_resets_per_eval": 10, "max_grad_norm": 1.0, "network_factory": {
            "policy_hidden_layer_sizes": (512, 256, 128), "value_hidden_layer_sizes": (512, 256, 128),
            "policy_obs_key": "state", "value_obs_key": "privileged_state",
        },
    },
}  # fmt: skip
# returns; Playground has none for its joystick, whose races end after --steps or --seconds
SOLVED = {"brax:ant": 3000.0, "brax:inverted_pendulum": 990.0, "playground:CartpoleBalance": 950.0}


def ppo_config(published: dict, widening: int, **changes):
    """The same settings in our words: samples and minibatches per update, networks, losses; `changes` are ours."""
    from bayessim_mjx.config import PPOConfig

    worlds = published["num_envs"] * widening
    samples = published["batch_size"] * published["num_minibatches"] * published["unroll_length"]
    networks = published.get("network_factory", {})
    config = PPOConfig(
        num_envs=worlds,
        num_steps=max(1, samples // worlds),
        num_epochs=published["num_updates_per_batch"],
        num_minibatches=published["num_minibatches"],
        gamma=published["discounting"],
        learning_rate=published["learning_rate"],
        entropy_coef=published["entropy_cost"],
        reward_scale=published["reward_scaling"],
        # Brax's defaults
        gae_lambda=0.95, clip_param=0.3, value_loss_coef=0.25, use_clipped_value_loss=False, schedule="fixed",
        max_grad_norm=published.get("max_grad_norm", 1e9), normalize_advantage_per_minibatch=True,
        hidden_actor=networks.get("policy_hidden_layer_sizes", (32,) * 4),
        hidden_critic=networks.get("value_hidden_layer_sizes", (256,) * 5),
        activation="swish", state_dependent_std=True, action_bound="tanh", init_std=0.7, weight_init="lecun_uniform",
        segment=published["unroll_length"],
    )  # fmt: skip
    return replace(config, **changes)


def between_restarts(published: dict) -> float:
    """Updates after which Brax restarts all worlds, whatever their episodes are at."""
    if "num_resets_per_eval" not in published:
        return float("inf")
    times = (published["num_evals"] - 1) * published["num_resets_per_eval"]
    update = published["batch_size"] * published["num_minibatches"] * published["unroll_length"]
    return -(-published["num_timesteps"] // (times * update))
