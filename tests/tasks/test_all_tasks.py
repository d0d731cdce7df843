"""What holds for every registered task."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.env.finite import NOT_FINITE

FAST = {"Pendulum", "Cartpole"}  # the others compile for up to half a minute
LONG = {"FrankaCabinet", "Humanoid", "Ingenuity", "ShadowHand"}  # compile for a minute or more: not in CI either
NAMES = [
    pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow] + [pytest.mark.ci] * (name not in LONG))
    for name in registry.names()
]


@pytest.fixture(params=NAMES)
def task(request, compiled):
    return compiled(request.param)


def draw(task, seed):
    keys = jax.random.split(jax.random.PRNGKey(seed), task.worlds)
    unit = jax.random.uniform(jax.random.PRNGKey(seed + 1), (task.worlds, len(task.env.space)))
    return keys, task.env.space.from_unit(unit)


def test_sizes_and_names_agree(task):
    env = task.env
    state = task.reset(*draw(task, 0))
    assert {group: value.shape[1:] for group, value in state.obs.items()} == env.observation_size
    assert env.observation_size["policy"] == env.observation_size["state"] == (len(env.observation_names),)
    assert len(set(env.observation_names)) == len(env.observation_names)
    assert len(env.actuator_names) == env.action_size
    assert env.episode_length == env.default_episode_length


def test_real_parameters_lie_in_the_prior(task):
    space = task.env.space
    if not hasattr(task.env, "real_parameters"):
        pytest.skip("its reality is a robot")
    assert len(space) == len(task.env.real_parameters)
    assert bool(space.contains(space.vector(task.env.real_parameters)))


def test_steps_stay_finite_over_the_whole_prior(task):
    state = task.reset(*draw(task, 3))
    rng = np.random.default_rng(0)
    reference = jax.tree.structure(state)
    types = [leaf.dtype for leaf in jax.tree.leaves(state)]
    for _ in range(40):
        action = rng.uniform(-1.5, 1.5, (task.worlds, task.env.action_size)).astype(np.float32)
        state = task.step(state, action)
        leaves = jax.tree.leaves((state.obs, state.reward, state.done, state.metrics, state.pipeline_state))
        assert all(np.isfinite(leaf).all() for leaf in leaves)
        assert not [n for n, x in state.metrics.items() if n.startswith(NOT_FINITE) and np.any(x)]  # 0 in their place
    assert jax.tree.structure(state) == reference  # scan and Brax's wrappers need a constant structure
    assert [leaf.dtype for leaf in jax.tree.leaves(state)] == types
    assert (np.asarray(state.info["steps"]) == 40).all()


def test_the_parts_of_the_reward_add_up_to_it(task):
    """Also in the steps that end an episode, which some tasks pay otherwise."""
    state = task.reset(*draw(task, 7))
    rng = np.random.default_rng(1)
    for _ in range(40):
        state = task.step(state, rng.uniform(-1, 1, (task.worlds, task.env.action_size)).astype(np.float32))
        parts = [np.asarray(x) for name, x in state.metrics.items() if name.startswith("reward_")]
        assert parts
        size = np.maximum(np.max(np.abs(parts), axis=0), 1.0)
        assert np.all(np.abs(sum(parts) - state.reward) < 1e-5 * size)


def test_actions_are_clipped_to_one(task):
    state = task.reset(*draw(task, 4))
    shape = (task.worlds, task.env.action_size)
    within, beyond = task.step(state, np.ones(shape, np.float32)), task.step(state, np.full(shape, 7.0, np.float32))
    assert np.array_equal(within.obs["policy"], beyond.obs["policy"])


def test_theta_reaches_the_physics(task):
    """Equal keys, different theta: different motion; and theta is recorded."""
    keys, thetas = draw(task, 5)
    keys = jnp.broadcast_to(keys[0], keys.shape)
    state = task.reset(keys, thetas)
    for _ in range(3):
        state = task.step(state, np.full((task.worlds, task.env.action_size), 0.7, np.float32))
    assert np.array_equal(state.pipeline_state.theta, thetas)
    assert np.ptp(np.asarray(state.pipeline_state.qvel), axis=0).max() > 1e-3


def test_a_diverged_world_terminates_with_finite_numbers(task):
    state = task.reset(*draw(task, 6))
    qvel = state.pipeline_state.qvel.at[0].set(jnp.nan)
    broken = state.replace(pipeline_state=state.pipeline_state.replace(qvel=qvel))
    action = np.zeros((task.worlds, task.env.action_size), np.float32)
    after, reference = task.step(broken, action), task.step(state, action)
    assert after.done[0] == after.info["terminated"][0] == 1
    assert np.isfinite(after.obs["policy"]).all() and np.isfinite(after.reward).all()
    assert after.reward[0] == np.float32(task.env.diverged_reward)
    assert all(np.isfinite(x).all() for x in after.metrics.values())
    assert np.array_equal(after.obs["policy"][1:], reference.obs["policy"][1:])  # the others do not notice


def image(x, part):
    perm, sign = part
    return sign * np.asarray(x)[..., perm]


def test_mirrored_steps_are_the_mirror_image_of_steps(task):
    """step(M s, M a) == M step(s, a), three steps on: the names' map against the physics."""
    if not task.env.mirrors:
        pytest.skip("no mirror symmetry")
    rng = np.random.default_rng(5)
    keys = jax.random.split(jax.random.PRNGKey(6), task.worlds)
    qpos, qvel = (np.asarray(x) for x in jax.vmap(task.env.initial)(keys))
    qvel = qvel + np.float32(rng.uniform(-0.3, 0.3, qvel.shape))
    for mirror in task.env.mirrors:
        one, two = task.reset_to(qpos, qvel), task.reset_to(image(qpos, mirror.qpos), image(qvel, mirror.qvel))
        turned = {name: -two.pipeline_state.task[name] for name in mirror.task}
        two = two.replace(pipeline_state=two.pipeline_state.replace(task={**two.pipeline_state.task, **turned}))
        for _ in range(3):
            action = np.float32(rng.uniform(-0.5, 0.5, (task.worlds, task.env.action_size)))
            one, two = task.step(one, action), task.step(two, image(action, mirror.action))
        np.testing.assert_allclose(two.pipeline_state.qpos, image(one.pipeline_state.qpos, mirror.qpos), atol=2e-5)
        np.testing.assert_allclose(two.pipeline_state.qvel, image(one.pipeline_state.qvel, mirror.qvel), atol=1e-3)
        for group, part in mirror.observation.items():
            assert np.abs(np.asarray(one.obs[group]) - image(one.obs[group], part)).max() > 0.1  # no symmetric state
            np.testing.assert_allclose(two.obs[group], image(one.obs[group], part), atol=1e-3, rtol=1e-3)
        np.testing.assert_allclose(two.reward, one.reward, atol=1e-3)
        np.testing.assert_array_equal(two.done, one.done)


def test_space_write_equals_recompiling(task):
    """Motion-relevant arrays of the written model are those of the recompiled, edited MJCF."""
    env = task.env
    theta = np.asarray(draw(task, 7)[1][0])
    written = jax.jit(lambda t: env.physics.model_of(env.physics.world(t)))(theta)
    compiled = env.space.edit(env.spec(), theta).compile()
    for name in ("body_mass", "body_inertia", "body_ipos", "geom_friction", "geom_solref", "jnt_stiffness"):
        np.testing.assert_allclose(getattr(written, name), getattr(compiled, name), rtol=1e-5, atol=1e-7, err_msg=name)
    for name in ("dof_damping", "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_gainprm"):
        np.testing.assert_allclose(getattr(written, name), getattr(compiled, name), rtol=2e-5, atol=1e-7, err_msg=name)


def test_the_spec_is_fresh_each_time(task):
    spec = task.env.spec()
    assert isinstance(spec, mujoco.MjSpec)
    spec.bodies[1].name = "other"
    assert task.env.spec().bodies[1].name != "other"
