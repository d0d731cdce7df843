"""Brax's trainer on our tasks and our trainer on Brax's and Playground's environments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.registry import make
from bayessim_mjx.rollout import rollout
from bayessim_mjx.wrappers.brax import BraxEnv, ours, train
from bayessim_mjx.wrappers.fresh import wrap
from tests.wrappers.toys import Counter

CONFIG = PPOConfig(num_envs=8, num_steps=4, num_epochs=1, num_minibatches=2, hidden_actor=(8,), hidden_critic=(8,))


class Toy:
    """Brax's protocol in ten lines: whole-number rewards at reset, real ones in step, plain array observations."""

    action_size, dt = 1, 0.1

    def reset(self, rng):
        from brax.envs.base import State

        return State(None, jnp.zeros(2), jnp.zeros((), int), jnp.zeros(()), {"m": jnp.zeros((), int)}, {})

    def step(self, state, action):
        obs = state.obs + 1
        done = (obs[0] >= 3).astype(float)
        return state.replace(obs=obs, reward=1.5 * action[0], done=done, metrics={"m": obs[0]})


def test_protocol_of_a_wrapped_environment():
    env = BraxEnv(Toy(), "toy", 2)
    assert env.observation_size == {"policy": (2,), "state": (2,)}
    assert len(env.space) == 0
    t = rollout(env, lambda key, obs: jnp.full(1, 7.0), jax.random.PRNGKey(0), jnp.zeros((2, 0)), 4)
    np.testing.assert_array_equal(t.truncated[0], [0, 1, 0, 0])
    np.testing.assert_array_equal(t.terminated[0], [0, 0, 0, 0])
    np.testing.assert_array_equal(t.reward[0], [1.5, 1.5, 0, 0])  # actions are clipped to +-1
    longer = rollout(
        BraxEnv(Toy(), "toy", 9), lambda key, obs: jnp.zeros(1), jax.random.PRNGKey(0), jnp.zeros((1, 0)), 4
    )
    np.testing.assert_array_equal(longer.terminated[0], [0, 0, 1, 0])


def test_our_trainer_on_a_wrapped_environment():
    env = BraxEnv(Toy(), "toy", 5)
    _, metrics = rl.train(env, CONFIG, jax.random.PRNGKey(0), iterations=2)
    assert metrics["Train/mean_episode_length"] <= 3
    assert np.isfinite(metrics["Loss/value"])


@pytest.mark.parametrize("name", ["brax:foo", "brax:annt"])
def test_unknown_names_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}.*inverted_pendulum"):
        make(name)


def test_settings_of_our_tasks_are_refused():
    with pytest.raises(ValueError, match="env.resetDist"):
        make("brax:ant", resetDist=2.0)


def test_braxs_own_environments_have_no_warp():
    with pytest.raises(ValueError, match="env.impl = 'warp': brax:ant is not simulated here"):
        make("brax:ant", impl="warp")
    with pytest.raises(ValueError, match="env.impl = 'cpp': allowed are jax, warp, auto"):
        make("playground:CartpoleBalance", impl="cpp")


def test_playground_that_is_not_installed_says_how_to_get_it():
    try:
        import mujoco_playground  # noqa: F401
    except ImportError:
        with pytest.raises(ValueError, match=r"pip install 'bayessim-mjx\[playground\]'"):
            make("playground:CartpoleBalance")
    else:
        assert make("playground:CartpoleBalance").episode_length == 1000


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brax:inverted_pendulum", "brax:ant"])
def test_our_trainer_trains_brax_environments(name):
    env = make(name, episodeLength=100)
    assert env.episode_length == 100 and env.mj_model.nu == env.action_size
    policy, metrics = rl.train(env, CONFIG, jax.random.PRNGKey(0), iterations=2)
    assert np.isfinite(metrics["Loss/value"])
    assert policy.act(None, jnp.zeros(env.observation_size["policy"])).shape == (env.action_size,)


@pytest.mark.slow
def test_our_trainer_trains_a_playground_environment():
    pytest.importorskip("mujoco_playground")
    env = make("playground:CartpoleBalance")
    _, metrics = rl.train(env, CONFIG, jax.random.PRNGKey(0), iterations=2)
    assert np.isfinite(metrics["Loss/value"])


