"""Other libraries' trainers on our worlds: what each is told on a counter, and that each learns to balance a pole.

Libraries that are not installed are skipped; `pip install 'bayessim-mjx[sb3,rsl-rl,skrl,rl-games,playground]'`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers.agents.shared import Recent
from tests.wrappers.toys import Counter

ENV = Counter()
NEEDED = {
    "sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl", "rl_games": "rl_games",
    "playground": "mujoco_playground",
}  # fmt: skip

# mean return on Cartpole at its nominal parameters, of 500; random actions get 3, none at all 35
# (its ranges have springs that hold the pole: there doing nothing gets 210)
BALANCED = 300


def wrapper(name):
    """Our module for a library, skipped where the library is not installed."""
    pytest.importorskip(NEEDED[name])
    from importlib import import_module

    return import_module(f"bayessim_mjx.wrappers.{name}")


def test_a_library_that_is_missing_is_named():
    missing = [name for name, module in NEEDED.items() if not _there(module)]
    if not missing:
        pytest.skip("all are installed")
    from importlib import import_module

    for name in missing:
        with pytest.raises(UserError, match=r"pip install 'bayessim-mjx\[" + name.replace("_", "-")):
            import_module(f"bayessim_mjx.wrappers.{name}")


def _there(module):
    import importlib.util

    return importlib.util.find_spec(module) is not None


def test_sb3_is_told_ends_and_last_observations():
    env = wrapper("sb3").make(ENV, 3)
    from stable_baselines3.common.monitor import Monitor

    env.env_method("set_theta", [[2.0], [5.0], [9.0]])
    assert env.reset().shape == (3, 3) and env.env_is_wrapped(Monitor) == [True] * 3
    for step in range(5):
        seen, reward, done, infos = env.step(np.full((3, 1), 0.5, np.float32))
        if step == 1:
            np.testing.assert_array_equal(done, [True, False, False])
            np.testing.assert_array_equal(infos[0]["terminal_observation"][[0, 2]], [2, 2])
            assert infos[0]["episode"]["l"] == 2 and infos[0]["episode"]["r"] == 3.0
            assert not infos[0]["TimeLimit.truncated"] and not infos[1] and not infos[2]
    np.testing.assert_array_equal(done, [False, True, True])
    assert [infos[i].get("TimeLimit.truncated") for i in range(3)] == [None, False, True]
    np.testing.assert_array_equal(reward, 1.5)
    assert seen.dtype == np.float32 and seen.flags.writeable
    np.testing.assert_array_equal(np.concatenate(env.get_attr("theta")), [2, 5, 9])
    with pytest.raises(UserError, match="allowed: set_theta"):
        env.env_method("fly")


def test_rsl_rl_is_told_time_outs_groups_and_last_observations():
    env = wrapper("rsl_rl").make(ENV, 3)
    import torch

    env.worlds.set_theta([[2.0], [5.0], [9.0]])
    obs, _ = env.reset()
    assert set(obs.keys()) == {"policy", "critic"} and obs["critic"].shape == (3, 6)
    assert (env.num_actions, env.max_episode_length, env.step_dt) == (1, 5, 0.1)
    for _ in range(5):
        obs, reward, dones, extras = env.step(torch.full((3, 1), 7.0))
    assert dones.tolist() == [0, 1, 1] and extras["time_outs"].tolist() == [False, False, True]
    assert extras["final_observations"]["policy"][:, 0].tolist() == [1, 5, 5] and obs["policy"][:, 0].tolist() == [
        1,
        0,
        0,
    ]
    assert reward.tolist() == [2.0, 2.0, 2.0]  # actions are clipped to +-1
    env.episode_length_buf = torch.tensor([0, 3, 4])
    assert env.episode_length_buf.tolist() == [0, 3, 4]
    _, _, dones, extras = env.step(torch.zeros(3, 1))
    assert extras["time_outs"].tolist()[2] is True


def test_rsl_rls_ppo_adds_the_value_of_the_true_last_observation():
    """r + gamma V(what the step led to), by a critic that says the number of steps."""
    ours = wrapper("rsl_rl")
    import torch
    from rsl_rl.runners import OnPolicyRunner

    env = ours.make(ENV, 2)
    env.worlds.set_theta([[9.0], [9.0]])
    env.reset()
    runner = OnPolicyRunner(env, ours.settings(num_steps_per_env=5), log_dir=None, device="cpu")
    alg, obs = runner.alg, env.get_observations()
    alg.critic.forward = lambda obs, *_, **__: obs["policy"][:, :1]
    with torch.inference_mode():
        for _ in range(5):
            action = alg.act(obs)
            obs, reward, dones, extras = env.step(torch.zeros_like(action))
            alg.process_env_step(obs, reward, dones, extras)
    np.testing.assert_allclose(alg.storage.rewards[:, 0, 0], [1, 1, 1, 1, 1 + 0.99 * 5], rtol=1e-6)


def test_rsl_rl_mirrors_by_the_tasks_maps():
    ours = wrapper("rsl_rl")
    import torch
    from tensordict import TensorDict

    env = ours.make("Cartpole", 2)
    x, u = torch.arange(8.0).reshape(2, 4), torch.ones(2, 1)
    obs, actions = ours.mirrored(env, TensorDict({"policy": x}, batch_size=2), u)
    assert torch.equal(obs["policy"], torch.cat([x, -x])) and torch.equal(actions, torch.cat([u, -u]))
    with pytest.raises(UserError, match="no mirror symmetry"):
        ours.mirrored(ours.make(ENV, 2), None, u)


@pytest.mark.parametrize("library", ["jax", "torch"])
def test_skrl_is_told_columns_and_the_critics_state(library):
    ours = wrapper("skrl")
    env = ours.make(ENV, 3, library=library)
    env.worlds.set_theta([[2.0], [5.0], [9.0]])
    env.reset()
    action = jnp.zeros((3, 1))
    if library == "torch":
        import torch

        action = torch.zeros(3, 1)
    for _ in range(5):
        obs, reward, terminated, truncated, info = env.step(action)
    assert obs.shape == (3, 3) and env.state().shape == (3, 6) and env.state_space.shape == (6,)
    assert reward.shape == terminated.shape == (3, 1)
    assert [bool(x) for x in terminated[:, 0]] == [False, True, False]
    assert [bool(x) for x in truncated[:, 0]] == [False, False, True]
    assert [float(x) for x in info["final_observation"][:, 0]] == [1, 5, 5]
    assert [float(x) for x in env.reset()[0][:, 0]] == [1, 0, 0]  # they restart by themselves
    with pytest.raises(UserError, match="allowed are jax, torch"):
        ours.make(ENV, 3, library="numpy")


def test_rl_games_is_told_time_outs_and_states():
    ours = wrapper("rl_games")
    import torch
    from rl_games.common import vecenv

    ours.register("counter", ENV)
    env = vecenv.create_vec_env("counter", 3)
    env.worlds.set_theta([[2.0], [5.0], [9.0]])
    first = env.reset()
    assert first["obs"].shape == (3, 3) and first["states"].shape == (3, 6)
    assert env.get_env_info()["state_space"].shape == (6,)
    for _ in range(5):
        _, reward, done, infos = env.step(torch.zeros(3, 1))
    assert done.tolist() == [False, True, True] and infos["time_outs"].tolist() == [False, False, True]


def test_playgrounds_registry_has_our_tasks():
    ours = wrapper("playground")
    from mujoco_playground._src import registry

    assert "bayessim_mjx/Pendulum" in ours.register() and "bayessim_mjx/Pendulum" in registry.ALL_ENVS
    env = registry.load("bayessim_mjx/Pendulum", config_overrides={"episode_length": 50, "domain": "prior"})
    assert env.env.episode_length == 50 and env.action_size == 1 and env.n_substeps >= 1
    with pytest.raises(UserError, match="domain = 'posteriour'"):
        registry.load("bayessim_mjx/Pendulum", config_overrides={"domain": "posteriour"})


def test_playground_draws_physics_at_a_full_reset():
    ours = wrapper("playground")
    from mujoco_playground import wrapper as theirs

    env = theirs.wrap_for_brax_training(ours.make(ENV, domain="prior"), episode_length=4, full_reset=True)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 16))
    step, lives = jax.jit(env.step), [state.obs["state"][:, 2]]
    for _ in range(4):
        state = step(state, jnp.zeros((16, 1)))
    assert (np.asarray(state.done) > 0).any()
    begun = np.asarray(state.obs["state"][:, 0]) == 0
    assert begun.any() and (np.asarray(state.obs["state"][:, 2]) != np.asarray(lives[0]))[begun].all()


@pytest.mark.slow
def test_sb3_learns():
    ours = wrapper("sb3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy

    env = ours.make("Cartpole", 64)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=5, learning_rate=1e-3, device="cpu", seed=0)
    assert evaluate_policy(model.learn(300_000), env, 64)[0] > BALANCED


@pytest.mark.slow
@pytest.mark.parametrize("more", [{}, {"symmetry": True, "rnd": 0.1}])
def test_rsl_rl_learns(more, tmp_path):
    ours = wrapper("rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    env = ours.make("Cartpole", 64)
    runner = OnPolicyRunner(env, ours.settings(**more), log_dir=str(tmp_path), device="cpu")
    runner.learn(150, init_at_random_ep_len=True)
    assert np.mean(runner.logger.rewbuffer) > BALANCED


@pytest.mark.slow
@pytest.mark.parametrize("library", ["jax", "torch"])
def test_skrl_learns(library, tmp_path):
    ours = wrapper("skrl")
    from importlib import import_module

    runner = import_module(f"skrl.utils.runner.{library}").Runner
    env = ours.make("Cartpole", 64, library=library)
    recent = Recent(env.worlds)
    runner(env, ours.settings(5000, str(tmp_path))).run("train")
    assert recent.metrics()["Train/mean_reward"] > BALANCED


@pytest.mark.slow
def test_rl_games_learns(tmp_path):
    ours = wrapper("rl_games")
    from rl_games.torch_runner import Runner

    ours.register("Cartpole")
    runner = Runner()
    runner.load(ours.settings("Cartpole", 64, 100, str(tmp_path)))
    agent = runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)
    agent.train()
    assert agent.game_rewards.get_mean()[0] > BALANCED


@pytest.mark.slow
def test_playgrounds_training_learns():
    ours = wrapper("playground")
    from brax.training.agents.ppo import networks, train
    from mujoco_playground import wrapper as theirs

    found = {}
    sizes = {"policy_hidden_layer_sizes": (64, 64), "value_hidden_layer_sizes": (64, 64)}
    keys = {"policy_obs_key": "state", "value_obs_key": "privileged_state"}
    train.train(
        environment=ours.make("Cartpole"),
        wrap_env_fn=functools.partial(theirs.wrap_for_brax_training, full_reset=True),
        num_timesteps=400_000, num_evals=2, episode_length=500, num_envs=64, batch_size=16, num_minibatches=4,
        unroll_length=16, num_updates_per_batch=4, learning_rate=1e-3, normalize_observations=True, discounting=0.99,
        entropy_cost=1e-3, network_factory=functools.partial(networks.make_ppo_networks, **sizes, **keys),
        progress_fn=lambda step, metrics: found.update({step: float(metrics["eval/episode_reward"])}),
    )  # fmt: skip
    assert found[max(found)] > BALANCED
