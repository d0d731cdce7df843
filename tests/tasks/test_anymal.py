"""Anymal: golden numbers of the model, observations and rewards by hand, standing, both engines."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry

HOME = np.array([0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8])
LEGS = ("LF", "LH", "RF", "RH")
YAW = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])  # a quarter turn to the left
HALF = 0.5**0.5


@pytest.fixture(scope="module")
def env():
    return registry.make("Anymal")


def posed(model, joints, height=0.0):
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:] = [0, 0, height, 1, 0, 0, 0], joints
    mujoco.mj_kinematics(model, data)
    return data


def test_golden_numbers_of_the_model(env):
    model = env.mj_model
    assert (model.nq, model.nv, model.nu, model.body_mass.sum()) == (19, 18, 12, pytest.approx(52.135, abs=1e-3))
    bodies = [f"{leg}_{link}" for leg in LEGS for link in ("HIP", "THIGH", "SHANK")]
    assert [model.body(i).name for i in range(1, model.nbody)] == ["base", *bodies]
    assert (
        env.joint_names[1:] == env.actuator_names == tuple(f"{leg}_{j}" for leg in LEGS for j in ("HAA", "HFE", "KFE"))
    )
    np.testing.assert_allclose(model.body_mass[2:5], [2.781, 3.071, 0.58842])
    data = posed(model, 0.0)
    np.testing.assert_allclose(data.geom("LF_FOOT").xpos, [0.4478, 0.3012, -0.6005], atol=5e-5)
    data = posed(model, HOME)
    for leg, sign in zip(LEGS, ((1, 1), (-1, 1), (1, -1), (-1, -1)), strict=True):
        place = [0.4527 * sign[0], 0.3166 * sign[1], -0.5127]
        np.testing.assert_allclose(data.geom(f"{leg}_FOOT").xpos, place, atol=5e-5)
    rolls = [model.joint(f"{leg}_HAA").range for leg in LEGS]
    np.testing.assert_allclose(rolls, [[-0.72, 0.49]] * 2 + [[-0.49, 0.72]] * 2)
    assert model.jnt_limited.sum() == 4
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 85)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1:3], [[-85, -2]] * 12)
    np.testing.assert_allclose(model.actuator_forcerange, [[-80, 80]] * 12)
    touching = [model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i]]
    assert touching == [f"{leg}_FOOT" for leg in LEGS] and model.npair == 0
    np.testing.assert_allclose(env.command(np.linspace(-1, 1, 12)), HOME + 0.5 * np.linspace(-1, 1, 12), atol=1e-6)


def test_left_and_right_are_mirror_images(env):
    """Accelerations of the mirrored robot are the mirrored ones, on the ground, to rounding."""
    model, mirror = env.spec().compile(), env.mirrors[0]
    data, rng, found = mujoco.MjData(model), np.random.default_rng(0), []
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    qpos = np.concatenate([[0, 0, 0.5], [0.99, 0.05, 0.1, -0.02], HOME + rng.uniform(-0.1, 0.1, 12)])
    qvel, ctrl = rng.uniform(-0.5, 0.5, 18), rng.uniform(-1, 1, 12)

    def image(x, part):
        return part[1] * x[part[0]]

    for q, v, u in (
        (qpos, qvel, ctrl),
        tuple(map(image, (qpos, qvel, ctrl), (mirror.qpos, mirror.qvel, mirror.action))),
    ):
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = q, v, u, 0
        mujoco.mj_forward(model, data)
        assert data.ncon >= 1
        found.append(data.qacc.copy())
    np.testing.assert_allclose(found[1], image(found[0], mirror.qvel), rtol=1e-6, atol=1e-6)


def test_bayessimigs_parameters_are_the_masses_of_the_links(env):
    assert env.space.names == tuple(f"{env.mj_model.body(i).name}_mass_mult" for i in range(1, 14))
    assert list(env.real_parameters) == [4.0, 0.2, 0.2] + [1.0] * 10
    real = env.space.edit(env.spec(), env.space.vector(env.real_parameters)).compile()
    assert real.body_mass.sum() == pytest.approx(52.13485 + 3 * 26.37317 - 0.8 * (2.781 + 3.071), rel=1e-5)
    np.testing.assert_allclose(real.body("base").inertia, 4 * env.mj_model.body("base").inertia, rtol=1e-5)


def test_the_variants_differ_in_their_control_step(env):
    """50 s in steps of 0.02 s or of 1/60 s, each of four timesteps; a length that is given holds."""
    other = registry.make("Anymal", variant="bayessim2021")
    assert (env.dt, env.physics.substeps, env.episode_length) == (0.02, 4, 2500)
    assert (other.dt, other.physics.substeps, other.episode_length) == (1 / 60, 4, 3000)
    assert registry.make("Anymal", episodeLength=9).episode_length == 9


def test_resets(env):
    qpos, qvel = (np.asarray(x) for x in jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 2000)))
    np.testing.assert_allclose(qpos[:, :7], np.tile(np.float32([0, 0, 0.62, 1, 0, 0, 0]), (2000, 1)))
    ratio = qpos[:, 7:] / HOME
    assert ratio.min() == pytest.approx(0.5, abs=2e-3) and ratio.max() == pytest.approx(1.5, abs=2e-3)
    assert not qvel[:, :6].any() and qvel[:, 6:].std() == pytest.approx(0.1 / 3**0.5, rel=0.02)
    drawn = jax.vmap(lambda key: env.start(key, None))(jax.random.split(jax.random.PRNGKey(1), 2000))
    for name, most in (("command_x", 2), ("command_y", 1), ("command_yaw", 1)):
        assert drawn[name].std() == pytest.approx(most / 3**0.5, rel=0.05) and abs(drawn[name]).max() <= most


COMMANDS = {"command_x": 1.5, "command_y": -0.5, "command_yaw": 0.25}


def test_observations_by_hand(env):
    """Of a base that has turned by a quarter to the left, and of one that lies on its left side."""
    qpos, qvel = np.concatenate([[0, 0, 0.5, HALF, 0, 0, HALF], HOME + 0.1]), np.full(18, 2.0)
    qvel[:6] = [1.0, 2.0, 3.0, 0.4, 0.5, 0.6]
    world = SimpleNamespace(measurement={"qpos": jnp.array(qpos), "qvel": jnp.array(qvel)}, task=COMMANDS)
    action = np.linspace(-1, 1, 12, dtype=np.float32)
    obs = env.observe(world, None, action)["policy"]
    np.testing.assert_allclose(obs[:12], [4, -2, 6, 0.1, 0.125, 0.15, 0, 0, -1, 3, -1, 0.0625], atol=1e-5)
    np.testing.assert_allclose(obs[12:36], [0.1] * 24, atol=1e-6)
    np.testing.assert_allclose(obs[36:], action)
    world.measurement["qpos"] = world.measurement["qpos"].at[3:7].set(jnp.array([HALF, -HALF, 0, 0]))
    np.testing.assert_allclose(env.observe(world, None, action)["policy"][6:9], [0, 1, 0], atol=1e-6)
    assert env.observation_clip == {"isaacgymenvs": 5.0, "bayessim2021": 100.0}


@pytest.mark.parametrize(("variant", "dt"), [("isaacgymenvs", 0.02), ("bayessim2021", 1 / 60)])
def test_rewards_by_hand(variant, dt):
    """Exact tracking pays 1.5 a second less torques; rewards are never negative; a knee in the ground is the end."""
    env = registry.make("Anymal", variant=variant)
    places = posed(env.mj_model, HOME, 0.55).geom_xpos
    torques = np.concatenate([np.zeros(6), np.linspace(-20, 20, 12)])

    def judged(velocity, turning, torques=torques, places=places):
        qpos, qvel = np.zeros(19), np.zeros(18)
        qpos[3:7], qvel[:3], qvel[5] = [HALF, 0, 0, HALF], YAW @ velocity, turning
        world = SimpleNamespace(qpos=jnp.array(qpos), qvel=jnp.array(qvel), task=COMMANDS)
        data = SimpleNamespace(qfrc_actuator=jnp.array(torques), geom_xpos=jnp.array(places))
        reward, end, _ = env.reward(world, world, data, None)
        return float(reward), bool(end)

    cost = 2.5e-5 * (torques**2).sum()
    assert judged([1.5, -0.5, 0.7], 0.25) == (pytest.approx(dt * (1.5 - cost), rel=1e-5), False)
    want = dt * (np.exp(-(0.3**2 + 0.4**2) / 0.25) + 0.5 * np.exp(-(0.2**2) / 0.25) - cost)
    assert judged([1.2, -0.1, 0.0], 0.45)[0] == pytest.approx(want, rel=1e-5)
    assert judged([-2.0, 1.0, 0.0], -1.0, 20 * torques)[0] == 0.0
    knee = env.mj_model.geom("RH_knee_guard").id
    for height, end in ((0.0651, False), (0.0649, True)):
        low = places.copy()
        low[knee, 2] = height
        assert judged([1.5, -0.5, 0.0], 0.25, places=low) == (pytest.approx(dt * (1.5 - cost), rel=1e-5), end)


def test_spheres_that_end_an_episode(env):
    """None of them is in the ground while the robot stands or crouches; one is when it lies on belly, side or back."""
    model = env.mj_model
    guards = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_guard")]
    assert len(guards) == 13

    def lowest(joints, height, quat):
        data = posed(model, joints, height)
        data.qpos[3:7] = quat
        mujoco.mj_kinematics(model, data)
        return (data.geom_xpos[guards, 2] - model.geom_size[guards, 0]).min()

    crouching = HOME * np.tile([1, 2.0, 2.0], 4)
    upright = [1, 0, 0, 0]
    assert lowest(HOME, 0.54, upright) > 0.15 and lowest(crouching, 0.38, upright) > 0
    assert (
        lowest(HOME, 0.085, upright) < 0
        and lowest(HOME, 0.2, [HALF, HALF, 0, 0]) < 0
        and lowest(HOME, 0.2, [0, 1, 0, 0]) < 0
    )


def stood(qpos, dt):
    """Checks that a robot dropped onto its feet stands, qpos `[T, 19]` over 10 s."""
    qpos = np.asarray(qpos)
    late = qpos[round(2 / dt) :]
    assert late[:, 2].min() > 0.47 and late[:, 2].max() < 0.53  # m
    assert late[0, 2] - late[-1, 2] < 0.025  # friction is regularised: legs slide apart by less than 2 mm/s
    assert np.abs(late[:, :2]).max() < 0.01 and late[:, 3].min() > 0.999


def test_it_stands_without_an_action(env):
    model, data, heights = env.mj_model, posed(env.mj_model, HOME, 0.62), []
    data.ctrl[:] = HOME
    for _ in range(500):
        mujoco.mj_step(model, data, env.physics.substeps)
        heights.append(data.qpos.copy())
    stood(heights, env.dt)


@pytest.mark.slow
@pytest.mark.ci
def test_mjx_agrees_with_mujoco_and_stands_too(both_engines):
    """Ten seconds without an action; then random targets from standing, until the first small contact is another."""
    env, rng = registry.make("Anymal"), np.random.default_rng(3)
    start = np.concatenate([[0, 0, 0.62, 1, 0, 0, 0], HOME])
    fast, exact = both_engines(env, start, np.zeros(18), np.tile(HOME, (500, 1)))
    np.testing.assert_allclose(fast[0][:50], exact[0][:50], atol=5e-3)
    np.testing.assert_allclose(fast[0][-1], exact[0][-1], atol=2e-2)
    stood(fast[0], env.dt)
    targets = np.tile(HOME, (500, 1))
    targets[:20] += 0.3 * rng.uniform(-1, 1, (20, 12))
    start = exact[0][100]
    fast, exact = both_engines(env, start, np.zeros(18), targets)
    np.testing.assert_allclose(fast[0][:14], exact[0][:14], atol=5e-3)
