"""ShadowHand in MJX: observations and forces of hands that hold cubes, and both engines side by side."""

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx.tasks import shadow_hand

GOAL = np.float32([0, -0.39, 0.56])
pytestmark = [pytest.mark.slow, pytest.mark.ci]


def settled(task, steps=90):
    """Worlds in which the cube has fallen into the hands, which then close a little."""
    keys = jax.random.split(jax.random.PRNGKey(4), task.worlds)
    state = task.reset(keys, np.tile(task.env.space.nominal, (task.worlds, 1)))
    low, high = task.env.mj_model.actuator_ctrlrange.T
    for k in range(steps):
        targets = np.where(np.isin(shadow_hand.ACTIONS, ("WRJ1", "WRJ0")), 0, min(k / 60, 1) * 0.35 * high)
        action = 2 * (targets - low) / (high - low) - 1
        state = task.step(state, np.tile(np.float32(action), (task.worlds, 1)))
    return state, action


def test_observations_by_hand(compiled):
    """Of hands that hold cubes: against MuJoCo C in the same state; forces where nothing moves any more."""
    task = compiled("ShadowHand")
    env, model = task.env, task.env.mj_model
    state, action = settled(task)
    names, held = env.observation_names, 0
    for i in range(task.worlds):
        world = jax.tree.map(lambda x, i=i: np.asarray(x[i], np.float64), state.pipeline_state)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = world.qpos, world.qvel, world.task["command"]
        mujoco.mj_forward(model, data)
        seen = dict(zip(names, np.asarray(state.obs["policy"][i]), strict=True))
        want = by_hand(model, data, world.task["goal"]) | dict(zip(shadow_hand.PARTS["actions"], action, strict=True))
        for name, value in want.items():
            assert seen[name] == pytest.approx(np.clip(value, -5, 5), abs=2e-4), name
        if np.abs(world.qvel).max() < 0.02 and data.ncon:
            held += 1
            for name, value in loads(model, data).items():
                assert seen[name] == pytest.approx(np.clip(value, -5, 5), abs=0.05), name
    assert held > 2


def by_hand(model, data, goal):
    """{name: number} of what a state shows."""
    low, high = model.jnt_range[:24].T
    cube = data.body("object")
    want = dict(zip(shadow_hand.PARTS["joints"], 2 * (data.qpos[:24] - low) / (high - low) - 1, strict=True))
    want |= dict(zip(shadow_hand.PARTS["speeds"], 0.2 * data.qvel[:24], strict=True))
    spin = cube.xmat.reshape(3, 3) @ data.qvel[27:30]
    want |= dict(zip(shadow_hand.PARTS["cube_motion"], [*data.qvel[24:27], *(0.2 * spin)], strict=True))
    want |= dict(zip(shadow_hand.PARTS["cube"], [*cube.xpos, *isaac(cube.xquat)], strict=True))
    want |= dict(zip(shadow_hand.PARTS["goal"], [*GOAL, *isaac(goal)], strict=True))
    between, back = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, goal)
    mujoco.mju_mulQuat(between, data.qpos[27:], back)
    want |= dict(zip(shadow_hand.PARTS["turn"], isaac(between), strict=True))
    states = []
    for tip in shadow_hand.TIPS:
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(tip).id, velocity, 0)
        states += [*data.body(tip).xpos, *isaac(data.body(tip).xquat), *velocity[3:], *velocity[:3]]
    return want | dict(zip(shadow_hand.PARTS["tip_states"], states, strict=True))


def isaac(quat):
    return np.roll(quat if quat[0] >= 0 else -quat, -1)


def loads(model, data):
    """{name: number} of torques of drives and forces on fingertips, x 10."""
    want = dict(zip(shadow_hand.PARTS["torques"], 10 * data.qfrc_actuator[:24], strict=True))
    total = {tip: np.zeros(6) for tip in shadow_hand.TIPS}
    for i, contact in enumerate(data.contact):
        force = np.zeros(6)
        mujoco.mj_contactForce(model, data, i, force)
        push = contact.frame.reshape(3, 3).T @ force[:3]  # on the second geom
        for geom, sign in zip(contact.geom, (-1, 1), strict=True):
            body = model.body(model.geom_bodyid[geom]).name
            if body in total:
                turn = data.body(body).xmat.reshape(3, 3)
                moment = np.cross(contact.pos - data.body(body).xpos, sign * push)
                total[body] += np.concatenate([turn.T @ (sign * push), turn.T @ moment])
    return want | dict(zip(shadow_hand.PARTS["loads"], 10 * np.concatenate(list(total.values())), strict=True))


def test_mjx_agrees_with_mujoco_on_a_cube_that_rests_and_one_that_is_held(compiled, both_engines):
    """A second without action; and hands that close on the cube and move."""
    env = compiled("ShadowHand").env
    model, start = env.mj_model, env.mj_model.qpos0.copy()
    fast, exact = both_engines(env, start, np.zeros(30), np.zeros((60, 20)))
    np.testing.assert_allclose(fast[0], exact[0], atol=1e-3)
    assert fast[0][-1, 26] == pytest.approx(0.524, abs=2e-3) and np.abs(fast[1][-1]).max() < 1e-2
    high, time = model.actuator_ctrlrange[:, 1], np.arange(60)[:, None]
    targets = 0.4 * high * np.minimum(time / 30, 1) * (1 + 0.2 * np.sin(0.2 * time + np.arange(20)))
    targets[:, :2] = 0
    fast, exact = both_engines(env, exact[0][-1], np.zeros(30), targets)
    np.testing.assert_allclose(fast[0], exact[0], atol=2e-2)
    assert exact[0][-1, 26] > 0.5 and np.abs(exact[0][-1, :24]).max() > 0.3
