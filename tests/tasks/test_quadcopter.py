"""Quadcopter: golden numbers of the model, hovering, observations and rewards by hand, both engines."""

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry

HOVER = 0.6169  # N of each rotor


def at(*positions):
    """(qpos, qvel) of eight worlds, level and at rest, at these positions first and at (0, 0, 1) otherwise."""
    qpos = np.zeros((8, 15), np.float32)
    qpos[:, 2:4] = 1.0
    for i, position in enumerate(positions):
        qpos[i, :3] = position
    return qpos, np.zeros((8, 14), np.float32)


def test_golden_numbers_of_the_model():
    env = registry.make("Quadcopter")
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    assert model.body_mass.sum() == pytest.approx(0.25154, abs=1e-5)
    assert model.body_mass.sum() * 9.81 / 4 == pytest.approx(HOVER, abs=1e-4)
    masses = [model.body(name).mass[0] for name in ("chassis", "rotor_arm0", "rotor0")]
    np.testing.assert_allclose(masses, [0.04712, 0.000838, 0.05027], rtol=1e-3)
    np.testing.assert_allclose(sorted(model.body("rotor2").inertia), [2.05e-5, 2.05e-5, 4.02e-5], rtol=5e-3)
    mujoco.mj_kinematics(model, data)
    angles = np.pi / 4 + np.arange(4) * np.pi / 2
    rotors = np.stack([data.body(f"rotor{k}").xpos[:2] for k in range(4)])
    np.testing.assert_allclose(rotors, 0.145 * np.c_[np.cos(angles), np.sin(angles)], atol=1e-6)
    pairs = [(f"rotor_pitch{k}", f"rotor_roll{k}") for k in range(4)]
    assert env.joint_names[1:] == tuple(name for pair in pairs for name in pair)
    assert env.actuator_names == (*env.joint_names[1:], *(f"thrust{k}" for k in range(4)))
    assert (model.nq, model.nv, len(env.space)) == (15, 14, 9)


def test_bayessimigs_true_masses_are_too_heavy_to_fly():
    env = registry.make("Quadcopter")
    assert env.space.names[:3] == ("chassis_mass_mult", "rotor_arm0_mass_mult", "rotor0_mass_mult")
    heavy = env.space.edit(env.spec(), env.space.vector(env.real_parameters)).compile()
    assert heavy.body_mass.sum() == pytest.approx(1.83, abs=0.005)
    assert heavy.body_mass.sum() * 9.81 > 4 * 2.0


