"""FrankaCabinet: golden numbers of the model, observations, targets and rewards by hand, both engines."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.errors import UserError
from bayessim_mjx.tasks.manipulation import Pose

HOME = np.float32([1.157, -1.066, -0.155, -2.239, -1.841, 1.003, 0.469, 0.035, 0.035])
LADDER = {0: 0.15, 0.01: 0.25, 0.05: 0.35, 0.1: 0.5, 0.15: 0.65, 0.2: 0.8, 0.38: 1.0}
AT_HANDLE = np.float32([-1.8619, -1.1388, 1.1616, -1.7195, 2.2301, 2.4706, -1.8612])  # of Isaac's point
HANDLE = np.float32([0.3515, 0.01, 0.7172])  # of the closed drawer


@pytest.fixture(scope="module")
def env():
    return registry.make("FrankaCabinet")


def posed(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[: len(qpos)] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def test_golden_numbers_of_the_model(env):
    model = env.mj_model
    assert (model.nq, model.nv, model.nu, model.npair) == (10, 10, 9, 6)
    masses = [0.629769, 4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522 + 0.73, 0.015, 0.015]
    np.testing.assert_allclose(model.body_mass[1:11], masses, rtol=1e-6)
    assert model.body("drawer").mass[0] == pytest.approx(5.18 + 0.094 + 3.28)
    low = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973, 0, 0, 0]
    high = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973, 0.04, 0.04, 0.4]
    np.testing.assert_allclose(model.jnt_range, np.stack([low, high], 1), atol=1e-9)
    np.testing.assert_allclose(model.actuator_ctrlrange, model.jnt_range[:9])
    np.testing.assert_allclose(model.actuator_gainprm[:7, 0], 400)
    np.testing.assert_allclose(-model.actuator_biasprm[:, 2], [80] * 7 + [100] * 2)
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], [87] * 4 + [12] * 3 + [200] * 2)
    assert model.joint("drawer").damping[0] == 10 and not model.opt.gravity.any()


def test_golden_poses(env):
    """World axes, m: link 7, fingers, Isaac's grasp point and its axes; and where that point is at the handle."""
    data = posed(env.mj_model, HOME)
    np.testing.assert_allclose(data.body("link7").xpos, [0.83059, -0.08131, 0.81182], atol=1e-5)
    np.testing.assert_allclose(data.body("leftfinger").xpos, [0.75909, 0.07096, 0.82870], atol=1e-5)
    np.testing.assert_allclose(data.body("rightfinger").xpos, [0.75756, 0.06184, 0.75931], atol=1e-5)
    np.testing.assert_allclose(data.site("isaac_grasp").xpos, [0.78438, 0.08227, 0.81988], atol=1e-5)
    turn = data.site("isaac_grasp").xmat.reshape(3, 3)
    np.testing.assert_allclose(turn[:, 2], [-0.4369, 0.8930, -0.1077], atol=1e-4)
    np.testing.assert_allclose(turn[:, 1], [0.0219, 0.1302, 0.9913], atol=1e-4)
    np.testing.assert_allclose(data.site("handle").xpos, HANDLE, atol=1e-6)
    tips = (data.site("left_tip").xpos + data.site("right_tip").xpos) / 2
    np.testing.assert_allclose(data.site("grasp").xpos, tips, atol=1e-6)
    data = posed(env.mj_model, AT_HANDLE)
    np.testing.assert_allclose(data.site("isaac_grasp").xpos, HANDLE, atol=1e-4)
    turn = data.site("isaac_grasp").xmat.reshape(3, 3)
    np.testing.assert_allclose(turn[:, 1:], [[0, -1], [0, 0], [1, 0]], atol=1e-3)
    data.qpos[9] = 0.3
    mujoco.mj_kinematics(env.mj_model, data)
    np.testing.assert_allclose(data.site("handle").xpos, HANDLE + [0.3, 0, 0], atol=1e-6)


def test_link_seven_weighs_and_turns_as_link_and_hand(env):
    """The sum of link 7 (com, inertia about it) and of the hand, which is turned by -45 degrees 0.107 m above."""
    c = s = np.sqrt(0.5)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    link = np.array(
        [[0.012516, -0.000428, -0.001196], [-0.000428, 0.010027, -0.000741], [-0.001196, -0.000741, 0.004815]]
    )
    hand = turn @ np.diag([0.001, 0.0025, 0.0017]) @ turn.T
    masses, inertias = np.array([0.735522, 0.73]), [link, hand]
    places = np.array([[0.010517, -0.004252, 0.061597], turn @ [-0.01, 0, 0.03] + [0, 0, 0.107]])
    middle = masses @ places / masses.sum()
    whole = sum(
        own + m * (d @ d * np.eye(3) - np.outer(d, d))
        for m, own, d in zip(masses, inertias, places - middle, strict=True)
    )
    body = env.mj_model.body("link7")
    np.testing.assert_allclose(body.ipos, middle, atol=1e-6)
    np.testing.assert_allclose(sorted(body.inertia), np.linalg.eigvalsh(whole), rtol=1e-4)


