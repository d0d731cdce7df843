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