@pytest.mark.slow
@pytest.mark.ci
def test_hovers_on_a_quarter_of_its_weight_per_rotor(compiled):
    task = compiled("Quadcopter")
    state = task.reset_to(*at())
    action = np.zeros((8, 12), np.float32)
    action[:, 8:] = HOVER / 2  # 200 N/s for 0.01 s
    for _ in range(20):
        state, action = task.step(state, action), np.zeros((8, 12), np.float32)
    np.testing.assert_allclose(state.pipeline_state.task["command"][:, 8:], HOVER, rtol=1e-5)
    want = at()[0]
    want[:, 7::2] = -0.0425 * (HOVER - 0.05027 * 9.81) / 5  # how far the servos give way, rad
    np.testing.assert_allclose(state.pipeline_state.qpos, want, atol=1e-4)
    np.testing.assert_allclose(state.reward, 3.0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.ci
def test_commands_move_at_their_rates_within_their_ranges(compiled):
    task = compiled("Quadcopter")
    qpos, qvel = at()
    qpos[:, 7:] = 0.1
    state = task.step(task.reset_to(qpos, qvel), np.ones((8, 12), np.float32))
    command = state.pipeline_state.task["command"][0]
    np.testing.assert_allclose(command, [*[0.1 + 0.08 * np.pi] * 8, *[2.0] * 4], rtol=1e-5)
    for _ in range(2):
        state = task.step(state, np.ones((8, 12), np.float32))
    np.testing.assert_allclose(state.pipeline_state.task["command"][0], [*[np.pi / 6] * 8, *[2.0] * 4], rtol=1e-5)
    down = task.step(state, np.full((8, 12), -1, np.float32))
    np.testing.assert_allclose(down.pipeline_state.task["command"][0], [*[0.2722714] * 8, *[0.0] * 4], atol=1e-5)


@pytest.mark.slow
@pytest.mark.ci
def test_observations_by_hand(compiled):
    task = compiled("Quadcopter")
    qpos, qvel = at((0.3, -0.6, 1.9))
    qpos[0, 3:7] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # yaw 90 degrees: its x is the world's y
    qpos[0, 7:], qvel[0, :3], qvel[0, 3:6] = np.arange(8) / 20, [1, 2, 3], [np.pi, 0, 0.5 * np.pi]
    obs = np.asarray(task.reset_to(qpos, qvel).obs["policy"][0])
    want = [-0.1, 0.2, -0.3, 0, 0, np.sqrt(0.5), np.sqrt(0.5), 0.5, 1, 1.5, 0, 1, 0.5, *np.arange(8) / 20]
    np.testing.assert_allclose(obs, want, atol=1e-5)


@pytest.mark.slow
@pytest.mark.ci
def test_reward_and_ends_by_hand(compiled):
    task = compiled("Quadcopter")
    qpos, qvel = at((1, 0, 1), (0, 0, 0.31), (0, 0, 0.25), (2.9, 0, 1), (2.9, 0.9, 1), (0, 0, 1))
    qpos[5, 3:7] = [np.cos(0.5), np.sin(0.5), 0, 0]  # rolled by 1 rad
    qvel[5, 3:6] = [1, 2, 3]
    after = task.step(task.reset_to(qpos, qvel), np.zeros((8, 12), np.float32))
    q, v = (np.asarray(x, np.float64) for x in (after.pipeline_state.qpos, after.pipeline_state.qvel))
    w, x, y, z = q[:, 3:7].T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)  # of the world, in its axes
    near = 1 / (1 + ((q[:, :3] - [0, 0, 1]) ** 2).sum(1))
    spin = (up * v[:, 3:6]).sum(1)
    want = near * (1 + 1 / (1 + (1 - up[:, 2]) ** 2) + 1 / (1 + spin**2))
    np.testing.assert_allclose(after.reward, want, atol=1e-5)
    assert want[0] == pytest.approx(1.5, abs=2e-3) and want[5] < 1.1 + 0.9
    assert np.array_equal(after.done, [0, 0, 1, 0, 1, 0, 0, 0])


@pytest.mark.slow
@pytest.mark.ci
def test_the_chassis_turns_no_faster_than_four_pi(compiled):
    task = compiled("Quadcopter")
    qpos, qvel = at()
    qvel[:, 3:6], qvel[:, 0] = [30, -30, 30], 30
    speeds = np.asarray(task.step(task.reset_to(qpos, qvel), np.zeros((8, 12), np.float32)).pipeline_state.qvel)
    assert np.abs(speeds[:, 3:6]).max() == pytest.approx(4 * np.pi) and speeds[0, 0] > 20


def test_resets():
    env = registry.make("Quadcopter")
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 3000)))
    unit = np.c_[qpos[:, :2] / 1.5, (qpos[:, 2] - 1.65) / 0.85, qpos[:, 7:] / 0.2]
    assert np.abs(unit).max() <= 1 + 1e-6 and np.abs(unit.mean(0)).max() < 0.05
    np.testing.assert_allclose(unit.std(0), 3**-0.5, rtol=0.05)
    assert (qpos[:, 3:7] == [1, 0, 0, 0]).all() and not qvel.any()


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco(compiled, both_engines):
    """50 control steps of random tilts and thrusts around hovering."""
    env, rng = compiled("Quadcopter").env, np.random.default_rng(3)
    commands = np.c_[rng.uniform(-0.2, 0.2, (50, 8)), rng.uniform(0.5, 0.7, (50, 4))]
    fast, exact = both_engines(env, at()[0][0], np.zeros(14), commands)
    np.testing.assert_allclose(fast[0], exact[0], atol=1e-4)
    np.testing.assert_allclose(fast[1], exact[1], atol=1e-2)
    assert np.abs(exact[1][:, 3:6]).max() < 4 * np.pi  # the clip between sub-steps has no part in it
