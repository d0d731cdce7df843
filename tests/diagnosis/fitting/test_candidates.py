"""Where the fits of a candidate begin."""

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import enumerate_candidates
from bayessim_mjx.diagnosis.fitting.scales import Scales, ranges
from bayessim_mjx.effects import load, make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics

XML = """
<mujoco>
  <worldbody>
    <body name="link"><joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02"/></body>
  </worldbody>
</mujoco>
"""


TWO = XML.replace(
    "</body>",
    '<body pos="0 0 -.4"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body></body>',
)


def test_no_two_links_carry_the_same_load_or_are_wrong_alike():
    model = mujoco.MjModel.from_xml_string(TWO)
    places = {
        "payload": ("link", "body2"),
        "inertial_parameters": ("link", "body2"),
        "viscous_friction": ("hinge", "joint1"),
    }
    physics = Physics(model, 0.02, ParameterSpace(), [make(name, at) for name, at in places.items()])
    found = {e: {c.where for c in enumerate_candidates(physics) if c.effect == e} for e in places}
    assert found["payload"] == found["inertial_parameters"] == {"link", "body2"}
    assert found["viscous_friction"] == {"hinge", "joint1", "all"}


def test_what_a_data_sheet_states_of_an_effect_is_gaussian():
    """5 % of a body's size, and 10 % of its inertia."""
    model = mujoco.MjModel.from_xml_string(XML)
    scales = Scales(model, *[np.ones(1)] * 6, np.ones(1, bool), np.ones(1, bool), np.ones(2), 0.02, {})
    kind = load("inertial_parameters")
    effect = kind(where="link", parameters=ranges(kind, "link", scales))
    (found,) = enumerate_candidates(Physics(model, 0.02, ParameterSpace(), [effect]))
    sd = [c.precision**-0.5 for c in found.coordinates]
    np.testing.assert_allclose(sd, [*3 * [0.05 * (0.2 + 0.02)], 0.1], rtol=1e-6)
    assert all(c.stated for c in found.coordinates)


def test_a_load_is_tried_at_the_bodys_centre_and_along_each_of_its_axes():
    model = mujoco.MjModel.from_xml_string(XML)
    physics = Physics(model, 0.02, ParameterSpace(), [make("payload", "link")])
    (payload,) = (c for c in enumerate_candidates(physics) if c.effect == "payload")
    masses, places = payload.probes[:, 0], payload.probes[:, 1:]
    assert len(np.unique(masses)) == 4 and len(payload.probes) == 4 * 7
    assert set(np.count_nonzero(np.round(places, 9), axis=1)) == {0, 1}
    assert all((places[:, axis] > 0).any() and (places[:, axis] < 0).any() for axis in range(3))