def test_bayessimigs_parameters_are_ten_masses_and_nine_stiffnesses_of_drives(env):
    links = ["franka", *(f"link{i}" for i in range(1, 8)), "leftfinger", "rightfinger"]
    assert env.space.names[:10] == tuple(f"{name}_mass_mult" for name in links)
    assert env.space.names[10:] == tuple(f"{name}_stiffness_mult" for name in env.actuator_names)
    model = env.space.edit(env.spec(), env.space.vector(env.real_parameters)).compile()
    factor = np.array([1.8] * 5 + [0.2] * 2 + [0.1] * 2)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], factor * ([400] * 7 + [2000] * 2), rtol=1e-5)
    np.testing.assert_allclose(-model.actuator_biasprm[:, 1], model.actuator_gainprm[:, 0])
    assert model.body("link3").mass[0] == pytest.approx(0.8 * 3.228604, rel=1e-5)


def test_resets(env):
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 2000)))
    low, high = (HOME + sign * 0.125 for sign in (-1, 1))
    low[7:], high[7:] = 0, 0.04
    np.testing.assert_allclose(qpos[:, :9].min(0), low, atol=1e-3)
    np.testing.assert_allclose(qpos[:, :9].max(0), high, atol=1e-3)
    assert qpos[:, :7].std(0) == pytest.approx(0.125 / 3**0.5, rel=0.05) and not qpos[:, 9].any() and not qvel.any()


POSE = np.array([[0, 0, -1], [1, 0, 0], [0, 1, 0]], np.float32)  # of a hand before the handle: z inwards, y up


def judged(env, grasp, left, right, drawer, action, turn=POSE):
    """(reward, end) of a hand whose points lie so from the handle, m."""
    poses = [Pose(HANDLE + np.float32(place), turn) for place in (grasp, left, right, (0, 0, 0))]
    env.frames = lambda world, *sites, measured=False: poses
    world = SimpleNamespace(qpos=np.append(HOME, np.float32(drawer)), task={"opened": np.float32(drawer)})
    reward, end, metrics = env.reward(world, world, None, action)
    assert metrics["opened"] == (drawer > 0.35) and metrics["drawer"] == np.float32(drawer)
    return float(reward), bool(end)


@pytest.mark.parametrize("drawer", [0.0, 0.005, 0.015, 0.07, 0.12, 0.17, 0.25, 0.385, 0.395])
def test_rewards_by_hand(drawer):
    """A hand 1 cm from the handle, fingers 3 and 2 cm off; beside it, turned by 60 degrees; a finger beyond."""
    action = np.linspace(-1, 1, 9, dtype=np.float32)
    cost, around, fingers = 0.01 * (action**2).sum(), 0.5, 0.08 - 0.05
    bonus = 0.5 * (drawer > 0.01) + around * (drawer > 0.2) + 2 * around * (drawer > 0.39)
    ladder = max([0.0] + [pay for over, pay in LADDER.items() if drawer > over])
    close, far = 2 / 1.0001**2, 1 / 1.04**2
    half = np.float32(
        [[np.cos(np.pi / 3), -np.sin(np.pi / 3), 0], [np.sin(np.pi / 3), np.cos(np.pi / 3), 0], [0, 0, 1]]
    )
    grasping = (0.01, 0, 0), (0.01, 0, 0.03), (0.01, 0, -0.02)
    beside, beyond = ((0, 0.2, 0), (0, 0, 0.03), (0, 0, 0.01)), (*grasping[:2], (-0.041, 0, -0.02))
    env = registry.make("FrankaCabinet")
    want = 2 * close + 0.5 * 1 + 0.25 * around + 7.5 * (drawer + drawer * around) + 5 * fingers + bonus - cost
    assert judged(env, *grasping, drawer, action) == (pytest.approx(want, abs=1e-5), drawer > 0.39)
    turned = 2 * far + 0.5 * 0.5 * (0.25 + 1) + 7.5 * drawer + 0.5 * (drawer > 0.01) - cost
    assert judged(env, *beside, drawer, action, half @ POSE) == (pytest.approx(turned, abs=1e-5), drawer > 0.39)
    assert judged(env, *beyond, drawer, action) == (-1.0, drawer > 0.39)
    env = registry.make("FrankaCabinet", variant="bayessim2021")
    want = 1.5 * close + 0.5 * 1 + 1.0 * around + 4 * drawer + 10 * fingers + ladder - cost
    assert judged(env, *grasping, drawer, action) == (pytest.approx(want, abs=1e-5), False)
    assert judged(env, *beyond, drawer, action) == (-1.0, True)


