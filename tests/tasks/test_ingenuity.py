"""Ingenuity: golden numbers of the model, hovering on Mars, way-points, observations and rewards by hand."""

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry

HOVER = 0.1395  # action of both rotors


def at(*positions):
    """(qpos, qvel) of eight worlds, level and at rest, at these positions first and at (0, 0, 1) otherwise."""
    qpos = np.zeros((8, 11), np.float32)
    qpos[:, 2:4] = 1.0
    for i, position in enumerate(positions):
        qpos[i, :3] = position
    return qpos, np.zeros((8, 10), np.float32)


def aimed(state, target=(0.0, 0.0, 1.0)):
    """The states with all their way-points there."""
    world = state.pipeline_state
    places = {f"target_{i}": np.full_like(world.task[f"target_{i}"], x) for i, x in zip("xyz", target, strict=True)}
    return state.replace(pipeline_state=world.replace(task=world.task | places))


def test_golden_numbers_of_the_model():
    env = registry.make("Ingenuity")
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    assert model.body_mass.sum() == pytest.approx(1.500, abs=5e-4)  # 0.2 g of them the rotors that are only seen
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -3.721])
    assert [model.body(n).mass[0] for n in ("chassis", "rotor_physics_0")] == pytest.approx([0.0864, 0.70686], rel=1e-4)
    np.testing.assert_allclose(sorted(model.body("rotor_physics_1").inertia), [0.003982, 0.003982, 0.007952], rtol=1e-3)
    mujoco.mj_forward(model, data)
    assert data.subtree_com[1, 2] - data.body("chassis").xpos[2] == pytest.approx(0.01178, abs=3e-5)
    parts = [f"rotor_{kind}_{k}" for k in (0, 1) for kind in ("physics", "visual")]
    assert env.joint_names[1:] == tuple(parts) and (model.nv, env.action_size) == (10, 6)
    assert env.space.names == (*[f"{b}_mass_mult" for b in ("chassis", *parts)], *[f"{j}_stiffness" for j in parts])


@pytest.mark.slow
@pytest.mark.ci
def test_hovers_and_its_locked_joints_do_not_reach_the_chassis(compiled):
    """It stays where it is but for the first step's fall, whatever the stiffness of joints."""
    task = compiled("Ingenuity")
    qpos, qvel = at()
    qvel[1:, [7, 9]] = [-50, 50]  # the rotors that are seen turn in all worlds but one
    state = aimed(
        task.reset_to(
            qpos, qvel, task.env.space.vector({f"rotor_{n}_stiffness": 20.0 for n in ("physics_0", "visual_1")})
        )
    )
    action = np.zeros((8, 6), np.float32)
    action[:, [2, 5]] = HOVER
    for _ in range(50):
        state = task.step(state, action)
    falling = 3.721 * 0.01  # m/s, gained while there was no force
    position = np.asarray(state.pipeline_state.qpos)
    np.testing.assert_allclose(position[:, 2], 1 - falling * 0.495, atol=3e-3)
    np.testing.assert_allclose(position[:, :2], 0, atol=1e-4)
    np.testing.assert_allclose(position[:, 3:7], np.tile([1, 0, 0, 0], (8, 1)), atol=1e-3)
    np.testing.assert_allclose(position[0, 7:], 0, atol=1e-6)


