"""BallBalance: golden numbers of the model, loads of the sensors, observations and rewards by hand, both engines."""

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry

REST = 0.669117  # m, of the ball on the tray: 0.559117 + 0.01 + 0.1


def at(*balls):
    """(qpos, qvel) of eight worlds: the robot at home, at rest, the ball at these places first, else on the middle."""
    qpos = np.tile(np.float32(registry.make("BallBalance").mj_model.qpos0), (8, 1))
    qpos[:, 13:16] = [0, 0, REST]
    for i, place in enumerate(balls):
        qpos[i, 13:16] = place
    return qpos, np.zeros((8, 18), np.float32)


def test_golden_numbers_of_the_model():
    env = registry.make("BallBalance")
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    assert model.body_subtreemass[model.body("tray").id] == pytest.approx(4.486, abs=1e-3)
    masses = {name: model.body(name).mass[0] for name in ("tray", "upper1", "lower2", "ball")}
    assert masses == pytest.approx({"tray": 1.5708, "upper1": 0.4859, "lower2": 0.4859, "ball": 0.8378}, rel=1e-4)
    np.testing.assert_allclose(sorted(model.body("tray").inertia), [0.0982, 0.0982, 0.1963], rtol=1e-3)
    np.testing.assert_allclose(sorted(model.body("upper0").inertia), [0.000096, 0.006113, 0.006113], rtol=5e-3)
    mujoco.mj_forward(model, data)
    assert data.body("tray").xpos[2] == pytest.approx(0.559117, abs=1e-6)
    for k in range(3):
        knee, angle = data.body(f"lower{k}").xpos, 2 * np.pi * k / 3
        np.testing.assert_allclose(knee, [0.1454 * np.cos(angle), 0.1454 * np.sin(angle), 0.2746], atol=1e-4)
        foot = knee + data.body(f"lower{k}").xmat.reshape(3, 3) @ model.eq_data[k, :3]
        np.testing.assert_allclose(foot, [0.4 * np.cos(angle), 0.4 * np.sin(angle), 0.02], atol=1e-6)
    assert (model.nq, model.nv, model.neq, model.npair) == (20, 18, 3, 1)
    np.testing.assert_allclose(np.degrees(model.actuator_ctrlrange), [[-70, 90]] * 3)


def test_bayessimigs_friction_is_a_hundredth_of_a_newton_metre():
    env = registry.make("BallBalance")
    joints = [f"{link}{k}" for k in range(3) for link in ("upper", "lower")]
    assert env.space.names == ("ball_mass_mult", *(f"{joint}_friction" for joint in joints))
    model = env.space.edit(env.spec(), env.space.vector(env.real_parameters)).compile()
    np.testing.assert_allclose(model.dof_frictionloss[6:12], [0.1, 0.8, 0.9, 0.2, 0.05, 0.05], rtol=1e-5)
    assert env.space.units[1] == "cN m"


def test_the_knee_opens_the_leg_as_its_angle_says():
    """From hip to foot it is 2 L sin((pi/2 + q) / 2)."""
    model = registry.make("BallBalance").mj_model
    data = mujoco.MjData(model)
    for q in (-0.5, 0.0, 0.7):
        data.qpos[:] = model.qpos0
        data.joint("lower1").qpos[:] = q
        mujoco.mj_kinematics(model, data)
        body = data.body("lower1")
        foot = body.xpos + body.xmat.reshape(3, 3) @ model.eq_data[1, :3]
        length = np.linalg.norm(foot - data.body("upper1").xpos)
        assert length == pytest.approx(2 * 0.36 * np.sin((np.pi / 2 + q) / 2), abs=1e-6)


