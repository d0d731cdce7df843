"""What each library adds where a time limit ended an episode: the value of the last observation, not of the next first.

The counter's critic says the number of steps, so that the last observation is worth 5 and the first one of the next
episode 0. Five rewards of 1 in each; gamma is .99, and a sixth step belongs to the next episode.
"""

from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.wrappers import agents, brax, fresh
from bayessim_mjx.wrappers.gymnasium import GymnasiumVectorEnv
from bayessim_mjx.wrappers.worlds import Worlds
from tests.wrappers.test_agent_settings import settings
from tests.wrappers.toys import Counter, Plain

NEEDED = {"sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl", "rl_games": "rl_games"}
REWARDS = [1, 1, 1, 1, 1 + 0.99 * 5, 1]  # each of six steps, with what is added where the episode ends


def made(name, env, **ppo):
    """An agent whose worlds end by time alone, with two worlds in rollouts of six steps."""
    pytest.importorskip(NEEDED[name])
    plain = {"num_steps": 6, "num_epochs": 1, "normalize_observations": False, "gamma": 0.99}
    return agents.make(settings(name, **plain | ppo), env, None)


class Deaf:
    """A counter that does not hear the action: its reward is 1."""

    def step(self, state, action):
        return super().step(state, 0.0 * action)


class DeafCounter(Deaf, Counter):
    pass


class DeafPlain(Deaf, Plain):
    pass


def test_the_worlds_tell_both():
    worlds = Worlds(DeafCounter(), num_envs=2)
    worlds.reset()
    for _ in range(5):
        batch = worlds.step(jnp.zeros((2, 1)))
    assert batch.truncated.all() and not batch.terminated.any()
    np.testing.assert_array_equal(batch.final["policy"][:, 0], 5)
    np.testing.assert_array_equal(batch.final["critic"][:, 3], 5)
    np.testing.assert_array_equal(batch.obs["policy"][:, 0], 0)


def test_sb3():
    agent = made("sb3", DeafPlain())
    agent.model.policy.predict_values = lambda obs: obs[:, :1]
    agent.learn(1)
    np.testing.assert_allclose(agent.model.rollout_buffer.rewards, np.tile(REWARDS, (6, 1)).T, rtol=1e-6)


def test_rsl_rl():
    agent = made("rsl_rl", DeafCounter())
    alg, kept = agent.runner.alg, []
    alg.critic.forward = lambda obs, *_, **__: obs["critic"][:, 3:4]
    alg.update = lambda: kept.append(alg.storage.rewards.clone()) or alg.storage.clear() or {}
    env, obs = agent.runner.env, agent.runner.env.get_observations()
    for _ in range(6):
        obs, reward, dones, extras = env.step(alg.act(obs))
        alg.process_env_step(obs, reward, dones, extras)
    np.testing.assert_allclose(alg.storage.rewards[..., 0], np.tile(REWARDS, (6, 1)).T, rtol=1e-6)


