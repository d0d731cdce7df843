"""Where the fits of a candidate begin."""

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import enumerate_candidates
from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics

XML = """
<mujoco>
  <worldbody>
    <body name="link"><joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02"/></body>
  </worldbody>
</mujoco>
"""


def test_a_load_is_tried_at_the_bodys_centre_and_along_each_of_its_axes():
    model = mujoco.MjModel.from_xml_string(XML)
    physics = Physics(model, 0.02, ParameterSpace(), [make("payload", "link")])
    (payload,) = (c for c in enumerate_candidates(physics) if c.effect == "payload")
    masses, places = payload.probes[:, 0], payload.probes[:, 1:]
    assert len(np.unique(masses)) == 4 and len(payload.probes) == 4 * 7
    assert set(np.count_nonzero(np.round(places, 9), axis=1)) == {0, 1}
    assert all((places[:, axis] > 0).any() and (places[:, axis] < 0).any() for axis in range(3))
