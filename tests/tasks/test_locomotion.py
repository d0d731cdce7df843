"""What walking tasks share, on a small robot with two legs, a tail and a waist."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import joints_by_side
from bayessim_mjx.tasks.locomotion import Locomotion

ROBOT = """<mujoco model="robot"><compiler angle="radian" autolimits="true"/><option timestep="0.01"/>
<default><geom size="0.05" contype="0" conaffinity="0"/><position kp="20" ctrlrange="-2 2"/></default>
<worldbody><body name="base" pos="0 0 0.4"><freejoint name="root"/><geom name="belly" size="0.1"/>
<body name="right_leg" pos="0 -0.1 0"><joint name="right_leg" axis="0 -1 0" range="0.2 1"/><geom pos="0 0 -0.2"/></body>
<body name="left_leg" pos="0 0.1 0"><joint name="left_leg" axis="0 1 0" range="-1 -0.2"/><geom pos="0 0 -0.2"/></body>
<body name="tail" pos="-0.1 0 0"><joint name="tail" axis="0 0 1"/><geom pos="-0.1 0 0"/></body>
<body name="waist" pos="0.1 0 0"><joint name="waist" type="slide" axis="1 0 0"/><geom/></body>
</body></worldbody><actuator><position name="right_leg" joint="right_leg"/><position name="left_leg" joint="left_leg"/>
<motor name="tail" joint="tail" ctrlrange="-3 3"/></actuator></mujoco>"""
HALF = 0.5**0.5
RATE = '<intvelocity name="left_leg" kp="3" actrange="-1 1"'
STUCK = '<general gainprm="0" biastype="affine" biasprm="0 -3" name="tail"'


class Robot(Locomotion):
    control_dt, default_episode_length, xml = 0.02, 10, ROBOT
    observations = {"height": 2.0, "gravity": 1.0, "commands": (10.0, 100.0), "own": 3.0, "joints": 1.0, "actions": 1.0}
    rewards = {"velocity": 2.0, "own": 0.5, "actions": -1.0}
    commands, own_names, own_turned = {"command_x": 1.0, "command_yaw": 0.5}, {"own": ("lean", "stretch")}, ("lean",)
    home, spread, speed_spread, reach = {"left_leg": -0.3, "waist": 0.1}, 0.2, 0.5, (0.5, 0.5, 3.0)
    lowest, least_upright, guards, fallen_reward = 0.2, 0.5, ("belly",), -7.0

    def spec(self):
        return mujoco.MjSpec.from_string(self.xml)

    def observe_own(self, view):
        return jnp.stack([view.turn[1, 2], view.qpos[10]])

    def reward_own(self, view):
        return view.qpos[0] - view.start[0]


def world(qpos=(), turn=(1, 0, 0, 0), velocity=(0, 0, 0), spin=(0, 0, 0), **commands):
    place = np.concatenate([qpos or [0, 0, 0.4], turn, [0.5, -0.5, 0.25, 0.3]])
    state = {"qpos": jnp.array(place), "qvel": jnp.array([*velocity, *spin, 1.0, 2, 3, 4])}
    return SimpleNamespace(**state, measurement=state, task={"command_x": 0.5, "command_yaw": -0.5} | commands)


@pytest.fixture(scope="module")
def robot():
    return Robot()


def test_observations_are_the_blocks_in_their_order(robot):
    joints = ("right_leg", "left_leg", "tail", "waist")
    positions, actions = (f"{joint}_position" for joint in joints), (f"{joint}_action" for joint in joints[:3])
    gravity, commands = ("gravity_x", "gravity_y", "gravity_z"), ("command_x", "command_yaw")
    assert robot.observation_names == ("height", *gravity, *commands, "lean", "stretch", *positions, *actions)
    side = world(turn=(HALF, HALF, 0, 0))  # on its right side
    obs = robot.observe(side, None, jnp.array([0.1, 0.2, 0.3]))["policy"]
    joints = [0.5 - 0.2, -0.5 + 0.3, 0.25, 0.3 - 0.1]  # the right leg's home is the nearest to 0 that it can reach
    np.testing.assert_allclose(obs, [0.8, 0, -1, 0, 5, -50, -3, 0.9, *joints, 0.1, 0.2, 0.3], atol=1e-6)


def test_starts_are_near_home_and_inside_the_limits(robot):
    qpos, qvel = (np.asarray(x) for x in jax.vmap(robot.initial)(jax.random.split(jax.random.PRNGKey(0), 1000)))
    np.testing.assert_array_equal(qpos[:, :7], np.tile(np.float32([0, 0, 0.4, 1, 0, 0, 0]), (1000, 1)))
    np.testing.assert_allclose(qpos[:, 7:].min(0), [0.2, -0.5, -0.2, -0.1], atol=0.01)
    np.testing.assert_allclose(qpos[:, 7:].max(0), [0.4, -0.2, 0.2, 0.3], atol=0.01)
    assert not qvel[:, :6].any() and np.abs(qvel[:, 6:]).max() == pytest.approx(0.5, abs=0.01)
    drawn = jax.vmap(lambda key: robot.start(key, None))(jax.random.split(jax.random.PRNGKey(1), 1000))
    assert set(drawn) == {"command_x", "command_yaw"} and abs(drawn["command_yaw"]).max() == pytest.approx(
        0.5, abs=0.01
    )


def test_drives_are_commanded_from_home_and_motors_from_nothing(robot):
    np.testing.assert_allclose(robot.command(jnp.array([1.0, -1.0, 0.5])), [0.2 + 0.5, -0.3 - 0.5, 1.5], atol=1e-6)


DRIVES = {
    "gear": '<position name="d" joint="{}" gear="2"/>',
    "gear that turns round": '<position name="d" joint="{}" gear="-1.5"/>',
    "spring weaker than its gain": '<general name="d" joint="{}" gainprm="30" biastype="affine" biasprm="2 -20 -1"/>',
    "gain that grows": '<general name="d" joint="{}" gear="1.3" gaintype="affine" gainprm="9 4" biastype="affine"'
    ' biasprm="1 -20"/>',
    "lag": '<position name="d" joint="{}" gear="2" timeconst=".1"/>',
    "tendon": '<position name="d" tendon="both" gear="1.4"/>',
    "site": '<position name="d" site="tip" refsite="middle" gear="1 0 2 0 0.5 0"/>',
}


@pytest.mark.parametrize("drive", DRIVES)
def test_a_drive_rests_at_home(drive):
    """MuJoCo's own force of the command at the action 0 is none at home, and some a little beside it."""
    tip = '<geom pos="0 0 -0.2"/><site name="tip" pos=".05 0 -.2"/></body>\n<body name="tail"'
    text = ROBOT.replace('<geom pos="0 0 -0.2"/></body>\n<body name="tail"', tip)
    text = text.replace('<geom name="belly"', '<site name="middle" pos=".1 0 0"/><geom name="belly"')
    tendon = '<tendon><fixed name="both"><joint joint="right_leg" coef="2"/><joint joint="left_leg" coef="-3"/></fixed>'
    own = DRIVES[drive].format("left_leg")
    text = text.replace("<actuator>", f"{tendon}</tendon><actuator>{own}")
    robot = type("Robot", (Robot,), {"xml": text, "sides": None, "reach": 1.0})()
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    data.ctrl[:] = np.asarray(robot.command(jnp.zeros(4)))
    data.act[:] = data.ctrl[: model.na]
    forces = []
    for away in (0.0, 0.1):
        data.qpos[:] = [0, 0, 0.4, 1, 0, 0, 0, 0.2, -0.3 + away, 0, 0.1]
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force.copy())
    np.testing.assert_allclose(forces[0], 0, atol=2e-5)
    assert abs(forces[1][0]) > 0.1 and data.ctrl[3] == 0