def test_rsl_rls_recurrent_critic_remembers_what_it_did_before():
    """A look at the last observation of the world that ended leaves the memory of the others as it was."""
    ours = pytest.importorskip(NEEDED["rsl_rl"]) and import_module("bayessim_mjx.wrappers.rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    recurrent = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 4, "rnn_num_layers": 1}
    plain = ours.settings(num_steps_per_env=5)
    plain = plain | {net: plain[net] | recurrent for net in ("actor", "critic")}
    env = ours.make(DeafCounter(), 4)
    runner = OnPolicyRunner(env, plain, log_dir=None, device="cpu")
    import torch

    env.episode_length_buf = torch.tensor([4, 0, 0, 0])
    alg, obs = runner.alg, env.get_observations()
    action = alg.act(obs)
    before = alg.critic.get_hidden_state().clone()
    obs, reward, dones, extras = env.step(action)
    assert extras["time_outs"].tolist() == [True, False, False, False]
    alg.process_env_step(obs, reward, dones, extras)
    after = alg.critic.get_hidden_state()
    torch.testing.assert_close(after[:, 1:], before[:, 1:], rtol=0, atol=0)
    assert not after[:, 0].any() and before[:, 0].any()  # the one that ended begins without


def skrls(agent):
    """Rewards `[6, N]` in the memory of skrl's agent, whose critic says the number of steps."""
    agent.value.act = lambda inputs, role: (inputs["states"][:, 3:4], {})
    agent.update = lambda **_: None
    return agent


def test_skrl_in_our_command():
    agent = made("skrl", DeafCounter())
    own = skrls(agent.agent)
    own._value_preprocessor = lambda x, **_: x
    agent.learn(1)
    kept = own.memory.get_tensor_by_name("rewards")[..., 0]
    np.testing.assert_allclose(kept, np.tile(REWARDS, (6, 1)).T, rtol=1e-6)


@pytest.mark.parametrize("library", ["jax", "torch"])
def test_skrls_own_trainers(library, tmp_path):
    """They give the next episode's first observation, worth 0, but where the agent is told of true ends."""
    ours = pytest.importorskip(NEEDED["skrl"]) and import_module("bayessim_mjx.wrappers.skrl")
    pytest.importorskip("torch" if library == "torch" else "jax")
    runner = import_module(f"skrl.utils.runner.{library}").Runner
    for told, expected in ((False, [1, 1, 1, 1, 1, 1]), (True, REWARDS)):
        env = ours.make(DeafCounter(), 2, library=library)
        plain = {"observation_preprocessor": None, "value_preprocessor": None, "rollouts": 6}
        run = runner(env, ours.settings(6, str(tmp_path), **plain))
        own = skrls(run.agent if not told else ours.told_true_ends(run.agent))
        run.run("train")
        kept = np.asarray(own.memory.get_tensor_by_name("rewards")[..., 0])
        np.testing.assert_allclose(kept, np.tile(expected, (2, 1)).T, rtol=1e-6)


def test_rl_games_has_the_value_before_the_last_step():
    """It takes no observation for it: the value of the one before the step, 4, as docs/trainers.md says."""
    ours = pytest.importorskip(NEEDED["rl_games"]) and import_module("bayessim_mjx.wrappers.rl_games")
    from rl_games.torch_runner import Runner

    ours.register("deaf", DeafPlain())
    runner = Runner()
    changes = {"horizon_length": 6, "minibatch_size": 12, "normalize_value": False, "normalize_input": False}
    runner.load(ours.settings("deaf", 2, 1, **changes))
    agent = runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)
    agent.init_tensors()
    agent.obs = agent.env_reset()
    values = agent.get_action_values
    agent.get_action_values = lambda obs: values(obs) | {"values": obs["obs"][:, :1]}
    agent.play_steps()
    kept = agent.experience_buffer.tensor_dict["rewards"][..., 0]
    np.testing.assert_allclose(kept, np.tile([1, 1, 1, 1, 1 + 0.99 * 4, 1], (2, 1)).T, rtol=1e-6)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_gymnasium(mode):
    """The observation that the last step led to is what is returned, but for "SameStep", which has it in `info`."""
    env = GymnasiumVectorEnv(DeafPlain(), 2, autoreset_mode=mode)
    env.reset(seed=0)
    for _ in range(5):
        seen, reward, terminated, truncated, info = env.step(np.zeros((2, 1), np.float32))
    assert truncated.all() and not terminated.any() and (reward == 1).all()
    last = np.stack(info["final_obs"]) if mode == "SameStep" else seen
    np.testing.assert_array_equal(last[:, 0], 5)
    if mode == "SameStep":
        np.testing.assert_array_equal(seen[:, 0], 0)
    elif mode == "NextStep":
        seen, reward, *_ = env.step(np.zeros((2, 1), np.float32))
        assert (seen[:, 0] == 0).all() and (reward == 0).all()


def test_brax_leaves_the_last_step_out():
    """Its estimate masks a step that time cut off: its target is its own value, and nothing of the next episode."""
    from brax.training.agents.ppo.losses import compute_gae

    env = fresh.wrap(brax.ours(DeafCounter()))
    state, rows = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2)), []
    step = jax.jit(env.step)
    for _ in range(6):
        value = state.obs["policy"][:, 0]
        state = step(state, jnp.zeros((2, 1)))
        truncation = state.info["truncation"]
        rows.append((truncation, state.done * (1 - truncation), state.reward, value))
    truncation, termination, reward, value = (jnp.stack(x) for x in zip(*rows, strict=True))
    np.testing.assert_array_equal(truncation[:, 0], [0, 0, 0, 0, 1, 0])
    np.testing.assert_array_equal(value[:, 0], [0, 1, 2, 3, 4, 0])
    targets, _ = compute_gae(truncation, termination, reward, value, state.obs["policy"][:, 0], 0.0, 0.99)
    np.testing.assert_allclose(targets[:, 0], [1 + 0.99, 1 + 1.98, 1 + 2.97, 1 + 3.96, 4, 1 + 0.99], rtol=1e-6)
