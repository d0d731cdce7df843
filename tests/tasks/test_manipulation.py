"""What tasks of arms share: targets, starts and poses, on a planar arm of two links; and the parts of rewards."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.tasks.manipulation import Manipulation, alignment, angle_between, closeness

ARM = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.01" integrator="implicitfast"/>
<default><joint axis="0 0 1" armature="0.05"/><position kp="50" kv="5" ctrlrange="-1 3"/></default>
<worldbody><body name="upper"><joint name="shoulder" range="-1 3"/><geom size="0.02" pos="0.3 0 0"/>
<body name="lower" pos="0.3 0 0"><joint name="elbow"/><geom size="0.02" pos="0.2 0 0"/><site name="hand" pos="0.2 0 0"/>
</body></body><body name="cube" pos="1 0 0"><freejoint name="cube"/><geom size="0.1"/></body></worldbody>
<actuator><position name="elbow" joint="elbow"/><position name="shoulder" joint="shoulder"/></actuator></mujoco>"""


class Arm(Manipulation):
    control_dt, default_episode_length, observation_names = 0.02, 10, ("nothing",)
    home, spread, smoothing = {"shoulder": 2.9, "elbow": 0.5}, 0.3, 0.25
    xml = ARM

    def spec(self):
        return mujoco.MjSpec.from_string(self.xml)

    def observe(self, world, data, action):
        return {"policy": jnp.zeros(1)}

    def reward(self, before, after, data, action):
        return jnp.zeros(()), jnp.zeros((), bool), {}


class Ramp(Arm):
    rates = (1.0, 10.0)


def test_starts_are_near_home_and_inside_the_limits():
    """Drives are in the order of the actuators: elbow, shoulder. What has no drive starts where the model says."""
    qpos, qvel = (np.asarray(x) for x in jax.vmap(Arm().initial)(jax.random.split(jax.random.PRNGKey(0), 500)))
    assert qpos[:, 0].min() == pytest.approx(2.6, abs=0.01) and qpos[:, 0].max() == 3.0
    assert qpos[:, 1].min() == pytest.approx(0.2, abs=0.01) and qpos[:, 1].max() == pytest.approx(0.8, abs=0.01)
    np.testing.assert_array_equal(qpos[:, 2:], np.tile(np.float32([1, 0, 0, 1, 0, 0, 0]), (500, 1)))
    assert not qvel.any()


def test_targets_move_at_a_rate_or_are_places():
    world = SimpleNamespace(task={"command": jnp.array([0.0, 1.0])})
    world.replace = lambda task: SimpleNamespace(task=task)
    after, command = Ramp().actuate(world, jnp.array([0.5, 1.0]))
    np.testing.assert_allclose(command, [0.01, 1.2], rtol=1e-6)
    assert after.task["command"] is command
    _, command = Arm().actuate(world, jnp.array([-1.0, 0.5]))  # a quarter of the way to the places -1 and 2
    np.testing.assert_allclose(command, [-0.25, 1.25], rtol=1e-6)
    qpos = jnp.array([0.3, -0.4, *[0.0] * 7])
    np.testing.assert_allclose(Arm().at_rest(qpos), [-0.4, 0.3], rtol=1e-6)


def test_targets_at_the_start_are_those_at_which_the_drives_rest():
    """Behind gears and with a spring unlike the gain; by MuJoCo's own forces."""

    class Geared(Arm):
        spring = '<general name="elbow" joint="elbow" gainprm="40" biastype="affine" biasprm="3 -50 -5"/>'
        xml = ARM.replace('<position name="elbow" joint="elbow"/>', spring).replace(
            'joint="shoulder"/></a', 'joint="shoulder" gear="-2" ctrlrange="-6 6"/></a'
        )

    arm = Geared()
    data = mujoco.MjData(arm.mj_model)
    data.qpos[:] = [0.7, -0.4, 1, 0, 0, 1, 0, 0, 0]
    data.ctrl[:] = np.asarray(arm.at_rest(jnp.asarray(data.qpos)))
    mujoco.mj_forward(arm.mj_model, data)
    np.testing.assert_allclose(data.actuator_force, 0, atol=2e-5)
    np.testing.assert_allclose(data.ctrl, [(-3 + 50 * -0.4) / 40, -1.4], rtol=1e-6)


def test_frames_are_those_of_the_state_or_of_the_sensors():
    arm = Arm()
    world = arm.physics.world(arm.space.nominal, jnp.array([0.5, 1.0, 1, 0, 0, 1, 0, 0, 0]))
    world = world.replace(measurement=world.measurement | {"qpos": world.qpos.at[1].set(0.0)})
    (true,), (seen,) = arm.frames(world, "hand"), arm.frames(world, "hand", measured=True)
    for pose, angle in ((true, 1.5), (seen, 0.5)):
        place = [0.3 * np.cos(0.5) + 0.2 * np.cos(angle), 0.3 * np.sin(0.5) + 0.2 * np.sin(angle), 0]
        np.testing.assert_allclose(pose.position, place, atol=1e-6)
        np.testing.assert_allclose(pose.turn[:, 0], [np.cos(angle), np.sin(angle), 0], atol=1e-6)


def test_joints_are_scaled_by_their_limits():
    class Limited(Arm):
        xml = ARM.replace('name="elbow"/><geom', 'name="elbow" range="0 2"/><geom')

    np.testing.assert_allclose(Limited().scaled_joints(jnp.array([1.0, 0.5])), [-0.5, 0.0], atol=1e-6)


def test_parts_of_rewards():
    assert closeness(jnp.float32(0.0), 0.1) == 2 and closeness(jnp.float32(1.0), 0.1) == 0.25
    x, y = jnp.array([1.0, 0, 0]), jnp.array([-0.6, 0.8, 0])
    assert float(alignment(x, y)) == pytest.approx(-0.36) and alignment(x, x) == 1
    for angle in (0.0, 0.4, 2.0, np.pi):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.append(np.cos(angle / 2), np.sin(angle / 2) * np.array([0.6, 0, 0.8])))
        found = angle_between(jnp.eye(3), jnp.asarray(turn.reshape(3, 3), jnp.float32))
        assert float(found) == pytest.approx(angle, abs=2e-3)


def test_bad_names_and_actuators_are_refused():
    class Lost(Arm):
        home = {"wrist": 1.0}

    class Pushed(Arm):
        xml = ARM.replace("</actuator>", '<motor name="push" joint="cube"/></actuator>')

    class Motor(Arm):
        xml = ARM.replace('<position name="elbow"', '<motor name="elbow"')

    with pytest.raises(UserError, match="Motor: actuator elbow pulls to no place; it has to be a position drive"):
        Motor()
    with pytest.raises(UserError, match="Lost: home names the joint 'wrist'; there are: shoulder, elbow, cube"):
        Lost()
    with pytest.raises(UserError, match="Pushed: actuator push has to drive a hinge or a slide"):
        Pushed()
