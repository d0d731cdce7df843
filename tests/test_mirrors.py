"""Mirrors declared by name: pairs, signs and joints; what is no mirror is refused by name."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import Mirror, MirrorMap, is_involution, resolve, signed_permutation

BODY = '<body name="{0}"><joint name="{0}" type="{1}"/><geom size="0.1"/></body>'
DRIVES = '<actuator><motor joint="right"/><motor joint="left"/></actuator>'


def model(*joints, free=True, drives=DRIVES):
    inner = "".join(BODY.format(name, kind) for name, kind in joints)
    base = f'<body><freejoint name="base"/><geom size="0.1"/>{inner}</body>' if free else inner
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{base}</worldbody>{drives}</mujoco>")


LEGS = model(("left", "hinge"), ("right", "hinge"), ("tail", "hinge"))
NAMES = ("height", "drift", "left_position", "left_speed", "right_position", "right_speed", "tail_position", "leftover")


def test_names_become_signed_permutations():
    """One way is enough; observations and actions follow their joints; what is not named keeps its place and sign."""
    mirror = Mirror({"left": "-right", "tail": "-tail"}, {"drift": "-drift"}, normal="y")
    maps = resolve(mirror, LEGS, {"policy": NAMES})
    perm, sign = maps.observation["policy"]
    np.testing.assert_array_equal(perm, [0, 1, 4, 5, 2, 3, 6, 7])
    np.testing.assert_array_equal(sign, [1, -1, -1, -1, -1, -1, -1, 1])  # "leftover" does not begin with "left_"
    np.testing.assert_array_equal(maps.action, [[1, 0], [-1, -1]])
    np.testing.assert_array_equal(maps.qpos, [[0, 1, 2, 3, 4, 5, 6, 8, 7, 9], [1, -1, 1, 1, -1, 1, -1, -1, -1, -1]])
    np.testing.assert_array_equal(maps.qvel, [[0, 1, 2, 3, 4, 5, 7, 6, 8], [1, -1, 1, -1, 1, -1, -1, -1, -1]])


def test_what_an_observation_declares_comes_before_its_joint():
    maps = resolve(Mirror({"left": "-right"}, {"left_speed": "right_speed"}, "x"), LEGS, {"policy": NAMES})
    assert maps.observation["policy"][1].tolist() == [1, 1, -1, 1, -1, 1, 1, 1]


@pytest.mark.parametrize(
    "images, message",
    [
        ({"a": "-b", "b": "a"}, "'b' goes to 'a', but 'b' also to"),
        ({"a": "c", "b": "c"}, "'b' goes to 'c', but 'c' also to"),
        ({"a": "b", "b": "c", "c": "a"}, "no pairs"),
        ({"a": "d"}, "there is no 'd'; there are a, b, c"),
    ],
)
def test_what_is_no_involution_is_refused_by_name(images, message):
    with pytest.raises(UserError, match=f"mirror of joints: .*{message}"):
        signed_permutation("abc", images, "joints")


@pytest.mark.parametrize(
    "part", [([1, 2, 0], [1, 1, 1]), ([1, 0, 2], [1, -1, 1]), ([0, 0, 2], [1, 1, 1]), ([0, 1, 2], [1, 1])]
)
def test_maps_given_as_arrays_are_checked_too(part):
    part = tuple(map(np.array, part))
    good = (np.array([1, 0, 2]), np.array([-1, -1, 1]))
    assert is_involution(*good) and not is_involution(*part)
    with pytest.raises(UserError, match="mirror of critic: applied twice it is not the identity"):
        MirrorMap({"policy": good, "critic": part}, good)
    with pytest.raises(UserError, match="mirror of action"):
        MirrorMap({"policy": good}, part)


@pytest.mark.parametrize(
    "mirror, joints, message",
    [
        (Mirror({"left": "rigth"}, normal="y"), [("left", "hinge"), ("right", "hinge")], "there is no 'rigth'"),
        (
            Mirror(observations={"hieght": "-hieght"}, normal="y"),
            [("left", "hinge"), ("right", "hinge")],
            "no 'hieght'",
        ),
        (Mirror(), [("left", "hinge"), ("right", "hinge")], "'base' floats freely: normal = None, expected x, y or z"),
        (Mirror(normal="y"), [("left", "hinge"), ("right", "hinge"), ("neck", "ball")], "'neck' is a ball"),
    ],
)
def test_wrong_declarations_are_refused_by_name(mirror, joints, message):
    with pytest.raises(UserError, match=message):
        resolve(mirror, model(*joints), {"policy": ("height",)})


def side(name, sign):
    """A limb at y = +-0.2 that turns about x and carries a tip; right and left are mirror images in the plane x-z."""
    return (
        f'<body name="{name}" pos="0 {0.2 * sign} 0"><joint name="{name}" type="hinge" axis="1 0 0" range="-1 1"/>'
        f'<geom size="0.1"/><body name="{name}_tip" pos="0 {0.3 * sign} 0"><joint name="{name}_tip" axis="0 1 0"/>'
        f'<geom size="0.05"/><site name="{name}" pos="0 {0.1 * sign} 0"/></body></body>'
    )


def two_sided(actuators, tendons=""):
    """(model, what is shown by the two joints) of two limbs on the world with these actuators."""
    limbs = (
        side("left", 1)
        + side("right", -1)
        + '<site name="top_left" pos="0 .1 1"/><site name="top_right" pos="0 -.1 1"/>'
    )
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{limbs}</worldbody><tendon>{tendons}</tendon><actuator>{actuators}</actuator></mujoco>"
    )


TWO = Mirror(
    {"left": "-right", "left_tip": "right_tip"}
)  # y -> -y: an axis in x turns the other way, one in y does not
SERVOS = (
    '<position name="pl" joint="left" kp="9"/><velocity name="vl" joint="left" kv="2"/>'
    '<position name="pr" joint="right" kp="9"/><velocity name="vr" joint="right" kv="2"/>'
)
FIXED = '<fixed name="{0}"><joint joint="{0}" coef="1"/><joint joint="{0}_tip" coef="{1}"/></fixed>'
ROPE = '<spatial name="rope_{0}"><site site="top_{0}"/><site site="{0}"/></spatial>'
MAPS = {
    "two on a joint": (SERVOS, "", [2, 3, 0, 1], [-1] * 4),
    "gears": ('<motor joint="left" gear="3"/><motor joint="right" gear="-3"/>', "", [1, 0], [1, 1]),
    "gains": (
        '<general joint="left" gainprm="3"/><general joint="right" gainprm="-3"/><motor joint="left_tip"/>'
        '<motor joint="right_tip"/>', "", [1, 0, 3, 2], [1, 1, 1, 1],
    ),
    "fixed tendons": (
        '<motor tendon="left" gear="2"/><motor tendon="right" gear="2"/>',
        FIXED.format("left", 1) + FIXED.format("right", -1), [1, 0], [-1, -1],
    ),
    "spatial tendons": (
        '<motor tendon="rope_left"/><motor tendon="rope_right"/>', ROPE.format("left") + ROPE.format("right"),
        [1, 0], [1, 1],
    ),
    "sites": ('<motor site="right" gear="0 0 1 0 0 0"/><motor site="left" gear="0 0 1 0 0 0"/>', "", [1, 0], [1, 1]),
    "sites across": (
        '<motor site="left" gear="0 1 0 0 0 0"/><motor site="right" gear="0 1 0 0 0 0"/>', "", [1, 0], [-1, -1],
    ),
    "shifted ranges": (
        '<position joint="left" kp="5" ctrlrange="-.2 1"/><position joint="right" kp="5" ctrlrange="-1 .2"/>', "",
        [1, 0], [-1, -1],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", MAPS)
def test_actions_mirror_by_what_actuators_do(case):
    """The map, and MuJoCo's own acceleration: mirrored states and commands give the mirrored one."""
    actuators, tendons, perm, sign = MAPS[case]
    robot = two_sided(actuators, tendons)
    maps = resolve(TWO, robot, {"policy": ("height",)})
    assert maps.action[0].tolist() == perm and maps.action[1].tolist() == sign
    rng, data = np.random.default_rng(1), [mujoco.MjData(robot), mujoco.MjData(robot)]
    for name, size in (("qpos", robot.nq), ("qvel", robot.nv), ("ctrl", robot.nu)):
        setattr(data[0], name, rng.uniform(-0.2, 0.2, size))
    for name, part in (("qpos", maps.qpos), ("qvel", maps.qvel), ("ctrl", maps.action)):
        setattr(data[1], name, part[1] * getattr(data[0], name)[part[0]])
    for one in data:
        mujoco.mj_forward(robot, one)
    np.testing.assert_allclose(data[1].qacc, maps.qvel[1] * data[0].qacc[maps.qvel[0]], atol=1e-9)


@pytest.mark.parametrize(
    "actuators",
    [
        '<motor joint="left"/>',  # the right one is not driven
        '<motor joint="left"/><position joint="right" kp="3"/>',
        '<position joint="left" kp="3" ctrlrange="0 1"/><position joint="right" kp="3" ctrlrange="0 1"/>',
        '<muscle joint="left"/><muscle joint="right"/>',  # both pull to the same side
        '<motor site="left" gear="0 0 1 0 0 0"/><motor site="right" gear="1 0 0 0 0 0"/>',
    ],
)
def test_actuators_without_a_partner_are_refused_by_name(actuators):
    with pytest.raises(UserError, match="mirror: no actuator does to the mirrored robot what 'actuator0' does"):
        resolve(TWO, two_sided(actuators), {"policy": ("height",)})
