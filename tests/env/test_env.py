"""The environment's protocol: State, episode ends, settings, Brax's wrappers, the registry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import training

from bayessim_mjx import config, effects, registry
from bayessim_mjx.errors import UserError
from bayessim_mjx.loop.state import domain_or_prior


@pytest.fixture(scope="module")
def cartpole():
    return registry.make("Cartpole", episodeLength=20)


@pytest.fixture(scope="module")
def compiled(cartpole):
    """(reset_to, step): traced once for all tests of this file."""
    return jax.jit(cartpole.reset_to), jax.jit(cartpole.step)


def test_state_of_reset_and_step(cartpole, compiled):
    state = jax.jit(cartpole.reset)(jax.random.PRNGKey(0))
    after = compiled[1](state, jnp.zeros(1))
    for s, steps in ((state, 0), (after, 1)):
        assert {"terminated", "truncated", "final_observation", "steps"} <= set(s.info)
        assert s.reward.dtype == s.done.dtype == s.info["truncated"].dtype == jnp.float32
        assert s.info["steps"] == steps and s.info["steps"].dtype == jnp.int32
        assert np.array_equal(s.info["final_observation"]["policy"], s.obs["policy"])
    assert np.array_equal(state.pipeline_state.theta, cartpole.space.nominal)
    assert jax.tree.structure(state) == jax.tree.structure(after)


def test_reset_to_is_exact(compiled):
    qpos, qvel = np.float32([0.3, -0.2]), np.float32([1.0, 2.0])
    state = compiled[0](qpos, qvel)
    np.testing.assert_array_equal(state.obs["policy"], np.float32([0.3, 1.0, -0.2, 2.0]))
    assert state.info["steps"] == 0


def test_truncation_comes_at_the_episode_length_and_termination_at_the_fall(compiled):
    reset_to, step = compiled
    upright = np.zeros(2, np.float32)
    state = reset_to(upright, upright)
    for i in range(1, 21):
        state = step(state, jnp.zeros(1))
        assert (state.done, state.info["truncated"]) == (0, float(i == 20))
    state = step(reset_to(np.float32([0, 1.6]), upright), jnp.zeros(1))
    assert (state.done, state.info["terminated"], state.info["truncated"]) == (1, 1, 0)


def test_a_world_that_runs_away_ends_its_episode_with_finite_observations(cartpole, compiled):
    """Reaching the speed limit counts as diverged, as a number that is not finite does."""
    (reset_to, step), still = compiled, np.zeros(2, np.float32)
    for speed in (2e5, np.inf, np.nan):
        after = step(reset_to(still, np.float32([speed, 0.0])), jnp.zeros(1))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after.obs, after.reward, after.metrics)))
        assert (after.done, after.info["terminated"], after.info["truncated"]) == (1, 1, 0)
        assert after.reward == cartpole.diverged_reward


def test_a_world_is_held_in_its_last_sound_state():
    class Slow(type(registry.make("Cartpole"))):
        speed_limit, diverged_reward = 2.0, -7.0

    env = Slow(effects=[effects.make("actuator_delay", where="all")])  # it remembers commands
    step, before = jax.jit(env.step), jax.jit(env.reset_to)(np.zeros(2, np.float32), np.float32([1.5, 0.0]))
    after, sound = step(before, jnp.ones(1)), step(before, 0.01 * jnp.ones(1))  # 400 N and 4 N on the cart
    assert (after.done, after.reward, sound.done) == (1, -7, 0)
    np.testing.assert_array_equal(after.obs["policy"], before.obs["policy"])
    held, old, new = (jax.tree.leaves(s.pipeline_state.memory) for s in (after, before, sound))
    assert all(np.array_equal(a, b) for a, b in zip(held, old, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(new, old, strict=True))


def test_parameters_that_are_switched_off_are_read_all_the_same():
    wrong = {"actor_params": {"cat": {"rigid_body_properties": {"mass": {"range": [0.5, 2.0]}}}}}
    with pytest.raises(UserError, match="no actor 'cat'.*cart"):
        type(registry.make("Cartpole"))({}, {"randomize": False, "randomization_params": wrong})


def test_without_randomisation_the_space_is_empty_and_the_domain_none():
    env = registry.make("Cartpole", config=config.load("Cartpole", overrides=["task.randomize=False"]))
    assert len(env.space) == 0 and domain_or_prior(env.space, 3) is None
    after = jax.jit(lambda key: env.step(env.reset(key), jnp.zeros(1)))(jax.random.PRNGKey(0))
    assert after.pipeline_state.fields == {}


def test_bayessim_variant_clips_observations():
    far = np.float32([500.0, 0.0]), np.zeros(2, np.float32)
    envs = registry.make("Cartpole"), registry.make("Cartpole", variant="bayessim2021")
    shown = jax.jit(lambda qpos, qvel: [env.reset_to(qpos, qvel).obs["policy"][0] for env in envs])(*far)
    assert shown == [500, 100]


def test_under_braxs_training_wrapper(cartpole):
    """Vmap, Episode and AutoReset: the wrapper's clock is the only one, and a reset restores every number we carry."""
    env = training.wrap(cartpole, episode_length=12)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    assert state.obs["state"].shape == (3, 4) and state.reward.shape == state.done.shape == (3,)
    step, ends, first = jax.jit(env.step), [], np.asarray(state.obs["state"])
    for _ in range(24):
        state = step(state, jnp.zeros((3, 1)))
        ends.append((np.asarray(state.done).copy(), np.asarray(state.info["truncation"])))
        if state.done.all():
            np.testing.assert_array_equal(state.obs["state"], first)
            assert not state.pipeline_state.task["steps"].any()
            assert not np.array_equal(state.info["final_observation"]["policy"], first)
    done = np.array([d for d, _ in ends])
    assert np.array_equal(np.flatnonzero(done[:, 0]), [11, 23])
    assert np.array_equal(np.array([t for _, t in ends]), done)


def test_unknown_names_and_settings_are_refused_with_a_hint():
    with pytest.raises(UserError, match="Did you mean Cartpole"):
        registry.make("cartpol")
    with pytest.raises(UserError, match="env.resetDits.*did you mean resetDist"):
        registry.make("Cartpole", resetDits=2.0)
    with pytest.raises(UserError, match="variant = 'isaac'.*isaacgymenvs, bayessim2021"):
        registry.make("Pendulum", variant="isaac")
    with pytest.raises(ValueError, match="theta has shape"):
        registry.make("Pendulum").reset(jax.random.PRNGKey(0), jnp.zeros(3))


def test_names_are_forgiving_and_complete():
    assert {"Ant", "Cartpole", "Pendulum"} <= set(registry.names())
    assert registry.make("pendulum").name == "Pendulum"


def test_facts(cartpole):
    assert cartpole.unwrapped is cartpole and cartpole.backend == "mjx"
    assert cartpole.observation_size == {"policy": (4,), "state": (4,)} and cartpole.action_size == 1
    assert cartpole.dt == pytest.approx(1 / 60)
    assert cartpole.joint_names == ("slider_to_cart", "cart_to_pole")
    np.testing.assert_allclose(cartpole.command(jnp.array([0.5])), [200.0])