def test_bad_settings():
    with pytest.raises(UserError, match=r"env\.graspPoint = 'palm': allowed are fingertips, isaac"):
        registry.make("FrankaCabinet", graspPoint="palm")


@pytest.mark.slow
@pytest.mark.ci
def test_the_point_of_isaac_gives_the_golden_rewards_at_reset():
    env = registry.make("FrankaCabinet", graspPoint="isaac")
    world = env.physics.world(env.space.nominal, jnp.append(HOME, 0.0))
    world = world.replace(task={"opened": jnp.zeros(())})
    reward, end, metrics = env.reward(world, world, None, jnp.zeros(9))
    assert metrics["handle_distance"] == pytest.approx(0.4507, abs=1e-4) and not end
    assert float(reward) == pytest.approx(2 * 0.691 + 0.5 * 0.5867, abs=2e-3)


def at(qpos):
    """(qpos, qvel) of eight worlds at rest."""
    return np.tile(np.float32(qpos), (8, 1)), np.zeros((8, 10), np.float32)


@pytest.mark.slow
@pytest.mark.ci
def test_observations_and_targets_by_hand(compiled):
    task = compiled("FrankaCabinet")
    model = task.env.mj_model
    qpos, qvel = at(np.append(HOME, 0.2))
    qvel[0] = np.arange(10)
    state = task.reset_to(qpos, qvel)
    data = posed(model, qpos[0])
    low, high = model.jnt_range[:9].T
    to_handle = data.site("handle").xpos - data.site("grasp").xpos
    want = [*(2 * (HOME - low) / (high - low) - 1), *(0.1 * np.arange(9)), *to_handle, 0.2, 9.0]
    np.testing.assert_allclose(state.obs["policy"][0], np.clip(want, -5, 5), atol=2e-5)
    np.testing.assert_allclose(state.pipeline_state.task["command"][0], HOME)
    action = np.tile(np.float32([1, -1, 0.5, 0, 1, -1, 0.5, 1, -1]), (8, 1))
    after = task.step(state, action)
    moved = HOME + np.append(0.125 * action[0, :7], 0.0125 * action[0, 7:])
    np.testing.assert_allclose(after.pipeline_state.task["command"][0], np.clip(moved, low, high), rtol=1e-5)


@pytest.mark.slow
def test_mjx_agrees_with_mujoco_in_the_air_and_pulling_the_handle(compiled, both_engines):
    """A second of random targets; and a hand that closes around the handle, pulls, and opens the drawer."""
    env, rng = compiled("FrankaCabinet").env, np.random.default_rng(3)
    targets = HOME + np.cumsum(rng.uniform(-0.05, 0.05, (60, 9)), axis=0)
    targets[:, 7:] = rng.uniform(0, 0.04, (60, 2))
    fast, exact = both_engines(env, np.append(HOME, 0), np.zeros(10), targets)
    np.testing.assert_allclose(fast[0], exact[0], atol=2e-4)
    start, pull = grasping(env.mj_model)
    fast, exact = both_engines(env, start, np.zeros(10), pull)
    np.testing.assert_allclose(fast[0], exact[0], atol=5e-3)
    assert exact[0][-1, 9] > 0.05


def grasping(model):
    """(qpos of a hand around the handle, targets [60, 9] that close it and draw back 15 cm), by inverse kinematics."""

    def solved(joints, place):
        joints = joints.copy()
        for _ in range(200):
            data = posed(model, np.append(joints, [0.03, 0.03]))
            mujoco.mj_comPos(model, data)
            jac = np.zeros((6, model.nv))
            mujoco.mj_jacSite(model, data, jac[:3], jac[3:], model.site("grasp").id)
            turn, error = np.zeros(4), np.zeros(3)
            mujoco.mju_mat2Quat(turn, (POSE @ data.site("grasp").xmat.reshape(3, 3).T).ravel())
            mujoco.mju_quat2Vel(error, turn, 1.0)
            gap = np.concatenate([place - data.site("grasp").xpos, error])
            joints += 0.3 * np.linalg.lstsq(jac[:, :7], gap, rcond=1e-3)[0]
        assert np.abs(gap).max() < 1e-4
        return joints

    bar = HANDLE + [0.0038, -0.01, 0.0095]
    start = solved(np.float64(AT_HANDLE), bar)
    back = solved(start, bar + [0.15, 0, 0])
    share = np.clip((np.arange(60) - 15) / 40, 0, 1)[:, None]
    arm = start + share * (back - start)
    return np.concatenate([start, [0.03, 0.03, 0]]), np.concatenate([arm, np.zeros((60, 2))], axis=1)