@pytest.mark.slow
def test_playgrounds_physics_may_be_warps():
    """The same motion, whatever computes it; episodes begin anew one by one though Warp's scratch is shared."""
    pytest.importorskip("mujoco_playground")
    pytest.importorskip("warp")
    keys, reached = jax.random.split(jax.random.PRNGKey(0), 8), []
    for impl in ("jax", "warp"):
        env = make("playground:CartpoleBalance", impl=impl, episodeLength=5)
        states, step = jax.vmap(env.reset)(keys), jax.jit(jax.vmap(env.step))
        for _ in range(5):
            states = step(states, jnp.full((8, 1), 0.5))
        reached.append(np.asarray(states.obs["policy"]))
        _, metrics = rl.train(env, CONFIG, jax.random.PRNGKey(0), iterations=2)
        assert np.isfinite(metrics["Loss/value"])
    np.testing.assert_allclose(*reached, atol=1e-4)
    assert np.abs(reached[0] - np.asarray(jax.vmap(env.reset)(keys).obs["policy"])).max() > 0.1


def test_what_braxs_trainers_ask_of_jax_is_there():
    """Brax 0.14.2 calls jax.device_put_replicated, which jax 0.10 removed; an environment of ours brings it back."""
    devices, tree = jax.local_devices(), {"w": jnp.arange(3.0), "key": jax.random.PRNGKey(0), "n": 2}
    there = jax.device_put_replicated(tree, devices)
    for x, y in zip(jax.tree.leaves(tree), jax.tree.leaves(there), strict=True):
        np.testing.assert_array_equal(y, np.stack([np.asarray(x)] * len(devices)))
    doubled = jax.pmap(lambda t: 2 * t["w"], axis_name="i")(there)
    np.testing.assert_array_equal(doubled, [[0, 2, 4]] * len(devices))


def test_braxs_trainers_get_fresh_episodes_each_with_its_own_physics():
    """Counter shows [steps, start, theta]; it ends for good after theta steps, by time after 5."""
    worlds = 16
    env = wrap(ours(Counter(), "prior"), action_repeat=1)

    def step(state, _):
        before = state.obs["policy"]
        state = env.step(state, jnp.zeros((worlds, 1)))
        return state, (before.at[:, 0].add(1), state.obs["policy"], state.done, state.info["truncation"])

    first = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), worlds))
    _, (last, seen, done, cut) = jax.jit(lambda state: jax.lax.scan(step, state, length=20))(first)
    last, seen, done, cut = map(np.asarray, (last, seen, done, cut))
    np.testing.assert_array_equal(done > 0, (last[..., 0] >= last[..., 2]) | (last[..., 0] == 5))
    np.testing.assert_array_equal(cut > 0, (last[..., 0] < last[..., 2]) & (last[..., 0] == 5))
    np.testing.assert_array_equal(seen[..., 0], np.where(done > 0, 0, last[..., 0]))
    starts = np.concatenate([np.asarray(first.obs["policy"])[:, 1], seen[done > 0][:, 1]])
    lives = np.concatenate([np.asarray(first.obs["policy"])[:, 2], seen[done > 0][:, 2]])
    assert done.sum() > 3 * worlds and len(set(starts)) == len(set(lives)) == len(starts)
    assert 1 <= lives.min() < 2 and 8 < lives.max() <= 9  # the prior's range


def test_braxs_own_randomisation_is_refused():
    with pytest.raises(UserError, match="randomization_fn: physics comes from a domain"):
        wrap(Counter(), 5, 1, lambda sys: sys)


@pytest.mark.slow
def test_braxs_trainer_learns():
    found = {}
    train(
        "Cartpole", num_timesteps=400_000, num_evals=2, num_envs=64, batch_size=16, num_minibatches=4,
        unroll_length=16, num_updates_per_batch=4, learning_rate=1e-3, normalize_observations=True, discounting=0.99,
        entropy_cost=1e-3, progress_fn=lambda step, metrics: found.update({step: metrics["eval/episode_reward"]}),
    )  # fmt: skip
    assert found[max(found)] > 300  # of 500; random actions get 3


@pytest.mark.slow
@pytest.mark.ci
def test_braxs_trainer_trains_our_task():
    """Its wrappers count the steps and end the episodes: 200 of Pendulum's steps, rewards of at most 0."""
    from brax.training.agents.ppo import train as ppo

    seen = []
    _, params, _ = ppo.train(
        environment=make("Pendulum"),
        num_timesteps=256,
        episode_length=200,
        num_envs=8,
        num_eval_envs=4,
        unroll_length=4,
        batch_size=4,
        num_minibatches=2,
        num_updates_per_batch=1,
        num_evals=2,
        progress_fn=lambda steps, metrics: seen.append(metrics),
    )
    assert len(seen) == 2
    assert all(metrics["eval/avg_episode_length"] == 200 for metrics in seen)
    assert all(-16.3 * 200 <= metrics["eval/episode_reward"] < 0 for metrics in seen)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))
