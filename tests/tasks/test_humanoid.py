"""Humanoid: golden numbers of the model, observations and rewards by hand, both engines."""

from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry

GEARS = np.array([67.5] * 3 + [45, 45, 135, 90, 22.5, 22.5] * 2 + [67.5, 67.5, 45] * 2)


def upright(height=1.34):
    """(qpos, qvel) of eight worlds that stand with straight joints."""
    qpos = np.zeros((8, 28), np.float32)
    qpos[:, 2], qpos[:, 3] = height, 1.0
    return qpos, np.zeros((8, 27), np.float32)


def test_golden_numbers_of_the_model():
    env = registry.make("Humanoid")
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    assert model.body_mass.sum() == pytest.approx(40.844, abs=1e-3)
    masses = {"torso": 5.8538, "pelvis": 6.6162, "left_thigh": 4.7518, "right_foot": 1.1311, "left_hand": 0.2681}
    assert {name: model.body(name).mass[0] for name in masses} == pytest.approx(masses, rel=1e-4)
    np.testing.assert_allclose(sorted(model.body("torso").inertia), [0.03115, 0.03197, 0.05127], atol=1e-5)
    np.testing.assert_allclose(sorted(model.body("right_foot").inertia), [0.0009, 0.00594, 0.00645], atol=1e-5)
    data.qpos[2], data.qpos[3] = 1.34, 1.0
    mujoco.mj_kinematics(model, data)
    feet = [i for i in range(model.ngeom) if "foot" in model.geom(i).name]
    slope = np.abs(data.geom_xmat.reshape(-1, 3, 3)[feet, 2, 2])
    lowest = data.geom_xpos[feet, 2] - slope * model.geom_size[feet, 1] - model.geom_size[feet, 0]
    assert len(feet) == 4 and lowest.min() == pytest.approx(0.0545, abs=1e-4)
    assert env.joint_names[1:] == env.actuator_names and len(env.space) == 16 + 21
    assert env.joint_names[1:5] == ("abdomen_z", "abdomen_y", "abdomen_x", "right_hip_x")
    np.testing.assert_allclose(env.command(np.ones(21)), GEARS)
    np.testing.assert_allclose(model.actuator_ctrlrange, np.stack([-GEARS, GEARS], 1))


def test_bayessimigs_noise_on_actions_is_on_by_default():
    env = registry.make("Humanoid")
    assert env.nuisance is not None and env.nuisance.actions is not None
    assert registry.make("Humanoid", episodeLength=7).episode_length == 7


def test_resets():
    env = registry.make("Humanoid")
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 2000)))
    np.testing.assert_allclose(qpos[:, :7], np.tile(upright()[0][0, :7], (2000, 1)))
    low, high = np.maximum(env.mj_model.jnt_range[1:, 0], -0.2), np.minimum(env.mj_model.jnt_range[1:, 1], 0.2)
    np.testing.assert_allclose(qpos[:, 7:].min(0), low, atol=2e-3)
    np.testing.assert_allclose(qpos[:, 7:].max(0), high, atol=2e-3)
    assert not qvel[:, :6].any() and qvel[:, 6:].std() == pytest.approx(0.1 / 3**0.5, rel=0.02)


@pytest.mark.slow
@pytest.mark.ci
def test_observations_by_hand(compiled):
    task, yaw = compiled("Humanoid"), 0.5
    qpos, qvel = upright()
    qpos[:, 3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    qpos[0, 7], qvel[:, :3], qvel[:, 3:6], qvel[:, 6:] = np.pi / 8, [1, 0, 0], [0.1, 0.2, 0.3], 5.0
    obs = np.asarray(task.reset_to(qpos, qvel).obs["policy"][0])
    root = [1.34, np.cos(yaw), -np.sin(yaw), 0, 0.025, 0.05, 0.075, yaw, 0, -yaw, 1, np.cos(yaw)]
    np.testing.assert_allclose(obs[:12], root, atol=1e-5)
    # half of the way to a limit of +-45 degrees; 0 in -75 to 30, in -35 to 35 and in -45 to 15 degrees
    np.testing.assert_allclose(obs[12:16], [0.5, 45 / 105, 0, 0.5], atol=1e-5)
    np.testing.assert_allclose(obs[33:54], 0.5, atol=1e-6)
    np.testing.assert_allclose(obs[54:], 0.0)


@pytest.mark.slow
def test_joint_forces_are_those_of_motors_springs_and_dampers(compiled):
    task = compiled("Humanoid")
    qpos, qvel = upright(2.0)
    qpos[:, 7], qvel[:, 6] = 0.1, 0.2
    state = task.reset_to(qpos, qvel)
    action = np.zeros((8, 21), np.float32)
    action[:, 0] = 0.1
    obs = np.asarray(task.step(state, action).obs["policy"][0])
    model, data = task.env.mj_model, mujoco.MjData(task.env.mj_model)
    data.qpos[:], data.qvel[:], data.ctrl[0] = qpos[0], qvel[0], 6.75
    mujoco.mj_step(model, data, 2)
    mujoco.mj_forward(model, data)
    want = 6.75 - 20 * data.qpos[7] - 5 * data.qvel[6]
    assert obs[54] == pytest.approx(0.01 * want, abs=2e-4) and abs(want) > 1
    np.testing.assert_allclose(obs[75:87], 0)  # in the air
    np.testing.assert_allclose(obs[87:], action[0])


def test_reward_by_hand():
    """Of worlds that go from one place to another: running, fallen, looking away by 1.6 rad, and with a bent knee."""
    env, rng = registry.make("Humanoid"), np.random.default_rng(5)
    (start, _), (end, speed) = upright(), upright()
    start[:, 0], end[:, 0], end[:, 1] = 2.0, 2.05, 0.01
    speed[:], end[:, 7:] = rng.uniform(-0.5, 0.5, (8, 27)), rng.uniform(-0.03, 0.03, (8, 21))
    end[1, 2], end[2, 3:7], end[3, 13] = 0.75, [np.cos(0.8), 0, 0, np.sin(0.8)], 0.05
    action = np.float32(rng.uniform(-1, 1, (8, 21)))
    low, high = env.mj_model.jnt_range[1:].T
    for i in range(4):
        before, after = SimpleNamespace(qpos=start[i]), SimpleNamespace(qpos=end[i], qvel=speed[i])
        reward, fallen, metrics = env.reward(before, after, None, action[i])
        place = np.abs((2 * end[i, 7:] - low - high) / (high - low))
        at_limits = (np.where(place > 0.98, 0.25 * (place - 0.98) / 0.02, 0) * GEARS / 135).sum()
        energy = (np.abs(action[i] * 0.1 * speed[i, 6:]) * GEARS / 135).sum()
        heading = 0.5 * np.cos(1.6) / 0.8 if i == 2 else 0.5
        want = 3.0 + 2.0 + 0.1 + heading - 0.01 * (action[i] ** 2).sum() - 0.05 * energy - at_limits
        assert bool(fallen) == (i == 1) and (at_limits > 0.2 or i != 3)
        assert float(reward) == pytest.approx(-1.0 if i == 1 else want, abs=2e-3)
        assert float(metrics["forward_speed"]) == pytest.approx(3.0, abs=1e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco(compiled, both_engines):
    """20 control steps of random torques: down to the ground, and on it."""
    env, rng = compiled("Humanoid").env, np.random.default_rng(3)
    qpos, qvel = (x[0] for x in upright(1.3))
    fast, exact = both_engines(env, qpos, qvel, 0.3 * GEARS * rng.uniform(-1, 1, (20, 21)))
    np.testing.assert_allclose(fast[0], exact[0], atol=5e-3)
