"""Whole episodes, auto-resetting collection, and replay of commands."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.registry import make
from bayessim_mjx.rl import networks, normalise
from bayessim_mjx.rollout import collect, replay, rollout
from bayessim_mjx.rollout.collection import _stride
from bayessim_mjx.rollout.episodes import _rollout
from tests.rl import probes


def key(seed):
    return jax.random.PRNGKey(seed)


def test_after_the_end_everything_stands_still():
    """theta is the lifetime: worlds of 2, 5 and more than 6 steps."""
    t = rollout(
        probes.Lifetime(),
        lambda key, obs: jax.random.normal(key, (1,)),
        key(0),
        jnp.array([[2.0], [5.0], [9.0]]),
        6,
    )
    assert t.observation.shape == (3, 7, 1) and t.action.shape == (3, 6, 1) and t.reward.shape == (3, 6)
    np.testing.assert_array_equal(t.valid.sum(1), [2, 5, 6])
    np.testing.assert_array_equal(t.reward, t.valid)
    np.testing.assert_array_equal(t.terminated.sum(1), [1, 1, 0])
    assert t.terminated[0, 1] == 1 and t.terminated[1, 4] == 1
    rise = np.diff(t.observation[:, :, 0], axis=1)
    np.testing.assert_allclose(rise, t.valid, atol=1e-6)
    for world, end in enumerate((2, 5)):
        np.testing.assert_array_equal(t.action[world, end:], np.repeat(t.action[world, end - 1 : end], 6 - end, 0))
    assert len(np.unique(t.action[2])) == 6
    np.testing.assert_array_equal(t.theta, [[2], [5], [9]])
    assert t.qpos.shape == (3, 7, 0) and t.command.shape == (3, 6, 0)


def test_the_time_limit_is_a_truncation_with_the_true_last_observation():
    t = rollout(probes.Clock(), lambda key, obs: jnp.zeros(1), key(0), jnp.zeros((1, 1)), 6)
    np.testing.assert_array_equal(t.observation[0, :, 0], [0, 1, 2, 3, 4, 4, 4])
    np.testing.assert_array_equal(t.truncated[0], [0, 0, 0, 1, 0, 0])
    assert t.terminated.sum() == 0


def test_another_key_theta_or_policy_of_the_same_kind_does_not_recompile():
    env = probes.Lifetime()
    sizes, config = networks.Sizes(1, 1, 1), PPOConfig(hidden_actor=(4,), hidden_critic=(4,))
    policies = [networks.Policy(networks.init(key(i), sizes, config)["actor"], normalise.init(1)) for i in (0, 1)]
    a = rollout(env, policies[0], key(0), jnp.ones((2, 1)), 3)
    b = rollout(env, policies[1], key(1), 2 * jnp.ones((2, 1)), 3)
    assert _rollout(env, 3)._cache_size() == 1
    assert (a.action != b.action).any()
    c = rollout(env, policies[1].act, key(1), 2 * jnp.ones((2, 1)), 3)  # a method is another function, once
    np.testing.assert_array_equal(b.action, c.action)
    rollout(env, policies[0].act, key(1), 2 * jnp.ones((2, 1)), 3)
    assert _rollout(env, 3)._cache_size() == 2
    assert env.traces == 1


def test_bad_sizes_are_refused():
    with pytest.raises(ValueError, match="length = 0"):
        rollout(probes.Clock(), lambda key, obs: jnp.zeros(1), key(0), jnp.zeros((1, 1)), 0)
    with pytest.raises(ValueError, match=r"\(1,\).*\[worlds, parameters\]"):
        rollout(probes.Clock(), lambda key, obs: jnp.zeros(1), key(0), jnp.zeros(1), 1)


def collected(env, thetas, pool_thetas, length):
    worlds = len(thetas)
    keys = jax.random.split(key(0), worlds)
    start, pool = (jax.vmap(env.reset)(keys, jnp.asarray(t, jnp.float32)[:, None]) for t in (thetas, pool_thetas))

    def act(key, obs):
        assert obs["policy"].shape == (worlds, 1)
        return jnp.zeros((worlds, 1)), {"index": jnp.arange(worlds)}

    return jax.jit(lambda: collect(env, act, jax.random.split(key(1), length), start, pool, ("policy", "critic")))()


def test_collection_starts_new_episodes_with_new_thetas_from_the_pool():
    """Clock: 4 steps an episode. 3 worlds start with theta 0, 1, 2 and the pool holds 10, 11, 12."""
    states, batch = collected(probes.Clock(), [0, 1, 2], [10, 11, 12], 10)
    time, last = (np.asarray(batch[name]["policy"])[:, :, 0] for name in ("observation", "final_observation"))
    np.testing.assert_array_equal(time[:, 0], [0, 1, 2, 3, 0, 1, 2, 3, 0, 1])
    np.testing.assert_array_equal(last, time + 1)  # never the observation after the reset
    np.testing.assert_array_equal(np.flatnonzero(batch["truncated"][:, 0]), [3, 7])
    assert batch["terminated"].sum() == 0
    theta = np.asarray(batch["observation"]["critic"])[:, :, 1]
    np.testing.assert_array_equal(theta[[0, 4, 8]], [[0, 1, 2], [10, 11, 12], [12, 10, 11]])
    np.testing.assert_array_equal(batch["final_observation"]["critic"][3, :, 1], [0, 1, 2])
    np.testing.assert_array_equal(states.obs["policy"][:, 0], [2, 2, 2])
    np.testing.assert_array_equal(batch["extras"]["index"][5], [0, 1, 2])


def test_only_what_later_steps_depend_on_is_carried_on():
    """Of a sum that is rewarded all goes on, through what only it depends on; what is only shown stays as it was."""

    class Rewarded(probes.Clock):
        def reset(self, key, theta=None):
            state = super().reset(key, theta)
            return state.replace(metrics={"shown": jnp.zeros(())}, info={**state.info, "sum": 0.0, "pace": 1.0})

        def step(self, state, action):
            total = state.info["sum"] + state.info["pace"]
            after = super().step(state, action).replace(reward=total, metrics={"shown": total})
            return after.replace(info={**after.info, "sum": total, "pace": 2 * state.info["pace"]})

    states, batch = collected(Rewarded(), [0, 1], [10, 11], 6)
    np.testing.assert_array_equal(batch["reward"][:, 0], [1, 3, 7, 15, 1, 3])
    assert (float(states.info["sum"][0]), float(states.info["pace"][0])) == (3, 4)
    np.testing.assert_array_equal(states.metrics["shown"], 0)


def test_a_termination_on_the_last_step_is_no_truncation():
    class Both(probes.Clock):
        horizon = 4

    _, batch = collected(Both(), [0], [0], 5)
    assert batch["terminated"].sum() == 1 and batch["truncated"].sum() == 0


@pytest.mark.parametrize("worlds", [1, 2, 3, 16, 100, 4096])
def test_a_world_goes_through_the_whole_pool_before_repeating(worlds):
    stride = _stride(worlds)
    assert len({k * stride % worlds for k in range(worlds)}) == worlds


@pytest.mark.slow
@pytest.mark.ci
def test_replaying_the_commands_gives_the_motion_back():
    """A rollout of a task records what its motors were told: the same commands in the same worlds move it alike."""
    env = make("Pendulum")
    thetas = jnp.array([[1.0, 1.0], [0.5, 1.5]])
    t = rollout(env, lambda key, obs: jax.random.uniform(key, (1,), minval=-2.0, maxval=2.0), key(0), thetas, 5)
    assert t.qpos.shape == (2, 6, 1) and t.command.shape == (2, 5, 1)
    np.testing.assert_allclose(t.command[..., 0], 2 * np.clip(t.action[..., 0], -1, 1), rtol=1e-6)
    np.testing.assert_allclose(t.observation[..., 2], t.qvel[..., 0], rtol=1e-6)
    again = replay(env.physics, t.qpos[:, 0], t.qvel[:, 0], t.command, thetas)
    np.testing.assert_allclose(again["qpos"], t.qpos, atol=1e-5)
    np.testing.assert_allclose(again["qvel"], t.qvel, atol=1e-5)
    other = replay(env.physics, t.qpos[:, 0], t.qvel[:, 0], t.command, thetas[::-1])
    assert np.abs(other["qpos"] - t.qpos).max() > 0.01
    with pytest.raises(ValueError, match=r"qpos0 \(1, 1\).*same N"):
        replay(env.physics, t.qpos[:1, 0], t.qvel[:, 0], t.command, thetas)
