"""Weight that the drives carry unasked, against MuJoCo C's gravcomp."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from tests.effects.truths import edited, moved, physics, truth

LINK = '<geom type="box" pos=".15 .02 .05" euler="20 30 10" size=".15 .03 .05" mass="{}" contype="0" conaffinity="0"/>'
XML = f"""
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body pos="0 0 .5">
      <joint name="lift" type="slide" axis="0 .6 .8" damping="9" armature=".5"/>{LINK.format(1.5)}
      <body pos=".3 0 .1">
        <joint name="elbow" axis="0 1 0" damping="1" armature=".02"/>{LINK.format(0.8)}
        <body pos=".3 0 0"><joint name="wrist" axis="0 .3 1" damping="1"/>{LINK.format(0.4)}</body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="lift"/><motor joint="elbow"/></actuator>
</mujoco>
"""
FREE = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


@pytest.mark.slow
@pytest.mark.ci
def test_is_gravcomp_of_all_bodies():
    """To 1e-4 rad or m; nothing moves at all where all weight is carried."""
    effect = make("gravity_compensation", where="world")
    command = np.zeros((30, 2))
    shares = (0.0, 0.6, 1.0, 1.3)
    q = moved(physics(XML, [effect]), [[s] for s in shares], command)
    for own, share in zip(q, shares, strict=True):
        np.testing.assert_allclose(own, truth(edited(XML, effect, {"world": {"share": share}}), command), atol=1e-4)
    assert np.abs(q[1] - q[0]).max() > 0.05
    assert np.abs(q[2]).max() < 1e-5


def test_what_mujoco_cannot_carry():
    spec = mujoco.MjSpec.from_string
    effect = make("gravity_compensation", where="world")
    assert "free base" in effect.edit(spec(FREE), {"world": {"share": 1.0}})
    assert "negative" in effect.edit(spec(XML), {"world": {"share": -0.3}})
