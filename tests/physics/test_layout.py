"""The layout of theta: the model's parameters, then each effect's at each of its places."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics

XML = """
<mujoco>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom size=".1" mass="1"/>
      <body name="lower" pos="0 0 .5"><joint name="elbow" axis="0 1 0"/><geom size=".1" mass="1"/></body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shoulder"/></actuator>
</mujoco>
"""
MASS = Parameter("mass", 1.1, 0.5, 2.0, attribute="mass", target="upper", kind="body")


@pytest.fixture(scope="module")
def physics():
    gain, friction = make("actuator_gain", where="motor"), make("stribeck_friction", where=("elbow", "shoulder"))
    tied = make("viscous_friction", where="all")
    return Physics(mujoco.MjModel.from_xml_string(XML), 0.02, ParameterSpace([MASS]), [gain, friction, tied])


def test_blocks_follow_each_other_and_are_all_of_theta(physics):
    shown = [(b.effect and b.effect.name, b.place, b.start, b.stop) for b in physics.blocks]
    assert shown == [
        (None, "", 0, 1), ("actuator_gain", "motor", 1, 2), ("stribeck_friction", "elbow", 2, 5),
        ("stribeck_friction", "shoulder", 5, 8), ("viscous_friction", "all", 8, 9),
    ]  # fmt: skip
    assert tuple(name for b in physics.blocks for name in b.names) == physics.space.names
    assert physics.space.names[3] == "elbow.stribeck_friction." + physics.quantity(3).name
    theta = np.arange(9.0)
    own, parts = physics.split(theta)
    assert [own.tolist(), *(part.tolist() for part in parts)] == [[0], [1], [2, 3, 4, 5, 6, 7], [8]]
    assert [b.start for b in physics.blocks_of(physics.effects[1])] == [2, 5]


def test_neutral_is_the_nominal_model_without_effects(physics):
    quantities = [q for b in physics.blocks for q in b.quantities]
    np.testing.assert_array_equal(physics.neutral, np.float32([1.1, *(q.neutral for q in quantities)]))
    assert physics.quantity(1).neutral == 1.0  # a gain
