"""Gymnasium's own checks, makers and wrappers on our environments, and the vector environment's restarts."""

import subprocess
import sys
import warnings

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

from bayessim_mjx.errors import UserError
from bayessim_mjx.registry import make
from bayessim_mjx.wrappers.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from tests.rl import probes

NAME = "bayessim_mjx/Pendulum-v0"


@pytest.mark.parametrize("order", ["bayessim_mjx, gymnasium", "gymnasium, bayessim_mjx"])
def test_gymnasium_knows_our_tasks_by_name(order):
    """In whichever order the two are imported, and without a heavy import for those who do not use it."""
    told = f"'{NAME}' in gymnasium.registry"
    code = f"import sys, {order}; assert {told}; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
@pytest.mark.ci
def test_gymnasiums_maker_and_checker_accept_a_task():
    env = gymnasium.make(NAME, episodeLength=3)
    assert env.spec.id == NAME and env.unwrapped.env.episode_length == 3
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="no video")  # where there is no OpenGL
        check_env(env.unwrapped)


@pytest.mark.slow
@pytest.mark.ci
def test_a_picture_of_the_present_state():
    env = gymnasium.make(NAME, render_mode="rgb_array", theta=[1.2, 1.2])
    assert env.metadata["render_modes"] == ["rgb_array"] and env.metadata["render_fps"] == 20  # dt 0.05 s
    env.reset(seed=0)
    if env.render() is None:
        pytest.skip("no OpenGL here")
    pictures = [env.render() for _ in range(10) if env.step(np.ones(1, np.float32))]
    assert pictures[0].shape == (360, 480, 3) and pictures[0].dtype == np.uint8
    assert np.any(pictures[0] != pictures[-1])
    many = gymnasium.make_vec(NAME, num_envs=2, render_mode="rgb_array")
    many.reset(seed=0)
    assert [p.shape for p in many.render()] == [(360, 480, 3)] * 2


@pytest.mark.slow
@pytest.mark.ci
def test_many_worlds_by_gymnasiums_maker_under_gymnasiums_wrappers():
    env = gymnasium.make_vec(NAME, num_envs=3, episodeLength=4)
    assert env.spec.id == NAME and env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    whole = wrappers.RecordEpisodeStatistics(wrappers.NormalizeObservation(env))
    whole.reset(seed=0)
    lengths = [whole.step(whole.action_space.sample())[4].get("episode", {"l": 0})["l"] for _ in range(10)]
    assert [np.max(n) for n in lengths] == [0, 0, 0, 4, 0, 0, 0, 0, 4, 0]  # the fifth step is the restart


def test_episode_of_one_world():
    env = GymnasiumEnv(probes.Lifetime(), theta=[2.0])
    with pytest.raises(UserError, match="reset"):
        env.step(np.zeros(1))
    first, info = env.reset(seed=3)
    assert info["theta"] == 2.0
    assert [env.step(np.zeros(1))[1:4] for _ in range(2)] == [(1.0, False, False), (1.0, True, False)]
    again, info = env.reset(seed=3, options={"theta": [9.0]})
    np.testing.assert_array_equal(first, again)
    assert info["theta"] == 9.0


def test_one_world_draws_its_physics_anew_in_each_episode_until_it_is_given():
    env = GymnasiumEnv(probes.Lifetime(), domain=probes.Domain(jnp.array([2.0]), jnp.array([5.0])))
    drawn = [float(env.reset(seed=None if i else 0)[1]["theta"][0]) for i in range(6)]
    assert len(set(drawn)) == 6 and min(drawn) >= 2 and max(drawn) <= 5
    assert [env.reset(options=o)[1]["theta"].tolist() for o in ({"theta": [3.0]}, None)] == [[3.0], [3.0]]


def test_many_worlds_under_a_domain_by_name():
    env = gymnasium.make_vec(NAME, num_envs=8, domain="prior")
    thetas = env.reset(seed=0)[1]["theta"]
    assert len(np.unique(thetas[:, 0])) == 8
    with pytest.raises(UserError, match="domain = 'posteriour'"):
        gymnasium.make_vec(NAME, num_envs=2, domain="posteriour")


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_statistics_of_episodes_in_both_modes_of_restarting(mode):
    """Lifetime's theta is how many steps an episode takes, and its return."""
    env = GymnasiumVectorEnv(probes.Lifetime(), 2, autoreset_mode=mode)
    env = wrappers.RecordEpisodeStatistics(env)
    env.reset(seed=1, options={"theta": np.array([[2.0], [3.0]])})
    seen = []
    for step in range(8):
        _, reward, terminated, _, info = env.step(np.zeros((2, 1), np.float32))
        found = info.get("episode", {"r": None, "l": None})
        seen += [(step, int(i), float(found["r"][i]), int(found["l"][i])) for i in np.flatnonzero(terminated)]
    pause = mode == "NextStep"  # a step between the episodes
    ends = [(n * k + n - 1 + pause * k, n - 2, float(n), n) for n in (2, 3) for k in range(4)]
    assert seen == sorted(e for e in ends if e[0] < 8)


