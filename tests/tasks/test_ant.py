"""Ant: golden numbers of the model, observations and rewards by hand, both engines, left-right symmetry."""

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry

Q0 = np.float32([0, 0, 0.44, 1, 0, 0, 0, 0, np.pi / 6, 0, -np.pi / 6, 0, -np.pi / 6, 0, np.pi / 6])
JOINT_PERM, JOINT_SIGN = np.array([6, 7, 4, 5, 2, 3, 0, 1]), np.array([-1, 1] * 4)


def mirrored(qpos, qvel):
    """The state seen in a mirror along the x-z plane, by hand."""
    x, w = qpos.copy(), qvel.copy()
    x[:, [1, 4, 6]] *= -1  # y, and the x and z parts of the quaternion
    w[:, [1, 3, 5]] *= -1
    x[:, 7:] = JOINT_SIGN * qpos[:, 7 + JOINT_PERM]
    w[:, 6:] = JOINT_SIGN * qvel[:, 6 + JOINT_PERM]
    return x, w


def states(seed, height=(0.36, 0.5)):
    """Eight random states, some in contact."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(Q0, (8, 1)) + np.concatenate([np.zeros((8, 3)), rng.uniform(-0.2, 0.2, (8, 12))], 1)
    qpos[:, :2] = rng.uniform(-1, 1, (8, 2))
    qpos[:, 2] = rng.uniform(*height, 8)
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return np.float32(qpos), np.float32(rng.uniform(-0.5, 0.5, (8, 14)))


def test_golden_numbers_of_the_model():
    env = registry.make("Ant")
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    assert model.body_mass.sum() == pytest.approx(0.91088, abs=1e-5)
    assert model.body("torso").mass[0] == pytest.approx(0.48388, abs=1e-5)
    np.testing.assert_allclose(sorted(model.body("torso").inertia), [0.01112, 0.01112, 0.01359], atol=1e-5)
    np.testing.assert_allclose(sorted(model.body("left_back_foot").inertia), [0.000209, 0.002675, 0.002675], atol=1e-6)
    data.qpos[:] = Q0
    mujoco.mj_kinematics(model, data)
    tips = np.stack([data.geom(f"{n}_tip").xpos for n in ("front_left", "front_right", "left_back", "right_back")])
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    np.testing.assert_allclose(tips, np.c_[0.7464 * signs, np.full(4, 0.44 - 0.2828)], atol=1e-4)
    assert tips[:, 2].min() - 0.08 == pytest.approx(0.0772, abs=1e-4)
    assert [model.joint(i).name for i in range(1, 9)] == [f"{j}_{i}" for i in range(1, 5) for j in ("hip", "ankle")]


@pytest.mark.slow
@pytest.mark.ci
def test_rests_on_its_feet(compiled):
    """Without torque it stands at z = 0.379, and the feet carry its weight of 8.94 N."""
    task = compiled("Ant")
    zero = np.zeros((8, 8), np.float32)
    state = task.reset_to(np.tile(Q0, (8, 1)), np.zeros((8, 14), np.float32))
    state = state.replace(pipeline_state=state.pipeline_state.replace(fields=nominal(task, 8)))
    for _ in range(200):
        state = task.step(state, zero)
    assert state.pipeline_state.qpos[0, 2] == pytest.approx(0.379, abs=3e-3)
    forces = np.asarray(state.obs["policy"][0, 28:52]).reshape(4, 2, 3)[:, 0] / 0.1
    turns = foot_frames(task.env.mj_model, state.pipeline_state.qpos[0])
    total = np.einsum("fij,fj->i", turns, forces)
    np.testing.assert_allclose(total, [0, 0, 0.91088 * 9.81], atol=0.05)


def nominal(task, worlds):
    """Fields of the unrandomised model (the prior's smallest stiffness is 0.01 N m/rad, not 0)."""
    fields = jax.eval_shape(lambda: task.env.physics.world(task.env.space.nominal)).fields
    model = task.env.physics.model
    return {name: np.stack([np.asarray(leaf(model, name))] * worlds) for name in fields}


def leaf(model, name):
    for part in name.split("."):
        model = getattr(model, part)
    return model


def foot_frames(mj_model, qpos):
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    names = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
    return np.stack([data.body(name).xmat.reshape(3, 3) for name in names])


def test_observations_by_hand(compiled):
    task = compiled("Ant")
    yaw = 0.5
    qpos, qvel = np.tile(Q0, (8, 1)), np.zeros((8, 14), np.float32)
    qpos[:, 3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    qpos[1, 3:7] = [np.cos(0.2), np.sin(0.2), 0, 0]  # roll 0.4
    qvel[:, :3], qvel[:, 3:6], qvel[:, 6:] = [1, 0, 0], [0.1, 0.2, 0.3], 5.0
    obs = np.asarray(task.reset_to(qpos, qvel).obs["policy"])
    want = [0.44, np.cos(yaw), -np.sin(yaw), 0, 0.1, 0.2, 0.3, yaw, 0, -yaw, 1, np.cos(yaw)]
    np.testing.assert_allclose(obs[0, :12], want, atol=1e-5)
    np.testing.assert_allclose(obs[1, [7, 8, 9, 10, 11]], [0, 0.4, 0, np.cos(0.4), 1], atol=1e-5)
    np.testing.assert_allclose(obs[0, 12:20], [0, -1, 0, 1, 0, 1, 0, -1], atol=1e-5)  # ankles at a limit
    np.testing.assert_allclose(obs[0, 20:28], 1.0, atol=1e-6)
    np.testing.assert_allclose(obs[0, 28:], 0.0)


def test_reward_by_hand(compiled):
    task = compiled("Ant")
    qpos, qvel = states(5)
    qpos[0, 2:7] = [0.30, 0, 1, 0, 0]  # on its back, feet in the air
    qpos[1, 3:7] = [np.cos(0.8), 0, 0, np.sin(0.8)]  # looks away by 1.6 rad
    before = task.reset_to(qpos, qvel)
    action = np.float32(np.random.default_rng(6).uniform(-1, 1, (8, 8)))
    after = task.step(before, action)
    q, v = (np.asarray(x, np.float64) for x in (after.pipeline_state.qpos, after.pipeline_state.qvel))
    obs = np.asarray(after.obs["policy"])
    q_before = qpos.astype(np.float64)
    progress = 60 * (np.hypot(1000 - q_before[:, 0], q_before[:, 1]) - np.hypot(1000 - q[:, 0], q[:, 1]))
    heading = obs[:, 11]
    want = progress + 0.5 + 0.1 * (obs[:, 10] > 0.93) + np.where(heading > 0.8, 0.5, 0.5 * heading / 0.8)
    want -= 0.005 * (action**2).sum(1) + 0.05 * np.abs(action * 0.2 * v[:, 6:]).sum(1)
    want -= 0.1 * (obs[:, 12:20] > 0.99).sum(1)
    fallen = q[:, 2] < 0.31
    assert fallen[0] and not fallen.all()
    assert np.array_equal(after.done, fallen)
    np.testing.assert_allclose(after.reward, np.where(fallen, -2, want), atol=1e-4)
    np.testing.assert_allclose(obs[:, 52:], action)


def test_foot_wrenches_agree_with_mujoco(compiled):
    """The same contact forces as MuJoCo's rne_postconstraint, in the foot's frame about its origin."""
    task = compiled("Ant")
    qpos, qvel = states(7, height=(0.33, 0.38))
    state = task.reset_to(qpos, qvel)
    state = state.replace(pipeline_state=state.pipeline_state.replace(fields=nominal(task, 8)))
    got = np.asarray(task.step(state, np.zeros((8, 8), np.float32)).obs["policy"][:, 28:52]).reshape(8, 4, 2, 3) / 0.1
    model = task.env.mj_model
    for i in range(8):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_step(model, data, nstep=2)
        mujoco.mj_rnePostConstraint(model, data)
        for k, name in enumerate(("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")):
            body, turn = model.body(name).id, data.body(name).xmat.reshape(3, 3)
            force = data.cfrc_ext[body, 3:]
            torque = data.cfrc_ext[body, :3] + np.cross(data.subtree_com[1] - data.xpos[body], force)
            np.testing.assert_allclose(got[i, k], [turn.T @ force, turn.T @ torque], rtol=1e-2, atol=0.05)
    assert np.abs(got).max() > 1


def test_mirror_equivariance_in_contact(compiled):
    task = compiled("Ant")
    qpos, qvel = states(8)
    action = np.float32(np.random.default_rng(9).uniform(-1, 1, (8, 8)))
    one = task.step(task.reset_to(qpos, qvel), action)
    perm, sign = task.env.mirrors[0].action
    two = task.step(task.reset_to(*mirrored(qpos, qvel)), sign * action[:, perm])
    perm, sign = task.env.mirrors[0].observation["policy"]
    left, right = np.asarray(two.obs["policy"]), sign * np.asarray(one.obs["policy"])[:, perm]
    assert np.abs(right[:, 28:52]).max() > 0.5  # some feet press on the ground
    smooth = [*range(28), *range(52, 60)]
    np.testing.assert_allclose(left[:, smooth], right[:, smooth], atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(left, right, atol=1e-4, rtol=1e-4)  # contact forces reach hundreds of N
    np.testing.assert_allclose(two.reward, one.reward, atol=1e-5, rtol=1e-5)


def test_resets(compiled):
    env = compiled("Ant").env
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 3000)))
    np.testing.assert_allclose(qpos[:, :7], np.tile(Q0[:7], (3000, 1)))
    low, high = env.mj_model.jnt_range[1:].T
    offset = qpos[:, 7:] - Q0[7:]
    assert (qpos[:, 7:] >= low - 1e-6).all() and (qpos[:, 7:] <= high + 1e-6).all()
    assert np.abs(offset).max() <= 0.2 + 1e-6
    assert offset[:, ::2].std(0) == pytest.approx(np.full(4, 0.2 / 3**0.5), rel=0.05)  # hips: uniform
    assert (offset[:, 1::2] == 0).mean() == pytest.approx(0.5, abs=0.02)  # ankles: half of them clipped
    assert not qvel[:, :6].any()
    assert qvel[:, 6:].std() == pytest.approx(0.1 / 3**0.5, rel=0.02)


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco_in_the_air(compiled, both_engines):
    """100 control steps of random torques with limits but no ground: the tumbling amplifies float32's rounding."""
    env, rng = compiled("Ant").env, np.random.default_rng(3)
    qpos = Q0.copy()
    qpos[2] = 50.0
    fast, exact = both_engines(env, qpos, np.zeros(14), rng.uniform(-1, 1, (100, 8)))
    np.testing.assert_allclose(fast[0], exact[0], atol=2e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco_in_contact(compiled, both_engines):
    """8 control steps from standing: one solver iteration and contacts that switch part the engines later."""
    env, rng = compiled("Ant").env, np.random.default_rng(4)
    qpos = Q0.copy()
    qpos[2] = 0.38
    fast, exact = both_engines(env, qpos, np.zeros(14), rng.uniform(-0.5, 0.5, (8, 8)))
    np.testing.assert_allclose(fast[0], exact[0], atol=2e-3)