def test_forces_by_hand():
    env = registry.make("Ingenuity")
    action = np.float32([0.1, -0.5, 0.5, 1.0, 0.05, -0.25])
    np.testing.assert_allclose(env.command(action), [1.0, -2.0, 10.0, -1.0, -0.25, -5.0], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.ci
def test_observations_by_hand(compiled):
    task = compiled("Ingenuity")
    qpos, qvel = at((0.3, -0.6, 1.9))
    qpos[0, 3:7] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # yaw 90 degrees: its x is the world's y
    qvel[0, :3], qvel[0, 3:6] = [1, 2, 3], [np.pi, 0, 0.5 * np.pi]
    state = task.reset_to(qpos, qvel)
    target = np.array([state.pipeline_state.task[f"target_{i}"][0, 0] for i in "xyz"])
    want = [*(target - qpos[0, :3]) / 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5), 0.5, 1, 1.5, 0, 1, 0.5]
    np.testing.assert_allclose(state.obs["policy"][0], want, atol=1e-5)


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("variant", ["isaacgymenvs", "bayessim2021"])
def test_reward_and_ends_by_hand(compiled, variant):
    env, weight = registry.make("Ingenuity", variant=variant), {"isaacgymenvs": 5, "bayessim2021": 1}[variant]
    qpos, qvel = at((1, 0, 1), (0, 0, 0.49), (7.9, 0, 1), (8.1, 0, 1), (0, 0, 1))
    qpos[4, 3:7] = [np.cos(0.5), np.sin(0.5), 0, 0]  # rolled by 1 rad
    qvel[4, 3:6] = [1, 2, 3]
    worlds = aimed(compiled("Ingenuity").reset_to(qpos, qvel)).pipeline_state
    rewards, ends, _ = jax.vmap(lambda world: env.reward(world, world, None, None))(worlds)
    up, spin = np.cos(1), np.sin(1) * 2 + np.cos(1) * 3
    want = np.array([0.5 * (2 + weight), 2 + weight, 0, 0, 1 + weight / (1 + (1 - up) ** 2) + 1 / (1 + spin**2)])
    np.testing.assert_allclose(np.asarray(rewards)[[0, 5, 4]], want[[0, 1, 4]], rtol=1e-4)
    assert np.array_equal(ends, [0, 1, 0, 1, 0, 0, 0, 0])


def test_a_new_target_every_500_steps():
    env = registry.make("Ingenuity")
    world = env.reset_to(*(x[0] for x in at())).pipeline_state
    targets = np.stack([world.task[f"target_{i}"] for i in "xyz"])
    assert targets.shape == (3, 4) and np.ptp(targets[0]) > 0.1
    for steps, which in ((0, 0), (1, 0), (500, 0), (501, 1), (1000, 1), (2000, 3)):
        now = world.replace(task=world.task | {"steps": np.int32(steps)})
        np.testing.assert_array_equal(env._target(now), targets[:, which])


def test_pictures_show_the_target():
    env, place, target = registry.make("Ingenuity"), np.float32([0.3, -0.6, 1.9]), np.float32([4.0, -2.0, 1.2])
    qpos, observation = np.zeros((2, 11), np.float32), np.zeros((2, 13), np.float32)
    qpos[1, :3], observation[1, :3] = place, (target - place) / 3
    marks = env.marks(qpos, observation)
    assert marks.shape == (2, env.mj_model.nmocap, 7)
    np.testing.assert_allclose(marks[1, 0], [*target, 1, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize(("variant", "reach"), [("isaacgymenvs", 5.0), ("bayessim2021", 1.0)])
def test_resets_and_targets(variant, reach):
    env, keys = registry.make("Ingenuity", variant=variant), jax.random.split(jax.random.PRNGKey(0), 1500)
    task = jax.vmap(lambda key: env.start(key, None))(keys)
    x, y, z = (np.asarray(task[f"target_{i}"]).ravel() for i in "xyz")
    position = np.asarray(jax.vmap(env.initial)(keys)[0])[:, :3]
    for sample, low, high in ((x, -reach, reach), (y, -reach, reach), (z, 1, 2), (position[:, 2], 0.8, 2.5)):
        unit = (sample - (low + high) / 2) / ((high - low) / 2)
        assert np.abs(unit).max() <= 1 + 1e-6 and abs(unit.mean()) < 0.05
        assert unit.std() == pytest.approx(3**-0.5, rel=0.05)


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco(compiled, both_engines):
    """50 control steps around hovering, pushed sideways, with turning rotors."""
    env, rng = compiled("Ingenuity").env, np.random.default_rng(3)
    commands = np.tile([0, 0, 20 * HOVER], (50, 2)) + rng.uniform(-0.3, 0.3, (50, 6))
    qpos, qvel = (x[0] for x in at())
    qvel[[7, 9]] = [-50, 50]
    fast, exact = both_engines(env, qpos, qvel, commands)
    np.testing.assert_allclose(fast[0], exact[0], atol=1e-4)
    np.testing.assert_allclose(fast[1], exact[1], atol=1e-3)