def judged(robot, after, belly=0.4, action=(0.1, 0.2, 0.2)):
    places = np.full((robot.mj_model.ngeom, 3), 0.4)
    places[robot.mj_model.geom("belly").id, 2] = belly
    data = SimpleNamespace(geom_xpos=jnp.array(places))
    reward, fallen, metrics = robot.reward(world(), after, data, jnp.array(action))
    return float(reward), bool(fallen), metrics


def test_rewards_are_weighted_sums_and_falls_end_them(robot):
    """Velocities are the base's own: one that has turned to the left runs along +y."""
    turned = world((0.3, 0, 0.4), (HALF, 0, 0, HALF), (0, 1.0, 0))
    parts = {"velocity": 2 * np.exp(-(0.5**2) / 0.25), "own": 0.5 * 0.3, "actions": -0.09}
    reward, fallen, metrics = judged(robot, turned)
    assert (reward, fallen) == (pytest.approx(sum(parts.values()), rel=1e-5), False)
    assert {name: float(metrics[f"reward_{name}"]) for name in parts} == pytest.approx(parts, rel=1e-5)
    assert judged(robot, turned, belly=0.099)[:2] == (-7.0, True)
    assert judged(robot, world((0, 0, 0.19)))[:2] == (-7.0, True)
    assert judged(robot, world(turn=(np.cos(0.55), np.sin(0.55), 0, 0)))[:2] == (-7.0, True)  # 63 degrees
    assert not judged(robot, world(turn=(np.cos(0.5), np.sin(0.5), 0, 0)))[1]


