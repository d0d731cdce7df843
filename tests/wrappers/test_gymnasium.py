"""Gymnasium's own checks on a task of ours, and the vector environment's restarts."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from bayessim_mjx.registry import make
from bayessim_mjx.wrappers.gymnasium import GymnasiumEnv, GymnasiumVectorEnv

sys.path.insert(0, str(Path(__file__).parents[1] / "rl"))
import probes  # noqa: E402


def test_gymnasiums_checker_accepts_a_task():
    check_env(GymnasiumEnv(make("Pendulum", episodeLength=3)), skip_render_check=True)


def test_episode_of_one_world():
    env = GymnasiumEnv(probes.Lifetime(), theta=[2.0])
    with pytest.raises(ValueError, match="reset"):
        env.step(np.zeros(1))
    first, info = env.reset(seed=3)
    assert info["theta"] == 2.0
    assert [env.step(np.zeros(1))[1:4] for _ in range(2)] == [(1.0, False, False), (1.0, True, False)]
    again, info = env.reset(seed=3, options={"theta": [9.0]})
    np.testing.assert_array_equal(first, again)
    assert info["theta"] == 9.0


def test_ended_worlds_restart_and_keep_their_last_observation():
    domain = probes.Domain(jnp.array([2.0]), jnp.array([3.0]))
    env = GymnasiumVectorEnv(probes.Clock(), 3, domain)
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