@pytest.mark.slow
def test_sensors_carry_the_ball(compiled):
    """A ball at rest beside the middle: its weight, and the torques of its lever about the three sensors."""
    task = compiled("BallBalance")
    theta = task.env.space.vector({f"{link}{k}_friction": 100.0 for k in range(3) for link in ("upper", "lower")})
    state = task.reset_to(*at((0.1, -0.2, REST)), theta)
    for _ in range(3):
        state = task.step(state, np.zeros((8, 3), np.float32))
    settled = [task.step(state, np.zeros((8, 3), np.float32))]
    for _ in range(29):
        settled.append(task.step(settled[-1], np.zeros((8, 3), np.float32)))
    loads = 20 * np.mean([s.obs["policy"][0, 12:] for s in settled[10:]], axis=0).reshape(4, 3)
    spot = np.mean([s.pipeline_state.qpos[0, 13:15] for s in settled[10:]], axis=0)
    weight, angles = 0.8378 * 9.81, 2 * np.pi * np.arange(3) / 3
    lever = spot[:, None] - 0.4 * np.stack([np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(loads[0], 0, atol=0.4)  # the tray is level but for a degree
    np.testing.assert_allclose(loads[1], -weight * lever[1], atol=0.3)
    np.testing.assert_allclose(loads[2], weight * lever[0], atol=0.3)
    np.testing.assert_allclose(loads[3], 0, atol=0.2)


@pytest.mark.slow
@pytest.mark.ci
def test_observations_by_hand(compiled):
    task = compiled("BallBalance")
    qpos, qvel = at((0.1, 0.2, 1.5))
    qpos[0, [8, 10, 12]], qvel[0, [7, 9, 11]], qvel[0, 12:15] = [0.1, 0.2, 0.3], [1, 2, 3], [-1, 2, -4]
    obs = task.reset_to(qpos, qvel).obs["policy"][0]
    np.testing.assert_allclose(obs, [0.1, 0.2, 0.3, 1, 2, 3, 0.1, 0.2, 1.5, -1, 2, -4, *[0] * 12], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.ci
def test_targets_rewards_and_ends_by_hand(compiled):
    task = compiled("BallBalance")
    qpos, qvel = at((0, 0, 0.14), (0.9, 0, 0.2), (0.3, 0, 1.7))
    qvel[2, 12] = 2.0
    action = np.tile(np.float32([1, -1, 0.5]), (8, 1))
    after = task.step(task.reset_to(qpos, qvel), action)
    q, v = np.asarray(after.pipeline_state.qpos), np.asarray(after.pipeline_state.qvel)
    distance = np.linalg.norm(q[:, 13:16] - [0, 0, 0.7], axis=1)
    np.testing.assert_allclose(after.reward, 1 / (1 + distance) / (1 + np.linalg.norm(v[:, 12:15], axis=1)), rtol=1e-4)
    assert after.reward[2] == pytest.approx(1 / (1 + np.hypot(0.32, 1)) / (1 + 2), rel=0.01)
    assert np.array_equal(after.done, [1, 0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(after.pipeline_state.task["command"][0], [0.2, -0.2, 0.1], rtol=1e-5)
    for _ in range(8):
        after = task.step(after, action)
    np.testing.assert_allclose(
        after.pipeline_state.task["command"][0], np.radians([90, -70, 0]) + [0, 0, 0.9], rtol=1e-5
    )


@pytest.mark.slow
@pytest.mark.ci
def test_a_ball_at_rest_pays_0_97(compiled):
    task = compiled("BallBalance")
    state = task.reset_to(*at())
    for _ in range(30):
        state = task.step(state, np.zeros((8, 3), np.float32))
    assert float(state.reward[0]) == pytest.approx(0.97, abs=0.01)


def test_resets():
    env = registry.make("BallBalance")
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 3000)))
    np.testing.assert_allclose(qpos[:, :13], np.tile(np.float32(env.mj_model.qpos0[:13]), (3000, 1)))
    distance, height = np.linalg.norm(qpos[:, 13:15], axis=1), qpos[:, 15]
    for sample, low, high in ((distance, 0.001, 0.5), (height, 1, 2)):
        unit = (sample - (low + high) / 2) / ((high - low) / 2)
        assert np.abs(unit).max() <= 1 + 1e-5 and unit.std() == pytest.approx(3**-0.5, rel=0.05)
    speed = np.linalg.norm(qvel[:, 12:14], axis=1)
    share = speed / 5 / ((distance - 0.001) / 0.499)
    assert share.max() <= 1 + 1e-3 and share.mean() == pytest.approx(0.5, abs=0.02)
    inwards = -(qpos[:, 13:15] * qvel[:, 12:14]).sum(1) / distance / speed
    np.testing.assert_allclose(inwards, 1, atol=1e-3)
    np.testing.assert_allclose(qvel[:, 14], -5)
    assert not qvel[:, :12].any() and not qvel[:, 15:].any()


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco(compiled, both_engines):
    """40 control steps of moving knees; the ball falls on the tray after 10 or so, and rolls."""
    env, rng = compiled("BallBalance").env, np.random.default_rng(3)
    commands = np.cumsum(rng.uniform(-0.05, 0.05, (40, 3)), axis=0)
    qpos, qvel = (x[0] for x in at((0.1, -0.1, 1.2)))
    qvel[12:15] = [-0.5, 0.5, -5]
    fast, exact = both_engines(env, qpos, qvel, commands)
    np.testing.assert_allclose(fast[0], exact[0], atol=2e-3)
    assert exact[0][:, 15].min() < 0.7
