"""Observations that are pictures: what each library gets, that convolutions train on them, and who refuses them."""

from collections import OrderedDict

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers import pictures
from bayessim_mjx.wrappers.conversion import boxes
from bayessim_mjx.wrappers.gymnasium import GymnasiumEnv
from bayessim_mjx.wrappers.worlds import Worlds
from tests.wrappers.toys import Camera, Counter

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


@pytest.mark.parametrize(
    ("library", "seen"), [("jax", "OBSERVATIONS"), ("torch", "permute(OBSERVATIONS, (0, 3, 1, 2))")]
)
def test_skrls_convolutions_train(library, seen, tmp_path):
    pytest.importorskip("skrl")
    from importlib import import_module

    from bayessim_mjx.wrappers import skrl

    env = skrl.make(ENV, 4, library=library)
    env.step(env.reset()[0][:, :1])
    bright, _ = env.reset()
    assert bright.shape == (4, 36 * 36) and env.observation_space.shape == (36, 36, 1)
    assert float(bright[0, 0]) == pytest.approx(40 / 255)
    settings = skrl.settings(
        4, str(tmp_path), rollouts=4, mini_batches=1, learning_epochs=1, observation_preprocessor=None
    )
    eye = {"name": "eye", "input": seen, "layers": [{"conv2d": {"out_channels": 4, "kernel_size": 8, "stride": 4}}]}
    eye["layers"].append("flatten")
    for model in ("policy", "value"):
        settings["models"][model]["network"] = [
            eye | {"activations": "elu"}, {"name": "net", "input": "eye", "layers": [8], "activations": "elu"},
        ]  # fmt: skip
    import_module(f"skrl.utils.runner.{library}").Runner(env, settings).run("train")


def test_rl_games_convolutions_train(tmp_path):
    pytest.importorskip("rl_games")
    from rl_games.torch_runner import Runner

    from bayessim_mjx.wrappers import rl_games

    rl_games.register("Camera", ENV)
    small = {"horizon_length": 4, "minibatch_size": 16, "mini_epochs": 1, "normalize_input": False}
    settings = rl_games.settings("Camera", 4, 1, str(tmp_path), **small)
    convolution = {"filters": 4, "kernel_size": 8, "strides": 4, "padding": 0}
    plain = {"activation": "relu", "initializer": {"name": "default"}, "regularizer": {"name": "None"}}
    network = {"type": "conv2d", "permute_input": True, "convs": [convolution]}
    settings["params"]["network"]["cnn"] = network | plain
    runner = Runner()
    runner.load(settings)
    agent = runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)
    agent.train()
    assert agent.epoch_num == 1


def test_cameras_keep_what_was_asked_for_last():
    """Models and renderers are dear to make, and renderers dear to keep."""
    store, made = OrderedDict(), []

    def ask(key):
        return pictures._kept(store, key, 2, lambda: made.append(key) or key.upper())

    assert [ask(key) for key in (b"a", b"b", b"a", b"c", b"a", b"b")] == [b"A", b"B", b"A", b"C", b"A", b"B"]
    assert made == [b"a", b"b", b"c", b"b"] and list(store) == [b"a", b"b"]