PARTS = {
    "alive": 1.0, "upright": 0.0, "turning": np.exp(-4.0), "torques": 1 + 4 + 9 + 16, "power": 1 + 4 + 9 + 16,
    "actions": 0.09, "bounce": 4.0, "wobble": 0.25 + 0.25,
}  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
def test_parts_of_rewards_by_hand(part):
    class One(Robot):
        rewards, fallen_reward = {part: 1.0}, None

    forces = jnp.array([9.0] * 6 + [1, 2, 3, 4])
    robot, data = One(), SimpleNamespace(geom_xpos=jnp.ones((9, 3)), qfrc_actuator=forces)
    side = world(turn=(HALF, HALF, 0, 0), velocity=(1, 3, -2), spin=(0.5, -0.5, 0.5))
    assert float(robot.reward(world(), side, data, jnp.array([0.1, 0.2, 0.2]))[0]) == pytest.approx(
        PARTS[part], abs=1e-5
    )


def test_the_mirror_follows_from_names_and_axes(robot):
    """The legs' axes are opposite, so that legs that swing alike differ in sign; the waist is its own image."""
    images = {"right_leg": "-left_leg", "tail": "-tail", "waist": "waist"}
    assert joints_by_side(robot.mj_model, ("left", "right")) == images
    assert joints_by_side(robot.mj_model, ("right", "left")) == images
    mirror = robot.mirrors[0]
    signs = dict(zip(robot.observation_names, mirror.observation["policy"][1].tolist(), strict=True))
    turned = {"gravity_y", "command_yaw", "lean", "right_leg_position", "left_leg_position", "tail_position"}
    turned |= {"right_leg_action", "left_leg_action", "tail_action"}
    assert {name for name, sign in signs.items() if sign < 0} == turned
    assert mirror.task == ("command_yaw",) and mirror.action[0].tolist() == [1, 0, 2]
    assert mirror.action[1].tolist() == [-1, -1, -1]


def test_without_sides_there_is_no_mirror_and_odd_axes_are_refused():
    class Odd(Robot):
        xml = ROBOT.replace('name="left_leg" axis="0 1 0"', 'name="left_leg" axis="0 1 1"')

    class Plain(Odd):
        sides = None

    assert Plain().mirrors == ()
    with pytest.raises(UserError, match="the axis of 'left_leg' is not the mirror image of 'right_leg''s"):
        Odd()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"observations": {"lidar": 1.0}}, "observations names 'lidar'; there are: actions, commands, foot_loads, "),
        ({"rewards": {"smile": 1.0}}, "rewards names 'smile'; there are: actions, alive, "),
        ({"commands": {"command_z": 1.0}}, "commands names 'command_z'; there are: command_x, command_y, command_yaw"),
        ({"guards": ("nose",)}, "guards names 'nose'; there are: belly$"),
        ({"home": {"knee": 1.0}}, "home names the joint 'knee'; there are: right_leg, left_leg, tail, waist"),
        (
            {"sides": None, "xml": ROBOT.replace('<position name="left_leg"', RATE)},
            "the command of actuator left_leg is a rate; allowed: <position> and <motor>",
        ),
        (
            {"xml": ROBOT.replace('<motor name="tail"', STUCK)},
            "actuator tail pulls to a place whatever its command",
        ),
        ({"xml": ROBOT.replace("<freejoint", '<joint type="ball"')}, "the first joint has to be a <freejoint>"),
    ],
)
def test_what_is_not_there_is_refused_by_name(wrong, message):
    with pytest.raises(UserError, match=f"Robot: .*{message}"):
        type("Robot", (Robot,), wrong)()