def test_next_step_begins_with_a_fresh_observation_and_no_reward():
    env = GymnasiumVectorEnv(probes.Lifetime(), 2)
    env.reset(seed=0, options={"theta": np.array([[1.0], [9.0]])})
    last, reward, terminated, *_ = env.step(np.zeros((2, 1)))
    assert terminated.tolist() == [True, False] and reward.tolist() == [1, 1] and (last > 1).all()
    first, reward, terminated, _, info = env.step(np.zeros((2, 1)))
    assert reward.tolist() == [0, 1] and not terminated.any() and info == {}
    assert 0 < first[0] < 1 and first[1] == last[1] + 1


def test_reset_of_some_worlds_and_their_parameters():
    env = GymnasiumVectorEnv(probes.Lifetime(), 3, autoreset_mode="Disabled")
    with pytest.raises(UserError, match="before the first reset"):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    _, info = env.reset(seed=0, options={"theta": [1.0]})
    assert info["theta"].tolist() == [[1], [1], [1]]
    before, *_ = env.step(np.zeros((3, 1)))
    with pytest.raises(UserError, match=r"worlds \[0, 1, 2\] have ended"):
        env.step(np.zeros((3, 1)))
    mask = np.array([False, True, False])
    after, info = env.reset(options={"reset_mask": mask, "theta": [5.0]})
    assert info["theta"].tolist() == [[1], [5], [1]] and info["_theta"].tolist() == mask.tolist()
    assert (after == before)[:, 0].tolist() == (~mask).tolist()
    with pytest.raises(UserError, match=r"worlds \[0, 2\] have ended"):
        env.step(np.zeros((3, 1)))
    for wrong, words in ((np.ones(3), "float64"), (np.ones(2, bool), r"bool \[2\]"), ([True] * 3, r"\[True")):
        with pytest.raises(UserError, match=f"reset_mask.*{words}.*expected a numpy array"):
            env.reset(options={"reset_mask": wrong})
    with pytest.raises(UserError, match="names no world"):
        env.reset(options={"reset_mask": np.zeros(3, bool)})


def test_parameters_that_cannot_be_meant_are_refused():
    env = make("Pendulum")
    name, low, high = env.space.names[0], env.space.low[0], env.space.high[0]
    one, many = GymnasiumEnv(env), GymnasiumVectorEnv(env, 2)
    for reset in (one.reset, many.reset):
        with pytest.raises(UserError, match=rf"theta: {name} = 99; allowed: \[{low:g}, {high:g}\]"):
            reset(options={"theta": [99.0, 1.0]})
        with pytest.raises(UserError, match=r"theta has shape \[3\]; expected \[2\]"):
            reset(options={"theta": [1.0, 1.0, 1.0]})
        with pytest.raises(UserError, match=r"options\['thta'\]: unknown; allowed: theta"):
            reset(options={"thta": [1.0]})
    with pytest.raises(UserError, match=f"{name} = nan"):
        GymnasiumEnv(env, theta=[np.nan, 1.0])
    with pytest.raises(UserError, match="render_mode = 'human': allowed: None, 'rgb_array'"):
        GymnasiumEnv(env, render_mode="human")
    with pytest.raises(UserError, match="autoreset_mode = 'never'; allowed: NextStep, SameStep, Disabled"):
        GymnasiumVectorEnv(env, 2, autoreset_mode="never")
    with pytest.raises(UserError, match="num_envs = 0"):
        GymnasiumVectorEnv(env, 0)


def test_an_action_of_another_shape_is_refused_with_the_right_one():
    env = make("Pendulum")
    for worlds, shape in ((GymnasiumEnv(env), r"\(1,\)"), (GymnasiumVectorEnv(env, 2), r"\(2, 1\)")):
        worlds.reset(seed=0)
        with pytest.raises(UserError, match=rf"an action of shape \(3,\); allowed: {shape}"):
            worlds.step(np.zeros(3))


def test_ended_worlds_restart_and_keep_their_last_observation():
    domain = probes.Domain(jnp.array([2.0]), jnp.array([3.0]))
    env = GymnasiumVectorEnv(probes.Clock(), 3, domain, "SameStep")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (3, 1) == env.observation_space.shape
    for _ in range(3):
        *_, info = env.step(np.zeros((3, 1), np.float32))
        assert info == {}
    observation, reward, terminated, truncated, info = env.step(np.zeros((3, 1), np.float32))
    np.testing.assert_array_equal(observation, np.zeros((3, 1)))
    np.testing.assert_array_equal(np.stack(info["final_obs"]), np.full((3, 1), 4))
    assert truncated.all() and not terminated.any()
    assert ((reward >= 2) & (reward <= 3)).all()
