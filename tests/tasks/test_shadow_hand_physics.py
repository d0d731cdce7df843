"""ShadowHand in MJX: observations and forces of hands that hold cubes, and both engines side by side."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.compat import program
from bayessim_mjx.physics import mjx
from bayessim_mjx.tasks import shadow_hand

GOAL = np.float32([0, -0.39, 0.56])
TURNED = np.float32([0.1, 0.7, -0.1, 0.7])
TURNED /= np.linalg.norm(TURNED)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def env():
    return registry.make("ShadowHand")


def closing(model, steps):
    """Targets `[steps, 20]` of a hand that closes by 40 % and moves its fingers."""
    time = np.arange(steps)[:, None]
    targets = (
        0.4 * model.actuator_ctrlrange[:, 1] * np.minimum(time / 30, 1) * (1 + 0.2 * np.sin(0.2 * time + np.arange(20)))
    )
    targets[:, :2] = 0
    return targets


def held(model):
    """Seven moments of a hand that closes around a cube, in MuJoCo C, and one with the cube on a fingertip alone."""
    data, states = mujoco.MjData(model), []
    mujoco.mj_step(model, data, nstep=60)
    for target in closing(model, 70):
        data.ctrl[:] = target
        mujoco.mj_step(model, data, nstep=2)
        states.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
    alone = mujoco.MjData(model)
    alone.qpos[24:27] = -0.05, -0.49, 0.5215  # on the side of the first finger
    return [*states[9::10], (alone.qpos.copy(), 0 * alone.qvel, 0 * alone.ctrl)]


def test_observations_of_held_cubes_by_hand(env):
    """Against MuJoCo C in the same states; forces on the finger that alone carries a cube against Newton's laws."""
    model = env.mj_model
    base = env.physics.world(env.space.nominal).replace(fields={})

    def seen(qpos, qvel, ctrl):
        world = base.replace(qpos=qpos, qvel=qvel, measurement={"qpos": qpos, "qvel": qvel}, task={"goal": TURNED})
        data = mjx.forward(env.physics.model, env.physics.data_of(world).replace(ctrl=ctrl))
        return env.observe(world, data, jnp.arange(20) / 20)["policy"], data.qacc

    states = held(model)
    rows = program(jax.vmap(seen), env)(*(np.stack(x).astype(np.float32) for x in zip(*states, strict=True)))
    for (qpos, qvel, ctrl), row in zip(states, rows[0], strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(model, data)
        shown = dict(zip(env.observation_names, np.asarray(row), strict=True))
        for name, value in by_hand(model, data, TURNED).items():
            assert shown[name] == pytest.approx(value, abs=2e-4), name
    qacc = np.asarray(rows[1][-1], float)
    force = -model.body("object").mass[0] * (qacc[24:27] + [0, 0, 9.81])  # of the cube on the finger
    assert force[2] < -0.3
    arm = data.body("object").xpos - data.body("ffdistal").xpos
    moment = np.cross(arm, force) - model.body("object").inertia * qacc[27:30]
    turn = data.body("ffdistal").xmat.reshape(3, 3)
    found = [shown[name] for name in shadow_hand.PARTS["loads"]]
    np.testing.assert_allclose(found[:6], 10 * np.concatenate([force @ turn, moment @ turn]), atol=2e-3, rtol=1e-3)
    np.testing.assert_allclose(found[6:], 0, atol=1e-5)


def by_hand(model, data, goal):
    """{name: number} of what a state shows, but for contacts' forces."""
    low, high = model.jnt_range[:24].T
    cube = data.body("object")
    between, back = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, goal)
    mujoco.mju_mulQuat(between, data.qpos[27:], back)
    states = []
    for tip in shadow_hand.TIPS:
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(tip).id, velocity, 0)
        states += [*data.body(tip).xpos, *isaac(data.body(tip).xquat), *velocity[3:], *velocity[:3]]
    parts = {
        "joints": 2 * (data.qpos[:24] - low) / (high - low) - 1,
        "speeds": 0.2 * data.qvel[:24],
        "torques": 10 * data.qfrc_actuator[:24],
        "cube": [*cube.xpos, *isaac(cube.xquat)],
        "cube_motion": [*data.qvel[24:27], *(0.2 * cube.xmat.reshape(3, 3) @ data.qvel[27:30])],
        "goal": [*GOAL, *isaac(goal)],
        "turn": isaac(between),
        "tip_states": states,
        "actions": np.arange(20) / 20,
    }
    return {name: x for part, values in parts.items() for name, x in zip(shadow_hand.PARTS[part], values, strict=True)}


def isaac(quat):
    return np.roll(quat if quat[0] >= 0 else -quat, -1)


def test_mjx_agrees_with_mujoco_on_a_cube_that_rests_and_one_that_is_held(env, both_engines):
    """A second without action, in which the cube falls on the palm; and hands that close on it and move.

    A box meets a capsule in other points in the two engines: on the edge of the palm the cube rocks by a degree in MJX
    where it lies still in C, and in a moving hand it turns otherwise after half a second.
    """
    model, start = env.mj_model, env.mj_model.qpos0.copy()
    fast, exact = both_engines(env, start, np.zeros(30), np.zeros((60, 20)))
    np.testing.assert_allclose(fast[0][:6], exact[0][:6], atol=1e-5)  # in the air
    np.testing.assert_allclose(fast[0], exact[0], atol=3e-2)
    for engine in (fast, exact):
        assert engine[0][-1, 26] == pytest.approx(0.524, abs=2e-3)
    fast, exact = both_engines(env, exact[0][-1], np.zeros(30), closing(model, 60))
    np.testing.assert_allclose(fast[0][:, :24], exact[0][:, :24], atol=3e-2)
    np.testing.assert_allclose(fast[0][:30, 24:], exact[0][:30, 24:], atol=0.12)
    for engine in (fast, exact):
        assert engine[0][-1, 26] > 0.5 and np.abs(engine[0][-1, :24]).max() > 0.3
