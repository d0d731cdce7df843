"""ShadowHand: golden numbers of the model, observations, rewards, goals and pushes by hand, both engines."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.errors import UserError
from bayessim_mjx.tasks import shadow_hand

SIZES = {"full_state": 211, "full": 157, "full_no_vel": 77, "openai": 42}
GOAL = np.float32([0, -0.39, 0.56])


@pytest.fixture(scope="module")
def env():
    return registry.make("ShadowHand")


def posed(model, qpos=None):
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data


def turned(angle, axis=(0, 0, 1)):
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.array(axis, float), angle)
    return quat.astype(np.float32)


def world_of(env, quat=(1, 0, 0, 0), place=GOAL, **task):
    """What the parts of the task that do not simulate need of a world."""
    qpos = np.zeros(31, np.float32)
    qpos[24:27], qpos[27:] = place, quat
    task = {"goal": np.float32([1, 0, 0, 0]), "reached": np.array(False), "successes": np.float32(0)} | task
    world = SimpleNamespace(qpos=jnp.asarray(qpos), qvel=jnp.zeros(30), task=task)
    world.replace = lambda **new: SimpleNamespace(**(vars(world) | new))
    return world


def test_golden_numbers_of_the_model(env):
    model = env.mj_model
    assert (model.nq, model.nv, model.nu, model.ntendon) == (31, 30, 20, 4)
    assert env.joint_names == (*shadow_hand.JOINTS, "object") and env.actuator_names == shadow_hand.ACTIONS
    moving = range(3, model.body("object").id)
    assert model.body_mass[moving].sum() == pytest.approx(0.911)
    assert model.body("object").mass[0] == pytest.approx(567 * 0.05**3) and model.body("forearm").mass[0] == 4
    np.testing.assert_array_equal(model.body_gravcomp, [0] + [1] * 26 + [0, 0])  # gravity pulls the cube alone
    np.testing.assert_allclose(model.actuator_ctrlrange, model.jnt_range[model.actuator_trnid[:, 0]])
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], [5, 5] + [1] * 18)
    finger = [0.9, 0.9, 0.7245]
    force = [4.785, 2.175, *finger * 3, 0.9, *finger, 2.3722, 1.45, 0.99, 0.99, 0.81]
    np.testing.assert_allclose(model.actuator_forcerange, np.stack([-np.array(force), force], 1))
    np.testing.assert_allclose(model.dof_damping[:24], [0.5] * 2 + [0.1] * 22)
    np.testing.assert_allclose(model.dof_armature[:24], [0.005] * 2 + [0.001] * 22)
    spread, bend = [-0.349, 0.349], [0, 1.571]
    finger = [spread, bend, bend, bend]
    thumb = [[-1.047, 1.047], [0, 1.222], [-0.209, 0.209], [-0.524, 0.524], [-1.571, 0]]
    ranges = [[-0.489, 0.140], [-0.698, 0.489], *finger * 3, [0, 0.785], *finger, *thumb]
    np.testing.assert_allclose(model.jnt_range[:24], ranges)


def test_golden_poses(env):
    data = posed(env.mj_model)
    want = {"palm": (0, -0.29, 0.49), "ffknuckle": (-0.033, -0.385, 0.49), "mfknuckle": (-0.011, -0.389, 0.49)}
    want |= {"rfknuckle": (0.011, -0.385, 0.49), "lfknuckle": (0.034, -0.378, 0.49), "thbase": (-0.034, -0.319, 0.499)}
    for body, place in want.items():
        np.testing.assert_allclose(data.body(body).xpos, place, atol=1e-6, err_msg=body)
    want = {"ffdistal": (-0.033, -0.467, 0.49), "mfdistal": (-0.011, -0.471, 0.49), "rfdistal": (0.011, -0.467, 0.49)}
    want |= {"lfdistal": (0.034, -0.46, 0.49), "thdistal": (-0.0927, -0.3777, 0.499)}
    for geom, place in want.items():
        np.testing.assert_allclose(data.geom(geom).xpos, place, atol=1e-4, err_msg=geom)
    np.testing.assert_allclose(data.body("object").xpos, [0, -0.39, 0.6], atol=1e-6)
    qpos = env.mj_model.qpos0.copy()
    qpos[[3, 4]] = 1.0, 1.142  # FFJ2, FFJ1 curl the finger upwards
    assert posed(env.mj_model, qpos).body("ffdistal").xpos[2] > 0.52


def test_the_cube_rests_on_the_palm_and_the_last_joints_follow(env):
    """MuJoCo C: two seconds without action, then a half closed hand."""
    model = env.mj_model
    data = posed(model)
    mujoco.mj_step(model, data, nstep=240)
    assert data.qpos[26] == pytest.approx(0.524, abs=2e-3) and abs(data.qvel).max() < 1e-3
    data = posed(model)
    data.qpos[24] = 1.0  # the cube is out of the way
    data.ctrl[:] = 0.5 * model.actuator_ctrlrange[:, 1]
    mujoco.mj_step(model, data, nstep=120)
    for finger in ("FF", "MF", "RF", "LF"):
        first, last = data.joint(f"{finger}J1").qpos[0], data.joint(f"{finger}J0").qpos[0]
        assert 0.7 < first < 0.8 and abs(0.00705 * last - 0.00805 * first) < 1.1e-3


def test_bayessimigs_parameters(env):
    names = env.space.names
    assert len(names) == 32 and names[:4] == tuple(f"T_{finger}J1c_stiffness" for finger in ("FF", "MF", "RF", "LF"))
    assert (
        names[4:7] == ("hand_mass_mult", "forearm_mass_mult", "wrist_mass_mult") and names[29] == "thdistal_mass_mult"
    )
    assert names[30:] == ("object_scale_mult", "object_mass_mult")
    model = env.space.edit(env.spec(), env.space.vector(env.real_parameters)).compile()
    np.testing.assert_allclose(model.tendon_stiffness, 1.8, rtol=1e-6)
    np.testing.assert_allclose(model.body_mass[1:27], 1.8 * env.mj_model.body_mass[1:27], rtol=1e-6)
    assert model.geom("cube").size[0] == pytest.approx(0.045) and model.opt.gravity[2] == -9.81
    assert model.body("object").mass[0] == pytest.approx(0.070875 * 1.8**3 * 1.8, rel=1e-5)


@pytest.mark.parametrize(("variant", "height"), [("isaacgymenvs", 0.1), ("bayessim2021", 0.04)])
def test_resets(variant, height):
    env = registry.make("ShadowHand", variant=variant)
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 2000)))
    low, high = env.mj_model.jnt_range[:24].T
    least = low if variant == "isaacgymenvs" else 2 * low - high
    assert (qpos[:, :24] >= 0.2 * least - 1e-6).all() and (qpos[:, :24] <= 0.2 * high + 1e-6).all()
    np.testing.assert_allclose(qpos[:, :24].mean(0), 0.1 * (least + high), atol=0.02)
    start = np.array([0, -0.39, 0.5 + height])
    np.testing.assert_allclose(qpos[:, 24:27].min(0), start - 0.01, atol=1e-4)
    np.testing.assert_allclose(qpos[:, 24:27].max(0), start + 0.01, atol=1e-4)
    np.testing.assert_allclose(env.goal_place, start - [0, 0, 0.04], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 27:], axis=1), 1, atol=1e-6)
    x, y = 2 * np.arctan2(qpos[:, 28], qpos[:, 27]), 2 * np.arctan2(qpos[:, 29], qpos[:, 27])  # R_x R_y
    product = np.stack([np.cos(x / 2) * np.cos(y / 2), np.sin(x / 2) * np.cos(y / 2)], 1)
    np.testing.assert_allclose(np.abs(product), np.abs(qpos[:, 27:29]), atol=1e-4)
    np.testing.assert_allclose(np.abs(np.sin(x / 2) * np.sin(y / 2)), np.abs(qpos[:, 30]), atol=1e-4)
    assert not qvel.any() and np.histogram(x, 4, (-np.pi, np.pi))[0].min() > 400


def test_sizes_of_observations():
    for kind, size in SIZES.items():
        names = registry.make("ShadowHand", observationType=kind).observation_names
        assert len(names) == len(set(names)) == size, kind
    assert shadow_hand.PARTS["turn"] == tuple(f"cube_from_goal_quaternion_{i}" for i in "xyzw")


def paid(env, angle, place=GOAL, action=None):
    world = env.advance(None, world_of(env, turned(angle), place), None, None)
    reward, ends, metrics = env.reward(None, world, None, jnp.zeros(20) if action is None else action)
    return float(reward), bool(ends), metrics


def test_rewards_by_hand(env):
    action = np.linspace(-1, 1, 20, dtype=np.float32)
    beside = GOAL + np.float32([0.03, 0, 0.04])
    for angle in (0.2, -1.3, np.pi, 2 * np.pi - 0.5):
        apart = min(abs(angle), 2 * np.pi - abs(angle))
        want = -10 * 0.05 + 1 / (apart + 0.1) - 0.0002 * (action**2).sum()
        reward, ends, metrics = paid(env, angle, beside, action)
        assert (reward, ends) == (pytest.approx(want, rel=1e-3), False) and metrics["consecutive_successes"] == 0
    reward, ends, metrics = paid(env, 0.09)
    assert (reward, ends) == (pytest.approx(250 + 1 / 0.19, rel=1e-4), False) and metrics["consecutive_successes"] == 1
    assert not paid(env, 0.11)[2]["consecutive_successes"]
    wide = registry.make("ShadowHand", successTolerance=0.4)
    assert paid(wide, 0.39)[2]["consecutive_successes"] == 1


def test_a_cube_that_falls_ends_the_episode(env):
    away = GOAL - np.float32([0, 0, 0.241])
    reward, ends, _ = paid(env, 1.0, away)
    assert (reward, ends) == (pytest.approx(-2.41 + 1 / 1.1, rel=1e-4), True)
    assert not paid(env, 1.0, GOAL - np.float32([0, 0, 0.239]))[1]
    dear = registry.make("ShadowHand", fallPenalty=-50.0)
    assert paid(dear, 1.0, away)[0] == pytest.approx(-52.41 + 1 / 1.1, rel=1e-4)


def started(env, **task):
    world = world_of(env, key=jax.random.PRNGKey(0), command=jnp.zeros(20), **task)
    return env.actuate(world, jnp.zeros(20))[0]


def test_a_goal_that_is_reached_is_followed_by_another(env):
    """The step that reaches it is still paid for it, and seen with it; the goal changes at the start of the next."""
    world = world_of(env, turned(0.05), key=jax.random.PRNGKey(0), command=jnp.zeros(20), successes=np.float32(3))
    world = env.advance(None, world, None, None)
    assert world.task["reached"] and world.task["successes"] == 4
    np.testing.assert_array_equal(world.task["goal"], [1, 0, 0, 0])
    after = started(env, reached=np.array(True))
    assert abs(after.task["goal"][0]) < 0.99 and np.linalg.norm(after.task["goal"]) == pytest.approx(1, abs=1e-6)
    again = env.advance(None, world_of(env, turned(0.05), **after.task), None, None)
    assert not again.task["reached"] and again.task["successes"] == 0
    np.testing.assert_array_equal(started(env).task["goal"], [1, 0, 0, 0])


def test_actions_are_places_or_rates(env):
    low, high = env.mj_model.actuator_ctrlrange.T
    world = world_of(env, key=jax.random.PRNGKey(0), command=jnp.asarray(0.5 * high, jnp.float32))
    action = np.linspace(-1, 1, 20, dtype=np.float32)
    asked = low + 0.5 * (action + 1) * (high - low)
    np.testing.assert_allclose(env.actuate(world, action)[1], asked, atol=1e-6)
    slow = registry.make("ShadowHand", actionsMovingAverage=0.3)
    np.testing.assert_allclose(slow.actuate(world, action)[1], 0.3 * asked + 0.7 * 0.5 * high, atol=1e-6)
    relative = registry.make("ShadowHand", useRelativeControl=True, dofSpeedScale=6.0)
    np.testing.assert_allclose(
        relative.actuate(world, action)[1], np.clip(0.5 * high + 0.1 * action, low, high), atol=1e-6
    )


def test_pushes_move_the_cube_alone_and_fade():
    env = registry.make("ShadowHand", forceScale=2.0)
    push = np.float32([3, 0, 0])  # m/s^2, in the cube's axes
    world = started(env, push=push, push_chance=np.float32(0))
    faded = push * 0.99 ** (1 / 60 / 0.08)
    np.testing.assert_allclose(world.task["push"], faded, rtol=1e-5)
    np.testing.assert_allclose(world.qvel[24:27], faded / 60, rtol=1e-5)
    assert not world.qvel[:24].any() and not world.qvel[27:].any()
    keys = jax.random.split(jax.random.PRNGKey(1), 4000)
    chances = np.asarray(jax.vmap(lambda key: env.start(key, world_of(env))["push_chance"])(keys))
    assert chances.min() == pytest.approx(0.001, rel=0.05) and chances.max() == pytest.approx(0.1, rel=0.05)
    assert np.median(chances) == pytest.approx(0.01, rel=0.1)

    def pushed(key):
        return env._pushed(world_of(env, push=jnp.zeros(3), push_chance=0.3), key).task["push"]

    drawn = np.asarray(jax.vmap(pushed)(keys))
    hit = drawn.any(axis=1)
    assert hit.mean() == pytest.approx(0.3, abs=0.03) and drawn[hit].std() == pytest.approx(2.0, rel=0.05)


def test_bad_settings():
    for setting, message in {
        ("observationType", "lots"): "allowed are full_state, full, full_no_vel, openai",
        ("actionsMovingAverage", 1.5): "numbers above 0, at most 1",
        ("successTolerance", 0.0): "angles above 0, rad",
        ("forceProbRange", 0.5): r"\[least, most\], above 0 and at most 1",
        ("forceScale", "strong"): "numbers from 0 on",
    }.items():
        with pytest.raises(UserError, match=f"env.{setting[0]} = .*{message}"):
            registry.make("ShadowHand", **dict([setting]))


def test_pictures_show_the_goal_beside_the_hand(env):
    """Its orientation follows from what is seen: the cube's, and how it differs from the goal."""
    observation = np.zeros((2, 211), np.float32)
    observation[:, [env.observation_names.index(name) for name in shadow_hand.PARTS["turn"]]] = [
        isaac(turned(0.0)),
        isaac(turned(0.5)),
    ]
    qpos = np.tile(env.mj_model.qpos0, (2, 1))
    qpos[:, 27:] = turned(0.2)
    marks = env.marks(qpos, observation)
    assert marks.shape == (2, env.mj_model.nmocap, 7)
    np.testing.assert_allclose(marks[:, 0, :3], np.tile(GOAL + np.float32([-0.2, -0.06, 0.12]), (2, 1)), atol=1e-6)
    np.testing.assert_allclose(marks[:, 0, 3:], [turned(0.2), turned(-0.3)], atol=1e-6)


def isaac(quat):
    return np.roll(quat, -1)
