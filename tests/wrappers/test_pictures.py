"""Observations that are pictures: what each library gets, that convolutions train on them, and who refuses them."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toys import Camera, Counter  # noqa: E402

from bayessim_mjx import rl  # noqa: E402
from bayessim_mjx.config import PPOConfig  # noqa: E402
from bayessim_mjx.errors import UserError  # noqa: E402
from bayessim_mjx.wrappers.gymnasium import GymnasiumEnv  # noqa: E402
from bayessim_mjx.wrappers.spaces import boxes  # noqa: E402
from bayessim_mjx.wrappers.worlds import Worlds  # noqa: E402

ENV = Camera()
BRIGHT = [0, 40, 80, 120, 160]


def test_bytes_have_their_range_and_numbers_have_none():
    seen, _ = boxes(ENV)
    assert (seen.shape, seen.dtype, seen.low.min(), seen.high.max()) == ((36, 36, 1), np.uint8, 0, 255)
    assert boxes(ENV, "numbers")[0].dtype == np.float32 and boxes(Counter())[0].shape == (3,)


def test_worlds_and_gymnasium_show_the_pictures_of_their_steps():
    worlds, one = Worlds(ENV, None, 2), GymnasiumEnv(ENV)
    shown = [np.asarray(worlds.reset()["policy"])[1, 3, 4, 0]]
    last = [one.reset(seed=0)[0]]
    for _ in range(4):
        shown.append(np.asarray(worlds.step(jnp.zeros((2, 1))).obs["policy"])[1, 3, 4, 0])
        last.append(one.step(np.zeros(1, np.float32))[0])
    assert shown == BRIGHT == [x[0, 0, 0] for x in last]
    assert all(x in one.observation_space for x in last)


def test_our_own_networks_refuse_a_picture_and_take_the_vector_beside_it():
    config = PPOConfig(num_envs=8, num_steps=4, num_minibatches=2, hidden_actor=(4,), hidden_critic=(4,))
    with pytest.raises(UserError, match=r"group 'policy' has shape \[36, 36, 1\]: our networks take vectors.*trainers"):
        rl.init(ENV, config, jax.random.PRNGKey(0))
    from bayessim_mjx.rl.groups import for_policy

    assert for_policy(ENV, ("numbers",)).observation_size["policy"] == (3,)
    with pytest.raises(UserError, match="group 'policy' has shape"):
        for_policy(ENV, ("numbers", "policy"))


def test_agents_of_our_commands_refuse_a_picture():
    pytest.importorskip("stable_baselines3")
    from bayessim_mjx.config import load
    from bayessim_mjx.wrappers import agents

    with pytest.raises(UserError, match="group 'policy' has shape"):
        agents.make(load("Cartpole", flags={"--agent": ("agent", "sb3")}, overrides=["ppo.symmetry=null"]), ENV, None)


def test_sb3s_convolutions_train():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from bayessim_mjx.wrappers import sb3

    model = PPO("CnnPolicy", sb3.make(ENV, 2), n_steps=4, batch_size=8, n_epochs=1, device="cpu", seed=0)
    before = model.policy.features_extractor.cnn[0].weight.detach().clone()
    model.learn(16)
    assert (model.policy.features_extractor.cnn[0].weight != before).any()


def test_rsl_rls_convolutions_train():
    pytest.importorskip("rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    from bayessim_mjx.wrappers import rsl_rl

    settings = rsl_rl.settings(num_steps_per_env=4)
    network = {"class_name": "CNNModel", "hidden_dims": [8], "activation": "elu"}
    network |= {"cnn_cfg": {"output_channels": [4, 4], "kernel_size": [8, 4], "stride": [4, 2]}}
    settings["actor"] = network | {"distribution_cfg": settings["actor"]["distribution_cfg"]}
    settings["critic"] = dict(network)
    settings["obs_groups"] = {"actor": ["policy", "numbers"], "critic": ["policy", "numbers"]}
    runner = OnPolicyRunner(rsl_rl.make(ENV, 4), settings, log_dir=None, device="cpu")
    before = [p.detach().clone() for p in runner.alg.actor.parameters()]
    runner.learn(1)
    assert any((p != q).any() for p, q in zip(runner.alg.actor.parameters(), before, strict=True))


@pytest.mark.parametrize("library", ["jax", "torch"])
def test_skrl_gets_them_flat_with_their_shape_beside(library):
    pytest.importorskip("skrl")
    from bayessim_mjx.wrappers import skrl

    env = skrl.make(ENV, 2, library=library)
    seen, _ = env.reset()
    assert seen.shape == (2, 36 * 36) and env.observation_space.shape == (36, 36, 1)
