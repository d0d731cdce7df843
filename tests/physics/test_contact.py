"""Which models can touch anything at all."""

import mujoco
import pytest

from bayessim_mjx.physics.visuals import collides

FLOOR = '<geom type="plane" size="1 1 .1"/>'


def chain(more="", a="", b="", between="", floor=""):
    """Two links, one hanging from the other by `between`."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco>{more}<worldbody>{floor}
        <body name="a" pos="0 0 1"><joint type="hinge"/><geom size=".1" {a}/>
          <body name="m" pos="0 0 -.3">{between}<geom size=".05" contype="0" conaffinity="0" mass=".1"/>
            <body name="b" pos="0 0 -.3"><joint type="hinge"/><geom size=".1" {b}/></body></body></body>
        </worldbody></mujoco>"""
    )


@pytest.mark.parametrize(
    ("model", "touches"),
    [
        (chain(), False),  # m is welded to a: a and b are parent and child
        (chain(between='<joint type="slide"/>'), True),  # with a joint between they are not
        (chain(between='<joint type="slide"/>', a='contype="2" conaffinity="4"'), False),  # classes that do not meet
        (chain(between='<joint type="slide"/>', a='contype="0" conaffinity="1"'), True),  # one way is enough
        (chain(floor=FLOOR), True),  # the world is nobody's parent here
        (chain(floor=FLOOR, more='<option><flag contact="disable"/></option>'), False),
        (
            chain(between='<joint type="slide"/>', more='<contact><exclude body1="a" body2="b"/></contact>'),
            False,
        ),
    ],
)
def test_by_classes_kin_and_exclusion(model, touches):
    assert collides(model) is touches


def test_a_declared_pair_touches_whatever_its_classes():
    xml = """<mujoco><worldbody><geom name="f" type="plane" size="1 1 .1" contype="0" conaffinity="0"/>
      <body pos="0 0 1"><freejoint/><geom name="g" size=".1" contype="0" conaffinity="0"/></body></worldbody>
      {}</mujoco>"""
    assert not collides(mujoco.MjModel.from_xml_string(xml.format("")))
    pair = '<contact><pair geom1="f" geom2="g"/></contact>'
    assert collides(mujoco.MjModel.from_xml_string(xml.format(pair)))
